"""Every hook has a test of its name; observers cannot stop a run."""

import inspect

import pytest
from helpers_plugins import install

from oodd_eval import hookspecs, load_split
from oodd_eval.hookspecs import hookimpl
from oodd_eval.plan import make_plan
from oodd_eval.plugins import discover
from oodd_eval.runner import Settings, run

HOOKS = [name for name in vars(hookspecs) if name.startswith("oodd_")]


class Recorder:
    def __init__(self):
        self.calls = []

    @hookimpl
    def oodd_run_started(self, plan):
        self.calls.append(("started", plan.cells))

    @hookimpl
    def oodd_cell_finished(self, record, resumed):
        self.calls.append(("cell", record.cell, resumed))

    @hookimpl
    def oodd_run_finished(self, plan, records, interrupted):
        self.calls.append(("finished", plan.cells, [r.cell for r in records], interrupted))


@pytest.fixture
def watched(tiny_split):
    """Run the clock on two anomalies with some plug-ins, and return what a recorder heard."""

    def carry_out(plugins=None, *observers):
        plugins = plugins or discover()
        recorder = Recorder()
        for number, observer in enumerate((recorder, *observers)):
            plugins.observe(observer, f"observer {number}")
        split = load_split(tiny_split)
        plan = make_plan(
            plugins, split=split.name, split_digest=split.digest, detectors=["clock"],
            environments=["cartpole"], anomalies=["iid", "gravity"],
        )  # fmt: skip
        done = run(plan, split, plugins, Settings(jobs=1))
        return recorder.calls, plan, done

    return carry_out


def test_every_hook_has_a_test_of_its_name():
    assert len(HOOKS) == 4
    assert {f"test_{name}" for name in HOOKS} <= set(globals())


@pytest.mark.parametrize("name", HOOKS)
def test_every_hook_says_when_it_is_called(name):
    assert "Called" in inspect.getdoc(getattr(hookspecs, name))


def test_oodd_detectors(monkeypatch, tmp_path):
    code = """
    @hookimpl
    def oodd_detectors(): return offer(mine=Good)
    """
    install(monkeypatch, tmp_path, "mine", code)
    assert discover().offer("mine").distribution == "oodd-mine"


def test_oodd_detectors_may_return_none(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "none", "@hookimpl\ndef oodd_detectors(): return None")
    assert discover().broken == []


def test_oodd_run_started(watched):
    calls, plan, _ = watched()
    assert calls[0] == ("started", plan.cells)
    assert [c[0] for c in calls].count("started") == 1


def test_oodd_cell_finished(watched):
    calls, plan, _ = watched()
    assert calls[1:-1] == [("cell", cell, False) for cell in plan.cells]


def test_oodd_run_finished(watched):
    calls, plan, _ = watched()
    assert calls[-1] == ("finished", plan.cells, plan.cells, False)


def test_an_observer_may_take_fewer_arguments(watched):
    class Terse:
        heard = 0

        @hookimpl
        def oodd_cell_finished(self):
            self.heard += 1

    terse = Terse()
    watched(None, terse)
    assert terse.heard == 2


@pytest.mark.parametrize("hook", [name for name in HOOKS if name != "oodd_detectors"])
def test_an_installed_observer_that_raises_is_noted_and_the_run_goes_on(
    watched, monkeypatch, tmp_path, hook
):
    install(monkeypatch, tmp_path, "moody", f"@hookimpl\ndef {hook}(): raise ValueError('no')")
    plugins = discover()
    calls, _, done = watched(plugins)
    assert [(b.plugin, b.distribution, b.reason) for b in plugins.broken] == [
        ("moody", "oodd-moody", f"hook {hook} failed: ValueError: no")
    ]
    assert [r.status for r in done.records] == ["ok", "ok"]
    assert calls[-1][0] == "finished"


def test_an_observer_of_the_program_may_raise(watched):
    class Wrong:
        @hookimpl
        def oodd_run_started(self):
            raise RuntimeError("a bug of ours")

    with pytest.raises(RuntimeError, match="a bug of ours"):
        watched(None, Wrong())

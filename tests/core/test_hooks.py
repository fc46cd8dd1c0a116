"""Hooks of plug-ins are called and checked; observers cannot stop a run."""

import sys

import pytest
from helpers_own import BASIN
from helpers_plugins import install

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.errors import PluginError
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.discovery import discover
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run


class Recorder:
    def __init__(self):
        self.calls = []

    @hookimpl
    def oodd_run_started(self, plan):
        self.calls.append(("started", plan.cells))

    @hookimpl
    def oodd_unit_started(self, unit):
        self.calls.append(("unit", unit))

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
        split = load_split(tiny_split)
        plan = make_plan(
            plugins, split=split, detectors=["clock"],
            environments=["cartpole"], anomalies=["iid", "gravity"],
        )  # fmt: skip
        done = run(plan, split, plugins, RunSettings(jobs=1), observers=[recorder, *observers])
        return recorder.calls, plan, done

    return carry_out


def test_oodd_detectors(monkeypatch, tmp_path):
    code = """
    @hookimpl
    def oodd_detectors(): return offer(mine=Good)
    """
    install(monkeypatch, tmp_path, "mine", code)
    assert discover().offer("mine").distribution == "oodd-mine"


def test_oodd_environments_and_anomalies(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "basin", BASIN, header="")
    plugins = discover(only=["basin"])
    specs = plugins.custom_specs
    (valve,), (seep,) = specs.meanings("basin/valve"), specs.meanings("seep")
    assert plugins.origin(valve.plugin) == "plug-in 'basin' of oodd-basin"
    assert [quantity.name for quantity in valve.actions] == ["close", "open"]
    assert (seep.group, seep.bound) == ("dynamics", 3.0)


MAKER = """
    class Made(Good):
        pass

    @hookimpl
    def oodd_detector_from_spec(spec):
        \"\"\"mine:N: a detector of the number N.

        More of it.
        \"\"\"
        kind, _, number = spec.partition(":")
        if kind != "mine":
            return None
        return DetectorSpec(f"mine:{int(number)}", Made, "a test's", version="lib.2")
    """


def test_oodd_detector_from_spec(monkeypatch, tmp_path, capsys):
    install(monkeypatch, tmp_path, "maker", MAKER)
    plugins = discover()
    assert "mine:7" not in plugins.offers
    offer = plugins.offer("mine:07")
    assert (offer.spec.name, offer.plugin, offer.module) == ("mine:7", "maker", "oodd_maker")
    assert (offer.distribution, offer.version) == ("oodd-maker", "1.0+lib.2")
    assert plugins.offer("mine:7") is offer
    assert plugins.select("clock, mine:8,mine:07") == ["clock", "mine:8", "mine:7"]
    assert main(["list", "detectors"]) == 0
    (line,) = [n for n in capsys.readouterr().out.splitlines() if n.startswith("(maker)")]
    assert " ".join(line.split()) == "(maker) oodd-maker 1.0 mine:N: a detector of the number N"


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ("1 / 0", "'odd' of oodd-odd failed to make .*'odd:1': ZeroDiv"),
        ('"text"', "expected None or a DetectorSpec whose name has a colon"),
        ('DetectorSpec("rf", Good, "")', "expected None or a DetectorSpec whose name has a colon"),
    ],
)
def test_a_plugin_that_makes_no_detector_is_named(monkeypatch, tmp_path, made, message):
    code = f"@hookimpl\ndef oodd_detector_from_spec(spec): return {made} if 'odd' in spec else None"
    install(monkeypatch, tmp_path, "odd", code)
    with pytest.raises(PluginError, match=message):
        discover().offer("odd:1")


def test_observers_hear_of_a_run_in_order(watched):
    calls, plan, _ = watched()
    assert calls == [
        ("started", plan.cells),
        ("unit", plan.units[0]),
        *(("cell", cell, False) for cell in plan.cells),
        ("finished", plan.cells, plan.cells, False),
    ]


TELLS = """
class Tells(Good):
    def fit(self, nominal, progress=None):
        super().fit(nominal)
        progress(0.25)
        self.later = progress
    def score(self, x):
        self.later(0.5)  # when nobody listens any more
        return super().score(x)

@hookimpl
def oodd_detectors(): return offer(tells=Tells, silent=Good)
"""


@pytest.fixture
def tell(tiny_split, monkeypatch, tmp_path):
    """Run a detector of a plug-in, and return its records and the shares that were heard."""

    def carry_out(detector, code=TELLS):
        install(monkeypatch, tmp_path, "talker", code)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        heard, plugins, split = [], discover(), load_split(tiny_split)

        class Listener:
            @hookimpl
            def oodd_fit_progressed(self, unit, share):
                heard.append((unit.environment, share))

        plan = make_plan(plugins, split=split, detectors=[detector], environments=["cartpole"])
        return run(plan, split, plugins, RunSettings(jobs=1), observers=[Listener()]).records, heard

    return carry_out


@pytest.mark.parametrize(("detector", "shares"), [("tells", [0.25, 1.0]), ("silent", [1.0])])
def test_oodd_fit_progressed(tell, detector, shares):
    records, heard = tell(detector)
    assert {record.status for record in records} == {"ok"}
    assert heard == [("cartpole", share) for share in shares]


@pytest.mark.parametrize("share", ["2", "float('nan')"])
def test_a_share_that_is_none_is_the_detectors_error(tell, share):
    (record, *_), _ = tell("tells", TELLS.replace("0.25", share))
    assert (record.status, "progress" in record.reason) == ("invalid", True)


OBSERVES = """
HEARD = []
@hookimpl
def oodd_run_started(): HEARD.append("started")
@hookimpl
def oodd_run_finished(interrupted): HEARD.append(("finished", interrupted))
"""


def install_observer(monkeypatch, path, name, code):
    install(monkeypatch, path, name, code, group="oodd_eval.observers")


@pytest.mark.parametrize("group", ["oodd_eval.observers", "oodd_eval", "both"])
def test_a_plugin_observes_the_runs_that_it_was_loaded_for_once(
    watched, monkeypatch, tmp_path, group
):
    install(
        monkeypatch, tmp_path, "nosy", OBSERVES, group="oodd_eval" if group == "both" else group
    )
    if group == "both":
        points = tmp_path / "oodd_nosy-1.0.dist-info" / "entry_points.txt"
        points.write_text("[oodd_eval]\nnosy=oodd_nosy\n[oodd_eval.observers]\nnosy=oodd_nosy\n")
    if group == "oodd_eval":  # a plug-in of detectors that are not asked for
        watched()
        assert "oodd_nosy" not in sys.modules
    plugins = discover()
    assert plugins.offers
    watched(plugins)
    assert sys.modules["oodd_nosy"].HEARD == ["started", ("finished", False)]


def test_an_observer_can_be_left_out(watched, monkeypatch, tmp_path):
    install_observer(monkeypatch, tmp_path, "nosy", "raise ValueError")
    plugins = discover(["nosy"])
    watched(plugins)
    assert plugins.broken == []
    monkeypatch.setenv("OODD_EVAL_PLUGINS", "riqn")
    assert discover().observer_points == []


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import no_such_module", "ModuleNotFoundError"),
        ("@hookimpl\ndef oodd_run_start(): pass", "did you mean 'oodd_run_started'"),
        ("@hookimpl\ndef oodd_run_started(nothing): pass", "nothing"),
    ],
)
def test_a_broken_observer_is_named_and_harmless(watched, monkeypatch, tmp_path, code, reason):
    install_observer(monkeypatch, tmp_path, "moody", code)
    plugins = discover()
    _, _, done = watched(plugins)
    (found,) = plugins.broken
    assert found.plugin == "moody"
    assert reason in found.reason
    assert [r.status for r in done.records] == ["ok", "ok"]


def test_an_observer_of_the_program_may_raise(watched):
    class Wrong:
        @hookimpl
        def oodd_run_started(self):
            raise RuntimeError("a bug of ours")

    with pytest.raises(RuntimeError, match="a bug of ours"):
        watched(None, Wrong())

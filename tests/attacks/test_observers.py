"""Observers that want to change a result, or to end the run: nothing of either happens."""

import contextlib
import json
import shutil
import sys
from pathlib import Path

import pytest
from helpers_plugins import install

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

VOLATILE = {"seconds_fit", "seconds_score", "peak_rss_mb", "provenance"}


def outcome(tiny_split, output, scores=None, **settings):
    """Records of a run of two detectors, as bytes, those that were written among them.

    Where another run left scores, nothing is fitted: what observers see of cells is the same.
    """
    if scores is not None:
        shutil.copytree(scores, Path(output) / "scores")
    split, plugins = load_split(tiny_split), discover()
    plan = make_plan(
        plugins, split=split, detectors=["clock", "persistence"], environments=["cartpole"],
        anomalies=["iid", "gravity"],
    )  # fmt: skip
    results = ResultsDirectory(output)
    done = run(plan, split, plugins, RunSettings(jobs=1, **settings), results)
    records = [*done.records, *results.records()]
    plain = [json.loads(record.to_json()) for record in records]
    return [{k: v for k, v in p.items() if k not in VOLATILE} for p in plain], plugins.broken


@pytest.fixture(scope="module")
def undisturbed(tiny_split, tmp_path_factory):
    """Records of a run without observers, and where its scores are."""
    output = tmp_path_factory.mktemp("undisturbed")
    return outcome(tiny_split, output)[0], output / "scores"


SET = "object.__setattr__"
CHANGES = {
    "oodd_cell_finished(record)": (
        f"[{SET}(m, 'value', 1.0) for m in record.metrics.values()]",
        "record.metrics['auc_matched'] = None",
        "[terms.fill(9.0) for terms in record.per_trajectory.values()]",
        "record.counts['test'] = 10**6",
        f"{SET}(record, 'detector', 'best')",
        "os.chdir('/')",
    ),
    "oodd_run_started(plan)": (
        "[plan.groups.update({k: 'sensor'}) for k in plan.groups]",
        "[u.parameters.update(x=1) for u in plan.units]",
        "[u.recorded.update(x=1) for u in plan.units]",
        f"[{SET}(u, 'scores_key', '../x') for u in plan.units]",
        f"{SET}(plan, 'units', plan.units[:1])",
        f"{SET}(plan, 'limit', 1)",
    ),
    "oodd_unit_started(unit)": (
        f"{SET}(unit, 'plugin', 'riqn')", "unit.parameters.update(x=1)",
    ),
    "oodd_run_finished(records)": ("records.clear()",),
}  # fmt: skip
"""What an observer may try in a hook, one after the other."""


def install_observer(monkeypatch, path, hook, change):
    code = f"import os\n@hookimpl\ndef {hook}: {change}"
    install(monkeypatch, path / "plugin", "meddler", code, group="oodd_eval.observers")


@pytest.mark.parametrize("hook", CHANGES)
def test_an_observer_that_changes_what_it_gets_changes_nothing(
    tiny_split, undisturbed, monkeypatch, tmp_path, hook
):
    install_observer(monkeypatch, tmp_path, hook, "; ".join(CHANGES[hook]))
    monkeypatch.chdir(tmp_path)
    records, scores = undisturbed
    # Plans and units are observed before anything is fitted.
    found, broken = outcome(tiny_split, "out", scores if "finished" in hook else None)
    assert found == records
    assert [b.reason for b in broken] == []
    assert (tmp_path / "out" / "records.jsonl").exists()


def test_each_observer_gets_a_copy_of_its_own(tiny_split, monkeypatch, tmp_path):
    code = "@hookimpl\ndef oodd_cell_finished(record): record.metrics.clear()"
    install(monkeypatch, tmp_path / "a", "early", code, group="oodd_eval.observers")
    code = """
    SEEN = []
    @hookimpl
    def oodd_cell_finished(record): SEEN.append(len(record.metrics))
    """
    install(monkeypatch, tmp_path / "b", "late", code, group="oodd_eval.observers")
    outcome(tiny_split, tmp_path / "out")
    assert all(sys.modules["oodd_late"].SEEN)


HOOKS = ("oodd_run_started", "oodd_unit_started", "oodd_fit_progressed", "oodd_cell_finished",
         "oodd_run_finished")  # fmt: skip
ENDS = [*((hook, "sys.exit(0)") for hook in HOOKS), (HOOKS[3], "raise GeneratorExit"),
        (HOOKS[3], "raise ValueError('x')")]  # fmt: skip


@pytest.mark.parametrize(("hook", "end"), ENDS)
def test_an_observer_that_leaves_is_noted_and_all_cells_are_done(
    tiny_split, undisturbed, monkeypatch, tmp_path, hook, end
):
    install_observer(monkeypatch, tmp_path, f"{hook}()", f"import sys; {end}")
    records, scores = undisturbed
    kept = None if hook == "oodd_fit_progressed" else scores  # kept scores have no fit
    found, broken = outcome(tiny_split, tmp_path / "out", kept)
    assert found == records
    assert [b.plugin for b in broken] == ["meddler"]


WRAPPERS = {
    "old": "@hookimpl(hookwrapper=True)\ndef oodd_cell_finished():\n    yield\n    sys.exit(0)",
    "new": "@hookimpl(wrapper=True)\ndef oodd_cell_finished():\n    yield\n    sys.exit(0)",
    "never yields": "@hookimpl(wrapper=True)\ndef oodd_cell_finished():\n    return\n    yield",
}


@pytest.mark.parametrize("name", WRAPPERS)
def test_a_wrapper_of_a_hook_that_leaves(tiny_split, undisturbed, monkeypatch, tmp_path, name):
    install(monkeypatch, tmp_path / "plugin", "meddler", WRAPPERS[name],
            group="oodd_eval.observers")  # fmt: skip
    records, scores = undisturbed
    found, broken = outcome(tiny_split, tmp_path / "out", scores)
    assert found == records
    assert [b.plugin for b in broken] == ["meddler"]


def test_a_command_in_which_something_leaves_does_not_end_with_0(tiny_split, monkeypatch, capsys,
                                                                 tmp_path):  # fmt: skip
    class Leaver(contextlib.nullcontext):
        @hookimpl
        def oodd_cell_finished(self):
            sys.exit(0)

    monkeypatch.setattr("oodd_eval.cli.run.TerminalReporter", lambda *_, **__: Leaver())
    command = ["run", "--detector", "clock", "--env", "cartpole", "--split", str(tiny_split),
               "--output", str(tmp_path / "out")]  # fmt: skip
    assert main(command) == 3
    assert "called sys.exit(0)" in capsys.readouterr().err
    assert main(["--version"]) == main(["run", "--help"]) == 0

"""One name for a detector without and with actions: what runs, and what results call it."""

import numpy as np
import pytest
from helpers_plugins import install

from oodd_eval import evaluate, import_frames, load_split
from oodd_eval.cli.main import main
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.plugins.discovery import discover
from oodd_eval.scoring.plan import make_plan

LINEAR = {"panel.forecast": "linear"}
TWO_ROWS = """
@hookimpl
def oodd_detectors():
    mine, = offer(mine=Good)
    actions = replace(mine, name={name!r}, inputs="observations+actions")
    return [replace(mine, with_actions="mine-a"), actions]
"""


def plan_of(detectors=("panel",), split="mini", environments=("hopper",), **settings):
    opened = load_split(split)
    return make_plan(
        discover(), split=opened, detectors=detectors, environments=environments, **settings
    )


def bare_split(tmp_path):
    """Write a split of logs without actions and return its directory."""
    rng = np.random.default_rng(0)
    logs = [rng.normal(size=(40, 2)) for _ in range(30)]
    parts = {"train": logs[:10], "calibration": logs[10:20], "test": {"slip": logs[20:]}}
    return import_frames("bench", **parts, output=tmp_path / "bench", report=len).path


def test_where_there_are_actions_the_row_with_them_runs():
    named, plan = (
        plan_of(["panel-a"], parameters={"forecast": "linear"}),
        plan_of(parameters=LINEAR),
    )
    assert plan.units == named.units
    assert [unit.setting.detector for unit in plan.units] == ["panel-a"]
    assert plan.notes == (
        "panel takes the actions of hopper: row panel-a; --param panel.actions=no leaves them out",
    )
    assert named.notes == ()


def test_actions_are_left_out_on_request_and_the_row_is_the_same_as_ever():
    plan = plan_of(parameters={"actions": "no"})
    [unit] = plan.units
    assert (unit.setting.detector, unit.inputs, plan.notes) == ("panel", "observations", ())
    assert not unit.setting.overrides
    assert "actions" not in unit.recorded


def test_both_rows_run_where_both_are_named():
    plan = plan_of(["panel", "panel-a"])
    assert [unit.setting.detector for unit in plan.units] == ["panel", "panel-a"]
    assert plan.notes == ()


def test_logs_without_actions_have_the_row_without(tmp_path):
    plan = plan_of(split=bare_split(tmp_path), environments=["bench"])
    assert [unit.setting.detector for unit in plan.units] == ["panel"]


@pytest.mark.parametrize(
    ("values", "named"), [({"actions": "never"}, "'auto', 'no'"), ({"forcast": "x"}, "forecast")]
)
def test_wrong_parameters_are_told_of_the_detector_that_was_named(values, named):
    with pytest.raises(UsageError, match=named) as raised:
        plan_of(parameters=values)
    assert "panel-a" not in str(raised.value)


def test_results_name_the_row(tiny_split):
    results = evaluate(
        "panel", tiny_split, environments="cartpole", anomalies="iid", parameters=LINEAR
    )
    assert [record.detector for record in results] == ["panel-a"]
    assert results[0].ok


def test_a_run_says_so_in_a_line(capsys):
    assert main(["run", "--detector", "panel", "--env", "ant,hopper", "--collect-only"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.startswith("panel takes the actions of ant and hopper: row panel-a; --param")


def test_rows_of_any_plugin_take_each_others_place(monkeypatch, tmp_path):
    header = "from dataclasses import replace\n"
    install(monkeypatch, tmp_path, "mine", header + TWO_ROWS.format(name="mine-a"))
    assert [u.setting.detector for u in plan_of(["mine"]).units] == ["mine-a"]
    install(monkeypatch, tmp_path, "mine", header + TWO_ROWS.format(name="other"))
    with pytest.raises(UnknownNameError, match="'mine-a'"):
        plan_of(["mine"])


READS = """
def rows(x):
    return np.hstack([x.observations[:-1], x.actions])

class Mine(Good):
    actions = 0
    def fit(self, nominal):
        self.actions = sum(rows(x).shape[1] for x in nominal)

@hookimpl
def oodd_detectors():
    return [DetectorSpec("mine", Mine, ""), DetectorSpec("declares", Mine, "", inputs=BOTH)]

BOTH = "observations+actions"
"""


def test_a_detector_that_reads_actions_and_does_not_declare_them_is_named(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "mine", READS)
    (note,) = plan_of(["mine", "declares", "rf", "mewma-a"]).notes
    assert note == (
        'mine reads actions and is given none: declare inputs="observations+actions" in its spec'
    )


def test_a_detector_that_looks_at_its_own_actions_alone_is_not_named(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "mine", READS.replace(", x.actions", ", self.actions"))
    assert not plan_of(["mine"]).notes


def test_a_detector_with_a_row_for_actions_has_declared_them(monkeypatch, tmp_path):
    """Where both rows are named, the one without actions runs as it is."""
    code = READS.replace('Mine, "")', 'Mine, "", with_actions="declares")')
    install(monkeypatch, tmp_path, "mine", code)
    assert not plan_of(["mine", "declares"]).notes


def test_logs_without_actions_have_none_to_declare(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "plugin", "mine", READS)
    assert not plan_of(["mine"], bare_split(tmp_path), ["bench"]).notes

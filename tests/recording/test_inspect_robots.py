"""The scorers for inspect-robots do what their page says, in the released package."""

import ast
import contextlib
import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_docs import python_blocks
from oodd_live import Watchdog

from oodd_eval.cli.main import main

inspect_robots = pytest.importorskip(
    "inspect_robots", reason="needs inspect-robots, a program of others"
)

EXAMPLE = Path(__file__).parents[2] / "examples" / "oodd-inspect-robots"
README = (EXAMPLE / "README.md").read_text()
GROUPS = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def module():
    """The example, as long as the tests of this file run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE))
        import oodd_inspect_robots

        yield oodd_inspect_robots
        del sys.modules["oodd_inspect_robots"]


@pytest.fixture(scope="module")
def page(module, tmp_path_factory):
    """What the code of the page leaves behind, and the folder in which it ran."""
    folder = tmp_path_factory.mktemp("page")
    record, *judge = python_blocks(README)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("OODD_EVAL_DATA", str(folder / "splits"))
        space = {"printed": []}
        exec(record, space)  # noqa: S102 - the code of a page of this repository
        recipe = re.search(r"```toml\n(.*?)```", README, re.DOTALL)[1]
        (folder / "cube.toml").write_text(recipe)
        assert main(["data", "import", "cube.toml"]) == 0
        exec("\n".join(judge).replace("print(", "printed.append("), space)  # noqa: S102 - the same
    return SimpleNamespace(folder=folder, **space)


def test_the_page_prints_what_the_scorers_find(page):
    shown = "".join(re.findall(r"```text\n(.*?)```", README, re.DOTALL))
    # On another processor an alarm may come a row sooner or later.
    lines = [pytest.approx(ast.literal_eval(line), abs=0.1) for line in shown.splitlines()]
    assert page.printed == lines
    assert all(metrics["success_at_end"] == 1 for metrics in page.printed)
    for healthy, weak in (page.printed[:2], page.printed[2:]):
        assert healthy["oodd_alarm"] <= 0.05 < weak["oodd_alarm"]
        assert weak["oodd_quiet_rows"] < healthy["oodd_quiet_rows"]
    # The first changed observation of the first robot is that of row 4.
    assert page.printed[1]["oodd_quiet_rows"] >= 4


def test_the_command_finds_the_threshold_that_the_page_finds(page, capsys):
    assert main(["calibrate", str(page.folder / "worn.jsonl"), "--score", "missed"]) == 0
    assert f"missed > {page.monitor.rule.threshold:.5g}" in capsys.readouterr().out


def test_a_column_is_judged_row_by_row(page, module, monkeypatch):
    """The row of the alarm is the first whose number is above the threshold."""
    page.monitor.save(page.folder / "missed.npz")
    monkeypatch.setenv("OODD_WATCHDOG", str(page.folder / "missed.npz"))
    monkeypatch.setenv("OODD_COLUMN", "missed")
    scorer = module.quiet_rows()
    for seed in range(5):
        record = trial(page, page.Worn(0.9, seed))
        missed = [
            row.get("missed", -1) > page.monitor.rule.threshold for row in module.rows(record)
        ]
        assert scorer(record, None).value == (missed.index(True) if any(missed) else len(missed))


def test_a_file_of_trials_has_each_of_them_with_its_outcome(page):
    trials = [json.loads(line) for line in (page.folder / "trials.jsonl").read_text().splitlines()]
    assert [trial["scene"] for trial in trials] == [f"cube-{seed}" for seed in range(100)]
    assert all(trial["success"] and trial["task"] == "reach" for trial in trials)
    for trial in trials:
        first, *_, last = trial["steps"]
        assert first["obs:eef_pos_0"] == 0.1
        moved = [row["obs:eef_pos_0"] + row["action:0"] for row in trial["steps"][:-1]]
        assert moved == pytest.approx([row["obs:eef_pos_0"] for row in trial["steps"][1:]])
        assert "action:0" not in last
        assert last["distance"] <= 0.05


def trial(page, robot, seed=5, **parts):
    """The record of a trial, with other parts where some are given."""
    records = []
    sink = SimpleNamespace(
        on_eval_start=lambda spec: None,
        on_trial_start=lambda scene, epoch: None,
        log_step=lambda *step: None,
        on_trial_end=records.append,
        on_eval_end=lambda log: None,
    )
    with contextlib.chdir(page.folder):  # where inspect-robots keeps logs of its own
        page.eval(page.reach("success_at_end", [seed]), page.policy, robot, sinks=[sink])
    return SimpleNamespace(**{**vars(records[0]), **parts})


def test_a_score_says_when_the_alarm_was_raised_and_what_is_promised(page, module):
    record = trial(page, page.Weak())
    scores = [
        make(page.folder / "cube.npz")(record, None) for make in (module.alarm, module.quiet_rows)
    ]
    assert [score.value for score in scores] == [1, scores[0].metadata["first_alarm"]]
    for score in scores:
        assert score.metadata["promise"] == page.watchdog.promise
        assert f"row {score.metadata['first_alarm']}: alarm" in score.explanation
        assert "at most 5 % of nominal episodes" in score.explanation
    healthy = module.quiet_rows(page.watchdog)(trial(page, page.CubePickEmbodiment()), None)
    assert healthy.metadata["first_alarm"] is None
    assert healthy.value == len(module.rows(trial(page, page.CubePickEmbodiment())))
    assert "no alarm" in healthy.explanation


def test_one_scorer_judges_each_trial_for_itself(page, module):
    scorer = module.quiet_rows(page.watchdog)
    records = [trial(page, robot) for robot in (page.Weak(), page.CubePickEmbodiment())]
    alone = [module.quiet_rows(page.watchdog)(record, None).value for record in records]
    assert [scorer(record, None).value for record in records * 2] == alone * 2


def test_a_trial_without_steps_has_no_alarm(page, module):
    record = trial(page, page.CubePickEmbodiment(), steps=[])
    assert module.alarm(page.watchdog)(record, None).value == 0
    module.TrialFile(page.folder / "none.jsonl").on_trial_end(record)
    assert not (page.folder / "none.jsonl").exists()


def test_arrays_and_numbers_become_columns_and_flags_do_not(module):
    seen = {"arm": np.arange(2.0), "grip": 3, "on": True, "name": "left"}
    state = SimpleNamespace(state=seen)
    step = SimpleNamespace(
        observation=state,
        action=SimpleNamespace(data=np.array([[7.0], [8.0]]), meta={"chunk_error": 0.5}),
        result=SimpleNamespace(observation=state, info={"success": False, "force": np.float32(2)}),
    )
    readings = {"obs:arm_0": 0.0, "obs:arm_1": 1.0, "obs:grip": 3.0}
    assert module.rows(SimpleNamespace(steps=[step])) == [
        {**readings, "action:0": 7.0, "action:1": 8.0, "chunk_error": 0.5},
        {**readings, "force": 2.0},
    ]


def test_the_shell_names_the_watchdog_of_the_command_line(page, module, monkeypatch):
    monkeypatch.delenv("OODD_WATCHDOG", raising=False)
    with pytest.raises(inspect_robots.errors.ConfigError, match="set OODD_WATCHDOG"):
        module.alarm()
    monkeypatch.setenv("OODD_WATCHDOG", str(page.folder / "cube.npz"))
    assert module.alarm().watchdog.promise == Watchdog.load(page.folder / "cube.npz").promise


def test_the_package_offers_what_inspect_robots_asks_for(module):
    for group, names in GROUPS.items():
        for name, value in names.items():
            assert EntryPoint(name, value, group).load().__module__ == module.__name__
    from inspect_robots.registry import _GROUPS

    assert {*GROUPS} <= {*_GROUPS.values()}


def test_the_command_of_the_page_scores_a_trial(page):
    (command,) = re.findall(r"^OODD_WATCHDOG=\S+ inspect-robots (run .*)$", README, re.MULTILINE)
    *arguments, limit = command.replace('"reach the cube"', "reach").split()
    # The entry points of a package that is not installed are registered by hand.
    code = (
        "import sys; from inspect_robots import cli, registry; import oodd_inspect_robots as our;"
        "registry.scorer('oodd_alarm')(our.alarm); sys.exit(cli.main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments, limit], cwd=page.folder,
        env={"PATH": "/usr/bin:/bin", "HOME": str(page.folder), "OODD_WATCHDOG": "cube.npz",
             "PYTHONPATH": str(EXAMPLE)},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^ +oodd_alarm: 0$", done.stdout, re.MULTILINE), done.stdout
    (log,) = (page.folder / "logs").glob("adhoc_*.json")
    assert json.loads(log.read_text())["results"]["metrics"] == {"oodd_alarm": 0.0}

"""Outcomes of a policy's rollouts: every figure is computed again from the files."""

import importlib.util
import json
import lzma
import math
import os
import warnings
from pathlib import Path

import h5py
import helpers_rollouts as plain
import numpy as np
import pytest

from oodd_eval import evaluate, load_split
from oodd_eval.data.split import Split
from oodd_eval.errors import PromiseWarning

FIGURES = Path(__file__).parents[2] / "docs" / "figures"
SPEC = importlib.util.spec_from_file_location("failures", FIGURES / "failures.py")
PROGRAM = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(PROGRAM)

ROWS = ("column:chunk_mse", "mean:chunk_mse", "clock", "mewma", "logistic", "tdqc")
WITHIN, UNSEEN = ((0.4, 0.36, 0.24), 0.5), (PROGRAM.SHARES, 1.0)
PARTS = {"train": "train", "calibration": "calibration", "failures": "failures",
         "nominal": "test/nominal", "failure": "test/failure"}  # fmt: skip
REAL = "OODD_EVAL_PI0"
"""Environment variable with the folder of pi0's files, see the recipe `pi0-failures`."""


def parts_of(rollouts, environment):
    """Parts by their definition: within tasks, or with one task that training has not seen."""
    unseen = environment.removeprefix("task-")
    if unseen == environment:
        return plain.shared_out(rollouts, *WITHIN)
    return plain.shared_out(rollouts, *UNSEEN, unseen=[unseen])


def kept(results, record, part, name="scores"):
    """Scores of a part by episode, or the surprise of its stream; None without it."""
    with h5py.File(results / "scores" / f"{record.scores}.h5") as file:
        if name not in file[part]:
            return None
        ends = file[part]["offsets"][1:-1]
        return [rows.tolist() for rows in np.split(file[part][name][:], ends)]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Rollouts, their two splits, and the rows' records and scores."""
    folder = tmp_path_factory.mktemp("rollouts")
    (folder / "files").mkdir()
    plain.simulate(folder / "files")
    splits = PROGRAM.splits_of(folder / "files", folder / "splits")
    with warnings.catch_warnings():
        # Tasks differ, and follow one another.
        warnings.simplefilter("ignore", PromiseWarning)
        records = {
            name: [*evaluate([*ROWS], load_split(path), output=folder / name)]
            for name, path in splits.items()
        }
    return folder, records


def test_parts_are_by_task_in_recorded_order(home):
    folder, records = home
    rollouts = plain.read(folder / "files")
    for name in ("within", "unseen"):
        split = Split(folder / "splits" / name)
        environments = {"within-tasks"} if name == "within" else {"task-0", "task-1", "task-3"}
        assert {*split.environments} == environments == {r.environment for r in records[name]}
        for environment in environments:
            parts, data = parts_of(rollouts, environment), split.environment(environment)
            every = []
            for part, stored in PARTS.items():
                arrays = data.arrays(stored)
                # Offsets are of transitions, of which an episode has one less than rows.
                ends = arrays["offsets"][1:-1] + np.arange(1, len(arrays["offsets"]) - 1)
                rows = np.split(arrays["observations"][:, 1], ends)
                assert [r.tolist() for r in rows] == [r.chunk_error for r in parts[part]], part
                tasks = [task.decode() for task in arrays["tasks"].tolist()]
                assert tasks == [r.task for r in parts[part]]
                every += parts[part]
            # Each rollout is in one part.
            assert sorted((r.task, r.number) for r in every) == sorted(
                (r.task, r.number) for r in rollouts
            )
            assert all(r.success for p in ("train", "calibration", "nominal") for r in parts[p])
            assert not any(r.success for p in ("failures", "failure") for r in parts[p])
            if environment != "within-tasks":
                unseen = environment.removeprefix("task-")
                for part in ("train", "calibration", "failures"):
                    assert unseen not in {r.task for r in parts[part]}
                assert {r.task for p in ("nominal", "failure") for r in parts[p]} == {unseen}
            data.close()


@pytest.mark.parametrize("detector", ROWS)
def test_every_figure_is_computed_again(home, detector):
    folder, records = home
    rollouts = plain.read(folder / "files")
    compared = 0
    for name, of_split in records.items():
        for record in (r for r in of_split if r.detector == detector):
            assert record.ok, record.reason
            parts = parts_of(rollouts, record.environment)
            scores, stream = {}, {}
            for part in ("calibration", "nominal", "failure"):
                scores[part] = kept(folder / name, record, PARTS[part])
                stream[part] = kept(folder / name, record, PARTS[part], "stream")
                if score := plain.FROM_FILES.get(detector):
                    from_files = [score(r) for r in parts[part]]
                    assert scores[part] == from_files
            assert (stream["nominal"] is None) == (":" in detector)
            alarms = plain.Alarms(record.alarm, scores["calibration"], stream["calibration"])
            tests = []
            for part in ("nominal", "failure"):
                seen = stream[part] or [None] * len(parts[part])
                columns = zip(parts[part], scores[part], seen, strict=True)
                tests.append([plain.Scored(r.task, s, x) for r, s, x in columns])
            learns = detector in ("logistic", "tdqc")
            expected = plain.figures(alarms, *tests, probabilities=learns)
            assert expected.keys() == record.metrics.keys()
            for metric, value in expected.items():
                assert record.value(metric) == pytest.approx(value, rel=1e-9, abs=1e-12), metric
            counts = {"train": "train", "calibration": "calibration", "nominal": "nominal",
                      "test": "failure"}  # fmt: skip
            assert record.counts == {k: len(parts[part]) for k, part in counts.items()}
            compared += len(expected)
    assert compared >= 4 * 11


def test_figures_differ_and_say_what_was_put_in(home):
    _, records = home
    values = {r.detector: r.value for r in records["within"]}
    assert values["column:chunk_mse"]("auc_outcome") > 0.7
    assert values["clock"]("auc_outcome") == values["clock"]("auc_outcome_half") == 0.5
    assert values["clock"]("auc_outcome_whole") > 0.9
    for detector in ("logistic", "tdqc"):
        assert values[detector]("auc_outcome") > 0.7
        assert 0 < values[detector]("brier_outcome") < 0.25


@pytest.mark.skipif(not os.environ.get(REAL), reason=f"{REAL} names no folder with pi0's files")
def test_committed_figures_are_those_of_the_published_files():
    rollouts = plain.read(Path(os.environ[REAL]))
    text = lzma.decompress((FIGURES / "failures.jsonl.xz").read_bytes()).decode()
    records = [json.loads(line) for line in text.splitlines()]
    compared = 0
    for record in (r for r in records if r["detector"] in plain.FROM_FILES):
        parts = parts_of(rollouts, record["environment"])
        score = plain.FROM_FILES[record["detector"]]
        alarms = plain.Alarms(record["alarm"], [score(r) for r in parts["calibration"]])
        tests = [[plain.Scored(r.task, score(r)) for r in parts[p]] for p in ("nominal", "failure")]
        expected = plain.figures(alarms, *tests)
        if record["detector"] == "clock":  # Its alarms are of the stream, too.
            expected = {name: value for name, value in expected.items() if "auc" in name}
        else:
            assert expected.keys() == record["metrics"].keys()
        for metric, value in expected.items():
            stored = record["metrics"][metric]["value"]
            stored = math.nan if stored is None else stored
            assert stored == pytest.approx(value, rel=1e-9, nan_ok=True), metric
            compared += 1
    assert compared

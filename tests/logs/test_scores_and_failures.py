"""Recipes that keep what a monitor computed, failed episodes for training, and unseen tasks."""

import json

import numpy as np
import pytest
from helpers_logs import draft_recipe
from oodd_logs.importing import import_frames, import_recipe
from oodd_logs.inspection.logs import inspect_logs
from oodd_logs.inspection.report import as_json, describe_logs
from oodd_logs.minari_files import export
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.logs import read_logs

from oodd_eval import load_split
from oodd_eval.errors import TrajectoryError, UsageError

ROWS = 50


def tables(bad=False, n=12, seed=0):
    """Recordings of two sensors, an innovation, and the flag that it raises."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        innovation = np.abs(rng.normal(size=ROWS)) + 9 * bad * (np.arange(ROWS) >= 20)
        yield {
            "height": rng.normal(size=ROWS),
            "yaw": rng.uniform(-np.pi, np.pi, ROWS),
            "vel_innov": innovation,
            "tripped": (innovation > 6).astype(float),
        }


@pytest.fixture
def frames(tmp_path):
    """Return a function that imports twelve nominal recordings and three faulty ones."""

    def of(notes=None, **keys):
        nominal = [*tables()]
        return import_frames(
            "flights",
            train=nominal[:6],
            calibration=nominal[6:],
            test={"nominal": [*tables(n=2, seed=1)], "bad": [*tables(bad=True, n=3)]},
            onset=20,
            output=tmp_path / "split",
            report=(notes if notes is not None else []).append,
            **keys,
        )

    return of


def test_a_score_is_kept_as_it_was_recorded_and_is_no_sensor(frames):
    keys = {"angles": ["yaw"], "scores": ["*innov", "flag = tripped"], "constant": "drop"}
    with frames(notes := [], **keys).opened() as opened:
        data = opened("flights")
        assert [q.name for q in data.sensors] == ["height", "sin yaw", "cos yaw"]
        assert [q.name for q in data.columns[3:]] == ["vel_innov", "flag"]
        assert {q.role for q in data.columns[3:]} == {"score"}
        recorded = [*tables(bad=True, n=3)]
        shown = data.of_columns(["vel_innov", "flag"]).labelled("bad")
        for episode, table in zip(shown, recorded, strict=True):
            expected = np.stack([table["vel_innov"], table["tripped"]], axis=1)
            assert episode.observations == pytest.approx(expected, rel=1e-6)
    text = "\n".join(notes)
    assert "3 sensors, 0 actions, 2 scores" in text
    assert "sensors: height, sin yaw, cos yaw\nscores: vel_innov and flag" in text
    # A flag is never raised where all is well: it stays, and that is said.
    assert "scores that are constant in training, and kept: flag" in text


def test_a_split_without_scores_has_the_digest_that_it_had(frames, tmp_path):
    sensors = {"sensors": ["height", "yaw"]}
    without = frames(**sensors).digest
    assert frames(**sensors, scores=["tripped"], replace=True).digest != without
    assert frames(**sensors, replace=True).digest == without


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"sensors": ["height", "vel*"], "scores": ["vel_innov"]}, "'vel_innov' is a score, and a"),
        ({"actions": ["vel_innov"], "scores": ["vel*"]}, "'vel_innov' is a score, and a sensor, a"),
        ({"labels": ["tripped"], "scores": ["tripped"]}, "'tripped' is a score, and a sensor, act"),
        ({"scores": ["chunk_mse"]}, "chunk_mse"),
        ({"scores": ["height = vel_innov"]}, "two sensors named 'height'"),
        ({"roles": {"score": ["height"]}}, "unknown role of import_frames: roles 'score'"),
    ],
)
def test_a_score_that_is_something_else_too_is_refused(frames, keys, expected):
    with pytest.raises(UsageError, match=expected):
        frames(**keys)


def csv_logs(folder, lines, n=12):
    for i in range(n):
        (folder / f"r{i}.csv").write_text("height,score\n" + "\n".join(lines(i)) + "\n")


def imported(folder, **keys):
    """Import files of two columns."""
    content = {"split": "s", "sensors": ["height"], "scores": ["score"], **keys}
    recipe = Recipe.parse({"nominal": {"files": "r*.csv"}, **content})
    with import_recipe(recipe, folder, folder / "split").opened() as opened:
        return [*opened("s").of_columns(["score"]).train]


def test_a_sparse_score_is_held_and_not_shifted(tmp_path):
    csv_logs(tmp_path, lambda i: [f"{i},{1e7 + row if row % 5 == 0 else ''}" for row in range(20)])
    with pytest.raises(
        TrajectoryError, match="column 'score' is missing, expected a finite number"
    ):
        imported(tmp_path)
    held = imported(tmp_path, missing="hold")[0].observations.ravel()
    assert held.tolist() == [1e7 + row // 5 * 5 for row in range(20)]


def test_a_score_in_words_is_refused(tmp_path):
    csv_logs(
        tmp_path, lambda i: [f"{i + row / 9},{'high' if row % 2 else 'low'}" for row in range(20)]
    )
    with pytest.raises(TrajectoryError, match="column 'score' is 'low', expected a number"):
        imported(tmp_path)


def test_a_score_that_float32_cannot_tell_is_not_shifted_and_that_is_said(tmp_path):
    csv_logs(tmp_path, lambda i: [f"{row / 9},{1e9 + row % 3}" for row in range(20)])
    recipe = {"split": "s", "sensors": ["height"], "scores": ["score"]}
    recipe = Recipe.parse({**recipe, "nominal": {"files": "r*.csv"}})
    split = import_recipe(recipe, tmp_path, tmp_path / "split", report=(notes := []).append)
    with split.opened() as opened:
        assert not opened("s").logs.offsets
    assert any("float32 cannot tell values of these scores: score" in note for note in notes)


def rollouts(folder, tasks=("0", "1", "2"), n=20):
    """Write a file a rollout, every second of which failed, with the task in a column."""
    rng = np.random.default_rng(0)
    for task in tasks:
        for i in range(n):
            rows = [f"{i},{rng.normal()},{task},{i % 2}" for _ in range(9)]
            text = "\n".join(["number,chunk_mse,task,success", *rows]) + "\n"
            (folder / f"task{task}-{i:02}.csv").write_text(text)


OUTCOMES = {
    "split": "s", "sensors": ["number"], "scores": ["chunk_mse"], "outcome": "success",
    "task": "task", "nominal": {"files": "*.csv"},
}  # fmt: skip


def parts(folder, notes=None, **keys):
    """Import rollouts; return task and number of the episodes of each part."""
    report = (notes if notes is not None else []).append
    recipe = Recipe.parse(OUTCOMES | keys)
    split = import_recipe(recipe, folder, folder / "split", replace=True, report=report)
    with split.opened() as opened:
        data = opened("s")
        sets = {"train": data.train, "calibration": data.calibration, "nominal": data.twins}
        sets |= {name: data.labelled(name) for name in data.anomalies}
        sets |= {"failures": data.failures} if data.failures else {}
        return {
            name: [(t, int(e.observations[0, 0])) for t, e in zip(part.tasks, part, strict=True)]
            for name, part in sets.items()
        }


def test_the_first_failed_episodes_of_each_task_are_for_training(tmp_path):
    rollouts(tmp_path)
    without, found = parts(tmp_path), parts(tmp_path, notes := [], failures=0.3)
    failed = [(task, i) for task in "012" for i in range(0, 20, 2)]
    assert (without["failure"], "failures" in without) == (failed, False)
    assert found["failures"] == [(task, i) for task, i in failed if i < 6]
    assert found["failure"] == [(task, i) for task, i in failed if i >= 6]
    assert {k: found[k] for k in without if k != "failure"} == {
        k: without[k] for k in without if k != "failure"
    }
    assert "failures: 9 episodes, 81 rows" in notes
    assert "failures" not in parts(tmp_path, notes, failures=0.01)
    assert "no failed episode is for training: failures = 0.01 of few" in notes


def test_failed_episodes_are_anomalous_whatever_their_kind_and_others_are_no_failures(tmp_path):
    for i in range(24):
        rows = [
            f"{i},{t % 5},0,{int(i % 4 > 0 and i != 11)},{'slip' if i % 2 == 0 else 'well'}"
            for t in range(9)
        ]
        text = "\n".join(["number,chunk_mse,task,success,kind", *rows]) + "\n"
        (tmp_path / f"r{i:02}.csv").write_text(text)
    nominal = {"files": "*.csv", "where": {"kind": "well"}}
    found = parts(tmp_path, kinds="kind", nominal=nominal, failures=0.5)
    # Number 11 is well by its kind, and failed.
    assert [i for _, i in found["failures"]] == [0, 4, 8, 11]
    assert [i for _, i in found["slip"]] == [2, 6, 10, 12, 14, 16, 18, 20, 22]
    assert [i for p in ("train", "calibration", "nominal") for _, i in found[p]] == [
        i for i in range(1, 24, 2) if i != 11
    ]


def test_unseen_tasks_are_in_the_test_alone(tmp_path):
    rollouts(tmp_path)
    found = parts(tmp_path, unseen=[1], failures=0.5)
    assert {task for name in ("train", "calibration", "failures") for task, _ in found[name]} == {
        "0", "2",
    }  # fmt: skip
    assert [i for task, i in found["nominal"] if task == "1"] == [*range(1, 20, 2)]
    assert [i for task, i in found["failure"] if task == "1"] == [*range(0, 20, 2)]
    # The other tasks are shared out as without it.
    seen = parts(tmp_path, failures=0.5)
    for name, episodes in seen.items():
        others = [episode for episode in found[name] if episode[0] != "1"]
        assert others == [episode for episode in episodes if episode[0] != "1"]


def test_an_export_has_the_failures_and_says_which_scores_it_lacks(tmp_path):
    rollouts(tmp_path)
    parts(tmp_path, failures=0.5)
    with load_split(tmp_path / "split").opened() as opened:
        lengths = opened("s").failures.lengths
    split = load_split(tmp_path / "split")
    written = export(split, tmp_path / "sets", environments=["s"], progress=len)
    assert [name.rpartition("/")[2] for name in written] == [
        "train-v0", "calibration-v0", "test-nominal-v0", "test-failure-v0", "failures-v0",
    ]  # fmt: skip
    file = tmp_path / "sets" / written[-1] / "data" / "metadata.json"
    content = json.loads(file.read_text())
    assert content["total_steps"] == lengths.sum()
    assert "failed episodes for training" in content["description"]
    assert "without the recorded scores chunk_mse" in content["description"]
    assert [sensor["name"] for sensor in content["sensors"]] == ["number"]


def test_unseen_tasks_are_taken_out_of_files_that_are_listed_for_training(tmp_path):
    rollouts(tmp_path)
    nominal = {"train": "task?-0*.csv", "calibration": "task?-1*.csv"}
    found = parts(tmp_path, nominal=nominal, unseen=["1"])
    odd = [*range(1, 20, 2)]
    assert found["train"] == [(task, i) for task in "02" for i in odd if i < 10]
    assert found["calibration"] == [(task, i) for task in "02" for i in odd if i > 10]
    assert sorted(found["nominal"]) == [("1", i) for i in odd]


def test_the_first_failed_episodes_are_those_with_the_first_stamps(tmp_path):
    for i in range(20):  # the last file is the first recording
        rows = [f"{1000 * (20 - i) + t},{i},{t % 5},0,{i % 2}" for t in range(9)]
        text = "\n".join(["t,number,chunk_mse,task,success", *rows]) + "\n"
        (tmp_path / f"r{i:02}.csv").write_text(text)
    found = parts(tmp_path, failures=0.3, time="t[s]")
    assert found["failures"] == [("0", i) for i in (18, 16, 14)]
    assert {i for _, i in found["failure"]} == {*range(0, 13, 2)}
    assert [i for _, i in found["train"]][:2] == [19, 17]


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"unseen": ["3"]}, "unknown task .unseen. '3'.*0, 1, 2"),
        ({"unseen": ["0", "1", "2"]}, "unseen names all tasks, 0, 1, 2: none is for training"),
        ({"unseen": ["0"], "task": ""}, "unseen names tasks: name the field with them .task., too"),
        ({"failures": 0.5, "outcome": ""}, "failures are known by their outcome: name its field"),
        ({"failures": 2}, "failures is 2, expected a share from 0 to 1"),
    ],
)
def test_errors_of_failures_and_unseen_tasks_say_what_to_do(tmp_path, keys, expected):
    rollouts(tmp_path)
    with pytest.raises(UsageError, match=expected):
        parts(tmp_path, **keys)


def test_columns_of_a_block_are_numbered_and_have_their_conversions_and_roles(frames):
    blocks = {"state": ["*yaw", "height"], "chunk": ["vel_innov", "tripped"]}
    roles = {"position": ["height"], "angle": ["yaw"]}
    keys = {"angles": ["yaw"], "roles": roles, "scores": ["vel*", "tripped"]}
    with frames(**keys, blocks=blocks).opened() as opened:
        data = opened("flights")
        state = ["state[0]", "state[1]", "state[2]"]
        assert [q.name for q in data.columns] == [*state, "chunk[0]", "chunk[1]"]
        assert [q.role for q in data.columns] == ["position", "sine", "cosine", "score", "score"]
        assert [q.name for q in data.of_columns(["chunk"]).sensors] == ["chunk[0]", "chunk[1]"]


@pytest.mark.parametrize(
    ("blocks", "expected"),
    [
        ({"chunk": ["hei*"], "samples": ["*t"]}, "'height' is chunk and samples, expected one b"),
        ({"chunk[0]": ["height"]}, "a name of import_frames: blocks is 'chunk.0.', expect"),
        ({"chunk": ["weight"]}, "unknown sensor whose block is chunk 'weight'"),
    ],
)  # fmt: skip
def test_errors_of_blocks_say_what_to_do(frames, blocks, expected):
    with pytest.raises(UsageError, match=expected):
        frames(blocks=blocks)


NAMES = {
    "vel_innov", "gps_hpos_test_ratio", "r_residual", "chunk_mse", "chunk_error", "anomaly_score",
    "NIS", "position uncertainty [m]", "recon_err", "OOD", "velInnov",
}  # fmt: skip
PLAIN = {
    "innov_var", "innovation_variances", "error", "tracking error", "moose", "loss", "nisan",
    "scoreboard", "speed", "std",
}  # fmt: skip


def write_table(path, columns, rows=60, seed=0):
    rng = np.random.default_rng(seed)
    table = [
        ",".join(columns),
        *(",".join(map(str, rng.normal(size=len(columns)))) for _ in range(rows)),
    ]
    path.write_text("\n".join(table) + "\n")


def test_inspect_proposes_scores_by_their_names(tmp_path):
    columns = sorted(NAMES | PLAIN)
    for i in range(4):
        write_table(tmp_path / f"r{i}.csv", columns, seed=i)
    logs = inspect_logs(tmp_path)
    recipe = draft_recipe(tmp_path)
    assert {*recipe.scores} == {*logs.scores} == NAMES
    assert {*recipe.sensors} == PLAIN
    assert "by name what a monitor computed" in describe_logs(logs)
    roles = {column["name"]: column["role"] for column in as_json(logs)["columns"]}
    assert (roles["NIS"], roles["speed"]) == ("scores", "sensor")
    source = import_recipe(recipe, tmp_path, tmp_path / "split")
    with source.opened() as opened:
        assert len(opened(recipe.environment).sensors) == len(PLAIN)


def test_a_score_in_few_rows_without_values_and_of_an_angle_is_proposed_as_it_is(tmp_path):
    cells = {
        "speed": lambda t: np.sin(t / 9), "yaw_innov": lambda t: (t / 20 + 3.1) % 6.28 - 3.1,
        "pos_innov": lambda t: t if t % 30 == 0 else "", "hgt_test_ratio": lambda t: 0,
        "sonar_innov": lambda t: "",
    }  # fmt: skip
    for i in range(4):
        rows = [",".join(str(cell(t)) for cell in cells.values()) for t in range(600)]
        (tmp_path / f"r{i}.csv").write_text("\n".join([",".join(cells), *rows]) + "\n")
    recipe = draft_recipe(tmp_path)
    # What has no value, or one, is left out as other columns are.
    assert recipe.scores == ("yaw_innov", "pos_innov")
    assert (recipe.columns, recipe.missing, recipe.missing_rows) == ({}, "hold", 29)


def test_scores_are_sensors_where_nothing_else_is_left(tmp_path):
    for i in range(4):
        write_table(tmp_path / f"r{i}.csv", ["vel_innov", "pos_innov"], seed=i)
    recipe = draft_recipe(tmp_path)
    assert (recipe.sensors, recipe.scores) == (("vel_innov", "pos_innov"), ())


def test_prefixed_columns_are_scores_too(tmp_path):
    for i in range(4):
        write_table(tmp_path / f"r{i}.csv", ["obs:q[rad]", "obs:q_residual[rad]"], seed=i)
    recipe = draft_recipe(tmp_path)
    assert (recipe.sensors, recipe.scores) == ((), ("obs:q_residual[rad]",))
    logs = read_logs(tmp_path)
    assert [(q.name, q.role) for q in logs.sensors] == [("q", "measured"), ("q_residual", "score")]
    assert logs.notes[:2] == ["sensors: q", "scores: q_residual"]
    recipe = Recipe("s", "s", scores=("obs:*",), nominal=recipe.nominal)
    with pytest.raises(UsageError, match=r"none is called obs:NAME\[UNIT\] and is no score"):
        import_recipe(recipe, tmp_path, tmp_path / "split")


def test_read_logs_has_all_columns_and_keeps_what_is_missing(tmp_path):
    csv_logs(tmp_path, lambda i: [f"{i + row % 7},{row if row > 3 else ''}" for row in range(40)])
    logs = read_logs(tmp_path)
    assert [q.role for q in logs.sensors] == ["measured", "score"]
    assert {episode.observations.shape for episode in logs.episodes} == {(36, 2)}

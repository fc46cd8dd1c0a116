"""Episodes of one table: told apart by keys, flags and counters, proposed, and imported."""

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers_logs import draft_recipe
from helpers_logs import write_table as write
from oodd_logs import splitting
from oodd_logs.episodes import read_episodes
from oodd_logs.importing import import_frames
from oodd_logs.inspection.episode_keys import episode_columns
from oodd_logs.inspection.logs import inspect_logs
from oodd_logs.inspection.report import describe_logs
from oodd_logs.recipe import Recipe
from oodd_logs.recording import Recording, Topic
from oodd_logs.scanning.logs import read_logs
from oodd_logs.splitting import split_recording

from oodd_eval.errors import UnknownNameError, UsageError

NAN = np.nan
ROWS = np.arange(12.0)


def recording(**columns):
    return Recording("all", "all.csv", {"": Topic.of(columns)})


def episodes(*names, **columns):
    """Name, fields and rows of the episodes of a table whose column x is the number of the row."""
    table = recording(x=np.arange(float(len(next(iter(columns.values()))))), **columns)
    return [
        (part.name.removeprefix("all-"), part.fields, rows.tolist())
        for part in split_recording(table, names)
        for rows in part.topics[""].read(["x"], 0, part.topics[""].rows).values()
    ]


@pytest.mark.parametrize(
    ("names", "columns", "expected"),
    [
        (["run"], {"run": [1, 1, 2, 2, 2]},
         [("1", {"run": 1}, [0, 1]), ("2", {"run": 2}, [2, 3, 4])]),
        (["robot"], {"robot": ["b", "a", "b", "a"]},
         [("b", {"robot": "b"}, [0, 2]), ("a", {"robot": "a"}, [1, 3])]),
        (["robot"], {"robot": [1, 2, 3] * 4},
         [("1", {"robot": 1}, [0, 3, 6, 9]), ("2", {"robot": 2}, [1, 4, 7, 10]),
          ("3", {"robot": 3}, [2, 5, 8, 11])]),
        (["robot", "run"], {"robot": ["a", "b"] * 4, "run": [1] * 4 + [2] * 4},
         [("a-1", {"robot": "a", "run": 1}, [0, 2]), ("b-1", {"robot": "b", "run": 1}, [1, 3]),
          ("a-2", {"robot": "a", "run": 2}, [4, 6]), ("b-2", {"robot": "b", "run": 2}, [5, 7])]),
        (["terminals", "timeouts"], {"terminals": [0, 1, 0, 0, 0], "timeouts": [0, 0, 0, 1, 0]},
         [("0", {"terminals": 1, "timeouts": 0, "terminated": True}, [0, 1]),
          ("1", {"terminals": 0, "timeouts": 1, "terminated": False}, [2, 3])]),
        (["next.done"], {"next.done": [0, 1, 0, 0]},
         [("0", {"next.done": 1}, [0, 1]), ("1", {"next.done": 0}, [2, 3])]),
        (["is_first"], {"is_first": [1, 0, 1, 0, 0]}, [("0", {}, [0, 1]), ("1", {}, [2, 3, 4])]),
        (["robot", "done"], {"robot": ["a", "b"] * 4, "done": [0, 0, 1, 0, 0, 1, 0, 0]},
         [("a-0", {"robot": "a", "done": 1}, [0, 2]), ("b-0", {"robot": "b", "done": 1}, [1, 3, 5]),
          ("a-1", {"robot": "a", "done": 0}, [4, 6])]),
        (["step"], {"step": [0, 1, 2, 0, 1]}, [("0", {}, [0, 1, 2]), ("1", {}, [3, 4])]),
        (["t"], {"t": [.0, .1, NAN, .3, .0, .1]}, [("0", {}, [0, 1, 2, 3]), ("1", {}, [4, 5])]),
        (["run"], {"run": [NAN, 1, NAN, 1, NAN, 2, 2]},
         [("1", {"run": 1}, [1, 2, 3]), ("2", {"run": 2}, [5, 6])]),
        (["run"], {"run": ["1.0", "", "1.0", "v", "v"]},
         [("1.0", {"run": "1.0"}, [0, 1, 2]), ("v", {"run": "v"}, [3, 4])]),
        (["run"], {"run": [0.5, 0.5, 1, 1]},
         [("0.5", {"run": 0.5}, [0, 1]), ("1", {"run": 1}, [2, 3])]),
    ],
)  # fmt: skip
def test_keys_flags_and_counters_tell_episodes_apart(names, columns, expected):
    arrays = {name: np.array(cells) for name, cells in columns.items()}
    assert episodes(*names, **arrays) == expected


def test_what_an_episode_leaves_out_is_said():
    table = recording(run=[NAN, 1, 1, 2, 3, 3], x=ROWS[:6])
    first, second = split_recording(table, ["run"])
    assert (first.name, second.name, first.source) == ("all-1", "all-3", "all.csv, run 1")
    assert first.topics[""].names == ("x",)  # a key is no sensor
    lines = "\n".join(first.ledger.lines())
    assert "1 row of run, no value of the column that tells episodes apart: all.csv row 0" in lines
    assert "1 episode, it has a single row" in lines
    assert not second.ledger


def test_columns_that_tell_no_episodes_apart_are_refused():
    table = recording(run=ROWS // 6, x=np.random.default_rng(0).normal(size=12))
    with pytest.raises(UnknownNameError, match="did you mean 'run'"):
        [*split_recording(table, ["runn"])]
    with pytest.raises(UsageError, match="of 12 episodes have a single row"):
        [*split_recording(table, ["x"])]
    (whole,) = split_recording(table, ["runn"], lenient=True)
    assert "no column 'runn', and counts as one episode" in "\n".join(whole.ledger.lines())
    assert [*split_recording(table, [])] == [table]
    empty = recording(run=ROWS[:0])
    assert [*split_recording(empty, ["run"])] == [empty]  # whoever reads its rows says so
    told_apart = Recording("all", "all.csv", table.topics, {"run": 3})
    assert [*split_recording(told_apart, ["run"])] == [told_apart]


@pytest.mark.parametrize("most", [0, 1 << 28])
def test_a_large_table_of_robots_in_turn_is_read_in_blocks(monkeypatch, most):
    monkeypatch.setattr(splitting, "_BLOCK", 7)
    monkeypatch.setattr(splitting, "EPISODE", type("Bounds", (), {"most": most}))
    reads = []

    def read_rows(names, start, stop):
        reads.append(stop - start)
        rows = np.arange(start, stop)
        return {name: rows % 3.0 if name == "robot" else rows + 1 for name in names}

    table = Recording("all", "all", {"": Topic(("robot", "x"), 90, read_rows)})
    parts = [*split_recording(table, ["robot"])]
    reads.clear()
    for i, part in enumerate(parts):
        assert part.topics[""].read(["x"], 0, 30)["x"].tolist() == [*range(1 + i, 91, 3)]
        assert part.topics[""].read(["x"], 10, 20)["x"].tolist() == [*range(31 + i, 61, 3)]
    assert (max(reads) <= 7) == (not most)
    assert len(reads) == 1 or not most


def test_other_topics_are_cut_by_their_stamps():
    marker = Topic.of({"t": np.array([10.0, 11, 20, 21]), "trial": np.array([1.0, 1, 2, 2])}, "t")
    stamps = np.array([9.0, 10, 10.5, 12, 19.9, 20, 22])
    imu = Topic.of({"t": stamps, "x": np.arange(7.0)}, "t")
    bag = Recording("bag", "bag", {"/trial": marker, "/imu": imu})
    parts = [*split_recording(bag, ["/trial.trial"])]
    x = [part.topics["/imu"].read(["x"], 0, part.topics["/imu"].rows)["x"] for part in parts]
    assert [values.tolist() for values in x] == [[1, 2, 3, 4], [5, 6]]
    assert "1 row of /imu, before the first episode" in "\n".join(parts[0].ledger.lines())
    unstamped = Recording("bag", "bag", {"/trial": marker, "/imu": Topic.of({"x": stamps})})
    with pytest.raises(UsageError, match="not all topics have stamps"):
        [*split_recording(unstamped, ["/trial.trial"])]


# Proposals.

LENGTHS = [120 + 5 * i for i in range(10)]
RUN = np.repeat(np.arange(10.0), LENGTHS)
STEP = np.concatenate([np.arange(float(n)) for n in LENGTHS])
LAST = np.append(np.diff(RUN), 0.0)
NOISE = np.random.default_rng(0).normal(size=len(RUN))
CLOCK = np.arange(len(RUN)) / 10
TICKS = np.cumsum(np.random.default_rng(1).uniform(5, 10, len(RUN)))


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"run_id": RUN, "step": STEP}, ["run_id"]),
        ({"0": RUN + 1, "1": STEP + 1, "2": np.round(NOISE)}, ["0"]),  # engines by cycle
        ({"log": RUN.astype(int).astype(str), "t": STEP / 10}, ["log"]),
        ({"load": 10 * RUN + 3, "unit": RUN, "t": STEP / 10}, ["unit"]),
        ({"simulationRun": RUN, "t": CLOCK}, ["simulationRun"]),
        ({"cycle": RUN, "time": 1.5 * STEP + 0.1 * np.abs(np.sin(STEP))}, ["cycle"]),
        ({"frame": STEP}, ["frame"]),
        ({"terminals": LAST * (RUN % 2), "timeouts": LAST * (1 - RUN % 2)},
         ["terminals", "timeouts"]),
        ({"index": CLOCK, "episode_index": RUN, "frame_index": STEP, "next.done": LAST},
         ["episode_index"]),
        ({"is_first": np.append(1.0, np.diff(RUN))}, ["is_first"]),
        ({"fault": np.repeat([0.0, 1], 600), "run": np.tile(np.repeat([1.0, 2, 3], 200), 2),
          "sample": np.tile(np.arange(200.0), 6)}, ["fault", "run"]),
        ({"t": np.repeat(np.arange(300.0), 3), "robot": np.array(["a", "b", "c"] * 300)},
         ["robot"]),
        ({"t": np.arange(900.0), "robot": np.arange(900) % 2 + 1.0,
          "trial": np.arange(900) // 90 * 1.0}, ["robot", "trial"]),
        ({"t": np.tile(np.repeat(np.arange(45.0), 2), 10), "device": np.arange(900) % 2 * 1.0,
          "run": np.arange(900) // 90 * 1.0}, ["device", "run"]),
        # One episode:
        ({"t": STEP / 10}, []),  # where the time falls, gap cuts
        ({"t": CLOCK, "encoder": TICKS % 1024, "turns": TICKS // 1024}, []),
        ({"t": CLOCK, "phase": RUN, "phase_step": STEP}, []),
        ({"t": CLOCK, "fault": (RUN > 6) * 1.0}, []),
        ({"t": CLOCK, "command": 10 * RUN}, []),
        ({"nsec": CLOCK % 1 * 1e9, "sec": CLOCK // 1}, []),
        ({"lap": RUN, "t": CLOCK}, []),
        ({"engine": np.round(20 * NOISE), "t": CLOCK}, []),
        ({"run": (RUN > 6) * 1.0, "t": CLOCK}, []),
        ({"done": (RUN > 6) * 1.0, "t": CLOCK}, []),
        ({"done": np.append(np.zeros(len(RUN) - 1), 1.0)}, []),
        ({"t": np.sort(np.round(np.random.default_rng(2).uniform(0, 100, len(RUN)), 1)),
          "valve": (NOISE > 0) * 1.0}, []),
    ],
)  # fmt: skip
def test_what_tells_episodes_apart_is_proposed(columns, expected):
    rows = len(next(iter(columns.values())))
    noise = np.random.default_rng(3).normal(size=rows)
    table = recording(x=noise, **columns)
    assert [*episode_columns(table)] == expected
    bag = Recording("bag", "bag", {"/topic": table.topics[""]})
    assert [*episode_columns(bag)] == expected
    assert not episode_columns(Recording("bag", "bag", {"": table.topics[""], **bag.topics}))


def table_of_runs(runs, rows=60, **more):
    rng = np.random.default_rng(len(runs))
    ids, steps = np.repeat(runs, rows), np.tile(np.arange(rows), len(runs))
    return {"run_id": ids, "step": steps, "a": rng.normal(size=len(ids)).round(4)} | more


def test_a_draft_cuts_a_table_and_a_scan_judges_its_episodes(tmp_path):
    write(tmp_path / "all.csv", table_of_runs(range(1, 25)))
    logs = inspect_logs(tmp_path / "all.csv")
    assert "24 episodes by run_id of 60 rows" in describe_logs(logs)
    assert draft_recipe(tmp_path / "all.csv").episode == ("run_id",)
    read = read_logs(tmp_path / "all.csv")
    assert [e.name for e in read.episodes][::23] == ["all-1", "all-24"]
    assert [q.name for q in read.sensors] == ["a"]


def test_a_later_file_may_show_what_tells_episodes_apart(tmp_path):
    write(tmp_path / "0.csv", table_of_runs([1]))
    write(tmp_path / "1.csv", table_of_runs([2, 3, 4]))
    write(tmp_path / "2.csv", table_of_runs([5]))
    logs = inspect_logs(tmp_path)
    assert [r.name for r in logs.recordings] == ["0-1", "1-2", "1-3", "1-4", "2-5"]
    assert set(logs.columns) == {"step", "a"}


def test_long_arrays_of_hdf5_and_flat_tables_of_lerobot_are_cut(tmp_path):
    rows = {"observations": np.stack([NOISE, CLOCK], 1), "actions": NOISE[:, None]}
    ends = {"terminations": LAST * (RUN % 2) == 1, "truncations": LAST * (1 - RUN % 2) == 1}
    for name, flags in (("a", ends), ("b", {"terminals": LAST == 1})):
        with h5py.File(tmp_path / f"{name}.hdf5", "w") as file:
            for key, array in (rows | flags).items():
                file[key] = array
        logs = inspect_logs(tmp_path / f"{name}.hdf5")
        assert (logs.episode, len(logs.recordings)) == (tuple(flags), 10)
    columns = {"observation.state": [*rows["observations"]], "episode_index": RUN.astype(int)}
    columns |= {"frame_index": STEP.astype(int), "task_index": RUN.astype(int) % 2}
    pq.write_table(pa.table(columns), tmp_path / "flat.parquet")
    recipe = draft_recipe(tmp_path / "flat.parquet")
    assert (recipe.episode, len(inspect_logs(tmp_path / "flat.parquet").recordings)) == (
        ("episode_index",), 10,
    )  # fmt: skip


# Import.


def read(root, **keys):
    content = {"split": "s", "episode": "run_id", "sensors": "a", "nominal": {"files": "*.csv"}}
    with read_episodes(Recipe.parse(content | keys), root) as source:
        return {part: list(source.episodes(part)) for part in source.parts}


def test_columns_of_an_episode_are_its_labels_outcome_and_task(tmp_path):
    runs = np.repeat(np.arange(10), 60)
    more = {"ok": runs != 7, "task": runs % 2, "fault": (runs == 8) & (np.arange(600) % 60 > 29)}
    write(tmp_path / "all.csv", table_of_runs(range(10), **more))
    parts = read(tmp_path, outcome="ok", task="task")
    (failed,) = parts["test/failure"]
    assert (failed.name, failed.task, failed.outcome) == ("all-7", "1", False)
    assert sum(map(len, parts.values())) == 10
    anomalous = {"leak": {"files": "*.csv", "where": {"run_id": 8}}}
    nominal = {"files": "*.csv", "where": {"run_id": [*range(8)]}}
    parts = read(tmp_path, labels="fault", anomalous=anomalous, nominal=nominal)
    (leak,) = parts["test/leak"]
    assert (leak.name, leak.intervals) == ("all-8", ((30, 60),))


def test_intervals_name_episodes_where_a_file_is_cut(tmp_path):
    write(tmp_path / "all.csv", table_of_runs(range(10)))
    keys = {"anomalous": {"leak": {"files": "*.csv", "where": {"run_id": 3}}}}
    parts = read(tmp_path, intervals=[["all-3", 10, 20]], **keys)
    assert [e.intervals for e in parts["test/leak"]] == [((10, 20),)]
    with pytest.raises(UsageError, match=r"names 'all\.csv', which is cut .* such as 'all-0'"):
        read(tmp_path, intervals=[["all.csv", 10, 20]], **keys)


def test_frames_are_cut_too(tmp_path):
    rng = np.random.default_rng(0)
    rows = [{"run": i // 20, "a": float(rng.normal())} for i in range(100)]
    keys = {"episode": "run", "output": tmp_path / "s", "report": len}
    split = import_frames("s", train=[rows], calibration=[rows], **keys)
    assert len(split.environment("s").train) == 5
    assert split.environment("s").train[0].observations.shape == (20, 1)

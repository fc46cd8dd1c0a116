"""`data inspect` sees what a recipe has to say of logs, and nothing where there is nothing."""

import csv
import json
import tomllib
import tracemalloc

import numpy as np
import pytest
from helpers_logs import draft_recipe
from helpers_logs import write_table as write
from oodd_logs.importing import import_recipe
from oodd_logs.inspection.columns import ClockFacts, ColumnFacts, time_unit
from oodd_logs.inspection.draft import draft
from oodd_logs.inspection.logs import inspect_logs
from oodd_logs.inspection.report import advise, describe_logs, looks_like
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.logs import read_logs

from oodd_eval.cli.main import main
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError


def process(rows, seed=0):
    """Two smooth sensors."""
    rng = np.random.default_rng(seed)
    return {
        "q[rad]": np.sin(np.arange(rows) / 20) + rng.normal(0, 0.01, rows),
        "tau[N m]": rng.normal(0, 1, rows),
    }


def times(rows, step=0.01):
    return {"t": np.round(np.arange(rows) * step, 6)}


@pytest.fixture
def clean(tmp_path):
    """A folder with nothing to remark but that there are few episodes."""
    for i in range(40):
        write(tmp_path / f"run-{i}.csv", times(60) | process(60, i))
    return tmp_path


def topics(logs):
    return {advice.topic: advice.text for advice in advise(logs)}


def test_a_clean_folder_has_no_remark_but_its_rate(clean):
    logs = inspect_logs(clean)
    assert topics(logs).keys() == {"time", "nominal"}
    assert (len(logs.recordings), {r.length for r in logs.recordings}) == (40, {60})
    assert logs.times == {"t": "s"}
    assert 'time = "t", rate = 100' in topics(logs)["time"]
    assert [*looks_like(logs).values()] == ["time (seconds)", "", ""]
    # A file of intervals is no recording.
    write(clean / "labels.csv", {"file": ["run-1.csv"], "start": [30], "stop": [40]})
    logs = inspect_logs(clean)
    assert logs.intervals == draft_recipe(clean).intervals == "labels.csv"
    assert len(logs.recordings) == 40


def with_columns(clean, rows=60, **columns):
    """The clean folder, the first file with further columns."""
    for i, path in enumerate(sorted(clean.glob("*.csv"))):
        with path.open() as file:
            table = list(csv.reader(file))
        extra = {name: function(rows, i) for name, function in columns.items()}
        cells = [[*table[0], *extra]]
        cells += [[*row, *(values[k] for values in extra.values())] for k, row in
                  enumerate(table[1:])]  # fmt: skip
        with path.open("w", newline="") as file:
            csv.writer(file).writerows(cells)
    return inspect_logs(clean)


def wrapped(period):
    def angle(rows, i):
        return np.mod(np.arange(rows) * period / 40 + i, period) - period / 2

    return angle


PECULIAR = {
    "constant": lambda rows, _: np.full(rows, 3.5),
    "empty": lambda rows, _: [""] * rows,
    "text": lambda rows, _: [f"note {k}" for k in range(rows)],
    "counters": lambda rows, _: np.arange(rows) + 17,
    "flags": lambda rows, _: np.arange(rows) // 20 % 2,
    "angles": wrapped(2 * np.pi),
    "missing": lambda rows, _: ["" if 5 < k < 9 else k % 7 + 0.1 * k for k in range(rows)],
    "float32": lambda rows, i: 5.4e6 + np.random.default_rng(i).normal(0, 10, rows),
    "setpoints": lambda rows, i: np.full(rows, 100.0 * i),
}


@pytest.mark.parametrize("topic", PECULIAR)
def test_a_peculiar_column_is_named_and_nothing_else(clean, topic):
    remarks = topics(with_columns(clean, odd=PECULIAR[topic]))
    assert remarks.keys() == {"time", "nominal", topic}
    assert "odd" in remarks[topic]


def test_what_float32_keeps_and_what_jumps_by_less_is_not_remarked(clean):
    logs = with_columns(
        clean,
        temperature=lambda rows, i: 300 + np.random.default_rng(i).normal(0, 5, rows),
        pressure=lambda rows, i: 101_325 + np.random.default_rng(i).normal(0, 0.5, rows),
        heading=wrapped(360.0),
        sawtooth=wrapped(5.0),
        noise=lambda rows, i: np.random.default_rng(i).uniform(-3.1, 3.1, rows),
    )
    # Steps of float32 are 3e-5 at 300 and .008 at 101 325.
    assert not logs.columns["temperature"].coarse
    assert logs.columns["pressure"].coarse
    wraps = {name: logs.columns[name].period for name in ("heading", "sawtooth", "noise")}
    assert wraps == {"heading": 360, "sawtooth": 5, "noise": 0}


def after_row_30(by):
    stamps = np.arange(60) * 0.01
    stamps[30:] += by
    return stamps


@pytest.mark.parametrize(
    ("stamps", "topic", "words"),
    [
        (after_row_30(1.5), "gaps", ["1.51 s before row 30 of run-3.csv", "gap = 0.2"]),
        (after_row_30(-0.1), "falls", ["1 row earlier"]),
        (np.arange(60) * 0.02, "rates", ["run-3.csv", "0.02 s"]),
    ],
)
def test_a_clock_of_one_file_is_told(clean, stamps, topic, words):
    write(clean / "run-3.csv", {"t": stamps} | process(60))
    logs = inspect_logs(clean)
    remarks = topics(logs)
    assert remarks.keys() - {"gaps"} == {"time", "nominal", topic} - {"gaps"}
    assert all(word in remarks[topic] for word in words)
    recipe = Recipe.parse(tomllib.loads(draft(logs)))
    if topic == "falls":
        assert (recipe.time, recipe.rate, recipe.gap) == (("t",), 100, 0.2)


def test_missing_cells_are_counted_at_the_start_and_in_runs(tmp_path):
    values = ["", "", "", *map(str, range(10)), "", "", *map(str, range(5))]
    write(tmp_path / "a.csv", {"x": values, "y": range(20)})
    facts = inspect_logs(tmp_path / "a.csv").columns["x"]
    assert (facts.missing, facts.leading, facts.longest) == (5, 3, 2)


def test_blocks_count_as_the_whole_does():
    rng = np.random.default_rng(1)
    values = 1e6 + rng.normal(size=1000)
    values[rng.random(1000) < 0.3] = np.nan
    values[:7] = np.nan
    whole, parts, pair = ColumnFacts(), ColumnFacts(), ColumnFacts()
    for facts in (whole, parts, pair):
        facts.begin()
    whole.add(values)
    for block in np.split(values, [3, 7, 8, 500, 501]):
        parts.add(block)
    assert (parts.missing, parts.leading, parts.longest) == (
        whole.missing, whole.leading, whole.longest)  # fmt: skip
    assert (parts.steps, parts.falls, parts.rises) == (whole.steps, whole.falls, whole.rises)
    pair.add(values[:400])
    pair.begin()
    pair.add(values[400:])
    assert pair.recordings == 2
    # The step from one recording to the next is none.
    assert pair.steps == whole.steps - 1
    for facts in (whole, parts, pair):
        assert facts.numbers.mean == pytest.approx(np.nanmean(values), abs=1e-9)
        assert facts.numbers.spread == pytest.approx(np.nanstd(values), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "stamps", "unit"),
    [
        ("datetime", ["2024-05-01 10:00:00", "2024-05-01 10:00:01"], "date"),
        ("stamp", [1.7e18, 1.7e18 + 1e7], "ns"),
        ("time", [1.7e12, 1.7e12 + 10], "ms"),
        ("time", [1.7e9, 1.7e9 + 1], "s"),
        ("Time", [9862, 9877], "ms"),
        ("time_us", [0, 4000], "us"),
        ("t", [0, 1], "s"),
        ("t [s]", [0, 20], "s"),
    ],
)
def test_units_of_stamps(tmp_path, name, stamps, unit):
    write(tmp_path / "a.csv", {name: stamps, "x": [1.5, 2.5]})
    assert inspect_logs(tmp_path).times == {name: unit}
    if unit == "date":
        assert draft_recipe(tmp_path).rate == 1


def test_a_clock_that_falls_is_no_clock():
    rng = np.random.default_rng(0)
    random = ClockFacts.of(np.arange(100), [rng.normal(size=100)])
    assert random.steps.falls > 30
    assert ClockFacts.of(np.arange(1), [np.array([1.0])]) is None
    assert time_unit("t", [ClockFacts.of(np.arange(9), [np.arange(9.0)])]) == "s"


@pytest.mark.parametrize("separator", [";", ","])
def test_labels_by_rows_sort_the_files(tmp_path, separator):
    for i in range(3):
        write(tmp_path / f"free-{i}.csv", times(200) | process(200, i), separator)
        labels = {"anomaly": (np.arange(200) // 50 == 2).astype(float)}
        write(tmp_path / f"valve-{i}.csv", times(200) | process(200, i) | labels, separator)
    logs = inspect_logs(tmp_path)
    assert logs.labels == ("anomaly",)
    assert "150 of 600 rows, in 3 of 6 episodes" in topics(logs)["labels"]
    assert "anomaly" in topics(logs)["headers"]
    recipe = Recipe.parse(tomllib.loads(draft(logs)))
    assert recipe.labels == ("anomaly",)
    assert recipe.sensors == ("q[rad]", "tau[N m]")
    assert recipe.nominal.files == ("free*.csv",)
    assert recipe.anomalous["valve"].files == ("valve*.csv",)
    assert (recipe.time, recipe.rate) == (("t",), 100)


def test_labels_are_often_nominal_and_texts_name_their_nominal_value(tmp_path):
    for zeros, label in ((30, True), (10, False)):
        write(tmp_path / "a.csv", process(60) | {"fail_flags": (np.arange(60) >= zeros) * 8})
        assert bool(inspect_logs(tmp_path).labels) == label
    write(tmp_path / "a.csv", process(200) | {"health": ["fine"] * 150 + ["broken"] * 50})
    recipe = draft_recipe(tmp_path)
    assert recipe.labels == ("health",)
    assert recipe.nominal_label == ("fine",)
    write(tmp_path / "a.csv", process(200) | {"health": [1] * 150 + [-1] * 50})
    assert "nominal_label = [1]  # as in most rows: check it" in draft(inspect_logs(tmp_path))
    assert "nominal_label = [1], as in most rows" in topics(inspect_logs(tmp_path))["labels"]
    write(tmp_path / "a.csv", process(200) | {"health": [1] * 100 + [-1] * 100})
    assert "# nominal_label = [" in draft(inspect_logs(tmp_path))
    write(tmp_path / "a.csv", process(200) | {"is_ok": [1] * 150 + [0] * 50})
    assert draft_recipe(tmp_path).nominal_label == (1,)
    # One file with both kinds of rows stands below both.
    assert recipe.nominal.files == recipe.anomalous["fault"].files == ("a.csv",)
    for i in range(4):
        write(tmp_path / f"r{i:02}.csv", process(200, i) | {"health": [0] * 150 + [i // 3] * 50})
    (tmp_path / "a.csv").unlink()
    assert [*draft_recipe(tmp_path).anomalous] == ["fault"]  # the number of a file is no kind


@pytest.mark.parametrize(
    ("names", "nominal", "kind", "anomalous"),
    [
        (["nominal/run-0", "nominal/run-1", "Slip 1/run-0"], "nominal/*.csv", "slip-1",
         "Slip 1/run-0.csv"),
        (["free_1", "free_2", "valve1_1"], "free*.csv", "valve1", "valve1_1.csv"),
        (["flight_1_no_failure", "flight_2_engine_failure", "flight_3_no_failure"],
         "flight*no_failure.csv", "engine", "flight_2_engine_failure.csv"),
    ],
)  # fmt: skip
def test_names_of_folders_and_files_sort_them(tmp_path, names, nominal, kind, anomalous):
    for i, name in enumerate(names):
        write(tmp_path / f"{name}.csv", times(50) | process(50, i))
    recipe = draft_recipe(tmp_path)
    assert recipe.nominal.files == (nominal,)
    assert recipe.anomalous[kind].files == (anomalous,)


@pytest.mark.parametrize("labelled", [False, True])
def test_a_first_recipe_cuts_faulty_files_only_where_labels_say_since_when(tmp_path, labelled):
    for i in range(20):
        for folder in ("good", "bad"):
            is_bad = folder == "bad"
            more = {"fault": [int(is_bad and row > 150) for row in range(300)]}
            columns = times(300) | process(300, i + 100 * is_bad) | (more if labelled else {})
            write(tmp_path / folder / f"run-{i}.csv", columns)
    logs = inspect_logs(tmp_path)
    text = draft(logs)
    recipe = Recipe.parse(tomllib.loads(text))
    assert recipe.anomalous["bad"].files == ("bad/*.csv",)
    assert (recipe.window, recipe.clock) == ((60, False) if labelled else (0, True))
    assert ("# window = 60 " in text) == (not labelled)
    assert ("once labels" in topics(logs)["few"]) == (not labelled)


def test_a_scan_cuts_few_recordings_whatever_is_known_of_them(tmp_path):
    for i in range(6):
        folder = tmp_path / ("good" if i < 3 else "bad")
        write(folder / f"run-{i}.csv", times(1000) | process(1000, i))
    assert draft_recipe(tmp_path).window == 0
    assert len(read_logs(tmp_path).episodes) == 6 * 1000 // 50


def test_a_transposed_matrix_is_noticed_by_its_neighbours_and_read_as_it_is_meant(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("d01.dat", "d02.dat"):
        np.savetxt(tmp_path / name, rng.normal(size=(96, 12)))
    np.savetxt(tmp_path / "d00.dat", rng.normal(size=(12, 50)))
    logs = inspect_logs(tmp_path)
    assert logs.transposed == ["d00.dat"]
    assert sorted(r.length for r in logs.recordings) == [50, 96, 96]
    assert len(logs.columns) == 12
    assert 'transpose = ["d00.dat"]' in topics(logs)["transposed"]
    assert draft_recipe(tmp_path).options == {"transpose": ["d00.dat"]}


def test_a_first_row_that_counts_gives_a_transposed_matrix_away(tmp_path):
    rng = np.random.default_rng(0)
    rows = np.vstack([np.arange(300), rng.normal(size=(3, 300))])
    for matrix, transposed in ((rows, ["a.dat"]), (rows.T, []), (rng.normal(size=(15, 20)), [])):
        np.savetxt(tmp_path / "a.dat", matrix)
        assert inspect_logs(tmp_path).transposed == transposed


def test_equal_files_are_named_and_those_without_a_column_in_common_left_out(tmp_path):
    for name, seed in (("a", 0), ("b", 1), ("c", 0)):
        write(tmp_path / f"{name}.csv", process(50, seed), ";" if name == "c" else ",")
    write(tmp_path / "room.csv", {"temperature": np.random.default_rng(0).normal(20, 1, 50)})
    logs = inspect_logs(tmp_path)
    assert logs.equal == [["a.csv", "c.csv"]]
    (entry,) = logs.ledger.of("file", "dropped")
    assert [*entry.sources] == ["room.csv"]
    recipe = draft_recipe(tmp_path)
    assert recipe.nominal.files == ("a.csv", "b.csv")
    assert recipe.sensors == ("q[rad]", "tau[N m]")


def test_what_a_draft_leaves_out_takes_no_part_in_it_and_an_import_says_it(clean, tmp_path_factory):
    write(clean / "labels.csv", {"filename": ["run-1.csv", "run-2.csv"] * 20, "label": [0, 1] * 20})
    (clean / "gone.csv").symlink_to(clean / "nowhere.csv")
    logs = inspect_logs(clean)
    assert (logs.labels, {*logs.columns}) == ((), {"t", "q[rad]", "tau[N m]"})
    dropped = {file for entry in logs.ledger.of("file", "dropped") for file in entry.sources}
    assert dropped == {"labels.csv", "gone.csv"}
    assert topics(logs).keys() == {"time", "nominal"}
    report = []
    output = tmp_path_factory.mktemp("split")
    import_recipe(draft_recipe(clean), clean, output, report=report.append)
    assert "dropped: 1 file, no line names it: labels.csv" in report


def test_blocks_with_classes_are_sorted_by_kind(tmp_path):
    blocks = []
    for i, kind in enumerate(["normal", "collision"] * 20):
        rows = np.random.default_rng(i).normal(size=(15, 6))
        blocks.append("\n".join([kind, *(" ".join(f"{x:.3f}" for x in row) for row in rows), ""]))
    (tmp_path / "lp1.data").write_text("\n".join(blocks))
    logs = inspect_logs(tmp_path)
    assert len(logs.recordings) == 40
    recipe = draft_recipe(tmp_path)
    assert recipe.kinds == "class"
    assert recipe.nominal.where == {"class": ("normal",)}
    assert "nominal" not in topics(logs)


def test_episodes_that_stand_in_two_files_are_counted(tmp_path):
    def write_blocks(name, seeds):
        rows = {i: np.random.default_rng(i).normal(size=(15, 3)) for i in seeds}
        blocks = ["\n".join(["fine", *(" ".join(map(str, x)) for x in r)]) for r in rows.values()]
        (tmp_path / name).write_text("\n\n".join(blocks))

    write_blocks("a.data", range(8))
    write_blocks("b.data", range(5, 12))
    logs = inspect_logs(tmp_path)
    assert logs.shared == {"a.data": 3, "b.data": 3}
    assert "3 of a.data" in topics(logs)["shared"]
    assert not logs.equal


def test_a_recording_that_ends_as_another_begins_is_named(tmp_path):
    columns, first = process(300, 0), process(300, 1)
    write(tmp_path / "free.csv", times(300) | columns)
    rest = {name: np.append(columns[name][-60:], first[name]) for name in columns}
    # It has a label, and times of its own.
    write(tmp_path / "odd.csv", times(360) | rest | {"fault": np.arange(360) > 300})
    write(tmp_path / "other.csv", times(300) | process(300, 2))
    for i in range(2):  # which stand still at either end
        rows = {name: np.pad(x, 40) for name, x in process(200, i).items()}
        write(tmp_path / f"{i}.csv", times(280) | rows)
    logs = inspect_logs(tmp_path)
    assert logs.continued == [("free.csv", "odd.csv", 60)]
    assert "60 rows of free.csv" in topics(logs)["continued"]


def test_a_file_that_cannot_be_read_is_reported_beside_the_others(clean):
    (clean / "notes.pdf").write_bytes(b"%PDF")
    (clean / "run-2.csv").write_text("t,q\n1,2\n1,2,3,4\n")
    logs = inspect_logs(clean)
    remarks = topics(logs)
    assert ".pdf" in remarks["others"]
    assert "run-2.csv" in remarks["unreadable"]
    assert "have no rows: run-2.csv" in draft(logs)
    patterns = draft_recipe(clean).nominal.files
    matched = {path.name for pattern in patterns for path in clean.glob(pattern)}
    assert matched == {f"run-{i}.csv" for i in range(40) if i != 2}
    for path in clean.glob("run-*.csv"):
        path.write_text("t,q\n1,2\n1,2,3,4\n")
    with pytest.raises(TrajectoryError, match=r"run-0\.csv"):
        inspect_logs(clean)


def test_what_is_no_log_is_an_error(tmp_path):
    with pytest.raises(UsageError, match="does not exist"):
        inspect_logs(tmp_path / "nothing")
    (tmp_path / "notes.pdf").write_bytes(b"%PDF")
    with pytest.raises(UsageError, match="--format"):
        inspect_logs(tmp_path)
    with pytest.raises(UnknownNameError, match="did you mean 'csv'"):
        inspect_logs(tmp_path, "cvs")
    write(tmp_path / "a.csv", process(5))
    with pytest.raises(UnknownNameError, match="did you mean 'separator'"):
        inspect_logs(tmp_path, "", {"seperator": ";"})


def test_a_long_recording_takes_few_windows_and_bounded_memory(tmp_path):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    rows, block = 3_000_000, 100_000
    rng = np.random.default_rng(0)
    path = tmp_path / "long.parquet"
    schema = pyarrow.schema([("t", "float64"), ("x", "float64"), ("y", "float64")])
    with parquet.ParquetWriter(path, schema) as file:
        for start in range(0, rows, block):
            columns = [np.arange(start, start + block) * 0.01, *rng.normal(size=(2, block))]
            file.write_table(pyarrow.table(columns, schema=schema))
    tracemalloc.start()
    logs = inspect_logs(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 200e6
    assert logs.recordings[0].length == rows
    assert 1_000_000 < logs.columns["x"].cells < rows
    assert logs.columns["x"].numbers.spread == pytest.approx(1, abs=0.01)
    assert "of 3000000 rows" in topics(logs)["sample"]
    assert draft_recipe(path).window == rows // 100


def test_the_command_prints_and_writes_a_recipe_that_is_read(
    clean, capsys, monkeypatch, tmp_path_factory
):
    monkeypatch.chdir(clean.parent)
    logs = with_columns(clean, **PECULIAR)
    for width in (80, 120):
        lines = describe_logs(logs, width).splitlines()
        assert max(map(len, lines)) <= width
        assert not any(line.endswith(" ") for line in lines)
    recipe = clean.parent / "arm.toml"
    assert main(["data", "inspect", clean.name, "--recipe", "arm.toml"]) == 0
    assert "data import arm.toml" in capsys.readouterr().out
    drafted = Recipe.load(recipe)
    # Files are relative to the recipe, and what is no sensor is left out.
    assert drafted.nominal.files == (f"{clean.name}/*.csv",)
    assert drafted.sensors == ("q[rad]", "tau[N m]", "flags", "angles", "missing", "float32")
    assert drafted.columns == {"angles": ("angles",)}
    assert drafted.missing == "hold"
    assert main(["data", "inspect", clean.name, "--recipe", "arm.toml"]) == 4
    # A recipe elsewhere names the root.
    elsewhere = tmp_path_factory.mktemp("recipes") / "arm.toml"
    capsys.readouterr()
    assert main(["data", "inspect", str(clean), "--recipe", str(elsewhere)]) == 0
    assert f"--root {clean}" in capsys.readouterr().out
    assert Recipe.load(elsewhere).nominal.files == ("*.csv",)


@pytest.mark.parametrize("cell", ["broken", "2,5"])
def test_a_cell_of_text_is_the_exception_of_its_file(clean, cell):
    logs = with_columns(
        clean, odd=lambda rows, i: [cell if (i, k) == (3, 7) else k % 7 + 0.5 for k in range(rows)]
    )
    recipe = Recipe.parse(tomllib.loads(draft(logs)))
    assert ("odd" in recipe.sensors, recipe.missing) == (True, "hold")
    (entry,) = logs.ledger.of("cell", "held")
    assert (entry.name, entry.row, entry.cell, entry.count) == ("odd", 7, cell, 1)
    assert entry.first in describe_logs(logs)


@pytest.mark.parametrize(
    ("rows", "text", "advised"), [(300, False, "--window=15"), (3, False, ""), (300, True, "")]
)
def test_the_command_advises_only_scans_that_work(tmp_path, capsys, rows, text, advised):
    columns = times(rows) | {"q": process(rows)["q[rad]"]}
    if text:
        columns["q"] = ["note" if i % 2 == 0 else x for i, x in enumerate(columns["q"])]
    write(tmp_path / "logs" / "run.csv", columns)
    assert main(["data", "inspect", str(tmp_path / "logs")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert ("No column can be a sensor" in out) == text
    assert ("--recipe FILE.toml" in out) == (not text)
    if not advised:
        assert "oodd-eval scan" not in out
        return
    command = out.split("Which of them are odd: oodd-eval ")[1].split(" A first")[0]
    assert command.endswith(advised)
    assert main(command.split()) in {0, 1}


def test_a_long_list_has_one_line_in_the_table(tmp_path):
    rows = np.random.default_rng(0).normal(size=(60, 40))
    lines = [json.dumps({"t": i / 10, "scan": row.tolist()}) for i, row in enumerate(rows)]
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    logs = inspect_logs(tmp_path)
    assert {"scan.least", "scan.mean", "scan.count"} <= {*logs.columns}
    table = describe_logs(logs, 120).split("\n\n")[1]
    (line,) = (line for line in table.splitlines() if line.startswith("scan."))
    assert line.split()[0] == "scan.least/.mean/.count"


def test_an_outcome_and_a_task_of_each_episode_are_named(tmp_path):
    lines = []
    for i in range(40):
        steps = [{"v": float(x)} for x in np.random.default_rng(i).normal(size=20)]
        fields = {"success": i % 3 > 0, "task_id": i % 2, "terminated": True}
        lines.append(json.dumps(fields | {"steps": steps}))
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    remarks = topics(inspect_logs(tmp_path))
    assert remarks.keys() == {"time", "fields"}
    recipe = draft_recipe(tmp_path)
    assert (recipe.outcome, recipe.task) == ("success", "task_id")


def test_a_header_of_very_many_numbered_names_is_no_matrix(tmp_path):
    names = [f"x{i}" for i in range(300)]
    lines = [",".join(names), *(",".join(f"{i * k % 7}.5" for i in range(300)) for k in range(20))]
    (tmp_path / "wide.csv").write_text("\n".join(lines) + "\n")
    logs = inspect_logs(tmp_path)
    assert (logs.transposed, len(logs.columns)) == ([], 300)


def test_a_long_table_is_said_to_mix_values(tmp_path):
    lines = [f"{i},{('p', 'q')[i % 2]},{i * i % 11}.5" for i in range(60)]
    for name, said in (("tag", 1), ("mode", 0)):
        (tmp_path / "long.csv").write_text("\n".join([f"time,{name},value", *lines]) + "\n")
        kept = inspect_logs(tmp_path).ledger.of("column", "kept")
        assert [e.name for e in kept if "each row of value" in e.reason] == [name] * said

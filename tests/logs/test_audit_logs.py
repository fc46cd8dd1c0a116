"""Logs as people have them become splits: each of these was refused, or came out wrong, before."""

import os
import resource
import tracemalloc

import numpy as np
import pytest
from helpers_logs import write_table as write
from oodd_logs.importing import import_data, import_recipe
from oodd_logs.readers.cells import WIDEST
from oodd_logs.readers.tables import table_recording
from oodd_logs.recipe import Recipe

from oodd_eval import evaluate, load_split
from oodd_eval.cli.main import main
from oodd_eval.data.facts import LogFacts
from oodd_eval.errors import OoddError, OutputError, TrajectoryError, UsageError


def walk(rows, seed, shift=0.0, start=0, stop=0):
    """Two sensors that follow one another; from `start` to `stop` the second is shifted."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=rows).cumsum() * 0.1
    b = 2 * a + rng.normal(size=rows) * 0.1
    b[start:stop] += shift
    return {"a": a.round(6), "b": b.round(6)}


def labels(rows, start, stop):
    return np.isin(np.arange(rows), range(start, stop)).astype(int)


def run_import(root, text):
    (root / "recipe.toml").write_text(text)
    return import_recipe(Recipe.load(root / "recipe.toml"), root, root / "out")


@pytest.fixture
def plant(tmp_path):
    """Nominal files and faults of two kinds, of any number, without twins and of any length."""
    for i in range(20):
        rows = 60 + 7 * i % 20
        write(tmp_path / "free" / f"{i}.csv", walk(rows, i) | {"fault": np.zeros(rows, int)})
    for kind, count in (("valve", 3), ("front_tyre", 2)):
        for i in range(count):
            rows = walk(80, 100 + i, 5.0, 30, 50)
            write(tmp_path / kind / f"{kind}-{i}.csv", rows | {"fault": labels(80, 30, 50)})
    return tmp_path


CONTENT = {"split": "s", "sensors": ["a", "b"], "nominal": {"files": "free/*.csv"}}

PLANT = """
split = "plant"
source = "our own"
sensors = ["a[bar]", "b"]
labels = "fault"
clock = false
[nominal]
files = ["free/*.csv"]
[anomalous.valve]
files = ["valve/*.csv"]
group = "sensor"
[anomalous.front_tyre]
files = ["front_tyre/*.csv"]
"""


# A1: faults without twins, in any number


def test_faults_without_twins_become_a_split_that_every_command_takes(plant, capsys, tmp_path):
    (plant / "plant.toml").write_text(PLANT)
    output = tmp_path / "split"
    assert main(["data", "import", str(plant / "plant.toml"), "--output", str(output)]) == 0
    printed = capsys.readouterr().out
    for line in ("test/valve: 3 episodes, 240 rows, 3 intervals with 60 anomalous rows",
                 "train: 8 episodes"):  # fmt: skip
        assert line in printed
    split = load_split(output)
    data = split.environment("plant")
    assert [len(s) for s in (data.train, data.calibration, data.twins)] == [8, 6, 6]
    assert data.logs == LogFacts(paired=False, source="our own", clock=False)
    assert split.groups == {"front_tyre": "dynamics", "valve": "sensor"}
    assert {*data.anomalies} == {"valve", "front_tyre"}
    valve = data.labelled("valve")
    assert (len(valve), valve.intervals) == (3, [((30, 50),)] * 3)
    assert valve.names == ("valve-0", "valve-1", "valve-2")
    expected = walk(80, 101, 5.0, 30, 50)
    assert valve[1].observations[:, 1] == pytest.approx(expected["b"], rel=1e-6)
    assert data.twins.names == tuple(str(i) for i in range(14, 20))
    assert main(["data", "verify", str(output)]) == 0
    assert main(["data", "info", str(output)]) == 0
    results = evaluate("mahalanobis", split)
    assert results.mean("auc_pool") > 0.9


# A6: formats, columns, stamps, missing values


def csv_parts(root, columns):
    for part in ("train", "calibration"):
        write(root / part / "run-1.csv", columns)
    return {"form": "csv", "train": root / "train", "calibration": root / "calibration"}


@pytest.mark.parametrize("first", ["obs:a", "Obs:a", "obs_a"])
@pytest.mark.parametrize(
    ("name", "right"), [("obs_b", "obs:b"), ("observation b", "obs:b"), ("Actions.b", "action:b")]
)
def test_a_name_that_is_nearly_right_is_an_error(tmp_path, first, name, right):
    columns = dict(zip((name, first), walk(20, 1).values(), strict=True))
    with pytest.raises(UsageError, match=f"{name}.*{right}"):
        import_data("s", "e", output=tmp_path / "out", **csv_parts(tmp_path, columns))


def paired(root, onsets, name="run.1.csv", kind="front_tyre"):
    for part in ("train", "calibration", "test/nominal", f"test/{kind}"):
        shift = 5.0 if part.endswith(kind) else 0.0
        rows = walk(30, 1, shift, 10, 30)
        write(root / part / name, {"obs:a": rows["a"], "obs:b": rows["b"]})
    (root / "test" / kind / "onsets.csv").write_text(onsets)
    return import_data("s", "e", form="csv", train=root / "train",
                       calibration=root / "calibration", test=root / "test",
                       output=root / "out")  # fmt: skip


@pytest.mark.parametrize(
    ("onsets", "word"),
    [
        # With dots and blanks.
        ("file, onset\nrun.1.csv, 10\n", ""),
        ("file,onset\nrun.1,10\n", ""),
        ("file,onset\nrun.1.csv,10.0\n", ""),
        ("file,onset\nrun.1.csv,10.5\n", "line 2"),
        ("file,onset\nrun.1.csv,10\nrun.1.csv,12\n", "twice"),
        ("file,onset\nrun.2.csv,10\n", r"run\.2\.csv"),
        ("file,onset\nrun.1.csv,soon\n", "line 2"),
        ("file\nrun.1.csv\n", "columns"),
    ],
)
def test_onsets_are_read_or_what_is_wrong_with_them_told(tmp_path, onsets, word):
    if not word:
        data = paired(tmp_path, onsets).environment("e")
        assert data.anomalous("front_tyre").onsets.tolist() == [10]
        return
    with pytest.raises(OoddError, match=word):
        paired(tmp_path, onsets)


# A7: float32


def test_a_northing_has_the_scores_that_it_has_without_the_offset(tmp_path):
    aucs = []
    for offset in (0.0, 5.4e6):
        root = tmp_path / str(int(offset))
        for i in range(20):
            write(root / "free" / f"{i}.csv", moved(walk(60, i), offset))
        for i in range(6):
            rows = walk(60, 50 + i, 1.0, 30, 60)
            write(root / "odd" / f"{i}.csv", moved(rows, offset))
        split = run_import(root, """
split = "track"
sensors = ["a", "b"]
[nominal]
files = "free/*.csv"
[anomalous.slip]
files = "odd/*.csv"
onset = 30
""")  # fmt: skip
        data = split.environment("track")
        assert (data.logs.offsets == ()) == (offset == 0.0)
        assert np.abs(data.train[0].observations).max() < 100
        aucs.append(evaluate("mahalanobis", split).mean("auc_pool"))
    assert aucs[0] > 0.9
    assert aucs[1] == pytest.approx(aucs[0], abs=0.005)


def moved(rows, offset):
    # Repr keeps all digits of float64.
    return {name: [repr(float(v) + offset / 10) for v in values] for name, values in rows.items()}


# Memory


def test_the_rows_of_a_part_never_all_lie_in_memory(tmp_path):
    values = np.random.default_rng(0).normal(size=(50_000, 8))
    for part, count in (("train", 12), ("calibration", 4)):
        (tmp_path / part).mkdir()
        for i in range(count):
            np.savez(tmp_path / part / f"run-{i}.npz", observations=values[: 50_000 - i])
    tracemalloc.start()
    import_data("s", "e", form="numpy", train=tmp_path / "train",
                calibration=tmp_path / "calibration", output=tmp_path / "out")  # fmt: skip
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # 16 files of 3.2 MB are 51 MB.
    assert peak < 25e6


# What users write by mistake


@pytest.mark.parametrize(
    ("change", "files", "words"),
    [
        ({"discrete": 10**11, "actions": ["b"], "sensors": ["a"]}, {}, "at most 1000"),
        ({"time": "t[ns]", "rate": 10}, {}, r"60 rows were logged.*\[ms\]"),
        ({"time": "t", "rate": 10, "gap": 1e-9}, {}, "pieces shorter than 2 rows"),
        ({}, {"free/1.csv": "a,b,t\n1,2,0\n2,broken,.1\n"}, "texts such as 'broken'; leave"),
        ({}, {"free/1.csv": "a,b,tür\n1,2,3\n"}, "encoding = 'cp1252'"),
        ({"labels": "c"}, {"free/0.csv": "a,b,c\n1,2,OK\n1,2,OK\n"}, "nominal_label"),
    ],
)  # fmt: skip
def test_a_mistake_comes_with_what_to_do(tmp_path, change, files, words):
    for i in range(10):
        write(tmp_path / "free" / f"{i}.csv", walk(60, i) | {"t": np.arange(60) / 10})
    for name, text in files.items():
        (tmp_path / name).write_text(text, "cp1252")
    content = CONTENT | change
    with pytest.raises(OoddError, match=words):
        import_recipe(Recipe.parse(content), tmp_path, tmp_path / "out")
    assert not (tmp_path / "out" / "manifest.json").exists()


@pytest.mark.filterwarnings("error")
def test_a_value_beyond_float32_is_refused_without_a_warning(tmp_path, capsys):
    for i in range(10):
        rows = walk(60, i)
        rows["a"][5] = 1e300 if i == 3 else 0.0
        write(tmp_path / "free" / f"{i}.csv", rows)
    with pytest.raises(TrajectoryError, match="sensor 'a' reaches 1e"):
        import_recipe(Recipe.parse(CONTENT), tmp_path, tmp_path / "out")
    assert main(["data", "inspect", str(tmp_path / "free")]) == 0
    assert "1e+300" in capsys.readouterr().out


def test_names_of_files_may_be_no_text_or_have_a_line_break_and_pipes_are_refused(tmp_path):
    for i in range(10):
        write(tmp_path / "free" / os.fsdecode(b"\xff%d.csv" % i), walk(60, i))
    split = import_recipe(Recipe.parse(CONTENT), tmp_path, tmp_path / "out")
    assert split.environment("s").train.names[0] == "\\udcff0"
    # A line break does not end a remark of a draft.
    for i in range(6):
        write(tmp_path / "logs" / f"{i}.csv", walk(60, i))
    copy = tmp_path / "logs" / 'x\nsplit = "y".csv'
    copy.write_bytes((tmp_path / "logs" / "1.csv").read_bytes())
    recipe = tmp_path / "r.toml"
    assert main(["data", "inspect", str(tmp_path / "logs"), "--recipe", str(recipe)]) == 0
    assert Recipe.load(recipe).sensors == ("a", "b")
    assert main(["scan", str(tmp_path / "logs"), "--detector=range"]) in {0, 1}
    # What is no file is not waited for.
    (tmp_path / "pipes" / "free").mkdir(parents=True)
    os.mkfifo(tmp_path / "pipes" / "free" / "0.csv")
    for form in ({}, {"read": {"format": "csv"}}):
        with pytest.raises(TrajectoryError, match=r"0\.csv is no plain file, but a broken link"):
            import_recipe(Recipe.parse(CONTENT | form), tmp_path / "pipes", tmp_path / "pout")


@pytest.fixture
def full_disk():
    """Lets files grow to some bytes and no further."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda most: resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize(
    ("while_reading", "words"),
    [(True, "rows cannot be kept in .*TMPDIR"), (False, r"s\.h5' cannot be written")],
)
def test_a_full_disk_is_told_and_nothing_is_left(tmp_path, full_disk, while_reading, words):
    for i in range(10):
        write(tmp_path / "free" / f"{i}.csv", walk(600, i))
    recipe, output = Recipe.parse(CONTENT), tmp_path / "out"
    output.mkdir()
    (output / ".s.h5.999999999").write_text("what a killed import left")
    if while_reading:  # rows take 144 kB
        full_disk(100_000)
    with pytest.raises(OutputError, match=words):
        import_recipe(recipe, tmp_path, output, progress=lambda _part: full_disk(20_000))
    full_disk(2**40)
    assert not (output / "s.h5").exists()
    assert import_recipe(recipe, tmp_path, output).environment("s").train
    assert {path.name for path in output.iterdir()} == {"manifest.json", "s.h5"}


def test_a_file_of_the_widest_is_read_and_a_wider_one_refused(tmp_path):
    path = tmp_path / "wide.csv"
    for columns in (WIDEST, WIDEST + 1):
        path.write_text(",".join(f"c{i}" for i in range(columns)) + "\n" + "1," * columns + "1\n")
        path.write_text(path.read_text().replace(",1\n", "\n"))
        if columns > WIDEST:
            with pytest.raises(TrajectoryError, match=f"{columns} columns or more, limit {WIDEST}"):
                table_recording(path, {})
            return
        (topic,) = table_recording(path, {}).topics.values()
        assert len(topic.names) == WIDEST

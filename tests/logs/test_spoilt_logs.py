"""One thing of thirty logs is spoilt: the result is that of the clean logs, or it is said which."""

import dataclasses
import functools
import json
import shutil
import unicodedata
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from oodd_logs.episodes import read_episodes
from oodd_logs.importing import import_frames, import_recipe
from oodd_logs.ledger import Ledger
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.logs import read_logs
from oodd_logs.scanning.scan import scan_episodes

from oodd_eval.cli.main import main
from oodd_eval.errors import OoddError

FILES, ROWS, FAULTY = 30, 60, range(24, 30)
COLUMNS = ("t[s]", "flow[l/s]", "Größe", "fault")
RECIPE = Recipe.parse(
    {
        "split": "spoilt",
        "environment": "spoilt",
        "time": "t[s]",
        "rate": 10,
        "sensors": ["flow[l/s]", "Größe"],
        "labels": "fault",
        "missing": "hold",
        "window": 30,
        "clock": False,
        "nominal": {"files": "*"},
        "anomalous": {"slip": {"files": "*"}},
    }
)


def logs(i):
    """Columns of a log: two sensors that swing, and a fault in the later half of the last logs."""
    rng, t = np.random.default_rng(i), np.arange(ROWS) / 10
    sensors = [f(t + i) + rng.normal(0, 0.1, ROWS) for f in (np.sin, np.cos)]
    fault = (t >= 3) * (i in FAULTY)
    columns = [t.round(1), *(values.round(4) for values in sensors), fault.astype(int)]
    return dict(zip(COLUMNS, (values.tolist() for values in columns), strict=True))


@dataclass
class Log:
    """A log that is spoilt, what of it is spoilt, and the bytes of its file if these are."""

    columns: dict
    thing: list = field(default_factory=list)
    content: bytes | None = None
    names: list | None = None


def text_of(log, separator=",", decimal="."):
    names = log.names or [*log.columns]
    rows = zip(*log.columns.values(), strict=True)
    lines = [separator.join(map(str, names))]
    for row in rows:
        cells = ("" if cell is None else str(cell).replace(".", decimal) for cell in row)
        lines.append(separator.join(cells))
    return "\n".join(lines) + "\n"


def write(path, log, form):
    if log.content is not None:
        path.write_bytes(log.content)
    elif form == "csv":
        path.write_text(text_of(log), encoding="utf-8")
    elif form == "jsonl":
        rows = (
            dict(zip(log.columns, row, strict=True))
            for row in zip(*log.columns.values(), strict=True)
        )
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    else:
        is_text = {n: any(isinstance(x, str) for x in c) for n, c in log.columns.items()}
        columns = {
            n: [None if x is None else str(x) for x in c] if is_text[n] else c
            for n, c in log.columns.items()
        }
        pq.write_table(pa.table(columns), path)


# Spoilers: each takes a random generator and the log, and names what it spoils


def _column(rng):
    return str(rng.choice(COLUMNS))


def cell(rng, log):
    values = ("#N/A", "-nan(ind)", "broken", None, "", 1e12, -1e300, float("inf"), "1e999", "nan")
    value, name = values[rng.integers(len(values))], _column(rng)
    row = int(rng.integers(ROWS))
    log.columns[name][row] = value
    log.thing += [name, f"row {row}", f"rows {row}"]


def several_cells(rng, log):
    name, start = _column(rng), int(rng.integers(1, ROWS - 10))
    value = (None, "#N/A", "off")[rng.integers(3)]
    for row in range(start, start + int(rng.integers(2, 9))):
        log.columns[name][row] = value
    log.thing += [name, f"row {start}"]


def last_cells(rng, log):
    name = _column(rng)
    for row in range(ROWS - int(rng.integers(1, 5)), ROWS):
        log.columns[name][row] = None
    log.thing += [name]


def _rename(log, old, new):
    log.columns = {new if name == old else name: cells for name, cells in log.columns.items()}
    log.thing += [old, new, old.partition("[")[0]]


def spelling(rng, log):
    name = _column(rng)
    bare, bracket, unit_of_it = name.partition("[")
    spellings = (
        bare.swapcase(),
        bare.upper(),
        unicodedata.normalize("NFD", bare),
        f" {bare} ",
        f"{bare}\N{NO-BREAK SPACE}",
        "\N{ZERO WIDTH SPACE}" + bare,
        f"{bare[0]}\N{ZERO WIDTH SPACE}{bare[1:]}",
        bare.translate({ord(c): ord(c) + 0xFEE0 for c in "abcdefghijklmnopqrstuvwxyz"}),
    )
    spelled = [spelling + bracket + unit_of_it for spelling in spellings]
    spelled += [f"{bare} ({unit_of_it.removesuffix(']')})"] * bool(bracket)
    _rename(log, name, spelled[rng.integers(len(spelled))])


def unit(rng, log):
    name = _column(rng)
    bare = name.partition("[")[0]
    units = ("", "[l/h]", "[ms]", "[m]", " (l/s)", "[L/s]")
    _rename(log, name, bare + units[rng.integers(len(units))])


def other_name(rng, log):
    _rename(log, _column(rng), ("speed", "x", "label", "u[l/s]")[rng.integers(4)])


def lost_column(rng, log):
    name = _column(rng)
    del log.columns[name]
    log.thing += [name, name.partition("[")[0]]


def more_columns(rng, log):
    name = ("note", "flow", "FLOW", "extra[l/s]")[rng.integers(4)]
    log.columns[name] = [float(x) for x in rng.normal(size=ROWS)]
    log.thing.append(name)


def stamps(rng, log):
    row, t = int(rng.integers(1, ROWS)), log.columns["t[s]"]
    kind = rng.integers(7)
    if kind == 0:
        t[row] = t[row - 1]
    elif kind == 1:
        t[row] = t[row - 1] - 0.7
    elif kind == 2:
        log.columns["t[s]"] = [x * 1000 for x in t]
    elif kind == 3:
        log.columns["t[s]"] = [x / 60 for x in t]
    elif kind == 4:
        t[row:] = [x + 100 for x in t[row:]]
    elif kind == 5:
        t[row] = "later"
    else:
        log.columns["t[s]"] = [f"2024-05-01T12:00:{x:06.3f}" for x in t]
    log.thing += ["t[s]", "stamp", f"row {row}", "gap", " s"]


def rows(rng, log):
    row, kind = int(rng.integers(1, ROWS - 9)), rng.integers(3)
    for cells in log.columns.values():
        if kind == 0:
            cells.insert(row, cells[row])
        elif kind == 1:
            cells[row], cells[row + 1] = cells[row + 1], cells[row]
        else:
            del cells[row : row + 5]
    log.thing += [f"row {row}", f"row {row + 1}", "stamp", "rows"]


def no_rows(_rng, log):
    log.columns = {name: [] for name in log.columns}
    log.thing.append("no rows")


def other_columns(rng, log):
    log.columns = {
        f"{c}{i}": cells
        for i, (c, cells) in enumerate(zip("wxyz", log.columns.values(), strict=True))
    }
    log.thing += [*COLUMNS, *log.columns, "flow"]


ANY = (cell, cell, cell, several_cells, last_cells, spelling, spelling, unit, other_name,
       lost_column, more_columns, stamps, stamps, rows, no_rows, other_columns)  # fmt: skip


def doubled_name(rng, log):
    name = _column(rng)
    log.names = [*log.columns, name]
    log.columns["double"] = [float(x) for x in rng.normal(size=ROWS)]
    log.thing.append(name.partition("[")[0])


def unit_row(_rng, log):
    for name, text in zip(log.columns, ("s", "l/s", "m", "-"), strict=True):
        log.columns[name] = [text, *log.columns[name]]
    log.thing += ["unit", "row 0", "text among numbers"]


def lines(rng, log):
    text = text_of(log).splitlines()
    row, kind = int(rng.integers(2, ROWS)), rng.integers(5)
    if kind == 0:
        text[row] = text[row].rpartition(",")[0]
    elif kind == 1:
        text[row] += ",7"
    elif kind == 2:
        text[-1] = text[-1].rpartition(",")[0].rpartition(",")[0]
    elif kind == 3:
        text[row] = text[row].replace(",", ";")
    else:
        text[row] = ""
        log.thing += ["rows"]
    log.content = "\n".join(text).encode()
    log.thing += [f"line {row}", f"line {row + 1}", f"row {row}", "last", "cell"]


def content(rng, log):
    text, kind = text_of(log), rng.integers(9)
    made = (
        lambda: b"",
        lambda: text.encode() + b"\0" * 100,
        lambda: text.encode()[:-40] + b"\0" * 40,
        lambda: bytes(rng.integers(0, 256, 500, np.uint8)),
        lambda: text.encode("utf-16"),
        lambda: text.encode("cp1252"),
        lambda: text.encode("utf-8-sig"),
        lambda: text_of(log, ";").encode(),
        lambda: text_of(log, ";", ",").encode(),
    )
    log.content = made[kind]()
    log.thing += ["no rows", "zero", "NUL", "read", "decode", "utf", "line", "byte", "encoding"]


CSV = (doubled_name, unit_row, lines, lines, content, content)


# Entrances: each returns what came out and what was said


def facts_of(episodes):
    return {(e.name, e.kind, e.intervals, len(e.observations)): e.observations for e in episodes}


def by_scan(folder):
    read = read_logs(folder)
    return [*read.sensors], facts_of(read.episodes), read.notes


def by_import(folder):
    with read_episodes(RECIPE, folder) as source:
        episodes = {
            (part, *key): rows
            for part in source.parts
            for key, rows in facts_of(source.episodes(part)).items()
        }
        return [*source.sensors], episodes, [*source.notes, *source.summary]


def equal(result, clean):
    (sensors, episodes, _), (clean_sensors, clean_episodes, _) = result, clean
    return (
        sensors == clean_sensors
        and episodes.keys() == clean_episodes.keys()
        and all(np.array_equal(x, clean_episodes[k], equal_nan=True) for k, x in episodes.items())
    )


ENTRANCES = {"scan": by_scan, "import": by_import}


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    results = {}
    for form in ("csv", "jsonl", "parquet"):
        folder = tmp_path_factory.mktemp(form)
        for i in range(FILES):
            write(folder / f"r{i:02}.{form}", Log(logs(i)), form)
        results[form] = folder, {name: read(folder) for name, read in ENTRANCES.items()}
    return results


@pytest.mark.parametrize("form", ["csv", "jsonl", "parquet"])
@pytest.mark.parametrize("entrance", ENTRANCES)
@pytest.mark.parametrize("seed", range(40))
def test_what_is_spoilt_changes_nothing_or_is_said(form, entrance, seed, clean):
    folder, results = clean[form]
    rng = np.random.default_rng([seed, len(form)])
    spoilers = (*ANY, *CSV) if form == "csv" else ANY
    spoil, i = spoilers[seed % len(spoilers)], int(rng.integers(FILES))
    log, path = Log(logs(i)), folder / f"r{i:02}.{form}"
    spoil(rng, log)
    before = path.read_bytes()
    try:
        write(path, log, form)
        result = ENTRANCES[entrance](folder)
        told = "\n".join(result[2])
    except OoddError as error:
        result, told = None, str(error)
    finally:
        path.write_bytes(before)
    assert result or spoil is not spelling, (log.thing, told)
    if result is None or not equal(result, results[entrance]):
        assert spoil is not spelling, (log.thing, told)
        assert path.stem in told, (spoil.__name__, log.thing, told)
        assert any(word in told for word in log.thing), (spoil.__name__, log.thing, told)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (("r25.csv", 7203.0, 7206.0, ""), ("r25.csv", "7203", "first stamp is 0.0", "last 5.9")),
        (("r25.csv", 600, 700, ""), ("r25.csv", "row 600", "60 rows", "600.0", "last 5.9")),
        (("r52.csv", 3.0, 6.0, ""), ("r52.csv",)),
    ],
)
def test_intervals_that_mark_nothing_are_refused_and_a_scan_says_them(row, words, clean):
    folder, _ = clean["csv"]
    marked = [(f"r{i}.csv", 3.0, 6.0, "") for i in FAULTY]
    recipe = dataclasses.replace(RECIPE, labels=(), intervals=(*marked, row))
    with pytest.raises(OoddError) as raised, read_episodes(recipe, folder):
        pass
    read = read_logs(folder, recipe)
    for told in (str(raised.value), "\n".join(read.notes)):
        assert all(word in told for word in words)
    assert len(read.episodes) == 2 * FILES


def test_a_split_keeps_what_became_of_its_logs_outside_its_digest(clean, tmp_path, capsys):
    folder, _ = clean["csv"]
    logs_of_it = shutil.copytree(folder, tmp_path / "logs")
    (logs_of_it / "r30.csv").touch()
    ledger = Ledger()
    whole = import_recipe(RECIPE, folder, tmp_path / "whole")
    split = import_recipe(RECIPE, logs_of_it, tmp_path / "split", ledger=ledger)
    assert split.digest == whole.digest
    line = "dropped: 1 file, no rows: r30.csv"
    assert line in split.manifest["environments"]["spoilt"]["ledger"]
    assert [entry["examples"] for entry in ledger.as_json()] == [["r30.csv"]]
    assert main(["data", "info", str(split.path)]) == 0
    run = ["run", "--detector", "range", "--split", str(split.path), "--output", str(tmp_path)]
    assert main([*run, "--env", "spoilt"]) == 0
    assert " ".join(capsys.readouterr().out.split()).count(line) == 2
    record = json.loads((tmp_path / "records.jsonl").read_text().splitlines()[0])
    assert line in record["provenance"]["logs"]


# In memory


def _strict(cells):
    """Cells of one type: texts where one is text."""
    is_text = any(isinstance(cell, str) for cell in cells)
    return [None if c is None else str(c) for c in cells] if is_text else cells


def _polars():
    return pytest.importorskip("polars")


def _masked(columns):
    """An array of numbers, masked where one is missing, with a broken number below the mask."""
    cells = np.array([*columns.values()], object).T
    mask = np.array([[cell is None for cell in row] for row in cells])
    return np.ma.masked_array(np.where(mask, 9999.0, cells).astype(float), mask)


FRAMES = {
    "pandas": pd.DataFrame,
    "polars": lambda columns: _polars().DataFrame({n: _strict(c) for n, c in columns.items()}),
    "lazy": lambda columns: _polars().LazyFrame({n: _strict(c) for n, c in columns.items()}),
    "arrow": lambda columns: pa.table({n: _strict(c) for n, c in columns.items()}),
    "mappings": lambda columns: [
        dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)
    ],
}
KEYS = {"labels": "fault", "time": "t[s]", "rate": 10, "sensors": ["flow[l/s]", "Größe"]}


def by_frames(frames, folder, keys):
    """Import episodes in memory, nominal ones first."""
    said = []
    parts = {"train": frames[:12], "calibration": frames[12:24], "test": frames[24:]}
    options = {"missing": "hold", "output": folder, "replace": True, "report": said.append}
    split = import_frames("frames", **parts, **options, **keys)
    data = split.environment("frames")
    parts = {"train": data.train, "calibration": data.calibration, "twins": data.twins}
    parts |= {kind: data.labelled(kind) for kind in data.anomalies}
    episodes = {(part, i): e.observations for part, es in parts.items() for i, e in enumerate(es)}
    episodes |= {(k, "rows"): np.array(data.labelled(k).intervals) for k in data.anomalies}
    return [q.name for q in data.sensors], episodes, said


def title(i):
    part = "train" if i < 12 else "calibration" if i < 24 else "test"
    return f"{part}-{i % 12}"


@pytest.fixture(scope="module")
def clean_frames(tmp_path_factory):
    @functools.cache
    def read(library):
        frames = [FRAMES[library](logs(i)) for i in range(FILES)]
        return by_frames(frames, tmp_path_factory.mktemp(library), KEYS)

    return read


@pytest.mark.parametrize("library", FRAMES)
@pytest.mark.parametrize("seed", range(16))
def test_what_is_spoilt_in_memory_changes_nothing_or_is_said(library, seed, tmp_path, clean_frames):
    rng = np.random.default_rng([seed, len(library)])
    spoil, i = ANY[seed % len(ANY)], int(rng.integers(FILES))
    log = Log(logs(i))
    spoil(rng, log)
    columns = [log.columns if j == i else logs(j) for j in range(FILES)]
    try:
        result = by_frames([*map(FRAMES[library], columns)], tmp_path, KEYS)
        told = "\n".join(result[2])
    except OoddError as error:
        result, told = None, str(error)
    if result is None or not equal(result, clean_frames(library)):
        assert title(i) in told, (spoil.__name__, log.thing, told)
        assert any(word in told for word in log.thing), (spoil.__name__, log.thing, told)


@pytest.mark.parametrize("seed", range(6))
def test_masked_cells_are_missing(seed, tmp_path):
    columns = [{n: logs(i)[n] for n in COLUMNS[1:3]} for i in range(FILES)]
    rng = np.random.default_rng(seed)
    i, name, row = int(rng.integers(24)), COLUMNS[1 + seed % 2], int(rng.integers(1, ROWS))
    columns[i][name][row] = None
    _, episodes, said = by_frames([*map(_masked, columns)], tmp_path, {})
    assert max(x.max() for (_, k), x in episodes.items() if k != "rows") < 10
    assert any(title(i) in line and f"row {row}" in line for line in said)
    scan = scan_episodes([*map(_masked, columns)], detector="mahalanobis")
    assert len(scan.episodes) == FILES
    assert np.isnan(scan.episodes[i].episode.observations[row, 0 if name == COLUMNS[1] else 1])

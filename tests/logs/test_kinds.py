"""Columns are read as what they are: times of any form, wraps, quaternions, counters, others'."""

import dataclasses
import tomllib
from datetime import datetime, timedelta

import numpy as np
import pytest
from helpers_logs import write_table as write
from oodd_logs import kinds
from oodd_logs.episodes import read_episodes
from oodd_logs.importing import import_recipe
from oodd_logs.inspection.draft import draft
from oodd_logs.inspection.logs import inspect_logs
from oodd_logs.kinds import Conversion, Kind
from oodd_logs.kinds.times import parse_times
from oodd_logs.recipe import Recipe

from oodd_eval.data.facts import Quantity
from oodd_eval.errors import PluginError, TrajectoryError, UsageError

ROWS = 240


def sensors(rng, rows=ROWS):
    return {"a": rng.normal(size=rows).round(4), "b": rng.normal(size=rows).round(4)}


def logs_of(folder, columns, files=6):
    """Logs of which a function of a generator, the rows and the file's number makes columns."""
    for i in range(files):
        rng = np.random.default_rng(i)
        write(folder / f"r{i}.csv", columns(rng, np.arange(ROWS), i) | sensors(rng))
    logs = inspect_logs(folder)
    return logs, Recipe.parse(tomllib.loads(draft(logs)))


def dates(form, step=1.0):
    return lambda rows: [
        (datetime(2025, 3, 4, 11, 58) + timedelta(seconds=step * row)).strftime(form)  # noqa: DTZ001
        for row in rows.tolist()
    ]


STAMPS = {
    "time [min]": lambda rows: rows / 60,
    "time_h": lambda rows: rows / 3600,
    "Time (days)": lambda rows: rows / 86400,
    "t": lambda rows: rows / 86400,
    "Timestamp": lambda rows: 45_000 + rows / 86400,
    "timeUs": lambda rows: rows * 1e6,
    "elapsed": lambda rows: [f"0 days 00:{r // 60:02}:{r % 60:02}.000" for r in rows.tolist()],
    "duration_time": lambda rows: [str(timedelta(seconds=r)) for r in rows.tolist()],
    "DateTime": dates("%d/%m/%Y %H:%M:%S"),
    "Zeit": dates("%d.%m.%y %H:%M:%S"),
    "Logged": dates("%m/%d/%Y %I:%M:%S %p"),
    "When": dates("%Y/%m/%d %H:%M:%S"),
    "Stamp": dates("%d-%b-%Y %H:%M:%S"),
}


@pytest.mark.parametrize("name", STAMPS)
def test_times_have_the_rate_that_was_logged_and_what_is_drafted_is_imported(tmp_path, name):
    logs, recipe = logs_of(tmp_path, lambda _rng, rows, _i: {name: STAMPS[name](rows)})
    assert (recipe.rate, recipe.sensors) == (1, ("a", "b"))
    import_recipe(recipe, tmp_path, tmp_path / "out")
    assert (name in {"DateTime", "Zeit", "Logged"}) == bool(recipe.dates)
    # What names and cells do not tell is said.
    guessed = {entry.name for entry in logs.ledger.of("column", "kept")}
    assert guessed == ({name} & {"t", "Timestamp", "DateTime", "Zeit", "Logged"})


PAIRS = {
    ("Date", "Time"): (dates("%d/%m/%Y"), dates("%I:%M:%S %p")),
    ("nanosec", "sec"): (lambda rows: rows % 4 * 250_000_000, lambda rows: 10**9 + rows // 4),
    ("t.secs", "t.nsecs"): (lambda rows: 10**9 + rows // 4, lambda rows: rows % 4 * 250_000_000),
    ("x.nanos", "x.seconds"): (lambda rows: rows % 4 * 250_000_000, lambda rows: rows // 4),
}


@pytest.mark.parametrize("names", PAIRS)
def test_times_of_two_columns_add_up_in_any_order(tmp_path, names):
    _, recipe = logs_of(
        tmp_path,
        lambda _rng, rows, _i: {n: f(rows) for n, f in zip(names, PAIRS[names], strict=True)},
    )
    assert ({*recipe.time}, recipe.rate) == ({*names}, 1 if "Date" in names else 4)
    assert recipe.sensors == ("a", "b")
    with read_episodes(dataclasses.replace(recipe, window=0), tmp_path) as source:
        assert {facts.rows for facts in source.parts["train"]} == {ROWS}


def test_one_cell_of_all_files_tells_day_from_month(tmp_path):
    def columns(_rng, rows, i):
        start = datetime(2025, 3, 4 + 4 * i)  # noqa: DTZ001
        return {
            "time": [f"{start + timedelta(seconds=r):%m/%d/%Y %H:%M:%S}" for r in rows.tolist()]
        }

    assert logs_of(tmp_path, columns)[1].dates == "month first"
    cells = np.array(["04/03/2025", "05/03/2025"])
    with pytest.raises(TrajectoryError, match="day first"):
        parse_times(cells)
    assert np.diff(parse_times(cells, "", "day first")).tolist() == [86400]
    assert np.diff(parse_times(np.append(cells, "13/03/2025"))).tolist() == [86400, 8 * 86400]
    for wrong in ("04/13/2025 11:61", "31/02/2025", "13:00 pm", "soon", "4 Foo 2025"):
        with pytest.raises(TrajectoryError, match="row 0"):
            parse_times(np.array([wrong]), "", "month first")


def test_a_unit_that_is_none_of_time_is_said(tmp_path):
    logs, recipe = logs_of(tmp_path, lambda _rng, rows, _i: {"t[ticks]": rows})
    assert (recipe.time, recipe.rate) == ((), None)
    assert "ticks" in logs.ledger.of("column", "kept")[0].reason


def turning(period, low=0.0, speed=0.012):
    def columns(rng, rows, i):
        turns = rng.uniform() + np.cumsum(speed * (1 + 0.3 * np.sin(rows / 20 + i)))
        return {"enc": (np.mod(turns, 1) * period + low + rng.normal(0, period / 9e3)).round(4)}

    return columns


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (turning(4096), {"wraps": {"enc": 4096.0}}),
        (turning(65536, -32768, -0.03), {"wraps": {"enc": 65536.0}}),
        (turning(24), {"wraps": {"enc": 24.0}}),
        (turning(1), {"wraps": {"enc": 1.0}}),
        (turning(400, -200), {"wraps": {"enc": 400.0}}),
        (turning(360, -180), {"angles": ("enc",)}),
        (turning(2 * np.pi), {"angles": ("enc",)}),
        (lambda _rng, rows, i: {"n": (rows + 17 * i) % 256}, {}),
        (lambda rng, rows, i: {"x": rows // (20 + i) % 2 * 50 + rng.normal(size=ROWS)}, {}),
        (lambda rng, rows, i: {"x": (rows > 99) * (i == 3) * 50 + rng.normal(size=ROWS)}, {}),
        (lambda rng, rows, _i: {"x": rng.uniform(0, 1, rows.size)}, {}),
        (lambda rng, rows, _i: {"x": np.repeat(rng.uniform(0, 9, rows.size // 20), 20)}, {}),
    ],
)  # fmt: skip
def test_what_begins_anew_is_told_from_what_jumps(tmp_path, columns, expected):
    assert logs_of(tmp_path, columns)[1].columns == expected


def read(folder, columns, **keys):
    """Return names of sensors and rows of two recordings with some columns."""
    for i, part in enumerate(("train", "cal")):
        write(folder / f"{part}.csv", {name: values[i] for name, values in columns.items()})
    content = {"split": "s", "sensors": "*", "nominal": {"train": "train.csv",
               "calibration": "cal.csv"}, **keys}  # fmt: skip
    with read_episodes(Recipe.parse(content), folder) as source:
        rows = [next(source.episodes(part)).observations for part in ("train", "calibration")]
        return [quantity.name for quantity in source.sensors], rows


def test_wraps_become_sine_and_cosine_and_counters_their_increments(tmp_path):
    columns = {"enc[ticks]": [[0, 1024, 4095]] * 2, "n": [[5, 7, 12]] * 2, "x": [[1, 2, 4]] * 2}
    names, (rows, _) = read(tmp_path, columns, wraps={"e*": 4096}, counters="n")
    assert names == ["sin enc", "cos enc", "step of n", "x"]
    assert rows[:, 0] == pytest.approx([0, 1, np.sin(-2 * np.pi / 4096)])
    assert rows[:, 2].tolist() == [0, 2, 5]
    for keys, message in (
        ({"wraps": {"e": 3}}, "'e'"),
        ({"wraps": {"enc": 0}}, "wraps.enc is 0"),
        ({"wraps": ["enc"]}, "a table of periods"),
        ({"wraps": {"enc": 2}, "counters": "enc"}, "below counters and wraps|wraps and counters"),
        ({"wrap": {"enc": 2}}, "did you mean 'wraps'"),
        ({"quaternions": ["x"]}, "four"),
        ({"quaternions": [["x", "n", "enc", "y"]]}, "'y'"),
    ):
        with pytest.raises(UsageError, match=message):
            read(tmp_path, columns, **keys)


def rotation(rng, rows, i):
    yaw = 3 + 0.8 * np.sin(rows / 25 + i) + rng.normal(0, 0.01, len(rows))
    tilt = rng.normal(0, 0.003, (2, len(rows)))
    return np.array([np.cos(yaw / 2), *tilt, np.sin(yaw / 2)])


@pytest.mark.parametrize(
    "names",
    [
        ("q_w", "q_x", "q_y", "q_z"),
        ("o.x", "o.y", "o.z", "o.w"),
        ("q[0]", "q[1]", "q[2]", "q[3]"),
        ("one", "two", "three", "four"),
    ],
)
def test_quaternions_are_told_and_their_sign_is_one(tmp_path, names):
    def columns(rng, rows, i, *, flips=True):
        values = rotation(rng, rows, i).round(6)
        signs = np.where((rows > 100 + i) & (i % 3 == 1), -1, 1) * (-1 if i == 2 else 1)
        return dict(zip(names, values * signs if flips else values, strict=True))

    _, recipe = logs_of(tmp_path, columns)
    assert recipe.columns == {"quaternions": (names,)}
    with read_episodes(recipe, tmp_path) as source:
        read_ = [e.observations[:, :4] for part in source.parts for e in source.episodes(part)]
    logs_of(tmp_path, lambda *arguments: columns(*arguments, flips=False))
    with read_episodes(recipe, tmp_path) as source:
        plain = [e.observations[:, :4] for part in source.parts for e in source.episodes(part)]
    sign = np.sign(read_[0][0] @ plain[0][0])
    assert all(np.array_equal(a, sign * b) for a, b in zip(read_, plain, strict=True))


def test_a_kind_of_a_plugin_is_told_drafted_and_converted(tmp_path, monkeypatch):
    kind = Kind(
        "decibel",
        "{names} in decibels: write {line}",
        "decibels",
        recognise=lambda columns: dict.fromkeys((n for n in columns if n.endswith("[dB]")), None),
        check=lambda _key, value: tuple(value),
        convert=lambda names, sensors: [
            Conversion((i,), (Quantity(s.name, "1"),), lambda: lambda rows: 10 ** (rows / 10))
            for i, s in enumerate(sensors)
            if s.name in names
        ],
    )
    with pytest.raises(UsageError, match="decibels"):
        Recipe.parse({"split": "s", "nominal": {"files": "*"}, "decibels": ["x"]})
    monkeypatch.setattr(kinds, "_registered", {})
    kinds.register_kinds([kind])
    _, recipe = logs_of(tmp_path, lambda rng, _rows, _i: {"p[dB]": rng.normal(size=ROWS)})
    assert recipe.columns == {"decibels": ("p",)}
    with read_episodes(recipe, tmp_path) as source:
        assert min(e.observations[:, 0].min() for e in source.episodes("train")) > 0
    with pytest.raises(PluginError, match="An angle"):
        kinds.check_kind(Kind("An angle", ""))


def spoilt(folder, columns, number=3):
    """Twelve logs, of which one has other columns."""
    for i in range(12):
        log = {"t": np.arange(ROWS) / 10} | sensors(np.random.default_rng(i))
        write(folder / f"r{i:02}.csv", columns(log) if i == number else log)
    logs = inspect_logs(folder)
    recipe = Recipe.parse(tomllib.loads(draft(logs)))
    files = {file.name for glob in recipe.nominal.files for file in folder.glob(glob)}
    return logs, recipe, files


@pytest.mark.parametrize("name", ["A", "\N{FULLWIDTH LATIN SMALL LETTER A}", "a[V]"])
def test_another_spelling_in_one_file_is_the_column_of_most(tmp_path, name):
    logs, recipe, files = spoilt(tmp_path, lambda log: {name: log.pop("a")} | log)
    assert (recipe.sensors, len(files)) == (("a", "b"), 12) or recipe.sensors == ("b", "a")
    assert {"r03.csv"} == {s for e in logs.ledger.of("column", "changed") for s in e.sources}
    assert logs.columns["a"].recordings == 12
    # The first file may be the exception, too.
    logs, _, _ = spoilt(tmp_path, lambda log: {name: log.pop("a")} | log, 0)
    assert {"r00.csv"} == {s for e in logs.ledger.of("column", "changed") for s in e.sources}
    assert logs.columns["a"].recordings == 12


@pytest.mark.parametrize(
    "columns",
    [
        lambda log: {n: x for n, x in log.items() if n != "a"},
        lambda log: log | {"a": ["off"] * ROWS},
        lambda log: {n: [] for n in log},
    ],
)
def test_a_column_that_one_file_lacks_is_a_sensor_and_the_file_left_out(tmp_path, columns):
    logs, recipe, files = spoilt(tmp_path, columns)
    assert {*recipe.sensors} == {"a", "b"}
    assert (len(files), "r03.csv" in files) == (11, False)
    assert any("r03.csv" in entry.sources for entry in logs.ledger)
    import_recipe(recipe, tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    ("code", "every", "recognised"),
    [(-999, 1, True), (65535, 2, True), (9999, 12, False), (12.5, 1, False)],
)
def test_a_code_for_missing_values_is_told_by_several_files(tmp_path, code, every, recognised):
    def columns(rng, rows, i):
        signal = np.sin(rows / 9).round(4)
        signal[40:43] = code if i % every == 0 else signal[40:43]
        return {"t": rows / 10, "x": signal}

    _, recipe = logs_of(tmp_path, columns, files=12)
    assert recipe.columns.get("missing_codes") == ({"x": (code,)} if recognised else None)
    with read_episodes(recipe, tmp_path) as source:
        column = [quantity.name for quantity in source.sensors].index("x")
        largest = max(e.observations[:, column].max() for e in source.episodes("train"))
    assert (largest > 5) == (code > 0 and not recognised)

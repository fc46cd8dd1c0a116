"""Episodes that are in memory: whatever library they are of, they are the same episodes."""

import datetime as dt
import decimal
import types

import numpy as np
import pytest
from oodd_logs import Topic, import_frames, scan_episodes
from oodd_logs.episodes import EVERY
from oodd_logs.frames import recordings_of, scanned_frames

from oodd_eval.errors import TrajectoryError, UsageError

ROWS = 40


def walk(seed, start=0, stop=0):
    """Two sensors that follow one another; from `start` to `stop` the second is shifted."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=ROWS).cumsum() * 0.1
    b = 2 * a + rng.normal(size=ROWS) * 0.1
    b[start:stop] += 5
    return {"a": a, "b": b, "fault": np.isin(np.arange(ROWS), range(start, stop))}


class Table:
    """What data frames of other libraries share: columns, and columns that become arrays."""

    def __init__(self, columns):
        self._columns, self.columns = columns, [*columns]

    def __getitem__(self, name):
        return types.SimpleNamespace(to_numpy=lambda: np.asarray(self._columns[name]))


class Lazy:
    """A frame that has its rows when it is asked for them."""

    def __init__(self, columns):
        self._columns = columns

    def collect(self):
        return Table(self._columns)


class Stream:
    """What offers nothing but a stream of arrow's."""

    def __init__(self, columns):
        self._table = library("pyarrow").table(columns)

    def __arrow_c_stream__(self, requested_schema=None):
        return self._table.__arrow_c_stream__(requested_schema)


def library(name):
    return pytest.importorskip(name)


def fields(columns):
    return np.rec.fromarrays([*columns.values()], names=[*columns])


FORMS = {
    "pandas": lambda e: library("pandas").DataFrame(e),
    "nullable": lambda e: library("pandas").DataFrame(e).convert_dtypes(),
    "polars": lambda e: library("polars").DataFrame(e),
    "lazy polars": lambda e: library("polars").LazyFrame(e),
    "arrow": lambda e: library("pyarrow").table(e),
    "batch": lambda e: library("pyarrow").table(e).to_batches()[0],
    "reader": lambda e: library("pyarrow").table(e).to_reader(),
    "stream": Stream,
    "another library": Table,
    "lazy": Lazy,
    "fields": fields,
    "masked fields": lambda e: np.ma.masked_array(fields(e)),
    "mapping": dict,
    "rows": lambda e: [dict(zip(e, row, strict=True)) for row in zip(*e.values(), strict=True)],
}


EPISODES = [walk(i) for i in range(13)] + [walk(13, 10, 15)]


def imported(make, folder):
    episodes = [*map(make, EPISODES)]
    parts = {"train": episodes[:6], "calibration": episodes[6:10]}
    parts["test"] = {"nominal": episodes[10:13], "bump": episodes[13:]}
    return import_frames("arm", **parts, labels="fault", output=folder, report=len)


@pytest.fixture(scope="module")
def digest(tmp_path_factory):
    return imported(Table, tmp_path_factory.mktemp("plain")).digest


@pytest.mark.parametrize("form", FORMS)
def test_one_split_and_one_scan_whatever_the_form(form, digest, tmp_path):
    split = imported(FORMS[form], tmp_path)
    assert split.digest == digest
    data = split.environment("arm")
    assert data.labelled("bump").intervals == [((10, 15),)]
    assert [q.name for q in data.sensors] == ["a", "b"]
    with scanned_frames([*map(FORMS[form], EPISODES)], ["b", "a"]) as source:
        assert [q.name for q in source.sensors] == ["b", "a"]
        for episode, columns in zip(source.episodes(EVERY), EPISODES, strict=True):
            expected = np.stack([columns["b"], columns["a"]], axis=1)
            assert np.array_equal(episode.observations, expected)


def test_a_scan_of_frames_is_that_of_their_arrays():
    scan = scan_episodes([*map(Table, EPISODES)], sensors=["b", "a"], detector="mahalanobis")
    arrays = [np.stack([e["b"], e["a"]], axis=1) for e in EPISODES]
    plain = scan_episodes(arrays, sensors=["b", "a"], detector="mahalanobis")
    values, expected = ([e.as_json() for e in result.episodes] for result in (scan, plain))
    assert [v["name"] for v in values] == [f"episode {i}" for i in range(14)]
    assert [v["largest"] for v in values] == pytest.approx([v["largest"] for v in expected])
    assert scan_episodes([*map(Table, EPISODES)], detector="mahalanobis").sensors == [
        "a",
        "b",
        "fault",
    ]


MASK = [False, True, False]
HIDDEN = {"fill_value": 9999, "mask": MASK}


def masked(values, dtype=None):
    return np.ma.masked_array(np.array(values, dtype), mask=MASK)


COLUMNS = {
    "masked": lambda: masked([1.0, 9999.0, 3.0]),
    "masked, whole numbers": lambda: np.ma.masked_array([1, 9999, 3], **HIDDEN),
    "masked truth": lambda: masked([True, True, False]),
    "masked objects": lambda: masked([1, 9999, 3], object),
    "masked text": lambda: masked(["x", "9999", "z"]),
    "masked dates": lambda: masked(["2024-01-01", "1999-09-09", "2024-01-02"], "M8[D]"),
    "masked durations": lambda: masked([1, 9999, 3], "m8[s]"),
    "masked among others": lambda: [1.0, np.ma.masked, 3],
    "None": lambda: [1, None, 3],
    "NaN among texts": lambda: ["x", float("nan"), "z"],
    "decimals": lambda: [decimal.Decimal("1.5"), None, decimal.Decimal(3)],
    "bytes": lambda: np.array([b"x", b"", b"z"]),
    "durations": lambda: [dt.timedelta(seconds=1), None, dt.timedelta(seconds=3)],
    "NaT": lambda: np.array([1000, "NaT", 3000], "m8[ms]"),
    "Int64": lambda: library("pandas").Series([1, None, 3], dtype="Int64"),
    "boolean": lambda: library("pandas").Series([True, None, False], dtype="boolean"),
    "string": lambda: library("pandas").Series(["x", None, "z"], dtype="string"),
    "category": lambda: library("pandas").Series(["x", None, "z"], dtype="category"),
    "category of numbers": lambda: library("pandas").Series([1, None, 3], dtype="category"),
    "timedelta": lambda: library("pandas").Series(
        library("pandas").to_timedelta([1, None, 3], "s")
    ),
    "dates of a zone": lambda: library("pandas").Series(
        library("pandas").to_datetime(["2024-01-01", None, "2024-01-02"], utc=True)
    ),
    "arrow": lambda: library("pyarrow").chunked_array([[1, None, 3]]),
    # As an array, of arrow's own making, it is x, z, z.
    "arrow's dictionary": lambda: library("pyarrow").chunked_array(
        [library("pyarrow").array(["x", None, "z"]).dictionary_encode()]
    ),
    "arrow's times": lambda: library("pyarrow").array(
        [1, None, 3], library("pyarrow").timestamp("us", "UTC")
    ),
}


@pytest.mark.parametrize("kind", COLUMNS)
def test_what_is_missing_is_missing_and_no_fill_value(kind):
    ((_, recording),) = recordings_of("train-", [{"c": COLUMNS[kind]()}])
    cells = recording.topics[""].read(["c"], 0, 3)["c"]
    missing = np.isnan(cells) if cells.dtype.kind == "f" else cells == ""
    assert missing.tolist() == MASK
    if cells.dtype.kind == "f":
        assert cells[0] in {1.0, 1.5}
    else:
        assert cells[0] == "x" or cells[0].startswith(("2024-01-01", "1970-01-01"))


def hidden(seed, rows=60):
    values = np.random.default_rng(seed).normal(size=(rows, 2))
    values[20:25, 0] = 9999
    return np.ma.masked_equal(values, 9999)


@pytest.mark.parametrize(
    "make", [hidden, lambda i: [*hidden(i)], lambda i: (hidden(i), hidden(i)[1:])]
)
def test_masked_arrays_are_held_dropped_or_refused(make, tmp_path):
    parts = {"train": [*map(make, range(5))], "calibration": [*map(make, range(5, 10))]}
    for missing, rows in (("hold", {60}), ("drop", {54, 55})):
        output = tmp_path / missing
        split = import_frames("m", **parts, missing=missing, output=output, report=len)
        for episode in split.environment("m").train:
            assert len(episode) in rows
            assert np.abs(episode.observations).max() < 10
    with pytest.raises(TrajectoryError, match="train-0, row 20, column 'obs:sensor 0' is missing"):
        import_frames("m", **parts, output=tmp_path / "refuse", report=len)


def test_a_scan_of_masked_arrays_is_that_of_missing_values():
    episodes = [hidden(i) for i in range(12)]
    plain = [episode.filled(np.nan) for episode in episodes]
    first, second = (scan_episodes(e, detector="mahalanobis").as_json() for e in (episodes, plain))
    assert first == second


def test_frames_in_a_list_are_told_apart_by_their_labels_and_stamps_may_be_an_index(tmp_path):
    pandas = library("pandas")
    indices = {
        "dates": pandas.date_range("2024-05-01", periods=ROWS, freq="100ms", name="when"),
        "durations": pandas.timedelta_range(0, periods=ROWS, freq="100ms", name="when"),
        "levels": pandas.MultiIndex.from_tuples(
            [("run", t / 10) for t in range(ROWS)], names=["name", "when"]
        ),
    }
    for name, index in indices.items():
        frames = [pandas.DataFrame(walk(i)).set_index(index) for i in range(9)]
        frames.append(pandas.DataFrame(walk(9, 10, 15)).set_index(index))
        data = import_frames(
            "arm", train=frames[:4], calibration=frames[4:7], test=frames[7:], labels="fault",
            time="when", rate=10, environment="joint", output=tmp_path / name, report=len,
        ).environment("joint")  # fmt: skip
        assert (len(data.twins), data.logs.rate) == (2, 10.0)
        assert data.labelled("anomaly").intervals == [((10, 15),)]


def levels():
    return library("pandas").DataFrame({("a", "x"): [1.0], ("a", "y"): [2.0]})


def doubled():
    return library("pandas").DataFrame(np.zeros((3, 3)), columns=[1, "b", "1"])


def doubled_in_arrow():
    arrow = library("pyarrow")
    return arrow.Table.from_arrays([arrow.array([1.0])] * 2, ["a", "a"])


@pytest.mark.parametrize(
    ("episode", "word"),
    [
        (lambda: np.zeros((3, 2, 2)), r"shape \(3, 2, 2\)"),
        (lambda: np.array([["x"]]), "numbers"),
        (lambda: (np.zeros((5, 2)), np.zeros((9, 1))), "5 observations and 9 actions"),
        (levels, r"several levels, such as \('a', 'x'\)"),
        (doubled, "several columns '1'"),
        (doubled_in_arrow, "several columns 'a'"),
        (lambda: np.zeros((3, 2), complex), "complex numbers"),
        (lambda: {"a": [1j, 2]}, "column 'a': complex numbers"),
        (lambda: np.array([[1, "x"]], object), "'x'"),
        (lambda: np.zeros((3, 2), "M8[s]"), "dates"),
        (lambda: {"a": [{"x": 1}]}, "column 'a'.*dict"),
        (lambda: [{"a": [1, 2]}, {"a": [3, 4]}], r"column 'a' has cells of shape \(2,\)"),
        (lambda: {"a": [1], "b": [1, 2]}, "lengths"),
        (lambda: [[1, 2], [3]], "list is no array"),
        (lambda: {1.0, 2.0}, "set"),
        (lambda: None, r"shape \(\)"),
    ],
)
def test_what_is_no_episode_is_refused_in_a_sentence(tmp_path, episode, word):
    with pytest.raises(TrajectoryError, match=f"train-0: .*{word}"):
        import_frames(
            "arm", train=[episode()], calibration=[episode()], output=tmp_path, report=len
        )
    with pytest.raises((TrajectoryError, UsageError), match="episode 0"):
        scan_episodes([episode()] * 12)


def test_wrong_arguments(tmp_path):
    with pytest.raises(UsageError, match="import_frames 'windw'"):
        import_frames("arm", train=[], calibration=[], windw=3, report=len)
    for call in (
        lambda frame: import_frames(
            "arm", train=frame, calibration=[], output=tmp_path, report=len
        ),
        scan_episodes,
    ):
        with pytest.raises(TrajectoryError, match="one Table, expected a list"):
            call(Table(walk(1)))
    frames = [Table(walk(i)) for i in range(12)]
    scan = scan_episodes(
        [*frames, Table({"a": np.zeros(ROWS)})], sensors=["a", "b"], detector="mahalanobis"
    )
    assert len(scan.episodes) == 12
    assert "episode 12" in "".join(scan.ledger.lines())


def test_a_reader_may_hand_masked_columns_over():
    topic = Topic.of({"a": masked([1, 9999, 3]), "b": masked(["x", "9999", "z"])})
    cells = topic.read(["a", "b"], 0, 3)
    assert np.isnan(cells["a"]).tolist() == (cells["b"] == "").tolist() == MASK

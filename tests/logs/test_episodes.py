"""A recipe makes episodes of recordings: columns, stamps, missing values, labels, parts."""

import re
from pathlib import Path

import numpy as np
import pytest
from helpers_logs import write_table as write
from oodd_logs.episodes import make_episodes, read_episodes
from oodd_logs.marks import anomalous_cells, merged
from oodd_logs.recipe import Recipe
from oodd_logs.recorded import Recorded
from oodd_logs.recording import Recording, Topic
from oodd_logs.rows import TopicRows

from oodd_eval.errors import OoddError, TrajectoryError, UnknownNameError, UsageError


def table(rows, seed=0, **more):
    rng = np.random.default_rng(seed)
    return {"a": rng.normal(size=rows).round(6), "b": rng.normal(size=rows).round(6)} | more


def recipe(**keys):
    """Files of three parts, unless the keys name others."""
    nominal = {"train": "train*.csv", "calibration": "cal*.csv"}
    content = {"split": "s", "sensors": ["a", "b"], "nominal": nominal} | keys
    return Recipe.parse({k: v for k, v in content.items() if v is not None})


def folder(root, rows=10, **more):
    for i in range(2):
        write(root / f"train{i}.csv", table(rows, i, **more))
        write(root / f"cal{i}.csv", table(rows, 10 + i, **more))
    return root


def read(root, **keys):
    with read_episodes(recipe(**keys), root) as source:
        parts = {part: list(source.episodes(part)) for part in source.parts}
    return source, parts


def said(source):
    return [*source.notes, *source.summary]


def problem(root, **keys):
    with pytest.raises(OoddError) as raised:
        read(root, **keys)
    return str(raised.value)


# Columns


def test_rows_stay_as_they_are_without_stamps(tmp_path):
    folder(tmp_path)
    source, parts = read(tmp_path)
    assert [q.name for q in source.sensors] == ["a", "b"]
    episode = parts["train"][1]
    expected = table(10, 1)
    assert np.array_equal(episode.observations[:, 0], expected["a"])
    assert np.array_equal(episode.observations[:, 1], expected["b"])
    assert (episode.name, episode.actions.shape, episode.rewards) == ("train1", (9, 0), None)


def test_globs_renames_and_units_choose_columns(tmp_path):
    names = {"q1[rad]": [1, 2, 3], "q2": [4, 5, 6], "x[0]": [7, 8, 9], "note": ["p", "q", "r"],
             "u": [1, 1, 2]}  # fmt: skip
    for part in ("train", "cal"):
        write(tmp_path / f"{part}.csv", names)
    sensors = ["q*[rad]", "wheel[m] = x[0]"]
    source, parts = read(tmp_path, sensors=sensors, actions="u")
    assert [(q.name, q.unit) for q in source.sensors] == [
        ("q1", "rad"), ("q2", "rad"), ("wheel", "m"),
    ]  # fmt: skip
    assert parts["train"][0].observations.tolist() == [[1, 4, 7], [2, 5, 8], [3, 6, 9]]
    # What the last action led to was not recorded.
    assert parts["train"][0].actions.tolist() == [[1], [1]]
    assert [e.name for e in source.ledger.of("column", "dropped")] == ["note"]
    assert any("note" in line for line in said(source))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"sensors": ["q1", "quark"]}, ["'quark'", "cal.csv"]),
        ({"sensors": ["bb"]}, ["'bb'", "did you mean"]),
        ({"sensors": ["new = q*"]}, ["renames 2 columns"]),
        ({"sensors": ["q1[deg]"]}, ["rad", "deg", "not converted"]),
        ({"sensors": ["z = q1", "z = q2"]}, ["two sensors named 'z'"]),
        ({"sensors": ["q1", "mode"]}, ["row 1", "'mode'", "'AUTO'", "'MANUAL'"]),
        ({"sensors": ["q1"], "actions": ["v"]}, ["'v'"]),
        ({"sensors": ["q1"], "labels": "wrong"}, ["'wrong'"]),
        ({"sensors": ["q1"], "time": "tick"}, ["'tick'"]),
        ({"sensors": ["q1"], "angles": "p*"}, ["'p*'"]),
        ({"sensors": ["q1"], "task": "job"}, ["'job'"]),
        ({"sensors": None}, ["obs:NAME[UNIT]", "sensors = "]),
    ],
)
def test_a_wrong_name_is_told_with_the_names_there_are(tmp_path, keys, words):
    columns = {
        "q1[rad]": [1, 2, 3],
        "q2": [3, 4, 5],
        "b": [5, 6, 7],
        "mode": ["", "AUTO", "MANUAL"],
    }
    for part in ("train", "cal"):
        write(tmp_path / f"{part}.csv", columns)
    message = problem(tmp_path, **keys)
    assert all(word in message for word in words), message


def test_columns_in_another_order_are_the_same_and_missing_ones_are_not(tmp_path):
    folder(tmp_path, d=np.full(10, 3.0))
    source, parts = read(tmp_path, sensors=["d", "a"])
    assert len(source.sensors) == 2
    source, parts = read(tmp_path, sensors=["d", "a"], constant="drop")
    assert [q.name for q in source.sensors] == ["a"]
    assert np.array_equal(parts["train"][0].observations[:, 0], table(10, 0)["a"])
    assert any("d" in line and "constant" in line for line in said(source))
    rows = table(10, 3)
    write(tmp_path / "train1.csv", {"d": rows["b"], "b": rows["b"], "c": rows["a"], "a": rows["a"]})
    source, parts = read(tmp_path, sensors="*")
    assert np.array_equal(parts["train"][1].observations[:, 0], rows["a"])
    assert [e.name for e in source.ledger.of("column", "dropped")] == ["c"]
    write(tmp_path / "train1.csv", {"b": rows["b"]})
    assert "lacks a[1]" in problem(tmp_path, sensors="*")


def test_angles_become_sine_and_cosine(tmp_path):
    for part in ("train", "cal"):
        write(tmp_path / f"{part}.csv", {"q[deg]": [0, 90, 359], "a": [1, 2, 3]})
    source, parts = read(tmp_path, sensors=["q", "a"], angles="q")
    assert [q.name for q in source.sensors] == ["sin q", "cos q", "a"]
    degrees = np.radians([0, 90, 359])
    rows = parts["train"][0].observations
    assert rows[:, 0] == pytest.approx(np.sin(degrees))
    assert rows[:, 1] == pytest.approx(np.cos(degrees))


def test_discrete_actions_become_one_hot_rows(tmp_path):
    for part in ("train", "cal"):
        write(tmp_path / f"{part}.csv", table(4, u=[0, 2, 1, ""]))
    source, parts = read(tmp_path, actions="u", discrete=["left", "stay", "right"])
    assert source.discrete
    assert [q.name for q in source.actions] == ["left", "stay", "right"]
    assert parts["train"][0].actions.tolist() == [[1, 0, 0], [0, 0, 1], [0, 1, 0]]
    assert "action 1 is 2" in problem(tmp_path, actions="u", discrete=2)


# Stamps


def in_memory(topics, fields=None, name="run", **keys):
    """Read one recording that is in memory as training and calibration."""
    recording = Recording(name, name, topics, fields or {})
    content = {"split": "s", "nominal": {"train": "x", "calibration": "y"}} | keys
    made = Recipe.parse(content)
    recorded = [
        Recorded(recording, tmp, str(tmp), frozenset({part}))
        for part, tmp in (("train", Path("x")), ("calibration", Path("y")))
    ]
    with make_episodes(made, recorded) as source:
        return source, list(source.episodes("train"))


def test_topics_are_joined_on_a_grid_and_nothing_is_taken_from_the_future():
    rng = np.random.default_rng(0)
    fast_times = np.cumsum(rng.uniform(0.005, 0.015, 400))
    slow_times = np.cumsum(rng.uniform(0.08, 0.12, 40)) - 0.05
    topics = {
        "/imu": Topic.of({"t": fast_times, "acc.x": np.arange(400.0)}),
        "/odom": Topic.of({"t": slow_times, "v": np.arange(40.0)}),
    }
    source, (episode,) = in_memory(topics, sensors=["/imu.acc.*", "/odom.v"], time="t", rate=50,
                                   gap=1.0)  # fmt: skip
    assert [q.name for q in source.sensors] == ["/imu.acc.x", "/odom.v"]
    begin = max(fast_times[0], slow_times[0])
    steps = 1e-3 / 50
    for k, (x, v) in enumerate(episode.observations):
        t = begin + k / 50
        assert x == np.flatnonzero(fast_times <= t + steps)[-1]
        assert v == np.flatnonzero(slow_times <= t + steps)[-1]
    end = max(fast_times[-1], slow_times[-1])
    assert len(episode.observations) == int((end - begin) * 50 + 1e-3) + 1
    assert episode.time == pytest.approx(begin + np.arange(len(episode.observations)) / 50)


def fast_and_slow(fast, slow):
    """Two topics whose values are their stamps."""
    return {
        name: Topic.of({"t": np.array(times), "v": np.array(times)})
        for name, times in (("imu", fast), ("gps", slow))
    }


JOINED = {"sensors": ["imu.v", "gps.v"], "time": "t", "rate": 50}


def test_steps_of_a_slow_topic_are_no_gaps():
    fast, slow = np.arange(2500) / 250, 0.1 + np.arange(10.0)
    for keys in ({}, {"gap": 2.0}):
        _, (episode,) = in_memory(fast_and_slow(fast, slow), **JOINED, **keys)
        assert len(episode.observations) == int((fast[-1] - slow[0]) * 50 + 1e-3) + 1
    with pytest.raises(UsageError, match=r"'gps' are 1 s, expected a gap of more, not 0.5 s"):
        in_memory(fast_and_slow(fast, slow), **JOINED, gap=0.5)
    with pytest.raises(UsageError, match="rate"):
        in_memory(fast_and_slow(fast, slow), sensors=["imu.v", "gps.v"], time="t")
    # A topic that ends early ends the recording.
    fast, slow = np.arange(0, 30, 0.004), np.arange(0.0, 10)
    _, (episode,) = in_memory(fast_and_slow(fast, slow), **JOINED, gap=3.0)
    assert episode.time[-1] == pytest.approx(12, abs=0.02)


@pytest.mark.parametrize("silent", ["imu", "gps"])
def test_a_gap_is_where_any_topic_is_silent(silent):
    fast, slow = np.arange(0, 60, 0.004), np.arange(0.0, 60)
    if silent == "imu":
        fast = fast[(fast <= 20) | (fast >= 45)]
    else:
        slow = slow[(slow <= 20) | (slow >= 45)]
    with pytest.raises(TrajectoryError, match=rf"gap of 25 s after 20 s in topic '{silent}'"):
        in_memory(fast_and_slow(fast, slow), **JOINED)
    source, (first, second) = in_memory(fast_and_slow(fast, slow), **JOINED, gap=3.0)
    # What is silent holds for as long as a gap may last, and no longer.
    ends = {"imu": 23.0, "gps": 23.0}
    assert first.time[-1] == pytest.approx(ends[silent], abs=0.02)
    assert second.time[0] == 45
    for episode in (first, second):
        behind = episode.time[:, None] - episode.observations
        assert behind.min() > -1e-4
        assert behind.max() < 3.0 + 1e-3
    assert any("another topic has none" in line for line in said(source))


def test_a_clock_that_was_set_back_is_cut_and_labels_and_times_follow(tmp_path):
    stamps = [0, 1, 2, 3, 4, 2.5, 3.5, 4.5, 5.5, 6.5]
    folder(tmp_path, t=stamps)
    message = problem(tmp_path, time="t")
    assert "row 5 is stamped 2.5" in message
    assert "gap" in message
    fault = [0, 0, 0, 0, 1, 1, 0, 0, 1, 0]
    write(tmp_path / "odd.csv", table(10, 5, t=stamps, fault=fault))
    _, parts = read(
        tmp_path, time="t", gap=5, labels="fault", anomalous={"x": {"files": "odd.csv"}}
    )
    assert [len(e.observations) for e in parts["train"]] == [5, 5, 5, 5]
    a = table(10, 0)["a"]
    assert np.array_equal(parts["train"][1].observations[:, 0], a[5:])
    assert [e.intervals for e in parts["test/x"]] == [((4, 5),), ((0, 1), (3, 4))]
    # A time that the clock showed twice is that of the first rows.
    for start, stop, intervals in ((2.5, 3.5, [((3, 4),)]), (5.0, 6.0, [((3, 4),)]),
                                   (0, 7, [((0, 5),), ((0, 2),)])):  # fmt: skip
        _, parts = read(
            tmp_path, time="t", gap=5, intervals=[["odd.csv", start, stop]],
            anomalous={"x": {"files": "odd.csv"}},
        )  # fmt: skip
        assert [e.intervals for e in parts["test/x"]] == intervals, start


@pytest.mark.parametrize(
    ("unit", "stamps"),
    [
        ("t", np.arange(10) / 10),
        ("t[s]", 1.7e9 + np.arange(10) / 10),
        ("t[ms]", 1.7e12 + np.arange(10) * 100),
        ("t[us]", np.arange(10) * 1e5),
        ("t[ns]", np.arange(10) * 1e8),
        ("t", [f"2024-05-01T12:00:00.{i}00" for i in range(10)]),
        ("t", [f"2024-05-01 12:00:00.{i}Z" for i in range(10)]),
        ("t", [f"2024-05-01T12:00:00.{i}+02:00" for i in range(10)]),
    ],
)
def test_stamps_may_be_in_any_unit(tmp_path, unit, stamps):
    folder(tmp_path, t=[repr(s) if isinstance(s, float) else s for s in np.array(stamps).tolist()])
    source, parts = read(tmp_path, time=unit, rate=20)
    rows = parts["train"][0].observations[:, 0]
    assert rows == pytest.approx(np.repeat(table(10, 0)["a"], 2)[:19])
    assert source.rate == 20


def test_even_stamps_say_the_rate_and_uneven_ones_are_reported(tmp_path):
    folder(tmp_path, t=np.arange(10) / 4)
    source, _ = read(tmp_path, time="t")
    assert source.rate == pytest.approx(4)
    folder(tmp_path, t=[0, 1, 2, 3, 5, 6, 7, 9, 10, 11])
    source, parts = read(tmp_path, time="t")
    assert source.rate is None
    assert any("1 to 2 s apart" in line for line in said(source))
    assert parts["train"][0].observations.shape == (10, 2)


@pytest.mark.parametrize(
    ("stamps", "keys", "words"),
    [
        ([0, 1, 2, 1.5, 3, 4, 5, 6, 7, 8], {"rate": 1}, ["row 3", "before row 2"]),
        ([0, 1, 2, 2, 3, 4, 5, 6, 7, 8], {}, ["row 3", "as row 2", "rate"]),
        ([0, 1, 2, 3, 4, 90, 91, 92, 93, 94], {"rate": 1}, ["gap of 86 s", "gap = "]),
        ([0, 1, 2, "soon", 3, 4, 5, 6, 7, 8], {"rate": 1}, ["'soon'", "row 3"]),
        ([0, 1, 2, "", 3, 4, 5, 6, 7, 8], {"rate": 1}, ["row 3 has no stamp"]),
        ([i * 1000 for i in range(10)], {"rate": 1}, ["unit", "NAME[ms]"]),
    ],
)
def test_wrong_stamps_are_told_with_their_row(tmp_path, stamps, keys, words):
    folder(tmp_path)
    write(tmp_path / "train1.csv", table(10, 1, t=stamps))
    write(tmp_path / "train0.csv", table(10, 1, t=range(10)))
    for i in range(2):
        write(tmp_path / f"cal{i}.csv", table(10, 1, t=range(10)))
    message = problem(tmp_path, time="t", **keys)
    assert "train1.csv" in message
    assert all(word in message for word in words), message


def test_gaps_cut_recordings_and_of_rows_with_one_stamp_the_later_one_holds(tmp_path):
    folder(tmp_path, t=[0, 1, 2, 3, 60, 61, 62, 63, 64, 65])
    _, parts = read(tmp_path, time="t", rate=1, gap=5)
    assert [e.name for e in parts["train"]] == ["train0#0", "train0#1", "train1#0", "train1#1"]
    assert [len(e.observations) for e in parts["train"]] == [4, 6, 4, 6]
    a = table(10, 0)["a"]
    assert np.array_equal(parts["train"][1].observations[:, 0], a[4:])
    # A step as long as the gap cuts nothing.
    folder(tmp_path, t=[0, 1, 2, 3, 8, 9, 10, 11, 12, 13])
    _, parts = read(tmp_path, time="t", rate=1, gap=5)
    assert [len(e.observations) for e in parts["train"]] == [14, 14]
    folder(tmp_path, t=[0, 1, 2, 2, 3, 4, 5, 6, 7, 8])
    _, parts = read(tmp_path, time="t", rate=1)
    assert np.array_equal(parts["train"][0].observations[:, 0], np.delete(a, 2))


# Missing values


def gappy(root):
    folder(root)
    a = [*"__", 1, 2, "_", "_", 5, 6, 7, 8]
    b = ["_", 1, "_", 3, 4, 5, 6, 7, 8, 9]
    cells = {n: ["" if c == "_" else c for c in v] for n, v in {"a": a, "b": b}.items()}
    for i in range(2):
        write(root / f"train{i}.csv", cells)
    return root


HELD = [[1, 1], [2, 3], [2, 4], [2, 5], [5, 6], [6, 7], [7, 8], [8, 9]]


@pytest.mark.parametrize(
    ("missing", "rows", "note"),
    [
        ("hold", HELD, ("4 rows", "before the first value", "in 2 of 4")),
        (
            "drop",
            [row for i, row in enumerate(HELD) if i not in (0, 2, 3)],
            ("10 rows", "missing values", "in 2 of 4"),
        ),
    ],
)
def test_missing_values_are_held_or_their_rows_dropped(tmp_path, missing, rows, note):
    message = problem(gappy(tmp_path))
    for word in ("train0.csv, row 0", "'a'", "missing", "'hold'", "'drop'"):
        assert word in message
    source, parts = read(tmp_path, missing=missing)
    assert parts["train"][0].observations.tolist() == rows
    assert any(all(word in line for word in note) for line in said(source))
    message = problem(tmp_path, missing=missing, missing_rows=1)
    for word in ("train0.csv, row 4", "2 rows", "missing_rows"):
        assert word in message


def test_values_are_held_over_the_blocks_in_which_they_are_read(tmp_path, monkeypatch):
    usual = TopicRows.__init__

    def make(self, *arguments):
        usual(self, *arguments)
        self._step = 3

    for module in ("rows", "recording"):
        monkeypatch.setattr(f"oodd_logs.{module}.CELLS", 3)
    monkeypatch.setattr(TopicRows, "__init__", make)
    _, parts = read(gappy(tmp_path), missing="hold")
    assert parts["train"][0].observations.tolist() == HELD
    assert "2 rows" in problem(tmp_path, missing="hold", missing_rows=1)


# Labels


@pytest.mark.parametrize(
    ("values", "keys"),
    [
        ([0, 0, 1, 1, 0, 0, 2, 0, 0, 0], {}),
        ([False, False, True, True, False, False, True, False, False, False], {}),
        (["H", "H", "A", "A", "H", "H", "A", "H", "H", "H"], {}),
        (["", "", "x", "y", "", "", "x", "", "", ""], {}),
        ([7, 7, 0, 0, 7, 7, 0, 7, 7, 7], {"nominal_label": 7}),
        (["ok", "ok", "H", "H", "ok", "ok", "H", "ok", "ok", "ok"], {"nominal_label": "ok"}),
    ],
)
def test_labels_may_switch_back_and_end_before_the_file(tmp_path, values, keys):
    def labelled(values):
        folder(tmp_path)
        write(tmp_path / "odd.csv", table(10, 5, label=values))
        return read(tmp_path, labels="label", anomalous={"leak": {"files": "odd.csv"}}, **keys)

    source, parts = labelled(values)
    (episode,) = parts["test/leak"]
    assert episode.intervals == ((2, 4), (6, 7))
    assert episode.kind == "leak"
    assert source.groups == {"leak": "dynamics"}
    assert any("2 intervals with 3 anomalous rows" in line for line in said(source))
    with pytest.raises(TrajectoryError, match=r"odd\.csv has no anomalous row .* in 'label'"):
        labelled([values[0]] * 10)


@pytest.mark.parametrize(
    ("name", "good", "bad", "keys", "message"),
    [
        (
            "y",
            1,
            -1,
            {},
            r"-1 is the label of nominal rows in some .* nominal_label = \[1\], if .*most",
        ),
        ("y", -1, 1, {}, r"nominal_label = \[-1\], if that is nominal, as in most rows"),
        ("y", "normal", "fault", {}, r"none of them is nominal .* nominal_label = \[\"normal\"\]"),
        ("y", "N", "F", {}, r"'N' \(55 rows\), 'F' \(5 rows\)"),
        ("y", "OK", "NOK", {}, r"nominal_label = \[\"OK\"\]"),
        ("y", 1, 2, {}, r"none of them is nominal \(0, false, H, or nothing\)"),
        ("y", 1, 0, {"nominal_label": "OK"}, r"nominal_label is \['OK'\]"),
        ("healthy", 1, 0, {}, r"by its name 1 is nominal, .* write nominal_label = \[1\]"),
    ],
)
def test_labels_that_do_not_say_what_is_nominal_are_refused(
    tmp_path, name, good, bad, keys, message
):
    folder(tmp_path, **{name: [good] * 10})
    write(tmp_path / "odd0.csv", table(10, 5, **{name: [good] * 10}))
    write(tmp_path / "odd1.csv", table(10, 6, **{name: [good] * 5 + [bad] * 5}))
    keys |= {"labels": name, "anomalous": {"leak": {"files": "odd1.csv"}}}
    keys["nominal"] = {"train": "train*.csv", "calibration": "cal*.csv", "test": "odd0.csv"}
    assert re.search(message, problem(tmp_path, **keys))
    _, parts = read(tmp_path, **keys | {"nominal_label": good})
    assert [e.intervals for e in parts["test/leak"]] == [((5, 10),)]


@pytest.mark.parametrize("before", [False, True])
def test_a_label_that_is_missing_is_that_of_the_row_before(before):
    cells = np.array([np.nan, 1.0, np.nan, 0.0, np.nan])
    expected = [before, True, True, False, False]
    assert anomalous_cells(cells, recipe(), before=before).tolist() == expected
    # Intervals that touch or overlap are one.
    rows = [(9, 12, "x"), (5, 9, ""), (20, 30, ""), (22, 24, ""), (40, 41, "")]
    assert merged(rows) == ((5, 12), (20, 30), (40, 41))
    assert merged([(-1, 3, ""), (3, 5, "")]) == ((-1, 5),)


def test_labels_follow_rows_that_are_resampled_and_short_ones_are_not_lost(tmp_path):
    times = {"t": np.arange(40) / 10}
    labels = np.zeros(40, int)
    labels[7], labels[20:30] = 1, 1
    keys = {"time": "t", "rate": 2, "anomalous": {"leak": {"files": "odd.csv"}}}
    for name in ("train0", "train1", "cal0", "cal1"):
        write(tmp_path / f"{name}.csv", table(40, **times))
    write(tmp_path / "odd.csv", table(40, 5, label=labels, **times))
    _, parts = read(tmp_path, labels="label", **keys)
    # Row 7 is at .7 s, between the rows at .5 and 1 s; rows 20 to 29 are 2.0 to 2.9 s.
    assert parts["test/leak"][0].intervals == ((2, 3), (4, 6))


def test_labels_follow_rows_that_are_dropped(tmp_path):
    a = [*range(4), "", "", *range(6, 10)]
    label = [0, 0, 0, 0, 1, 1, 1, 1, 0, 0]
    folder(tmp_path)
    write(tmp_path / "odd.csv", {"a": a, "b": range(10), "label": label})
    keys = {"labels": "label", "missing": "drop", "anomalous": {"leak": {"files": "odd.csv"}}}
    _, parts = read(tmp_path, **keys)
    assert parts["test/leak"][0].intervals == ((4, 6),)
    assert parts["test/leak"][0].observations[:, 0].tolist() == [0, 1, 2, 3, 6, 7, 8, 9]


def test_a_nominal_file_with_anomalous_rows_is_refused_unless_windows_divide_it(tmp_path):
    label = [0] * 10 + [0, 0, 0, 1, 1] + [0] * 15
    for name in ("run0", "run1"):
        write(tmp_path / f"{name}.csv", table(30, label=label))
    keys = {"labels": "label", "nominal": {"files": "run*.csv"},
            "anomalous": {"leak": {"files": "run*.csv"}}}  # fmt: skip
    message = problem(tmp_path, **keys | {"anomalous": None})
    for word in ("run0.csv", "rows 13 to 14", "window"):
        assert word in message
    source, parts = read(tmp_path, **keys, window=5)
    assert [len(parts[p]) for p in ("train", "calibration", "test/nominal")] == [4, 3, 3]
    assert [e.intervals for e in parts["test/leak"]] == [((3, 5),)] * 2
    # Without a kind for them, such windows are left out.
    source, parts = read(tmp_path, **keys | {"anomalous": None}, window=5)
    assert "test/leak" not in parts
    assert any("dropped: 2 episodes, windows with anomalous rows" in line for line in said(source))


def test_onsets_intervals_and_fields_name_rows(tmp_path):
    folder(tmp_path)
    write(tmp_path / "odd" / "x.csv", table(10, 5))
    write(tmp_path / "odd" / "y.1.csv", table(10, 6))
    files = {"leak": {"files": "odd/*.csv"}}
    _, parts = read(tmp_path, anomalous=files, onset=4, stop=9)
    assert [e.intervals for e in parts["test/leak"]] == [((4, 9),)] * 2
    _, parts = read(tmp_path, anomalous={"leak": {"files": "odd/*.csv", "onset": 3}})
    assert [e.intervals for e in parts["test/leak"]] == [((3, 10),)] * 2
    (tmp_path / "labels.csv").write_text("file, start, stop\nx.csv, 2, 4\nx, 6,\ny.1, , 5\n")
    _, parts = read(tmp_path, anomalous=files, intervals="labels.csv")
    assert [e.intervals for e in parts["test/leak"]] == [((2, 4), (6, 10)), ((-1, 5),)]
    for rows, word in [
        ([["z.csv", 1, 2]], "'z.csv'"),
        ([["x.csv", 1, 2], ["x.csv", 1, 2]], "twice"),
        ([["x.csv", 4, 2]], "from 4 to 2"),
        ([["x.csv", 1, 20]], "row 20"),
        ([["x.csv", 1.5, 2.5]], "stamps"),
    ]:
        assert word in problem(tmp_path, anomalous=files, intervals=rows)


def test_intervals_may_be_times_and_name_kinds(tmp_path):
    stamps = [f"2024-05-01T12:00:{i:02d}" for i in range(20)]
    write(tmp_path / "run.csv", table(20, t=stamps))
    intervals = [["run.csv", "2024-05-01 12:00:06", "2024-05-01 12:00:09", "Oil Leak"],
                 ["run.csv", "2024-05-01 12:00:17", "", "jam"]]  # fmt: skip
    source, parts = read(
        tmp_path, time="t", window=5, intervals=intervals,
        nominal={"files": "run.csv", "parts": [0.5, 0.5]},
        anomalous={"jam": {"group": "sensor"}},
    )  # fmt: skip
    assert [e.intervals for e in parts["test/oil-leak"]] == [((1, 4),)]
    assert [e.intervals for e in parts["test/jam"]] == [((2, 5),)]
    assert source.groups == {"oil-leak": "dynamics", "jam": "sensor"}
    assert len(parts["train"]) == len(parts["calibration"]) == 1


# Outcomes, kinds, tasks


def objects(root, rows):
    import json

    root.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(row) for row in rows]
    (root / "log.jsonl").write_text("\n".join(lines))


def episodes_of(n, **fields):
    rng = np.random.default_rng(n)
    return [
        {"id": i, "steps": [{"a": float(a), "b": float(b)} for a, b in rng.normal(size=(5 + i, 2))]}
        | {name: value(i) for name, value in fields.items()}
        for i in range(n)
    ]


def test_outcomes_tell_nominal_episodes_from_failures_and_tasks_share_out(tmp_path):
    objects(tmp_path, episodes_of(24, success=lambda i: i % 4 != 3, task=lambda i: i // 12))
    _, parts = read(
        tmp_path, nominal={"files": "*.jsonl"}, outcome="success", task="task", sensors="*"
    )
    sizes = {part: len(episodes) for part, episodes in parts.items()}
    assert sizes == {"train": 8, "calibration": 4, "test/nominal": 6, "test/failure": 6}
    assert [e.task for e in parts["train"]] == ["0"] * 4 + ["1"] * 4
    failure = parts["test/failure"][0]
    assert (failure.intervals, failure.outcome, failure.task) == ((), False, "0")
    assert parts["train"][0].outcome is True
    assert "'maybe'" in (
        objects(tmp_path, episodes_of(3, success=lambda i: "maybe"))
        or problem(tmp_path, nominal={"files": "*.jsonl"}, outcome="success", sensors="*")
    )


def test_a_field_may_name_the_anomaly_or_choose_episodes(tmp_path):
    kinds = ["normal", "normal", "Front Collision", "normal", "slip"]
    objects(tmp_path, episodes_of(5, cls=lambda i: kinds[i]))
    source, parts = read(
        tmp_path, sensors="*", kinds="cls", onset=0,
        nominal={"files": "*.jsonl", "where": {"cls": "normal"}},
        anomalous={"slip": {"group": "sensor"}},
    )  # fmt: skip
    assert source.groups == {"front-collision": "dynamics", "slip": "sensor"}
    assert [e.intervals for e in parts["test/slip"]] == [((0, 9),)]
    assert sum(len(parts[p]) for p in ("train", "calibration", "test/nominal")) == 3
    objects(tmp_path, episodes_of(9, day=lambda i: i % 3))
    _, parts = read(
        tmp_path, sensors="*", nominal={"files": "*.jsonl", "where": {"day": [0, "1"]}},
        anomalous={"odd": {"files": "*.jsonl", "where": {"day": 2}}},
    )  # fmt: skip
    assert {len(e.observations) % 3 for e in parts["test/odd"]} == {(5 + 2) % 3}
    assert sum(len(parts[p]) for p in ("train", "calibration", "test/nominal")) == 6


# Parts


def test_parts_follow_one_another_in_natural_order_or_are_shuffled(tmp_path):
    for i in range(1, 13):
        write(tmp_path / f"run_{i}.csv", table(10, i))
    keys = {"nominal": {"files": "run_*.csv", "parts": [0.5, 0.25, 0.25]}}

    def names(**more):
        source, parts = read(tmp_path, **keys, **more)
        three = [parts[part] for part in ("train", "calibration", "test/nominal")]
        return source, [[e.name for e in part] for part in three]

    source, (train, calibration, test) = names()
    assert train + calibration + test == [f"run_{i}" for i in range(1, 13)]
    assert (len(train), len(calibration), len(test)) == (6, 3, 3)
    assert "nominal episodes were shared out in the order of files" in said(source)
    source, mixed = names(order="shuffled", seed=1)
    every = [name for part in mixed for name in part]
    assert every != train + calibration + test
    assert sorted(every) == sorted(train + calibration + test)
    assert any("shuffled (seed 1)" in line for line in said(source))
    assert names(order="shuffled", seed=1)[1] == mixed
    # Stamps order recordings where none overlap.
    keys = {"time": "t", "nominal": {"files": "r_*.csv", "parts": [0.34, 0.33, 0.33]}}
    for name, start in {"a": 2000, "b": 0, "c": 1000}.items():
        write(tmp_path / f"r_{name}.csv", table(10, t=start + np.arange(10)))
    assert names()[1] == [["r_b"], ["r_c"], ["r_a"]]
    write(tmp_path / "r_a.csv", table(10, t=5 + np.arange(10)))
    assert names()[1] == [["r_a"], ["r_b"], ["r_c"]]


def test_windows_cut_recordings_and_what_is_left_over_is_said(tmp_path):
    folder(tmp_path, 25)
    source, parts = read(tmp_path, window=10)
    assert [len(e.observations) for e in parts["train"]] == [10] * 4
    assert np.array_equal(parts["train"][1].observations[:, 0], table(25, 0)["a"][10:20])
    assert any("20 rows, at ends" in line for line in said(source))
    _, parts = read(tmp_path, window=30)
    assert [len(e.observations) for e in parts["train"]] == [25, 25]
    # The last window of a fault may be shorter.
    folder(tmp_path, fault=[0] * 10)
    write(tmp_path / "odd.csv", table(10, 5, fault=[0] * 8 + [1] * 2))
    odd = {"odd": {"files": "odd.csv"}}
    _, parts = read(tmp_path, labels="fault", window=4, anomalous=odd)
    (episode,) = parts["test/odd"]
    assert (len(episode.observations), episode.intervals) == (2, ((0, 2),))
    assert {len(e.observations) for e in parts["train"]} == {4}


def test_a_baseline_is_shorter_than_every_episode_and_nominal(tmp_path):
    folder(tmp_path)
    assert "11" in problem(tmp_path, baseline=10)
    write(tmp_path / "odd.csv", table(10, label=[0, 0, 0, 1, 1, 0, 0, 0, 0, 0]))
    keys = {"labels": "label", "anomalous": {"leak": {"files": "odd.csv"}}}
    _, parts = read(tmp_path, baseline=3, **keys)
    assert parts["test/leak"][0].intervals == ((3, 5),)
    message = problem(tmp_path, baseline=4, **keys)
    assert "odd.csv" in message
    assert "baseline" in message


def test_too_few_episodes_and_files_are_told(tmp_path):
    assert "matches no file" in problem(tmp_path)
    write(tmp_path / "one.csv", table(10))
    message = problem(tmp_path, nominal={"files": "one.csv"})
    assert "no train" in message or "no calibration" in message
    assert "window" in message
    write(tmp_path / "one.foo", table(10))
    assert "ending" in problem(tmp_path, nominal={"files": "one.foo"})
    with pytest.raises(UnknownNameError, match="csw"):
        read(tmp_path, nominal={"files": "one.csv"}, read={"format": "csw"})
    write(tmp_path / "train.csv", table(1))
    write(tmp_path / "cal.csv", table(10))
    assert "1 observation" in problem(tmp_path)


# Values that float32 cannot tell


def test_a_northing_has_its_training_mean_subtracted(tmp_path):
    rng = np.random.default_rng(0)
    walk = 5.4e6 + 0.05 * rng.normal(size=(4, 50))
    names = ("train0", "train1", "cal0", "cal1")
    for name, north in zip(names, walk, strict=True):
        write(tmp_path / f"{name}.csv", {"n": north, "a": north - 5.4e6})
    source, parts = read(tmp_path, sensors=["n", "a"])
    assert source.offsets == (pytest.approx(walk[:2].mean(), abs=1e-9), 0.0)
    rows = parts["train"][0].observations
    assert rows[:, 0] == pytest.approx(walk[0] - walk[:2].mean(), abs=1e-8)
    assert any("training mean" in line for line in said(source))
    source, _ = read(tmp_path, sensors=["a"])
    assert source.offsets == ()


def test_a_constant_that_moves_later_has_it_too_and_others_keep_their_value(tmp_path):
    for name in ("train0", "train1"):
        write(tmp_path / f"{name}.csv", table(10, c=np.full(10, 5.4e6)))
    write(tmp_path / "cal0.csv", table(10, c=5.4e6 + np.arange(10) / 100))
    source, parts = read(tmp_path, sensors=["a", "c"])
    assert source.offsets == (0.0, 5.4e6)
    assert parts["calibration"][0].observations[:, 1] == pytest.approx(np.arange(10) / 100)
    folder(tmp_path, firmware=[7] * 10)
    source, parts = read(tmp_path, sensors=["a", "firmware"])
    assert source.offsets == ()
    assert (parts["train"][0].observations[:, 1] == 7).all()


def test_ends_of_recordings_known_by_their_outcome_are_left_out_as_nominal_ones_are(tmp_path):
    folder(tmp_path, 25)
    write(tmp_path / "bad.csv", table(25, 5))
    bad = {"bad": {"files": "bad.csv"}}
    source, parts = read(tmp_path, window=10, anomalous=bad)
    assert [len(e.observations) for e in parts["test/bad"]] == [10, 10]
    assert any("25 rows, at ends" in line for line in said(source))
    (warning,) = [line for line in said(source) if line.startswith("warning")]
    assert "test/bad was cut by window" in warning
    # What is shorter than a window from the start is whole.
    source, parts = read(tmp_path, window=30, anomalous=bad)
    assert [len(e.observations) for e in parts["test/bad"]] == [25]
    assert not any("warning" in line for line in said(source))
    source, _ = read(tmp_path, window=10, anomalous={"bad": bad["bad"] | {"onset": 0}})
    assert not any("warning" in line for line in said(source))

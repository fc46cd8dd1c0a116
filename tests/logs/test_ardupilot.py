"""Logs of ArduPilot, which the tests write from the published format."""

import contextlib
import struct

import numpy as np
import pytest
from helpers_logs import draft_recipe
from oodd_logs.inspection.logs import recognised
from oodd_logs.readers import readers

from oodd_eval.errors import TrajectoryError

CODES = {
    "b": "b", "B": "B", "c": "h", "C": "H", "d": "d", "e": "i", "E": "I", "f": "f", "g": "e",
    "h": "h", "H": "H", "i": "i", "I": "I", "L": "i", "M": "B", "n": "4s", "N": "16s", "q": "q",
    "Q": "Q", "Z": "64s",
}  # fmt: skip


UNITS = {"s": b"s", "m": b"m", "D": b"deg", "n": b"m/s", "v": b"V"}


def message(number, types, *values):
    layout = "<" + "".join(CODES[letter] for letter in types)
    return b"\xa3\x95" + bytes([number]) + struct.pack(layout, *values)


def defined(number, name, types, columns):
    """The FMT of a message."""
    length = 3 + struct.calcsize("<" + "".join(CODES[letter] for letter in types))
    texts = (text.encode() for text in (name, types, columns))
    return message(128, "BBnNZ", number, length, *texts)


HEAD = b"".join(
    [
        defined(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
        defined(1, "UNIT", "QbZ", "TimeUS,Id,Label"),
        defined(3, "FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds"),
        defined(10, "XKF4", "QBccC", "TimeUS,C,SV,SP,OFN"),
        defined(11, "GPS", "QLefH", "TimeUS,Lat,Alt,Spd,Volt"),
        defined(12, "MSG", "QZ", "TimeUS,Message"),
        defined(13, "MODE", "QMn", "TimeUS,Mode,Name"),
        defined(14, "NONE", "Qf", "TimeUS,A"),
        *(message(1, "QbZ", 0, ord(c), text) for c, text in UNITS.items()),
        message(3, "QBNN", 0, 10, b"s#---", b"F----"),
        message(3, "QBNN", 0, 11, b"sDmnv", b"FGB0C"),
        message(12, "QZ", 5, b"ArduCopter"),
    ]
)  # fmt: skip


def flight(rows=200, seed=0):
    """Two instances of a filter's ratios in every row, and positions in every second one."""
    rng = np.random.default_rng(seed)
    parts = [HEAD]
    for i in range(rows):
        for core in (0, 1):
            ratios = rng.integers(0, 90, 3).tolist()
            parts.append(message(10, "QBccC", 100_000 * i + 7, core, *ratios))
        if i % 2 == 0:
            at = 475_000_001 + i, 12_345 + int(rng.integers(99)), rng.normal(), 1200 + i
            parts.append(message(11, "QLefH", 100_000 * i + 9, *at))
    parts.append(message(13, "QMn", 50, 4, b"LOIT"))
    return b"".join(parts)


def opened(path, **options):
    return next(iter(readers()["ardupilot"].read(path, options)))


def cells(topic, *names):
    columns = topic.read(names or topic.names, 0, topic.rows)
    return {name: column.tolist() for name, column in columns.items()}


def test_messages_are_topics_by_instance(tmp_path):
    path = tmp_path / "flight.BIN"
    path.write_bytes(flight(4))
    log = opened(path)
    assert [*log.topics] == ["XKF4", "XKF4_1", "GPS", "MODE"]
    gps = log.topics["GPS"]
    assert (gps.names, gps.time) == (("time", "Lat", "Alt", "Spd", "Volt"), "time")
    assert cells(gps, "time", "Lat", "Volt") == {
        "time": [9e-6, 0.200009], "Lat": [47.5000001, 47.5000003], "Volt": [1200, 1202],
    }  # fmt: skip
    assert gps.read(["Alt"], 1, 2)["Alt"] == pytest.approx([123.45], abs=1)
    first, second = log.topics["XKF4"], log.topics["XKF4_1"]
    draws = np.random.default_rng(0).integers(0, 90, 6) / 100
    assert first.read(["SV", "SP", "OFN"], 0, 1) == dict(
        zip(["SV", "SP", "OFN"], draws, strict=False)
    )
    assert second.read(["SV", "SP", "OFN"], 0, 1) == dict(
        zip(["SV", "SP", "OFN"], draws[3:], strict=True)
    )
    assert cells(log.topics["MODE"]) == {"time": [5e-5], "Mode": [4], "Name": ["LOIT"]}
    assert log.ledger.lines() == ["dropped: column MSG, about the log"]
    assert [*opened(path, topics=["*_1"]).topics] == ["XKF4_1"]


def test_test_ratios_of_its_filter_are_proposed_as_scores(tmp_path):
    for i in range(3):
        (tmp_path / f"{i}.bin").write_bytes(flight(seed=i))
    recipe = draft_recipe(tmp_path)
    assert (recipe.format, recipe.rate) == ("ardupilot", 5)
    assert recipe.scores == ("XKF4.SV", "XKF4.SP", "XKF4_1.SV", "XKF4_1.SP")
    assert "GPS.Spd" in recipe.sensors
    # Anything may end in .bin.
    (tmp_path / "log.csv").write_text("a,b\n1,2\n3,4\n")
    assert recognised(tmp_path, "")[0].name == "csv"


def test_what_is_damaged_is_skipped_and_said(tmp_path):
    path = tmp_path / "flight.bin"
    whole = flight(50)
    path.write_bytes(whole)
    before = {name: cells(topic) for name, topic in opened(path).topics.items()}
    cut = whole.index(b"\xa3\x95\x0a", len(HEAD) + 500)
    path.write_bytes(whole[:cut] + b"\xa3\x95\xee" + bytes(90) + whole[cut:] + bytes(300))
    log = opened(path)
    assert {name: cells(topic) for name, topic in log.topics.items()} == before
    said = (
        'changed: 1 recording, it is damaged: what lies between its messages is skipped: "93 bytes"'
    )
    assert said in log.ledger.lines()
    # The rest of a page is no damage.
    path.write_bytes(whole + bytes(300) + b"\xa3")
    assert len(opened(path).ledger.lines()) == 1


@pytest.mark.parametrize("content", [b"", b"\xa3\x95", b"PK\x03\x04" * 99, HEAD, HEAD[:50]])
def test_what_is_no_log_of_it_is_refused(tmp_path, content):
    path = tmp_path / "weights.bin"
    path.write_bytes(content)
    with pytest.raises(TrajectoryError, match=r"weights\.bin"):
        opened(path)


@pytest.mark.parametrize("number", range(60))
def test_random_damage_never_ends_in_another_error(tmp_path, number):
    rng = np.random.default_rng(number)
    content = np.frombuffer(flight(9), np.uint8).copy()
    places = rng.integers(0, len(content), 40)
    content[places] = rng.integers(0, 256, 40)
    path = tmp_path / "flight.bin"
    path.write_bytes(content.tobytes()[: int(rng.integers(1, len(content)))])
    with contextlib.suppress(TrajectoryError):
        for topic in opened(path).topics.values():
            assert {len(column) for column in cells(topic).values()} == {topic.rows}

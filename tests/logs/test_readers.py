"""Readers of logs: what files of each format hold comes back, and damage is told with the file."""

import functools
import gzip
import io
import json
import math
import struct
import zipfile

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from helpers_plugins import install
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as Ros2Writer
from oodd_logs import readers as logs
from oodd_logs.kinds.times import parse_times
from oodd_logs.minari_files import export
from oodd_logs.readers import Reader, check_reader, library, readers, register_readers
from oodd_logs.readers.cells import column_names, conventional, nearest_spelling
from oodd_logs.readers.gathered import Gathered
from oodd_logs.recording import Recording, Topic
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import oodd_eval
from oodd_eval.cli.main import main
from oodd_eval.errors import (
    MissingExtraError,
    PluginError,
    TrajectoryError,
    UnknownNameError,
    UsageError,
)
from oodd_eval.plugins.discovery import discover


def recordings(form, path, **options):
    return [*readers()[form].read(path, options)]


def rows(topic, *names):
    """All rows of some columns of a topic, as lists."""
    cells = topic.read(names or topic.names, 0, topic.rows)
    return {name: column.tolist() for name, column in cells.items()}


def table(form, path, **options):
    """The one recording with one topic that a file is."""
    (recording,) = recordings(form, path, **options)
    return recording.topics[""]


def written(tmp_path, text, name="run.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


# Text.


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("t,x\n0,1.5\n1,-2e3\n", {"t": [0, 1], "x": [1.5, -2000]}),
        ("t;x\n0;1,5\n1;-2,25\n", {"t": [0, 1], "x": [1.5, -2.25]}),
        ("t\tx\n0\t1\n", {"t": [0], "x": [1]}),
        ("t;x\n0;1.234\n1;2,5\n", {"t": [0, 1], "x": [1234, 2.5]}),
        ("t;x;y\n" + "0;1;1\n" * 200 + "0;2,5;1\n",
         {"t": [0] * 201, "x": [1] * 200 + [2.5], "y": [1] * 201}),
        ("t|x\n0|1\n", {"t": [0], "x": [1]}),
        ("t x\n0  1\n1 2\n", {"t": [0, 1], "x": [1, 2]}),
        ("sep=;\nt;x\n0;1\n", {"t": [0], "x": [1]}),
        ('"t","x, y"\n"0","1"\n', {"t": [0], "x, y": [1]}),
        ("\ufefft, x\n0, 1\n", {"t": [0], "x": [1]}),
        ("%time,x\n2020-01-01,1\n", {"%time": ["2020-01-01"], "x": [1]}),
        ("# t,x\n0,1\n2,3\n", {"t": [0, 2], "x": [1, 3]}),
        ("# from the plant\nt,x\n0,1\n", {"t": [0], "x": [1]}),
        ("x, x,x\n1,2,3\n", {"x": [1], "x (2)": [2], "x (3)": [3]}),
        ("t;x;;;\n0;1;;;\n1;2;;;\n", {"t": [0, 1], "x": [1, 2]}),
        ("t,,x\n0,5,1\n", {"t": [0], "column 2": [5], "x": [1]}),
        ("t,ok\n0,True\n1,false\n", {"t": [0, 1], "ok": [1, 0]}),
        ("mode,x\nauto,1\n,2\n", {"mode": ["auto", ""], "x": [1, 2]}),
        ("0,1\n2,3\n", {"0": [0, 2], "1": [1, 3]}),
        ("2020-01-01 00:00:01,1\n2020-01-01 00:00:02,3\n",
         {"0": ["2020-01-01 00:00:01", "2020-01-01 00:00:02"], "1": [1, 3]}),
        ("x\n1\n2\n", {"x": [1, 2]}),
        ("x,y\n1,2\n\n3,4\n,\n\n", {"x": [1, 3], "y": [2, 4]}),
        ("x,n\n1_000,2\n", {"x": ["1_000"], "n": [2]}),
        ("time,x\n0,1\r\n1,2\r\n", {"time": [0, 1], "x": [1, 2]}),
        ('x,note\n1,"two\nlines"\n2,b\n', {"x": [1, 2], "note": ["two\nlines", "b"]}),
        ("x,y\n", {"x": [], "y": []}),
    ],
)  # fmt: skip
def test_a_csv_file_is_read_as_it_is(tmp_path, text, columns):
    assert rows(table("csv", written(tmp_path, text))) == columns


def test_options_say_how_a_csv_file_is_laid_out(tmp_path):
    path = written(tmp_path, "made by a plant\nh°;x\n1;1,5\n", encoding="cp1252")
    with pytest.raises(TrajectoryError, match="UnicodeDecodeError"):
        recordings("csv", path, skip=1)
    topic = table("csv", path, skip=1, encoding="cp1252", separator=";", decimal=",")
    assert rows(topic) == {"h°": [1], "x": [1.5]}
    numbered = written(tmp_path, "1,2\n3,4\n")
    named = {"a": [1, 3], "b[bar]": [2, 4]}
    assert rows(table("csv", numbered, names=["a", "b[bar]"])) == named
    assert rows(table("csv", numbered, header=True)) == {"1": [3], "2": [4]}
    wide = written(tmp_path, "t\u20ac;x\n1;2", encoding="utf-16")
    assert rows(table("csv", wide)) == {"t\u20ac": [1], "x": [2]}
    for cell in ("", "nan", "NaN", "NA", "N/A", "null", "None", " "):
        topic = table("csv", written(tmp_path, f"t,x\n0,1\n1,{cell}\n2,3\n"))
        assert rows(topic)["x"] == pytest.approx([1, np.nan, 3], nan_ok=True)
    # A last row may lack its commands.
    text = "obs:x,action:u,reward\n1,5,0\n2,6,0\n3,,\n"
    cells = rows(table("csv", written(tmp_path, text)))
    assert cells["action:u"] == pytest.approx([5, 6, np.nan], nan_ok=True)
    assert rows(table("csv", written(tmp_path, text.replace("3,,", "3"))))["obs:x"] == [1, 2, 3]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seperator": ";"}, "did you mean 'separator'"),
        ({"separator": ";;"}, "expected one character"),
        ({"decimal": ";"}, "expected '.' or ','"),
        ({"encoding": "klingon"}, "expected one such as utf-8"),
        ({"names": ["a"]}, "has 2 columns"),
        ({"names": "a"}, "expected a list"),
        ({"skip": -1}, "expected a whole number"),
        ({"header": 1}, "expected true or false"),
        ({"transpose": "yes"}, "expected true, false or a list of globs"),
    ],
)
def test_a_wrong_option_is_refused_with_what_is_expected(tmp_path, options, message):
    with pytest.raises(UsageError, match=message):
        recordings("csv", written(tmp_path, "t,x\n0,1\n"), **options)


@pytest.mark.parametrize(
    ("cells", "column", "said"),
    [
        (["980", "1.013", "1.020"], [980, 1013, 1020], "'.' stands between thousands: row 1"),
        (["980", "1,013", "1,020"], [980, 1013, 1020], "',' stands between thousands"),
        (["0.980", "1.013", "2"], [0.98, 1.013, 2], ""),
        (["1.013", "1.02", "999"], [1.013, 1.02, 999], ""),
        (["1.013", "1.027", "1.034"], [1.013, 1.027, 1.034], ""),
        (["1.234", "3.456", "2"], [1.234, 3.456, 2], "may stand between thousands"),
        (["1.013.250", "999", "7"], [1013250, 999, 7], "stands between thousands"),
        (["1.013,5", "999", "7,25"], [1013.5, 999, 7.25], "stands between thousands"),
        (["1,013.5", "999", "7.25"], [1013.5, 999, 7.25], "stands between thousands"),
        (["1'013", "999", "7.25"], [1013, 999, 7.25], ""),
        (["1\u202f013", "999", "7"], [1013, 999, 7], ""),
        (["1.5D+03", "45 %", "7"], [1500, 45, 7], ""),
        (["1.5", "#N/A", "2"], [1.5, np.nan, 2], "1 cell of x, a code for what is missing: "),
        (["-nan(ind)", "1.#QNAN", "2"], [np.nan, np.nan, 2], "-nan(ind)"),
        (["?", "-", "2"], [np.nan, np.nan, 2], "row 0"),
        (["1.#INF", "1", "2"], [np.inf, 1, 2], ""),
        (["open", "-", "shut"], ["open", "-", "shut"], ""),
        (["?", "?", "?"], ["?", "?", "?"], ""),
    ],
)  # fmt: skip
def test_a_column_is_read_as_its_numbers_are_written(tmp_path, cells, column, said):
    path = written(tmp_path, "n;x\n" + "".join(f"{i};{cell}\n" for i, cell in enumerate(cells)))
    (recording,) = recordings("csv", path)
    assert rows(recording.topics[""])["x"] == pytest.approx(column, nan_ok=True)
    assert said in "\n".join(recording.ledger.lines())
    assert bool(said) == bool(recording.ledger)


def test_a_mark_between_thousands_may_be_said(tmp_path):
    path = written(tmp_path, "n;x\n0;1.013\n1;2.500\n")
    assert rows(table("csv", path))["x"] == [1.013, 2.5]
    assert rows(table("csv", path, thousands="."))["x"] == [1013, 2500]
    path = written(tmp_path, "n;x\n0;980\n1;1.020\n")
    assert rows(table("csv", path, thousands=False))["x"] == [980, 1.02]
    with pytest.raises(UsageError, match="expected one of"):
        table("csv", path, thousands=";")


@pytest.mark.parametrize(
    ("text", "columns", "said"),
    [
        ("t,p,n\ns,bar,-\n0,1,2\n1,3,4\n", {"t[s]": [0, 1], "p[bar]": [1, 3], "n": [2, 4]}, "bar"),
        ("t;p\n[s];(bar)\n0;1,5\n1;3\n", {"t[s]": [0, 1], "p[bar]": [1.5, 3]}, "units"),
        ("t,mode\n0,auto\n1,auto\n", {"t": [0, 1], "mode": ["auto", "auto"]}, ""),
        ("mode,kind\na,b\nc,d\ne,f\n", {"mode": ["a", "c", "e"], "kind": ["b", "d", "f"]}, ""),
        ("t,x\n#N/A,?\n1,2\n3,4\n", {"t": [np.nan, 1, 3], "x": [np.nan, 2, 4]}, "code"),
        ("t,x\n0,1\n2,3\n\0\0\0\0", {"t": [0, 2], "x": [1, 3]}, "zero bytes are left out"),
        ("t,x\n0,1\n\0\0\0" + "2,3\n", {"t": [0, 2], "x": [1, 3]}, "zero bytes"),
        ("t,x\n0,1\n2,\0\0\0\0" + "4\n5,6\n", {"t": [0, 5], "x": [1, 6]}, "zero bytes are in its"),
        ("t,x\n0,1\n2,3\n4", {"t": [0, 2], "x": [1, 3]}, "the last line is cut"),
        ("t,x\n0,1\n2,3\n4\n", {"t": [0, 2, 4], "x": [1, 3, np.nan]}, ""),
        ("t,x\n0,1\n# pump\n2,3\n", {"t": [0, 2], "x": [1, 3]}, "a remark between rows"),
        ("t,x\n0,1\nt,x\n2,3\n", {"t": [0, 2], "x": [1, 3]}, "the header again"),
        ('t,x,n\n0,1,a\n1,"2,b\n2,3,c\n3,4,d\n',
         {"t": [0, 1, 2, 3], "x": ["1", '"2', "3", "4"], "n": [*"abcd"]}, "never closed"),
        ("x,x\n0,1\n", {"x": [0], "x (2)": [1]}, "'x' stands twice"),
        ("obs:x,action:u\n0,1\n2", {"obs:x": [0, 2], "action:u": [1, np.nan]}, ""),
    ],
)  # fmt: skip
def test_what_a_logger_left_around_its_rows_is_said(tmp_path, text, columns, said):
    (recording,) = recordings("csv", written(tmp_path, text))
    cells = rows(recording.topics[""])
    assert [*cells] == [*columns]
    for name, column in columns.items():
        assert cells[name] == pytest.approx(column, nan_ok=True)
    assert said in "\n".join(recording.ledger.lines())
    assert bool(said) == bool(recording.ledger)


def test_a_line_of_units_may_be_a_row_and_zero_bytes_may_be_many(tmp_path):
    cells = rows(table("csv", written(tmp_path, "t,p\ns,bar\n0,1\n2,3\n"), units=False))
    assert cells == {"t": ["s", "0", "2"], "p": ["bar", "1", "3"]}
    assert rows(table("csv", written(tmp_path, "t,p\n0,1\n" + "\0" * 10**7)))["p"] == [1]


def test_codes_of_a_recipe_are_missing_in_every_format(tmp_path):
    path = written(tmp_path, "x,y,mode\n1,err,on\n-999,2,err\n3,4,off\n")
    cells = rows(table("csv", path, missing_codes=[-999, "err"]))
    assert cells["x"] == pytest.approx([1, np.nan, 3], nan_ok=True)
    assert cells["y"] == pytest.approx([np.nan, 2, 4], nan_ok=True)
    assert cells["mode"] == ["on", "", "off"]
    np.savez(tmp_path / "run.npz", t=np.arange(3), x=[1, -999, 3])
    cells = rows(table("numpy", tmp_path / "run.npz", missing_codes=[-999]))
    assert cells["x"] == pytest.approx([1, np.nan, 3], nan_ok=True)
    with pytest.raises(UsageError, match="expected a list of numbers and texts"):
        table("csv", path, missing_codes=-999)


def npy(header, content=b""):
    text = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


def many_members(count):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for i in range(count):
            archive.writestr(f"{i}.npy", b"")
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.csv", b"t,x\n0,1\n1,2,3\n4,5\n", "line 3 has 3 cells, expected 2"),
        ("x.csv", b"t,x\n0\n1,2\n", "line 2 has 1 cells"),
        ("x.csv", b"t,x\n0,1\nx,t\n1,2\n", "line 3 is a header of another order"),
        ("x.csv", b't,n\n0,"a\nb"\n1,2,3\n4,5', "line 4 has 3 cells"),
        ("x.csv", b"PK\x00\x03\x04", "is no text"),
        ("x.csv", b"", "x.csv is empty"),
        ("x.csv", b"\n\n# nothing\n", "x.csv is empty"),
        ("x.csv", b"t,x\n0,\xff\n", "UnicodeDecodeError"),
        ("x.csv", b"t,x\n" + b"1" * 2**21, "more than 1048576 characters"),
        ("x.jsonl", b'{"steps": [', "line 1 cannot be read"),
        ("x.jsonl", b"[1, 2]", "expected an object"),
        ("x.jsonl", b"[" * 100_000, "RecursionError"),
        ("x.jsonl", b'{"a": ' * 50 + b"1" + b"}" * 50, "more than 16 levels"),
        ("x.jsonl", b'{"steps": [{"t": 1}, 2]}', "expected an object"),
        ("x.jsonl", b'{"steps": [{"t": 1}]}\n{"t": 2}', "line 2 has no list of steps"),
        ("x.jsonl", b'{"x": 1' + b"0" * 400 + b"}", "OverflowError"),
        ("x.jsonl.gz", gzip.compress(b'{"x": 1}\n' * 1000)[:-20], "EOFError"),
        ("x.npy", npy("{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000, 4), }"),
         "announces 288000000000 bytes"),
        ("x.npy", npy("{'descr': '|O', 'fortran_order': False, 'shape': (2,), }", b"\x80\x04."),
         "expected numbers"),
        ("x.npy", b"\x93NUMPY\x01", "cannot be read"),
        ("x.npz", b"PK\x03\x04", "cannot be read"),
        ("x.npz", many_members(20_000), "has 20000 arrays, limit 16384"),
        ("x.csv", b"a," * 20_000 + b"b\n", "has 20001 columns or more, limit 16384"),
        ("x.mat", b"no file of MATLAB", r"x\.mat"),
        ("x.ulg", b"ULog", r"x\.ulg"),
    ],
    ids=lambda value: value if isinstance(value, str) else "content",
)  # fmt: skip
def test_a_damaged_file_is_told_with_its_place(tmp_path, name, content, message):
    forms = {"npy": "numpy", "npz": "numpy", "ulg": "ulog"}
    kind = name.split(".")[1]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(TrajectoryError, match=message):
        recordings(forms.get(kind, kind), tmp_path / name)


def test_the_convention_of_columns_is_taken_however_it_is_spelled(tmp_path):
    text = "Obs:y, obs: x[m],observations:z,actions:u,Reward,obs_q\n1,2,3,4,5,6\n"
    assert table("csv", written(tmp_path, text)).names == (
        "obs:y", "obs:x[m]", "obs:z", "action:u", "reward", "obs_q",
    )  # fmt: skip
    assert conventional("observer:x") == "observer:x"
    assert [nearest_spelling(n) for n in ("obs_q", "Action.u", "obstacle", "flow")] == [
        "obs:q", "action:u", "", "",
    ]  # fmt: skip
    assert column_names(["x (2)", "x", "x"]) == ("x (2)", "x", "x (3)")


@pytest.mark.parametrize("transpose", [False, True])
def test_tables_packed_by_gzip_are_read(tmp_path, transpose):
    text = "t {} 0 {} 1\nx {} 1.5 {} 2\n" if transpose else "t {} x\n0 {} 1.5\n1 {} 2\n"
    for form, mark in (("csv", ","), ("text", "")):
        path = tmp_path / f"run.1.{form[:3].replace('tex', 'txt')}.gz"
        path.write_bytes(gzip.compress(text.replace("{}", mark).encode()))
        (recording,) = recordings(form, path, transpose=transpose)
        assert recording.name == "run.1"
        assert rows(recording.topics[""]) == {"t": [0, 1], "x": [1.5, 2]}
    assert logs.reader_for(path).name == "text"


def test_what_unpacks_to_much_more_than_a_log_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("oodd_logs.readers.packed._SOME", 2**20)
    parts = [*map(gzip.compress, (b"t,a\n1,2\n", b"\n" * 2**22, b"1,2"))]
    for name, count in (("x.csv.gz", 2), ("y.csv.gz", 3), ("x.json.gz", 3), ("x.jsonl.gz", 2)):
        # The size at the end is that of the last part.
        (tmp_path / name).write_bytes(b"".join(parts[:count]))
        with pytest.raises(TrajectoryError, match="unpacks to more than 1048576 bytes"):
            recordings(name.split(".")[1], tmp_path / name)


def test_ranges_of_a_file_of_many_blocks_are_its_rows(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3000, 3))
    modes = [f"{i:05d}" if i != 2500 else 'ab"c, d\ne' for i in range(3000)]
    lines = ["a,b,mode,c"]
    for (a, b, c), mode in zip(values.tolist(), modes, strict=True):
        cell = '"' + mode.replace('"', '""') + '"' if "a" in mode else mode
        lines.append(f"{a},{b},{cell},{c}")
    path = written(tmp_path, "\n".join(lines))
    monkeypatch.setattr("oodd_logs.readers.tables._BLOCK", 5000)
    monkeypatch.setattr("oodd_logs.readers.tables._PIECE", 700)
    topic = table("csv", path)
    assert topic.rows == 3000
    for start, stop in ((0, 3000), (0, 1), (700, 1800), (2400, 2600), (2999, 3000), (50, 50)):
        cells = topic.read(["c", "mode"], start, stop)
        assert cells["c"].tolist() == values[start:stop, 2].tolist()
        # One text, far behind, makes texts of all cells of the column.
        assert cells["mode"].tolist() == modes[start:stop]


def test_a_transposed_table_is_turned(tmp_path):
    path = written(tmp_path, "1 2 3\n4 5 6\n", "d00.dat")
    assert table("text", path).rows == 2
    assert rows(table("text", path, transpose=["d0?.dat"])) == {"0": [1, 2, 3], "1": [4, 5, 6]}
    assert table("text", path, transpose=["other"]).rows == 2
    named = written(tmp_path, "t,0,1\nx,5,6\n")
    assert rows(table("csv", named, transpose=True)) == {"t": [0, 1], "x": [5, 6]}
    with pytest.raises(TrajectoryError, match="lines have from 1 to 2 cells"):
        recordings("csv", written(tmp_path, "1,2\n3\n"), transpose=True)


def test_blocks_below_a_class_are_episodes(tmp_path):
    text = "normal\n\t1\t-2\n\t3\t4\n\n\ncollision\n\t5\t6\n\t7\t8\n"
    first, second = recordings("text", written(tmp_path, text, "lp1.data"))
    assert (first.name, first.fields, rows(first.topics[""])) == (
        "lp1-0", {"class": "normal"}, {"0": [1, 3], "1": [-2, 4]},
    )  # fmt: skip
    assert (second.fields, second.topics[""].rows) == ({"class": "collision"}, 2)
    ragged = written(tmp_path, "normal\n1 2\n3\n", "lp2.data")
    with pytest.raises(TrajectoryError, match="block 0 has rows of"):
        recordings("text", ragged)


def test_times_are_seconds():
    assert parse_times(np.array([1.5, np.nan]), "ms").tolist() == pytest.approx(
        [0.0015, np.nan], nan_ok=True
    )
    stamps = np.array(
        ["1970-01-01T00:00:01.5Z", "1970-01-01 02:00:01+02:00", "", "NaN",
         "1970-01-01T00:00:00,25", "1969-12-31T19:00:00-0500", "19700101T000001Z"]
    )  # fmt: skip
    expected = [1.5, 1, np.nan, np.nan, 0.25, 0, 1]
    for count in (6, 7):  # the last one is not for NumPy
        seconds = parse_times(stamps[:count])
        assert seconds.tolist() == pytest.approx(expected[:count], nan_ok=True)
    for wrong in ("now", "5", "2020-13-01", "noon"):
        with pytest.raises(TrajectoryError, match=f"row 1: '{wrong}' is no time"):
            parse_times(np.array(["2020-01-01", wrong]))
    with pytest.raises(TrajectoryError, match="expected numbers"):
        parse_times(np.array(["2020-01-01"]), "ms")
    with pytest.raises(TrajectoryError, match="expected dates"):
        parse_times(np.array([1.0]), "iso")
    with pytest.raises(UsageError, match="unknown unit of time 'tick'"):
        parse_times(np.array([1.0]), "tick")
    assert parse_times(np.array([1.5]), "minutes").tolist() == [90]
    assert parse_times(np.array([], dtype="U1")).tolist() == []


# Lines of JSON.


def test_an_object_a_line_is_an_episode_with_its_steps(tmp_path):
    episodes = [
        {"task_id": 3, "success": i == 0, "steps": [{"t": t, "q": [t, 2 * t], "pose": {"x": -t}}
                                                    for t in range(2 + i)]}
        for i in range(2)
    ]  # fmt: skip
    text = "\n".join(map(json.dumps, episodes)) + "\n"
    for name in ("task.jsonl", "task.jsonl.gz"):
        content = text.encode()
        (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
        first, second = recordings("jsonl", tmp_path / name)
        assert (first.name, first.fields) == ("task-0", {"task_id": 3, "success": True})
        assert rows(second.topics[""]) == {
            "t": [0, 1, 2], "q.0": [0, 1, 2], "q.1": [0, 2, 4], "pose.x": [0, -1, -2],
        }  # fmt: skip


def test_an_object_a_line_may_be_a_row_or_hold_matrices(tmp_path):
    lines = [{"t": 0, "mode": "a", "x": None}, {"t": 1, "x": 2, "late": True}]
    path = written(tmp_path, "\n".join(map(json.dumps, lines)), "run.jsonl")
    cells = rows(table("jsonl", path))
    assert cells["x"] == pytest.approx([np.nan, 2], nan_ok=True)
    assert cells["late"] == pytest.approx([np.nan, 1], nan_ok=True)
    assert (cells["t"], cells["mode"]) == ([0, 1], ["a", ""])
    episode = {"obs": [[1, 2], [3, 4], [5, 6]], "actions": [[7], [8]], "ok": True}
    (recording,) = recordings("jsonl", written(tmp_path, json.dumps(episode), "run.jsonl"))
    cells = rows(recording.topics[""])
    assert cells["obs:sensor 1"] == [2, 4, 6]
    assert cells["action:action 0"] == pytest.approx([7, 8, np.nan], nan_ok=True)
    assert recording.fields == {"ok": True}


@pytest.mark.parametrize(
    ("row", "names"),
    [
        ({"t": 0, "status": [{"name": "arm", "level": 1}]}, ("t", "status.arm.level")),
        ({"hits": [{"name": "a", "x": 1}, {"name": "b", "x": 2}]}, ("hits.a.x", "hits.b.x")),
        ({"header": {"stamp": {"sec": 1, "nanosec": 0}}, "cov": [[1, 2], [3, 4]]},
         ("header.stamp", "cov.0.0", "cov.0.1", "cov.1.0", "cov.1.1")),
    ],
)  # fmt: skip
def test_an_object_with_a_stamp_or_named_parts_is_a_row(tmp_path, row, names):
    topic = table("jsonl", written(tmp_path, f"{json.dumps(row)}\n" * 3, "run.jsonl"))
    assert (topic.names, topic.rows) == (names, 3)


@pytest.mark.parametrize(
    ("end", "said"),
    [(b'{"t": 2, "x', "line 3 is cut"), (b"\0\0\0", "zero bytes"), (b'{"t": 2\0\0\n', "line 3")],
)
def test_lines_of_json_that_a_logger_cut_are_said(tmp_path, end, said):
    (tmp_path / "run.jsonl").write_bytes(b'{"t": 0, "x": 5}\n{"t": 1, "x": 6}\n' + end)
    (recording,) = recordings("jsonl", tmp_path / "run.jsonl")
    assert rows(recording.topics[""]) == {"t": [0, 1], "x": [5, 6]}
    assert said in "\n".join(recording.ledger.lines())


# Parquet and LeRobot.


def test_a_parquet_file_is_read_in_ranges(tmp_path):
    count = 100_000
    columns = {
        "x": np.arange(count, dtype="i8"),
        "ok": np.arange(count) % 2 == 0,
        "state": pa.FixedSizeListArray.from_arrays(pa.array(np.arange(2.0 * count)), 2),
        "tail": pa.array([[i, -i] for i in range(count)]),
        "pose": pa.array(
            [{"x": float(i), "frame": "map"} for i in range(count)],
            pa.struct([("x", pa.float64()), ("frame", pa.string())]),  # which PyArrow 17 sorts
        ),
        "at": pa.array(np.arange(count), pa.timestamp("ms")),
        "gap": pa.array([None if i == 7 else i for i in range(count)]),
        "mode": pa.array(["a", "b"] * (count // 2)).dictionary_encode(),
        "image": pa.array([b"png"] * count),
    }
    path = tmp_path / "run.parquet"
    pq.write_table(pa.table(columns), path, row_group_size=30_000)
    topic = table("parquet", path)
    assert topic.names == ("x", "ok", "state.0", "state.1", "tail.0", "tail.1", "pose.x",
                           "pose.frame", "at", "gap", "mode")  # fmt: skip
    assert (topic.rows, topic.time) == (count, "at")
    for start, stop in ((0, 3), (29_999, 60_001), (10, 20), (5, 12), (99_999, count), (0, count)):
        cells = topic.read(["state.1", "x", "tail.1"], start, stop)
        expected = np.arange(start, stop)
        assert np.array_equal(cells["x"], expected)
        assert np.array_equal(cells["state.1"], 2 * expected + 1)
        assert np.array_equal(cells["tail.1"], -expected)
    assert rows(Topic(topic.names, 8, topic.read), "gap")["gap"] == pytest.approx(
        [*range(7), np.nan], nan_ok=True
    )
    head = topic.read(["at", "ok", "mode", "pose.frame"], 1, 3)
    assert {name: column.tolist() for name, column in head.items()} == {
        "at": [0.001, 0.002], "ok": [0, 1], "mode": ["b", "a"], "pose.frame": ["map", "map"],
    }  # fmt: skip


def test_lists_in_a_parquet_file_are_columns_figures_or_named(tmp_path):
    columns = {
        "grow": pa.array([[1.0], [1.0, 2.0], None]),
        "shrink": pa.array([[1, 2], [3], []]),
        "some": pa.array([[1.0, 2.0], None, [3.0, 4.0]]),
        "long": pa.array([[float(i)] * 40 for i in range(3)], pa.list_(pa.float32(), 40)),
        "at": pa.array([{"nanosec": 500_000_000, "sec": i} for i in range(3)]),
        "status": pa.array([[{"key": "temp", "value": f"{i}.5"}] for i in range(3)]),
        "more": pa.array([[("volt", 1.0)]] * 3, pa.map_(pa.string(), pa.float64())),
        "png": pa.array([b"png"] * 3),
    }
    pq.write_table(pa.table(columns), tmp_path / "run.parquet")
    (recording,) = recordings("parquet", tmp_path / "run.parquet")
    cells = rows(recording.topics[""])
    nan = np.nan
    expected = {
        "grow.least": [1, 1, nan], "grow.mean": [1, 1.5, nan], "grow.count": [1, 2, 0],
        "shrink.least": [1, 3, nan], "shrink.mean": [1.5, 3, nan], "shrink.count": [2, 1, 0],
        "some.0": [1, nan, 3], "some.1": [2, nan, 4],
        "long.least": [0, 1, 2], "long.mean": [0, 1, 2], "long.count": [40, 40, 40],
        "at": [0.5, 1.5, 2.5], "status.temp": [0.5, 1.5, 2.5], "more.volt": [1, 1, 1],
    }  # fmt: skip
    assert [*cells] == [*expected]
    for name, column in expected.items():
        assert cells[name] == pytest.approx(column, nan_ok=True)
    assert [e.name for e in recording.ledger.of("column", "dropped")] == ["png"]
    assert "long.39" in table("parquet", tmp_path / "run.parquet", lists=["lo*"]).names
    joints = {"name": pa.array([["hip", "knee"], ["knee", "hip"]]), "q": pa.array([[1, 2], [2, 1]])}
    pq.write_table(pa.table(joints), tmp_path / "run.parquet")
    assert rows(table("parquet", tmp_path / "run.parquet")) == {"q.hip": [1, 1], "q.knee": [2, 2]}


INFO = {
    "codebase_version": "v2.1",
    "fps": 10,
    "features": {
        "observation.state": {"dtype": "float32", "shape": [2], "names": [["hip", "knee"]]},
        "observation.effort": {"dtype": "float32", "shape": [1], "names": None},
        "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["hip", "knee"]}},
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        "next.success": {"dtype": "bool", "shape": [1], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "task_index": {"dtype": "int64", "shape": [1], "names": None},
    },
}
LENGTHS = (3, 4, 2)


def lerobot_table(episodes, first=0):
    """Rows of some episodes, numbered through from `first` on."""
    counts = [(e, t) for e in episodes for t in range(LENGTHS[e])]
    values = np.arange(2.0 * len(counts)).reshape(-1, 2)
    return pa.table({
        "observation.state": pa.array(values.tolist(), pa.list_(pa.float32(), 2)),
        "observation.effort": pa.array(values[:, 0]),
        "action": pa.array((-values).tolist(), pa.list_(pa.float32(), 2)),
        "next.reward": pa.array([1.0] * len(counts)),
        "next.success": pa.array([e == 1 for e, _ in counts]),
        "timestamp": pa.array([t / 10 for _, t in counts], pa.float32()),
        "frame_index": pa.array([t for _, t in counts]),
        "episode_index": pa.array([e for e, _ in counts]),
        "index": pa.array(range(first, first + len(counts))),
        "task_index": pa.array([e % 2 for e, _ in counts]),
    })  # fmt: skip


def as_version_2(root):
    chunk = root / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text(json.dumps(INFO))
    tasks = [{"task_index": i, "task": name} for i, name in enumerate(("walk", "turn"))]
    (root / "meta" / "tasks.jsonl").write_text("\n".join(map(json.dumps, tasks)))
    for e in range(3):
        pq.write_table(lerobot_table([e]), chunk / f"episode_{e:06d}.parquet")


def as_version_3(root):
    chunk, places = root / "data" / "chunk-000", root / "meta" / "episodes" / "chunk-000"
    chunk.mkdir(parents=True)
    places.mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(INFO | {"codebase_version": "v3.0"}))
    pq.write_table(lerobot_table([0, 1]), chunk / "file-000.parquet")
    pq.write_table(lerobot_table([2], first=7), chunk / "file-001.parquet")
    tasks = pa.table({"task_index": [0, 1], "__index_level_0__": ["walk", "turn"]})
    pq.write_table(tasks, root / "meta" / "tasks.parquet")
    ends = np.cumsum(LENGTHS)
    episodes = pa.table({
        "episode_index": range(3),
        "data/chunk_index": [0, 0, 0],
        "data/file_index": [0, 0, 1],
        "dataset_from_index": ends - LENGTHS,
        "dataset_to_index": ends,
        "stats/action/max": [[1.0]] * 3,
    })  # fmt: skip
    pq.write_table(episodes, places / "file-000.parquet")


@pytest.mark.parametrize("make", [as_version_2, as_version_3])
def test_a_lerobot_data_set_is_its_episodes(tmp_path, make):
    make(tmp_path)
    found = recordings("lerobot", tmp_path)
    assert [r.name for r in found] == [f"episode_{e:06d}" for e in range(3)]
    assert [r.topics[""].rows for r in found] == [*LENGTHS]
    assert [r.fields["task"] for r in found] == ["walk", "turn", "walk"]
    assert [r.fields["success"] for r in found] == [False, True, False]
    topic = found[1].topics[""]
    assert topic.names == ("obs:hip", "obs:knee", "obs:effort", "action:hip", "action:knee",
                           "reward", "next.success", "timestamp")  # fmt: skip
    assert topic.time == "timestamp"
    cells = rows(topic)
    first = 0 if make is as_version_2 else 6
    assert cells["obs:knee"] == [first + 1 + 2 * t for t in range(4)]
    # What the last action led to was not recorded.
    expected = [-(first + 2.0 * t) for t in range(3)]
    assert cells["action:hip"] == pytest.approx([*expected, np.nan], nan_ok=True)
    assert np.isnan(cells["reward"][-1])
    assert cells["timestamp"] == pytest.approx([0, 0.1, 0.2, 0.3])
    part = topic.read(["action:hip"], 1, 3)
    assert not np.isnan(part["action:hip"]).any()


def test_rows_number_their_episodes_and_not_the_table(tmp_path):
    as_version_3(tmp_path)
    path = tmp_path / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    table_of_episodes = pq.read_table(path).to_pylist()
    table_of_episodes[0]["dataset_to_index"] += 2
    table_of_episodes[1]["dataset_from_index"] += 2
    pq.write_table(pa.Table.from_pylist(table_of_episodes), path)
    first, second, third = recordings("lerobot", tmp_path)
    assert [r.topics[""].rows for r in (first, second, third)] == [*LENGTHS]
    assert rows(second.topics[""])["obs:knee"] == [7, 9, 11, 13]
    (entry,) = second.ledger.of("recording")
    assert entry.cell == "5 to 7, but 3 to 7"
    assert not third.ledger
    mixed = pa.concat_tables([lerobot_table([0]), lerobot_table([1]), lerobot_table([0])])
    pq.write_table(mixed, tmp_path / "data" / "chunk-000" / "file-000.parquet")
    with pytest.raises(TrajectoryError, match="do not follow one another"):
        recordings("lerobot", tmp_path)


def test_a_flat_folder_of_episodes_is_a_lerobot_data_set(tmp_path):
    (tmp_path / "info.json").write_text(json.dumps(INFO))
    plain = lerobot_table([1]).drop_columns(["timestamp"])
    pq.write_table(plain, tmp_path / "episode_000010.parquet")
    pq.write_table(lerobot_table([0]), tmp_path / "episode_000009.parquet")
    first, second = recordings("lerobot", tmp_path)
    assert (first.name, second.name) == ("episode_000009", "episode_000010")
    topic = second.topics[""]
    assert topic.time == "time"  # from the rate
    assert rows(topic, "time")["time"] == pytest.approx([0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("info.json", b"{", "info.json' cannot be read"),
        ("info.json", b'{"features": {}}', "fps is None"),
        ("info.json", b"[" * 100_000, "cannot be read: maximum recursion"),
        ("info.json", json.dumps(INFO | {"data_path": "../{chunk_index}/x.parquet"}).encode(),
         "outside the data set"),
        ("data/chunk-000/episode_000000.parquet", b"PAR1 and nothing", "ArrowInvalid"),
    ],
    ids=lambda value: value if isinstance(value, str) else "content",
)  # fmt: skip
def test_a_damaged_lerobot_data_set_is_told(tmp_path, name, content, message):
    (as_version_3 if b"data_path" in content else as_version_2)(tmp_path)
    (tmp_path / ("meta" if name == "info.json" else "") / name).write_bytes(content)
    with pytest.raises(TrajectoryError, match=message):
        recordings("lerobot", tmp_path)


# Arrays.


def test_arrays_are_known_by_their_usual_names(tmp_path):
    rng = np.random.default_rng(1)
    # A northing keeps all its digits.
    seen, done = 5.4e6 + rng.normal(size=(4, 2)), rng.normal(size=(3, 1))
    for observations, actions in (("observations", "actions"), ("obs", "action"),
                                  ("observation", "actions")):  # fmt: skip
        arrays = {observations: seen, actions: done, "rewards": np.ones(3)}
        more = {"temperature": np.arange(4), "onset": 2, "name": "a"}
        np.savez(tmp_path / "run.npz", **arrays, **more)
        (recording,) = recordings("numpy", tmp_path / "run.npz")
        topic = recording.topics[""]
        assert topic.names == ("obs:sensor 0", "obs:sensor 1", "action:action 0", "reward",
                               "temperature")  # fmt: skip
        cells = rows(topic)
        assert cells["obs:sensor 1"] == seen[:, 1].tolist()
        assert cells["action:action 0"] == pytest.approx([*done[:, 0], np.nan], nan_ok=True)
        assert recording.fields == {"onset": 2, "name": "a"}
    # Of as many actions as observations the last one led to nothing.
    np.savez(tmp_path / "run.npz", obs=np.zeros((3, 1)), action=np.arange(3.0))
    cells = rows(table("numpy", tmp_path / "run.npz"))
    assert cells["action:action 0"] == pytest.approx([0, 1, np.nan], nan_ok=True)


def test_arrays_without_observations_are_a_table(tmp_path):
    np.savez(tmp_path / "run.npz", t=np.arange(5), q=np.ones((5, 2)), gains=np.eye(2), k=3.5)
    (recording,) = recordings("numpy", tmp_path / "run.npz")
    assert recording.topics[""].names == ("t", "q.0", "q.1")
    assert recording.fields["k"] == 3.5
    np.save(tmp_path / "run.npy", np.arange(10.0).reshape(5, 2))
    assert rows(table("numpy", tmp_path / "run.npy"))["obs:sensor 1"] == [1, 3, 5, 7, 9]
    turned = table("numpy", tmp_path / "run.npy", transpose=["run.*"])
    np.save(tmp_path / "demos.npy", np.arange(24.0).reshape(2, 4, 3))
    first, second = recordings("numpy", tmp_path / "demos.npy")
    assert (first.name, second.name, first.topics[""].rows) == ("demos-0", "demos-1", 4)
    assert rows(second.topics[""])["obs:sensor 0"] == [12, 15, 18, 21]
    assert (turned.rows, len(turned.names)) == (2, 5)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"obs": np.zeros((4, 2)), "action": np.zeros((9, 1))}, "action has shape"),
        ({"obs": np.zeros((4, 20_000))}, "has 20000 columns or more"),
        ({"gain": np.array(1.0)}, "expected arrays with a row a step"),
        ({"obs": np.array([{"a": 1}], dtype=object)}, "obs has dtype"),  # never unpickled
    ],
)
def test_arrays_that_form_no_episode_are_told(tmp_path, arrays, message):
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(TrajectoryError, match=message):
        recordings("numpy", tmp_path / "run.npz")


def test_groups_of_an_hdf5_file_are_episodes_and_a_flat_file_one(tmp_path):
    with h5py.File(tmp_path / "train.h5", "w") as file:
        for i in (2, 10, 1):
            group = file.create_group(f"run-{i}")
            group["observations"], group["actions"] = np.full((3, 2), i), np.zeros((2, 1))
            group["terminations"] = [False, i == 2]
            group.attrs.update({"onset": i, "seed": 7, "parameters": '{"mass": 2}', "bed": "B"})
    found = recordings("hdf5", tmp_path / "train.h5")
    assert [r.name for r in found] == ["run-1", "run-2", "run-10"]
    assert found[1].fields == {"onset": 2, "seed": 7, "parameters": {"mass": 2}, "bed": "B",
                               "terminated": True}  # fmt: skip
    assert rows(found[2].topics[""])["obs:sensor 1"] == [10, 10, 10]
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["t"], file["joints/q"], file["k"] = np.arange(5), np.ones((5, 2)), 2.5
    (recording,) = recordings("hdf5", tmp_path / "run.h5")
    assert {*recording.topics[""].names} == {"t", "joints.q.0", "joints.q.1"}
    assert (recording.name, recording.fields) == ("run", {"k": 2.5})
    assert recording.topics[""].read(["t"], 2, 4)["t"].tolist() == [2, 3]


def test_a_file_of_robomimic_is_its_demonstrations(tmp_path):
    with h5py.File(tmp_path / "lift.hdf5", "w") as file:
        file["mask/train"] = np.array([b"demo_0"])
        for i in range(2):
            demo = file.create_group(f"data/demo_{i}")
            demo["actions"], demo["rewards"] = np.full((4, 2), 1.0), np.arange(4.0)
            demo["dones"] = [0, 0, 0, 1]
            demo["obs/eef_pos"], demo["obs/gripper"] = np.full((4, 3), i), np.zeros(4)
            demo["next_obs/eef_pos"] = np.zeros((4, 3))
            demo["obs/camera"], demo["obs/depth"] = np.zeros((4, 9, 9, 3), "u1"), np.ones((4, 6, 6))
            demo["obs/pose"] = np.arange(16.0).reshape(4, 2, 2)
            demo.attrs["model_file"] = "<xml/>" * 1000
    first, second = recordings("hdf5", tmp_path / "lift.hdf5")
    assert (first.name, first.fields) == ("demo_0", {})
    assert {*second.topics[""].names} == {
        "obs:eef_pos.0", "obs:eef_pos.1", "obs:eef_pos.2", "obs:gripper", "action:action 0",
        "action:action 1", "reward", "dones", "obs:pose.0.0", "obs:pose.0.1", "obs:pose.1.0",
        "obs:pose.1.1", "obs:depth.least", "obs:depth.mean", "obs:depth.count",
    }  # fmt: skip
    assert {e.name for e in second.ledger.of("column", "dropped")} == {"obs/camera", "next_obs"}
    cells = rows(second.topics[""])
    assert (cells["obs:pose.1.0"], cells["obs:depth.count"]) == ([2, 6, 10, 14], [36] * 4)
    assert cells["obs:eef_pos.2"] == [1, 1, 1, 1]
    assert cells["action:action 1"] == pytest.approx([1, 1, 1, np.nan], nan_ok=True)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: f.update(leak=h5py.ExternalLink("/etc/passwd", "/")), "points elsewhere"),
        (lambda f: f.create_dataset("x", (2**40,), "f8", chunks=(2**20,)),
         "damaged, or made to fill the memory"),
        (lambda f: f.update(x=np.arange(10_000.0)), "truncated or no HDF5 file"),
    ],
    ids=["link", "bomb", "truncated"],
)  # fmt: skip
def test_a_hostile_hdf5_file_is_refused(tmp_path, spoil, message):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        spoil(file)
    if message.startswith("truncated"):
        path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(TrajectoryError, match=message):
        recordings("hdf5", path)


def test_a_minari_data_set_is_its_episodes(tiny_split, tmp_path):
    split = oodd_eval.load_split(tiny_split)
    export(split, tmp_path, environments=["cartpole"])
    root = tmp_path / "oodd" / "tiny" / "cartpole" / "test-iid-v0"
    data = split.environment("cartpole")
    anomalous = data.anomalous("iid")
    found = recordings("minari", root)
    assert [r.fields["onset"] for r in found] == anomalous.onsets.tolist()
    assert found[0].fields["discrete"] == len(data.actions)
    topic = found[0].topics[""]
    assert sum(name.startswith("obs:") for name in topic.names) == len(data.sensors)
    cells = rows(topic)
    position = next(name for name in topic.names if name.startswith("obs:"))
    assert cells[position] == anomalous[0].observations[:, 0].tolist()
    (root / "data" / "metadata.json").write_text("{}")
    with pytest.raises(TrajectoryError, match=r"metadata\.json cannot be read"):
        recordings("minari", root)


def test_matrices_of_a_matlab_file_are_columns(tmp_path):
    path = tmp_path / "run.mat"
    content = {"t": np.arange(6.0)[None], "q": np.arange(12.0).reshape(6, 2), "gain": np.eye(2),
               "rpm": 1797, "note": "a text", "log": {"x": np.arange(3)}}  # fmt: skip
    scipy.io.savemat(path, content)
    (recording,) = recordings("mat", path)
    assert rows(recording.topics[""]) == {
        "t": [0, 1, 2, 3, 4, 5], "q.0": [0, 2, 4, 6, 8, 10], "q.1": [1, 3, 5, 7, 9, 11],
    }  # fmt: skip
    assert recording.fields["rpm"] == 1797
    assert table("mat", path, variable="q").names == ("q.0", "q.1")
    turned = table("mat", path, variable=["q"], transpose=True)
    assert (turned.rows, turned.names[:2]) == (2, ("q.0", "q.1"))
    with pytest.raises(UsageError, match="unknown variable"):
        recordings("mat", path, variable="p")
    scipy.io.savemat(path, {"log": {"x": np.arange(3)}})
    with pytest.raises(TrajectoryError, match=r"log \(struct\)"):
        recordings("mat", path)
    scipy.io.savemat(path, {"x": np.arange(1000.0)}, do_compression=True)
    for size in (200, 60):
        path.write_bytes(path.read_bytes()[:size])
        with pytest.raises(TrajectoryError, match=r"run\.mat"):
            recordings("mat", path)


def test_a_matlab_file_of_version_7_3_is_in_matlabs_order(tmp_path):
    path = tmp_path / "run.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["x"] = np.arange(8.0).reshape(2, 4)  # MATLAB's 4 x 2
        file["t"] = np.arange(4.0)[:, None]
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    assert rows(table("mat", path)) == {"t": [0, 1, 2, 3], "x.0": [0, 1, 2, 3], "x.1": [4, 5, 6, 7]}


# Messages.

IMU = """std_msgs/Header header
geometry_msgs/Vector3 linear_acceleration
float64[3] bias
float64[] extra
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


def imu(i):
    return {
        "header": {"stamp": {"sec": 100 + i, "nanosec": 500_000_000}, "frame_id": "base"},
        "linear_acceleration": {"x": i, "y": 2.0 * i, "z": 9.81},
        "bias": [0.0, 0.5, float(i)],
        "extra": [1.0] * i,
    }


def check_imu(topic, *, stamps=True):
    cells = rows(topic)
    assert topic.time == "log_time"
    assert cells["log_time"] == pytest.approx([10, 10.5, 11])
    assert cells["linear_acceleration.y"] == [0, 2, 4]
    assert cells["bias.2"] == [0, 1, 2]
    assert cells["extra.least"] == pytest.approx([np.nan, 1, 1], nan_ok=True)
    assert cells["extra.count"] == [0, 1, 2]
    if stamps:
        assert cells["header.stamp"] == [100.5, 101.5, 102.5]
        assert cells["header.frame_id"] == ["base"] * 3


@pytest.mark.parametrize(
    ("message", "columns"),
    [
        ({"at": {"nanosec": 500_000_000, "sec": 7}}, {"at": 7.5}),
        ({"at": {"nanos": 250_000_000, "seconds": "7"}}, {"at": 7.25}),
        ({"at": {"seconds": 7, "phase": 1}}, {"at.seconds": 7, "at.phase": 1}),
        ({"name": ["a"], "hits": [{"x": 1}], "values": [1, 2]},
         {"name.0": "a", "hits.0.x": 1, "values.0": 1, "values.1": 2}),
        ({"name": ["hip", "knee"], "position": [1, 2], "effort": []},
         {"position.hip": 1, "position.knee": 2}),
        ({"joint_names": ["hip", "knee"], "points": [{"positions": [1, 2]}, {"positions": [3, 4]}]},
         {"points.0.positions.hip": 1, "points.0.positions.knee": 2,
          "points.1.positions.hip": 3, "points.1.positions.knee": 4}),
        ({"status": [{"name": "arm", "level": 1, "values": [{"key": "temp[C]", "value": "41.5"}]}]},
         {"status.arm.level": 1, "status.arm.values.temp[C]": 41.5}),
        ({"tf": [{"child_frame_id": "wrist", "x": 1}]}, {"tf.wrist.x": 1}),
        ({"pair": [[1, 2], [3, None]]},
         {"pair.0.0": 1, "pair.0.1": 2, "pair.1.0": 3, "pair.1.1": float("nan")}),
        ({"ranges": [math.inf, 2.0, *[4.0] * 38]},
         {"ranges.least": 2, "ranges.mean": 154 / 39, "ranges.count": 39}),
        ({"a": 1, "image": [7] * 5000, "data": bytes(40), "text": "x" * 2000}, {"a": 1}),
    ],
    ids=lambda value: next(iter(value)),
)  # fmt: skip
def test_values_in_messages_have_names_and_not_places(message, columns):
    gathered = Gathered("run")
    gathered.add(message)
    cells = rows(gathered.topic())
    assert {*cells} == {*columns}
    for name, value in columns.items():
        assert cells[name][0] == pytest.approx(value, nan_ok=True)
    left_out = {entry.name for entry in gathered.ledger.of("column", "dropped")}
    assert left_out == {"image", "data", "text"} & {*message}
    assert {e.name for e in gathered.ledger.of("column", "changed")} == {"ranges"} & {*message}


def test_rows_of_changing_parts_are_one_table():
    gathered, folded = Gathered("run"), Gathered("run", ["beams"])
    for names in (["hip", "knee"], ["knee", "hip"], ["gripper"]):
        gathered.add({"name": names, "position": [len(name) for name in names]}, stamp=2.0)
        gathered.add({"hits": [{"x": 5}] * len(names), "mode": "on" if len(names) > 1 else 1.25})
        folded.add({"beams": [1] * 50})
    cells = rows(gathered.topic())
    nan = np.nan
    expected = {
        "position.hip": [3, nan, 3, nan, nan, nan],
        "position.gripper": [nan, nan, nan, nan, 7, nan],
        "hits.x.count": [nan, 2, nan, 2, nan, 1],
        "log_time": [2, nan, 2, nan, 2, nan],
    }
    for name, column in expected.items():
        assert cells[name] == pytest.approx(column, nan_ok=True)
    assert cells["mode"] == ["", "on", "", "on", "", "1.25"]
    assert len(folded.topic().names) == 50
    with pytest.raises(TrajectoryError, match="has 20006 columns or more"):
        gathered.add({f"c{i}": i for i in range(20_000)})


def write_mcap(path, *, compression=CompressionType.ZSTD):
    with path.open("wb") as file:
        writer = Ros2Writer(file, compression=compression)
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", IMU)
        for i in range(3):
            stamp = 10_000_000_000 + i * 500_000_000
            writer.write_message("/imu", schema, imu(i), stamp, stamp)
        plain = writer._writer
        identifier = plain.register_schema("plain", "jsonschema", b"{}")
        channel = plain.register_channel("/motor", "json", identifier)
        for i in range(2):
            data = json.dumps({"current": i, "phase": [1, -i], "mode": "on"}).encode()
            plain.add_message(channel, 10**9 * i, data, 10**9 * i)
        other = plain.register_channel("/blob", "protobuf", identifier)
        plain.add_message(other, 0, b"\x00", 0)
        writer.finish()


@pytest.mark.parametrize("compression", [*CompressionType])
def test_an_mcap_file_has_topics(tmp_path, compression):
    write_mcap(tmp_path / "run.mcap", compression=compression)
    (recording,) = recordings("mcap", tmp_path / "run.mcap")
    assert {*recording.topics} == {"/imu", "/motor"}
    check_imu(recording.topics["/imu"])
    assert rows(recording.topics["/motor"]) == {
        "log_time": [0, 1], "current": [0, 1], "phase.0": [1, 1], "phase.1": [0, -1],
        "mode": ["on", "on"],
    }  # fmt: skip
    (some,) = recordings("mcap", tmp_path / "run.mcap", topics=["/m*"])
    assert [*some.topics] == ["/motor"]
    with pytest.raises(UsageError, match="unknown topic '/imo': did you mean '/imu'"):
        recordings("mcap", tmp_path / "run.mcap", topics=["/imo"])
    with pytest.raises(TrajectoryError, match=r"/blob \(protobuf\)"):
        recordings("mcap", tmp_path / "run.mcap", topics=["/blob"])


def test_a_damaged_mcap_file_is_told(tmp_path):
    write_mcap(tmp_path / "run.mcap")
    content = (tmp_path / "run.mcap").read_bytes()
    with (tmp_path / "json.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        writer.add_message(channel, 0, b"[" * 100_000, 0)
        writer.finish()
    with pytest.raises(TrajectoryError, match="RecursionError"):
        recordings("mcap", tmp_path / "json.mcap")
    rng = np.random.default_rng(0)
    for cut in (10, 300):
        (tmp_path / "run.mcap").write_bytes(content[:cut])
        with pytest.raises(TrajectoryError):
            recordings("mcap", tmp_path / "run.mcap")
    for _ in range(40):
        spoiled = bytearray(content)
        for at in rng.integers(len(content), size=20).tolist():
            spoiled[at] ^= 0x55
        (tmp_path / "run.mcap").write_bytes(spoiled)
        try:
            recordings("mcap", tmp_path / "run.mcap")
        except TrajectoryError as error:
            assert "run.mcap" in str(error)  # noqa: PT017  a flip in a number may go unnoticed


def write_bag(store, writer, name, *, cdr=True, **more):
    vector = store.types["geometry_msgs/msg/Vector3"]
    time, header = store.types["builtin_interfaces/msg/Time"], store.types["std_msgs/msg/Header"]
    kind = store.types[name]
    connection = writer.add_connection("/imu", name, typestore=store)
    serialize = store.serialize_cdr if cdr else store.serialize_ros1
    for i in range(3):
        message = kind(
            header=header(stamp=time(sec=100 + i, nanosec=500_000_000), frame_id="base", **more),
            linear_acceleration=vector(x=i, y=2.0 * i, z=9.81),
            bias=np.array([0.0, 0.5, i]),
            extra=np.ones(i),
        )
        data = serialize(message, name)
        writer.write(connection, 10_000_000_000 + i * 500_000_000, data)


@pytest.mark.parametrize("plugin", [*StoragePlugin])
def test_a_bag_of_ros_2_has_topics(tmp_path, plugin):
    store = get_typestore(Stores.ROS2_HUMBLE)
    body = IMU.partition("=====")[0]
    store.register(get_types_from_msg(body, "arm_msgs/msg/Imu"))
    with Bag2Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        write_bag(store, writer, "arm_msgs/msg/Imu")
    (recording,) = recordings("rosbag", tmp_path / "bag")
    assert recording.name == "bag"
    check_imu(recording.topics["/imu"])
    with pytest.raises(UsageError, match="unknown topic"):
        recordings("rosbag", tmp_path / "bag", topics=["/odom"])


def test_a_bag_of_ros_1_has_topics(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    body = IMU.partition("=====")[0]
    store.register(get_types_from_msg(body, "arm_msgs/msg/Imu"))
    with Bag1Writer(tmp_path / "run.bag") as writer:
        write_bag(store, writer, "arm_msgs/msg/Imu", cdr=False, seq=0)
    (recording,) = recordings("rosbag", tmp_path / "run.bag")
    check_imu(recording.topics["/imu"])
    content = (tmp_path / "run.bag").read_bytes()
    for cut in (5, len(content) // 2):
        (tmp_path / "run.bag").write_bytes(content[:cut])
        with pytest.raises(TrajectoryError, match=r"run\.bag"):
            recordings("rosbag", tmp_path / "run.bag")


def never_closed_mcap(folder):
    write_mcap(folder / "run.mcap")
    content = (folder / "run.mcap").read_bytes()
    (folder / "run.mcap").write_bytes(content[: content.rindex(b"/imu")])
    return "mcap", folder / "run.mcap"


def never_closed_bag_of_ros_1(folder):
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(IMU.partition("=====")[0], "arm_msgs/msg/Imu"))
    with Bag1Writer(folder / "run.bag") as writer:
        write_bag(store, writer, "arm_msgs/msg/Imu", cdr=False, seq=0)
    content = bytearray((folder / "run.bag").read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = bytes(8)
    (folder / "run.bag").write_bytes(content[:-100])
    return "rosbag", folder / "run.bag"


def never_closed_bag_of_ros_2(folder, *, as_file=False):
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(IMU.partition("=====")[0], "arm_msgs/msg/Imu"))
    with Bag2Writer(folder / "bag", version=9) as writer:
        write_bag(store, writer, "arm_msgs/msg/Imu")
    (folder / "bag" / "metadata.yaml").unlink()
    return "rosbag", next((folder / "bag").glob("*.db3")) if as_file else folder / "bag"


@pytest.mark.parametrize(
    "record",
    [never_closed_mcap, never_closed_bag_of_ros_1, never_closed_bag_of_ros_2,
     functools.partial(never_closed_bag_of_ros_2, as_file=True)],
    ids=["mcap", "ros1", "ros2", "database"],
)  # fmt: skip
def test_a_killed_recorder_leaves_what_it_had_written(tmp_path, record):
    form, path = record(tmp_path)
    (recording,) = recordings(form, path)
    check_imu(recording.topics["/imu"])
    (entry,) = recording.ledger.of("recording")
    assert "recovered" in entry.reason


def test_only_names_and_numbers_of_a_definition_become_code():
    words = logs.rosbag._check_words
    words(("a/msg/B", [("X", "int32")], [("x", (1, ("float64", 0)))]))
    for wrong in ("x = 1", "x\nimport os", "a-b", 'x"'):
        with pytest.raises(TrajectoryError, match="has the name"):
            words(("a/msg/B", [], [(wrong, (1, ("float64", 0)))]))


def ulog(messages):
    """A ULog file with a format `imu` of three fields: messages are (instance, µs, x, y0, y1)."""

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    text = b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 5)
    text += message("B", bytes(8) + bytes(8) + bytes(24))
    text += message("F", b"imu:uint64_t timestamp;float x;float[2] y;")
    for instance in sorted({m[0] for m in messages}):
        text += message("A", struct.pack("<BH", instance, instance) + b"imu")
    for instance, *values in messages:
        text += message("D", struct.pack("<HQfff", instance, *values))
    return text


def test_a_ulog_file_has_topics_with_seconds(tmp_path):
    path = tmp_path / "flight.ulg"
    path.write_bytes(
        ulog([(0, 1_000_000, 1, 2, 3), (1, 1_500_000, 4, 5, 6), (0, 2_000_000, 7, 8, 9)])
    )
    (recording,) = recordings("ulog", path)
    assert {*recording.topics} == {"imu", "imu_1"}
    topic = recording.topics["imu"]
    assert (topic.names, topic.time) == (("time", "x", "y.0", "y.1"), "time")
    assert rows(topic) == {"time": [1, 2], "x": [1, 7], "y.0": [2, 8], "y.1": [3, 9]}
    assert rows(recording.topics["imu_1"], "time") == {"time": [1.5]}
    (some,) = recordings("ulog", path, topics=["*_1"])
    assert [*some.topics] == ["imu_1"]


def test_a_damaged_ulog_file_is_told(tmp_path, capsys):
    path = tmp_path / "flight.ulg"
    whole = ulog([(0, i, 1, 2, 3) for i in range(50)])
    for spoiled in (b"", b"ULog", whole[:20], whole[:100], whole.replace(b"imu:", b"\xff\xfe::")):
        path.write_bytes(spoiled)
        with pytest.raises(TrajectoryError, match=r"flight\.ulg"):
            recordings("ulog", path)
    assert capsys.readouterr().out == ""


# JSON files.

T, A = [0.0, 0.1, 0.2, 0.3], [1.0, 2.0, 3.0, 4.0]
STEPS = [{"t": t, "a": a} for t, a in zip(T, A, strict=True)]
COLUMNS = {"t": T, "a": A}


@pytest.mark.parametrize(
    ("value", "fields"),
    [
        (COLUMNS | {"outcome": "success", "meta": {"robot": 3}},
         {"outcome": "success", "meta.robot": 3}),
        (STEPS, {}),
        ({"success": True, "steps": STEPS}, {"success": True}),
        ({"data": STEPS}, {}),
        ({"data": COLUMNS, "fs": 10}, {"fs": 10}),
        ({"trial": {"data": COLUMNS}}, {}),
        ({k: dict(zip("0123", v, strict=True)) for k, v in COLUMNS.items()}, {}),
        ({"columns": ["t", "a"], "index": [0, 1, 2, 3],
          "data": [*map(list, zip(T, A, strict=True))]}, {}),
    ],
    ids=["columns", "rows", "steps", "rows below", "columns below", "deep", "frame", "split"],
)  # fmt: skip
def test_a_json_file_is_a_recording(tmp_path, value, fields):
    for indent in (None, 1):
        (recording,) = recordings(
            "json", written(tmp_path, json.dumps(value, indent=indent), "x.json")
        )
        assert (recording.name, recording.fields) == ("x", fields)
        assert rows(recording.topics[""]) == COLUMNS


@pytest.mark.parametrize(
    ("value", "names"),
    [
        ([{"steps": STEPS, "k": i} for i in range(2)], ["x-0", "x-1"]),
        ([COLUMNS] * 5, [f"x-{i}" for i in range(5)]),
        ({"trials": [COLUMNS, COLUMNS]}, ["x-0", "x-1"]),
        ({"first": COLUMNS, "second": COLUMNS, "robot": "r"}, ["x-first", "x-second"]),
    ],
)
def test_a_json_file_may_hold_several_episodes(tmp_path, value, names):
    episodes = recordings("json", written(tmp_path, json.dumps(value), "x.json"))
    assert [episode.name for episode in episodes] == names
    assert all(rows(episode.topics[""]) == COLUMNS for episode in episodes)


def test_tables_of_other_columns_in_a_json_file_are_topics(tmp_path):
    def topics(value):
        (recording,) = recordings("json", written(tmp_path, json.dumps(value), "x.json"))
        return {name: topic.names for name, topic in recording.topics.items()}

    assert topics({"imu": STEPS, "gps": [{"t": 0, "lat": 1}] * 2}) == {
        "imu": ("t", "a"), "gps": ("t", "lat"),
    }  # fmt: skip
    assert topics({"imu": {"x": T}, "arm": {"q": A}}) == {"": ("imu.x", "arm.q")}
    assert topics({"observations": [T, A], "actions": [[1.0]]}) == {
        "": (*(f"obs:sensor {i}" for i in range(4)), "action:action 0")
    }
    arm = {"q": A, "gains": [1, 2], "joint": 3}
    (recording,) = recordings(
        "json", written(tmp_path, json.dumps({"imu": {"x": T}, "arm": arm}), "x.json")
    )
    assert recording.fields == {"arm.joint": 3}
    assert "column gains" in "\n".join(recording.ledger.lines())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            '{"rate": 10, "names": ["a", "b"]}',
            "an object with rate, names: expected lists of equal",
        ),
        ("[1, 2, 3]", r"holds \[1, 2, 3\]: expected"),
        ("3", "holds 3: expected"),
        ('{"a": 1,', "JSONDecodeError"),
        ("", "JSONDecodeError"),
        ("[" * 100_000, "RecursionError"),
    ],
)
def test_json_without_rows_is_refused(tmp_path, content, message):
    with pytest.raises(TrajectoryError, match=message):
        recordings("json", written(tmp_path, content, "x.json"))


def test_lines_of_json_by_another_name_are_read(tmp_path):
    path = written(tmp_path, "\n".join(map(json.dumps, STEPS)), "x.json")
    assert rows(table("json", path)) == COLUMNS
    (recording,) = recordings(
        "json", written(tmp_path, json.dumps(COLUMNS | {"gains": [1, 2]}), "x.json")
    )
    assert "column gains, a list of another length than the rows" in recording.ledger.lines()[0]


# Readers in general.


def test_a_format_says_by_what_it_is_recognised():
    known = readers()
    assert {*known} == {"csv", "text", "json", "jsonl", "parquet", "lerobot", "mcap", "rosbag",
                        "ulog", "ardupilot", "mat", "hdf5", "numpy", "minari"}  # fmt: skip
    endings = [suffix for reader in known.values() for suffix in reader.suffixes]
    assert len(endings) == len({*endings})
    assert all(reader.suffixes or reader.directory_markers for reader in known.values())


def test_what_is_not_there_is_said(tmp_path):
    with pytest.raises(UsageError, match="does not exist, expected a CSV file"):
        recordings("csv", tmp_path / "none.csv")
    with pytest.raises(UsageError, match="is a directory, expected a CSV file"):
        recordings("csv", tmp_path)
    topic = table("csv", written(tmp_path, "speed,x\n1,2\n"))
    with pytest.raises(UsageError, match=r"run\.csv 'sped': did you mean 'speed'"):
        topic.read(["sped"], 0, 1)
    with pytest.raises(MissingExtraError, match=r"need no_such_library: .*oodd-eval\[logs\]"):
        library("no_such_library.part")
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: [" * 50)
    with pytest.raises(TrajectoryError):
        recordings("rosbag", tmp_path)


READER = """
from oodd_logs import Reader, Recording, Topic

def open_log(path, options):
    yield Recording(path.stem, str(path), {"": Topic.of({"x": [1.0, 2.0]})})

@hookimpl
def oodd_readers():
    return [Reader("NAME", "a file of the plant", (".plant",), open_log)]
"""


def test_a_recipe_names_the_format_of_a_plugin(monkeypatch, tmp_path, capsys):
    code = READER.replace("NAME", "plant").replace("[1.0, 2.0]", "[len(path.stem), 2.0, 3.0]")
    install(monkeypatch, tmp_path, "plant", code)
    monkeypatch.setattr(logs, "_registered", {})
    for i in range(6):
        written(tmp_path, "x", f"{'a' * (i + 1)}.plant")
    text = (
        'split = "mill"\nenvironment = "mill"\nsensors = ["x"]\n[read]\nformat = "plant"\n'
        '[nominal]\nfiles = ["*.plant"]\nparts = [0.4, 0.3, 0.3]\n'
    )
    written(tmp_path, text, "mill.toml")
    command = ["data", "import", str(tmp_path / "mill.toml"), "--output", str(tmp_path / "mill")]
    assert main(command) == 0
    train = oodd_eval.load_split(tmp_path / "mill").environment("mill").train
    assert train[0].observations[:, 0].tolist() == [1, 2, 3]
    assert main(["data", "inspect", str(tmp_path / "a.plant")]) == 0
    assert "x" in capsys.readouterr().out


def test_a_plugin_takes_no_name_of_ours_and_clashes_break_none(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "a", "plant", READER.replace("NAME", "csv"))
    install(monkeypatch, tmp_path / "b", "mill", READER.replace("NAME", "csv"))
    shop = READER.replace("NAME", "shop")
    for name in ("one", "two"):
        install(monkeypatch, tmp_path / name, name, shop)
    plugins = discover(only=["plant", "mill", "one", "two"])
    offered = plugins.offered_by("oodd_readers", Reader, check_reader, logs.shipped_readers())
    names = ["mill/csv", "one/shop", "plant/csv", "two/shop"]
    assert ([*plugins.broken], sorted(reader.name for reader in offered)) == ([], names)
    monkeypatch.setattr(logs, "_registered", {})
    register_readers(offered)
    (tmp_path / "a.csv").write_text("x\n1\n")
    assert logs.reader_for(tmp_path / "a.csv") is logs.shipped_readers()["csv"]
    assert logs.reader_for(tmp_path / "a.csv", "two/shop").name == "two/shop"
    with pytest.raises(UnknownNameError, match="one/shop"):
        logs.reader_for(tmp_path / "a.csv", "shop")
    install(monkeypatch, tmp_path / "c", "loom", READER.replace("NAME", "No"))
    plugins = discover(only=["loom"])
    assert plugins.offered_by("oodd_readers", Reader, check_reader) == []
    assert "cannot be the name of a reader" in plugins.broken[0].reason
    with pytest.raises(PluginError, match="has the suffixes"):
        register_readers([Reader("odd", "a file", ("odd",), print)])


def test_a_reader_in_a_further_module_is_found(tmp_path, monkeypatch):
    code = "READER = Reader('toy', 'a toy', ('.toy',), print)"
    (tmp_path / "toy.py").write_text(f"from oodd_logs.readers import Reader\n{code}\n")
    monkeypatch.setattr(logs, "__path__", [*logs.__path__, str(tmp_path)])
    assert "toy" in logs.shipped_readers.__wrapped__()


def test_whatever_a_reader_raises_names_the_file(tmp_path, monkeypatch):
    def fail(path, options):
        yield Recording("a", "a.odd", {"": Topic(("x",), 1, lambda *_: 1 // 0)})
        raise MemoryError("too much")

    reader = Reader("odd", "a file", (".odd",), fail)
    path = written(tmp_path, "", "a.odd")
    opened = reader.read(path)
    with pytest.raises(TrajectoryError, match=r"a\.odd cannot be read: ZeroDivisionError"):
        next(opened).topics[""].read(["x"], 0, 1)
    with pytest.raises(TrajectoryError, match=r"a\.odd cannot be read: MemoryError: too much"):
        next(opened)

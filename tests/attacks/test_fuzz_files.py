"""Random damage to what others publish or keep: splits, entries, saved detectors.

With ``--long``, thousands of each. Never a traceback, much memory, or many seconds.
"""

import io
import json
import os
import shutil
import tempfile
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from helpers_fuzz import ANY, damaged
from helpers_split import make_split
from hypothesis import strategies as st
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.reported import by_detector, entries_of, read_reported, sections
from oodd_leaderboard.site.content import site_data
from oodd_leaderboard.submit import submit

from oodd_eval import evaluate, load_split
from oodd_eval.data.bounded import STATE as STATE_BOUNDS
from oodd_eval.data.bounded import Bounds, read_bytes, read_npz
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import FittedStateError, OoddError
from oodd_eval.plugins.state import PackedState, labelled, pack, read_state, unlabelled, write_state


def paths(value, above=()):
    listed = enumerate(value) if isinstance(value, list) else ()
    for key, inner in value.items() if isinstance(value, dict) else listed:
        yield (*above, key)
        yield from paths(inner, (*above, key))


def replaced(value, path, new):
    if not path:
        return new
    copied = value.copy()
    copied[path[0]] = replaced(value[path[0]], path[1:], new)
    return copied


def changed(whole):
    """Strategy: a JSON object as bytes, one value of which is another, or with damaged bytes."""
    text = json.dumps(whole).encode()
    places = st.sampled_from([*paths(whole)])
    other = st.tuples(places, ANY).map(lambda p: json.dumps(replaced(whole, *p)).encode())
    return damaged(st.just(text)) | other


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    return make_split(
        tmp_path_factory.mktemp("where") / "split", ("cartpole",), train=2, calibration=2, test=2
    )


def read_whole(path):
    split = load_split(path)
    with split.opened() as data:
        found = data("cartpole")
        for part in (found.train, found.twins, found.anomalous("iid")):
            assert sum(len(t) for t in part) > 0


@pytest.mark.parametrize("name", ["manifest.json", "cartpole.h5"])
def test_whatever_stands_in_a_split_is_read_or_refused(fuzzed, split, name):
    whole = (split / name).read_bytes()
    contents = damaged(st.just(whole)) | st.binary(max_size=99)
    if name == "manifest.json":
        contents |= changed(json.loads(whole))

    def tried(content):
        with tempfile.TemporaryDirectory() as place:
            other = shutil.copytree(split, Path(place) / "split")
            (other / name).write_bytes(content)
            if content == whole:
                read_whole(other)
            else:
                with suppress(OoddError):
                    read_whole(other)

    read_whole(split)
    fuzzed(contents, tried)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The entry of a shipped row, with its records and curves."""
    home = tmp_path_factory.mktemp("results")
    split = make_split(home / "split", calibration=20)
    evaluate("persistence", split, output=home / "out")
    return submit(home / "out", "persistence", home / "entries", Entry(""))


@pytest.mark.parametrize("name", ["entry.toml", "records.jsonl", "curves.json"])
def test_whatever_stands_in_an_entry_is_read_or_refused(fuzzed, results, name):
    whole = (results / name).read_bytes()
    contents = damaged(st.just(whole))
    if name == "records.jsonl":
        first, rest = whole.split(b"\n", 1)
        contents |= changed(json.loads(first)).map(lambda line: line + b"\n" + rest)

    def tried(content):
        with tempfile.TemporaryDirectory() as place:
            entry = shutil.copytree(results, Path(place) / "entries" / results.name)
            (entry / name).write_bytes(content)
            try:
                by_name = by_detector(entries_of(Path(place)))
                site_data(sections(read_reported(Path(place)), by_name), (), ())
            except OoddError as error:
                said = str(error).replace("\n", "")
            else:
                said = ""
            assert not said or said.isprintable()

    fuzzed(contents, tried)


ARRAYS = {"mean": np.zeros(5), "scale": np.ones(5), "count": np.arange(3)}
KEPT = labelled("mine/1", {"size": 3}, ARRAYS)


def restored(file):
    return unlabelled(read_state(file).state(), "mine/1", {"size": 3})


def test_whatever_stands_in_a_state_is_read_or_refused(fuzzed, tmp_path):
    write_state(tmp_path / "fit.npz", pack(KEPT))
    whole = (tmp_path / "fit.npz").read_bytes()

    def tried(content):
        (tmp_path / "fit.npz").write_bytes(content)
        with suppress(FittedStateError):
            restored(tmp_path / "fit.npz")

    fuzzed(damaged(st.just(whole)) | st.binary(max_size=99), tried)


def test_whatever_the_values_of_a_state_are_they_are_read_or_refused(fuzzed, tmp_path):
    def tried(content):
        text = content.decode(errors="replace")
        write_state(tmp_path / "fit.npz", PackedState(ARRAYS, text))
        with suppress(FittedStateError):
            restored(tmp_path / "fit.npz")

    fuzzed(changed({"kind": "mine/1", "settings": {"size": 3}}), tried)


def npz(**members):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return buffer.getvalue()


def npy(shape, kind="<f8", content=b""):
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header = header.ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content


def single():
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(3))
    return buffer.getvalue()


def encrypted():
    content = bytearray(npz(mean=npy((1,), content=bytes(8))))
    for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(mark) + place] |= 1
    return bytes(content)


def values(text):
    return npz(_json=npy((len(text),), "|u1", text))


STATES = {
    "deep": values(b"[" * 10**6), "long": values(b'"' + b"x" * 2**25 + b'"'),
    "not-utf-8": values(b"\xff\xfe"), "number": values(b"1" * 10**5),
    "nan": values(b'{"size": NaN}'), "list": values(b"[]"), "other": values(b"{}"),
    "no-values": npz(mean=npy((1,), content=bytes(8))),
    "no-zip": b"x", "one-array": single(),
    "bomb": npz(**{f"a{k}": npy((10**9,), "|i1", bytes(10**6)) for k in range(3)}),
    "huge-shape": npz(a=npy((10**15,))), "negative": npz(a=npy((-1,))),
    "objects": npz(a=npy((1,), "|O", b"cos\nsystem\n(S'true'\ntR.")),
    "header": npz(a=npy("(" * 5000)), "version": npz(a=b"\x93NUMPY\x09\x00"),
    "encrypted": encrypted(),
    "method": npz(a=b"x").replace(b"\x08\x00", b"\x63\x00"),
    "other-order": npz(_json=npy((2,), "|u1", b"{}"), a=npy((1,), ">f8", bytes(8))),
    "long-numbers": npz(_json=npy((2,), "|u1", b"{}"), a=npy((1,), "<f16", bytes(16))),
}  # fmt: skip


@pytest.mark.parametrize("case", STATES)
def test_a_state_that_is_none_is_refused(tmp_path, case):
    (tmp_path / "fit.npz").write_bytes(STATES[case])
    with pytest.raises(FittedStateError):
        restored(tmp_path / "fit.npz")


@pytest.mark.parametrize(
    "read",
    [
        lambda pipe: read_npz(pipe, STATE_BOUNDS),
        lambda pipe: read_bytes(pipe, 10, FittedStateError),
        lambda pipe: StoredFile(pipe, STATE_BOUNDS),
    ],
    ids=["npz", "text", "hdf5"],
)
def test_a_pipe_in_place_of_a_file_is_refused(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FittedStateError, match="no plain file"):
        read(tmp_path / "pipe")


def test_arrays_are_bounded_together(tmp_path):
    """Each fits for itself; the second is one too many, and objects are never read."""
    bounds = Bounds(1000, FittedStateError, "say less")
    np.savez(tmp_path / "x.npz", a=np.zeros(80), b=np.zeros(80))
    with pytest.raises(FittedStateError, match="b: arrays take 1280 bytes, limit 1000: say less"):
        read_npz(tmp_path / "x.npz", bounds)

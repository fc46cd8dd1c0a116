"""A worker that says something else over its pipe than a worker says: a status, and never more.

The other end of the pipe is a script that stands in the place of the worker.
"""

import io
import json
import os
import re
import struct
import threading
import time

import numpy as np
import psutil
import pytest
from helpers_plugins import install

from oodd_eval import evaluate
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.plugins.contract import score_chunk
from oodd_eval.plugins.isolation import LONGEST_MESSAGE, Channel, child, supervisor
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.supervisor import run_isolated
from oodd_eval.results.record import STATUSES

ROWS = 30
GARBLED = "the detector wrote into the pipe between worker and harness"
FITTED = {"seconds_fit": 0.0, "warm_up": 0, "explains": False}
SCORED = {"seconds_score": 0.0, "peak_rss_mb": 1.0}
LAST = {"peak_rss_mb": 1.0}

WORKER = """
import os, sys, threading, time
channel = int(sys.argv[1])
told, groups = threading.Event(), int(os.environ["GROUPS"])
def drain():
    rest = b""
    while part := os.read(channel, 1 << 16):
        rest += part
        if rest.count(b'{"score": 0}') == groups:  # the ends of all groups
            told.set()
threading.Thread(target=drain, daemon=True).start()
told.wait()  # A worker cannot answer what it was not sent.
with open(os.environ["SCRIPT"], "rb") as script:
    while part := script.read(1 << 20):
        while part: part = part[os.write(channel, part):]
time.sleep(float(os.environ.get("STAY", 0)))
"""


def frame(content):
    return len(content).to_bytes(4, "big") + content


def said(message):
    return frame(message if isinstance(message, bytes) else json.dumps(message).encode())


def saved(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return frame(buffer.getvalue())


def header(text, content=b""):
    """An array whose header says what it likes."""
    padded = text.encode().ljust(117) + b"\n"
    return frame(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + content)


@pytest.fixture
def converse(tmp_path, monkeypatch):
    """Run the harness's side against a script of bytes; return the outcome."""

    def run(*parts, stay=0.0, limits=Limits(60), groups=1, stop=lambda: False):  # noqa: B008
        (tmp_path / "oodd_script.py").write_text(WORKER)
        (tmp_path / "script").write_bytes(b"".join(parts))
        monkeypatch.setenv("SCRIPT", str(tmp_path / "script"))
        monkeypatch.setenv("STAY", str(stay))
        monkeypatch.setenv("GROUPS", str(groups))
        monkeypatch.syspath_prepend(str(tmp_path))
        child = supervisor.Child
        monkeypatch.setattr(supervisor, "Child", lambda _, *more: child("oodd_script", *more))
        one = Trajectory(np.zeros((ROWS, 2)))
        request = {"plugin": "p", "detector": "d", "parameters": {}, "train": 1}
        try:
            return run_isolated(request, [one], [[one]] * groups, limits=limits, stop=stop)
        finally:
            monkeypatch.setattr(supervisor, "Child", child)

    return run


def test_a_worker_that_says_what_it_should_is_believed(converse):
    scores = np.arange(ROWS, dtype=np.float64)
    out = converse(said(FITTED), said({"type": "array"}), saved(scores), said(SCORED), said(LAST))
    assert (out.status, out.reason) == ("ok", "")
    assert np.array_equal(out.scores[0], scores)


AT_FIT = {
    "a status of no kind": {"status": "fine", "reason": "x"},
    "a status of the harness": {"status": "timeout", "reason": "x"},
    "a list as status": {"status": ["error"], "reason": "x"},
    "no reason": {"status": "error"},
    "a number as reason": {"status": "error", "reason": 7},
    "seconds as text": {**FITTED, "seconds_fit": "1"},
    "seconds that are no number": {**FITTED, "seconds_fit": float("nan")},
    "no warm-up": {"seconds_fit": 0.0, "explains": False},
    "text as explains": {**FITTED, "explains": "no"},
    "a list": [],
    "no JSON": b"garbage",
    "no UTF-8": b'{"\xff": 1}',
    "deep nesting": b"[" * 10**6,
    "a huge number": b'{"seconds_fit": ' + b"9" * 10**6 + b"}",
}


@pytest.mark.parametrize("message", AT_FIT.values(), ids=AT_FIT)
def test_a_wrong_message_instead_of_the_fit(converse, message):
    out = converse(said(message), stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


IN_SCORING = {
    "no memory": {"peak_rss_mb": None},
    "negative memory": {**SCORED, "peak_rss_mb": -1},
    "negative seconds": {**SCORED, "seconds_score": -1e9},
    "no kind": {"kind": "array"},
    "a list as kind": {"type": ["array"]},
    "an explanation that nobody asked for": {"type": "explanation"},
}


@pytest.mark.parametrize("message", IN_SCORING.values(), ids=IN_SCORING)
def test_a_wrong_message_in_scoring(converse, message):
    rest = saved(np.zeros((2, ROWS), np.int32))
    out = converse(said(FITTED), said(message), rest, said(LAST), stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


NPY = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"
ARRAYS = {
    "twenty megabytes": saved(np.zeros(20 * 10**6 // 8)),
    "a header longer than what follows": header(NPY.format("'<f8'", (10**9,))),
    "items of no size": header(NPY.format("'|V0'", (10**18,)), b"x"),
    "Python objects": header(NPY.format("'|O'", (1,)), b"cos\nsystem\n(S'true'\ntR."),
    "an unknown type": header(NPY.format("'<q77'", (1,)), bytes(8)),
    "a header that is code": header("__import__('os').abort()"),
    "a deep header": header("(" * 100),
    "a version of nobody": frame(b"\x93NUMPY\x09\x00" + bytes(300)),
    "a pickle": frame(b"\x80\x04\x95" + bytes(300)),
    "nothing": frame(b""),
    "a length without end": b"\xff" * 4 + (2**63).to_bytes(8, "big"),
    "a negative length": b"\xff\xff\xff\x00",
}


@pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS)
def test_a_wrong_array(converse, array):
    out = converse(said(FITTED), said({"type": "array"}), array, said(SCORED), stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


def test_more_arrays_than_trajectories(converse):
    one = said({"type": "array"}) + saved(np.zeros(ROWS))
    out = converse(said(FITTED), one, one, stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


def test_arrays_that_are_too_large_are_not_held(converse):
    """An audit had 110 arrays of 20 MB in the harness at once."""
    one = said({"type": "array"}) + saved(np.zeros(2 * 10**6))
    grown = []

    def watching():
        grown.append(psutil.Process().memory_info().rss)
        return False

    out = converse(said(FITTED), *[one] * 12, groups=12, stay=30, stop=watching)
    assert out.status == "error"
    assert max(grown) - grown[0] < 100e6


def test_a_long_message_is_not_read(converse):
    out = converse((LONGEST_MESSAGE + 1).to_bytes(4, "big"), b"{" * 100, stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


def test_costs_are_bounded_by_what_the_harness_knows(converse):
    start = time.monotonic()
    out = converse(
        said({**FITTED, "seconds_fit": 1e9}), said({"type": "array"}), saved(np.zeros(ROWS)),
        said({"seconds_score": 1e9, "peak_rss_mb": 1e12}),
        said({"seconds_score": 1e300, "peak_rss_mb": 1.0}), said({"peak_rss_mb": 1e300}),
    )  # fmt: skip
    spent = time.monotonic() - start
    assert out.status == "ok"
    assert out.seconds_fit <= spent
    assert out.seconds_score <= spent
    assert out.peak_rss_mb <= psutil.virtual_memory().total / 1e6


def test_memory_is_at_least_what_was_seen(converse):
    out = converse(
        said(FITTED), said({"type": "array"}), saved(np.zeros(ROWS)), said(SCORED), said(LAST),
        stay=30,  # so that it is there when it is looked at
    )  # fmt: skip
    assert out.peak_rss_mb > 3.0  # an interpreter holds more than the megabyte that it told of


@pytest.mark.parametrize("warm_up", [None, [], {}, "x", 1e300, 10**4000, {"a": [1] * 1000}])
def test_a_warm_up_of_any_kind_is_the_business_of_the_contract(converse, warm_up):
    out = converse(
        said({**FITTED, "warm_up": warm_up}), said({"type": "array"}), saved(np.zeros(ROWS)),
        said(SCORED), said(LAST),
    )  # fmt: skip
    assert (out.status, out.warm_up) == ("ok", warm_up)


def test_a_worker_killed_by_somebody_is_not_out_of_memory(converse, monkeypatch):
    killer = threading.Timer(
        1.0, lambda: [p.kill() for p in psutil.Process().children() if "oodd_script" in p.cmdline()]
    )
    killer.start()
    out = converse(stay=60)
    assert out.status == "error"
    assert re.fullmatch(
        r"the worker was killed by SIGKILL while fitting, not by oodd-eval; it held \d+ MB or more",
        out.reason,
    )


def test_a_worker_that_the_system_killed_for_memory_is_out_of_memory(converse, monkeypatch):
    counts = iter((4, 5))
    monkeypatch.setattr(child, "_killed_for_memory", lambda: next(counts))
    killer = threading.Timer(
        1.0, lambda: [p.kill() for p in psutil.Process().children() if "oodd_script" in p.cmdline()]
    )
    killer.start()
    out = converse(stay=60)
    assert (out.status, out.reason) == (
        "oom",
        "the system ran out of memory and killed the worker while fitting",
    )


# The worker's own side

HOSTILE = """
class Masked(Good):
    def score(self, x): return np.ma.masked_less(super().score(x), 1e9)

class Unmasked(Good):
    def score(self, x): return np.ma.MaskedArray(super().score(x))

class Saves(Good):
    def save(self, directory):
        (directory / "half").write_text("x")
        raise KeyboardInterrupt
    def load(self, directory): raise RuntimeError("was not saved")

class Leaves(Saves):
    def save(self, directory):
        directory.rmdir()
        sys.exit(0)

class Wide(Good):
    def score(self, x): return np.zeros((len(x), 40))

class Wordy(Good):
    def fit(self, nominal): raise ValueError("no " * 6 * 10**6)

class Odd(Good):
    def score(self, x): return np.zeros(len(x), [("a", "f8"), ("b", "O")])

@hookimpl
def oodd_detectors():
    return offer(masked=Masked, unmasked=Unmasked, saves=Saves, leaves=Leaves, wide=Wide,
                 wordy=Wordy, odd=Odd)
"""

ENDS = {
    "masked": ("invalid", "score returned a masked array, expected NaN where it is undefined"),
    "unmasked": ("ok", ""),
    "saves": ("ok", ""),
    "leaves": ("ok", ""),
    "wide": ("invalid", r"score returned an array of shape \(\d+, 40\), expected a numpy array of"),
    "wordy": ("error", "ValueError: no no"),
    "odd": ("invalid", "score returned ndarray of object"),
}


@pytest.mark.parametrize("name", ENDS)
def test_an_odd_detector_ends_in_a_state_that_says_why(tiny_split, monkeypatch, tmp_path, name):
    install(monkeypatch, tmp_path, "oddities", HOSTILE)
    (record,) = evaluate(name, tiny_split, environments="cartpole", anomalies="iid")
    status, reason = ENDS[name]
    assert record.status == status, record.reason
    assert record.status in STATUSES
    assert re.search(reason, record.reason)


def test_a_mask_is_not_lost_without_a_worker():
    class Masked:
        def score(self, x):
            return np.ma.masked_less(np.zeros(len(x)), 1)

    with pytest.raises(ContractError, match="masked array"):
        score_chunk(Masked(), [Trajectory(np.zeros((5, 1)))])


@pytest.mark.parametrize("array", [np.zeros((7, 0)), np.float64(3.0), np.zeros((2, 3), order="F")])
def test_arrays_of_the_harness_arrive_as_they_were(array):
    reading, writing = os.pipe()
    Channel(writing).send_array(np.asarray(array))
    received = Channel(reading).receive_array()
    assert np.array_equal(received, array)
    assert received.dtype == np.asarray(array).dtype


def test_half_a_frame_is_no_reason_to_wait_for_ever(converse):
    half = (100).to_bytes(4, "big") + b"{"
    out = converse(half, stay=60, limits=Limits(1.0))
    assert (out.status, out.reason) == ("timeout", "not done after 1 s (--timeout)")
    out = converse(half)
    assert (out.status, "ended with exit code 0" in out.reason) == ("error", True)


def test_a_process_that_escaped_and_holds_the_channel_is_not_waited_for(converse, monkeypatch):
    """It has left the group, has no mark, and its parent is gone."""
    escape = (
        "import os, sys, time\n"
        "if os.fork() == 0:\n"
        "    os.setsid()\n"
        "    if os.fork() == 0:\n"
        "        os.set_inheritable(int(sys.argv[1]), True)\n"
        "        os.execve('/bin/sleep', ['sleep', '8'], {})\n"
        "    os._exit(0)\n"
        "os.wait(); os._exit(4)\n"
    )
    monkeypatch.setitem(globals(), "WORKER", escape)
    monkeypatch.setitem(globals(), "ROWS", 10**6)  # more than fits into the socket
    start = time.monotonic()
    assert "ended with exit code 4" in converse().reason
    assert time.monotonic() - start < 6

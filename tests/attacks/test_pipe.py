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
from oodd_eval.plugins.isolation import LONGEST_MESSAGE, Channel, child, supervisor
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.supervisor import run_isolated
from oodd_eval.plugins.state import VALUES
from oodd_eval.results.record import STATUSES

ROWS = 30
GARBLED = "the detector wrote into the pipe between worker and harness"
FITTED = {"seconds_fit": 0.0, "warm_up": 0, "explains": False, "updates": True, "forks": True,
          "state": False, "voices": False}  # fmt: skip
SCORED = {"seconds_score": 0.0, "peak_rss_mb": 1.0}

WORKER = """
import os, socket, sys, threading, time
channel, stay = socket.socket(fileno=int(sys.argv[1])), float(os.environ["STAY"])

def say(to, name):
    with open(os.environ["SCRIPT"] + name, "rb") as script:
        to.sendall(script.read())

def serve(descriptor):
    group = socket.socket(fileno=descriptor)
    threading.Thread(target=drain, args=(group,), daemon=True).start()
    time.sleep(float(os.environ["DELAY"]))
    say(group, "group")
    group.shutdown(socket.SHUT_RDWR) if not stay else time.sleep(stay)
    os._exit(0)

def drain(what):
    while True:
        part, descriptors, *_ = socket.recv_fds(what, 1 << 16, 1)
        if not part: return
        for descriptor in descriptors:
            threading.Thread(target=serve, args=(descriptor,), daemon=True).start()

threading.Thread(target=drain, args=(channel,), daemon=True).start()
say(channel, "fit")
time.sleep(stay or 0.5 if os.environ["SILENT"] else 600)
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
    """Run the harness's side against scripts of bytes; return the outcome.

    The first part is said to begin with, and the others to the group.
    """

    def run(*parts, stay=0.0, delay=0.0, limits=Limits(60), streamed=False):  # noqa: B008
        (tmp_path / "oodd_script.py").write_text(WORKER)
        (tmp_path / "fit").write_bytes(b"".join(parts[:1]))
        (tmp_path / "group").write_bytes(b"".join(parts[1:]))
        monkeypatch.setenv("SCRIPT", f"{tmp_path}/")
        monkeypatch.setenv("STAY", str(stay))
        monkeypatch.setenv("DELAY", str(delay))
        monkeypatch.setenv("SILENT", "" if parts[1:] else "1")
        monkeypatch.syspath_prepend(str(tmp_path))
        child = supervisor.Child
        monkeypatch.setattr(supervisor, "Child", lambda _, *more: child("oodd_script", *more))
        one = Trajectory(np.zeros((ROWS, 2)))
        request = {"plugin": "p", "detector": "d", "parameters": {}}
        try:
            return run_isolated(
                request, [one], [[one]], limits=limits, stop=lambda: False, streamed=streamed
            )
        finally:
            monkeypatch.setattr(supervisor, "Child", child)

    return run


def test_a_worker_that_says_what_it_should_is_believed(converse):
    scores = np.arange(ROWS, dtype=np.float64)
    out = converse(said(FITTED), said(SCORED), saved(scores))
    assert (out.status, out.reason) == ("ok", "")
    assert np.array_equal(out.scores[0], scores)


AT_FIT = {
    "a status of no kind": {"status": "fine", "reason": "x"},
    "a status of the harness": {"status": "timeout", "reason": "x"},
    "a list as status": {"status": ["error"], "reason": "x"},
    "seconds as text": {**FITTED, "seconds_fit": "1"},
    "seconds that are no number": {**FITTED, "seconds_fit": float("nan")},
    "no warm-up": {name: FITTED[name] for name in FITTED if name != "warm_up"},
    "text as explains": {**FITTED, "explains": "no"},
    "no JSON": b"garbage",
    "no UTF-8": b'{"\xff": 1}',
    "deep nesting": b"[" * 10**6,
    "a huge number": b'{"seconds_fit": ' + b"9" * 10**6 + b"}",
}


IN_SCORING = {
    "no memory": {"peak_rss_mb": None},
    "negative memory": {**SCORED, "peak_rss_mb": -1},
    "another message": FITTED,
}


@pytest.mark.parametrize("message", AT_FIT.values(), ids=AT_FIT)
def test_a_wrong_message_instead_of_the_fit(converse, message):
    out = converse(said(message), stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


@pytest.mark.parametrize("message", IN_SCORING.values(), ids=IN_SCORING)
def test_a_wrong_message_in_scoring(converse, message):
    out = converse(said(FITTED), said(message), saved(np.zeros(ROWS)), stay=30)
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
    "a pickle": frame(b"\x80\x04\x95" + bytes(300)),
    "a length without end": b"\xff" * 4 + (2**63).to_bytes(8, "big"),
    "a negative length": b"\xff\xff\xff\x00",
}


@pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS)
def test_a_wrong_array(converse, array):
    out = converse(said(FITTED), said(SCORED), array, stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


STATED = {**FITTED, "state": True}
STATES = {
    "no names": said({"text": "{}"}),
    "a number of names": said({"names": 3, "text": "{}"}),
    "a list as name": said({"names": [[]], "text": "{}"}) + saved(np.zeros(3)),
    "no JSON": said({"names": [], "text": "{"}),
    "deep": said({"names": [], "text": "[" * 10**5}),
    "text without end": said({"names": [], "text": json.dumps({"x": "x" * 2**21})}),
    "letters": said({"names": ["x"], "text": "{}"}) + saved(np.array(["a"])),
    "a reserved name": said({"names": [VALUES], "text": "{}"}) + saved(np.zeros(3)),
    "an enormous array": said({"names": ["x"], "text": "{}"}) + (10**9).to_bytes(4, "big"),
    "names without end": said({"names": [*map(str, range(10**6))], "text": "{}"})
    + saved(np.zeros(0)) * 5000,
}


@pytest.mark.parametrize("state", STATES.values(), ids=STATES)
def test_a_wrong_state(converse, state):
    out = converse(said(STATED) + state, stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)
    assert out.state is None


def test_rows_are_answered_one_by_one(converse):
    scores = np.arange(ROWS, dtype="<f8")
    sent = [said({"streams": 1}), *(frame(b"=" + score.tobytes()) for score in scores)]
    out = converse(said(FITTED), *sent, said(SCORED), streamed=True, stay=30)
    assert (out.status, out.reason) == ("ok", "")
    assert np.array_equal(out.scores[0], scores)
    out = converse(said(FITTED), *sent[:2], sent[2][:-3], streamed=True)
    assert (out.status, "ended with exit code 0" in out.reason) == ("error", True)


@pytest.mark.parametrize(
    ("said_instead", "status", "reason"),
    [
        (said(SCORED), "error", GARBLED),
        (frame(bytes(9)), "error", GARBLED),
        (frame(b"=" + bytes(7)), "error", GARBLED),
        (frame(b"=" + bytes(16)), "error", GARBLED),
        (frame(b""), "error", GARBLED),
        (b"", "error", "the worker ended with exit code 0 while scoring"),
        (said({"status": "invalid", "reason": "why"}), "invalid", "why"),
    ],
)
def test_a_failure_in_place_of_a_score_says_why(converse, said_instead, status, reason):
    stay = 30 if said_instead else 0
    first = said({"streams": 1}), frame(b"=" + bytes(8))
    out = converse(said(FITTED), *first, said_instead, streamed=True, stay=stay)
    assert (out.status, out.reason) == (status, reason)


@pytest.mark.parametrize("streams", [0, -1, 2, 1.0, True, "1", None])
def test_a_wrong_number_of_streams(converse, streams):
    out = converse(said(FITTED), said({"streams": streams}), streamed=True, stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


def test_a_long_message_is_not_read(converse):
    out = converse((LONGEST_MESSAGE + 1).to_bytes(4, "big"), b"{" * 100, stay=30)
    assert (out.status, out.reason) == ("error", GARBLED)


def test_costs_are_bounded_by_what_the_harness_knows(converse):
    start = time.monotonic()
    out = converse(
        said({**FITTED, "seconds_fit": 1e9}), said({"seconds_score": 1e300, "peak_rss_mb": 1e12}),
        saved(np.zeros(ROWS)),
    )  # fmt: skip
    spent = time.monotonic() - start
    assert out.status == "ok"
    assert out.seconds_fit <= spent
    assert out.seconds_score <= spent
    assert out.peak_rss_mb <= psutil.virtual_memory().total / 1e6


def test_memory_is_at_least_what_was_seen(converse):
    out = converse(said(FITTED), said(SCORED), saved(np.zeros(ROWS)), delay=1.0)
    assert out.peak_rss_mb > 3.0  # an interpreter holds more than the megabyte that it told of


@pytest.mark.parametrize("warm_up", [None, {}, "x", 1e300, 10**4000, {"a": [1] * 1000}])
def test_a_warm_up_of_any_kind_is_the_business_of_the_contract(converse, warm_up):
    fitted = said({**FITTED, "warm_up": warm_up})
    out = converse(fitted, said(SCORED), saved(np.zeros(ROWS)))
    assert (out.status, out.warm_up) == ("ok", warm_up)


@pytest.mark.parametrize("by_system", [False, True])
def test_a_killed_worker_is_out_of_memory_where_the_system_killed_for_memory(
    converse, monkeypatch, by_system
):
    counts = iter((4, 4 + by_system))
    monkeypatch.setattr(child, "_killed_for_memory", lambda: next(counts))
    killer = threading.Timer(
        1.0, lambda: [p.kill() for p in psutil.Process().children() if "oodd_script" in p.cmdline()]
    )
    killer.start()
    out = converse(stay=60)
    assert out.status == ("oom" if by_system else "error")
    reason = (
        "the system ran out of memory and killed the worker while fitting" if by_system else
        r"the worker was killed by SIGKILL while fitting, not by oodd-eval; it held \d+ MB or more"
    )  # fmt: skip
    assert re.fullmatch(reason, out.reason)


# The worker's own side

HOSTILE = """
class Masked(Good):
    def score(self, x): return np.ma.masked_less(super().score(x), 1e9)

class Unmasked(Good):
    def score(self, x): return np.ma.MaskedArray(super().score(x))

class Tells(Good):
    def state(self): raise KeyboardInterrupt
    def restore(self, state): raise RuntimeError("there was no state")

class Odd(Good):
    def score(self, x): return np.zeros(len(x), [("a", "f8"), ("b", "O")])

@hookimpl
def oodd_detectors():
    return offer(masked=Masked, unmasked=Unmasked, tells=Tells, odd=Odd)
"""

ENDS = {
    "masked": ("invalid", "score returned a masked array, expected NaN where it is undefined"),
    "unmasked": ("ok", ""),
    "tells": ("ok", ""),
    "odd": (
        "invalid",
        r"score returned ndarray of \[\('a', '<f8'\), \('b', 'O'\)\], expected real",
    ),
}


@pytest.mark.parametrize("name", ENDS)
def test_an_odd_detector_ends_in_a_state_that_says_why(tiny_split, monkeypatch, tmp_path, name):
    install(monkeypatch, tmp_path, "oddities", HOSTILE)
    (record,) = evaluate(
        name, tiny_split, environments="cartpole", anomalies="iid", output=tmp_path / "out"
    )
    status, reason = ENDS[name]
    assert record.status == status, record.reason
    assert record.status in STATUSES
    assert re.search(reason, record.reason)


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

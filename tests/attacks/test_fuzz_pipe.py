"""Random bytes where the harness reads what others wrote: a known state, or an error that says why.

With ``--long``, thousands of each. Never a traceback, much memory, or many seconds.
"""

import io
import json
import os
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_fuzz import ANY, damaged
from hypothesis import strategies as st

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import OoddError
from oodd_eval.plugins.contract import ignore_progress
from oodd_eval.plugins.isolation import Channel, ChannelClosedError, ChannelGarbledError, supervisor
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.state import pack
from oodd_eval.results.directory import RECORDS, FitStore, ResultsDirectory, ScoreFile
from oodd_eval.results.record import STATUSES, Record
from oodd_eval.scoring.unit import Scored

LENGTHS = {"calibration": [5, 6], "test/nominal": [7]}
RECORD = Record(
    detector="a", detector_version="1", plugin="p:a", parameters={"x": 1}, environment="ant",
    anomaly="iid", group="sensor", horizon=1, seed=0, split="s", split_digest="0" * 64,
    status="ok", protocol=2, metrics={}, scores="a-ant-0",
).to_json()  # fmt: skip


FLAG = st.booleans() | ANY
FIT = st.fixed_dictionaries(
    {"seconds_fit": st.floats(0, 9) | ANY, "warm_up": ANY, "explains": FLAG, "updates": FLAG,
     "forks": FLAG, "state": FLAG, "voices": FLAG}
)  # fmt: skip
STATE = st.fixed_dictionaries({"names": st.lists(st.text()) | ANY, "text": st.text() | ANY})
NAMES = st.sampled_from(["status", "reason", "seconds_score", "peak_rss_mb", "seconds_fit",
                         "warm_up", "explains", "updates", "forks", "state",
                         "streams"])  # fmt: skip
KNOWN = st.sampled_from(["error", "ok", "oom", "timeout", 0, 1.5, True])
MESSAGE = FIT | STATE | st.dictionaries(NAMES, KNOWN | ANY, max_size=4) | ANY
JSON = MESSAGE.map(lambda message: json.dumps(message).encode())


@st.composite
def saved(draw):
    """An array as a worker sends it, with some bytes of it changed."""
    kind = draw(st.sampled_from(["f8", "f4", "i4", "c16", "S3", "?", "M8[s]", "V0", "i4,f8"]))
    shape = draw(st.sampled_from([(30,), (2, 30), (0,), (), (30, 1), (29,), (10**4,)]))
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(shape, kind), allow_pickle=False)
    return draw(damaged(st.just(buffer.getvalue())))


def framed(content):
    return len(content).to_bytes(4, "big") + content


FRAME = (JSON | saved() | st.binary(max_size=50) | damaged(JSON)).map(framed)
GOOD = [
    {"seconds_fit": 0.1, "warm_up": 0, "explains": False, "updates": True, "forks": True,
     "state": True, "voices": False}, {"names": ["x"], "text": "{}"},
]  # fmt: skip
PREFIX = b"".join(framed(json.dumps(message).encode()) for message in GOOD)
TALK = st.lists(FRAME, max_size=6).map(b"".join)
ROWS = st.lists(st.binary(max_size=20).map(b"=".__add__).map(framed), max_size=3).map(b"".join)
STREAMS = framed(b'{"streams": 2}')
TALKS = (
    TALK | damaged(TALK) | TALK.map(PREFIX.__add__) | saved().map(lambda a: PREFIX + framed(a))
    | ROWS.map(lambda rows: PREFIX + STREAMS + rows)
)  # fmt: skip


def child_of(descriptor):
    """What the supervisor knows of a worker, without one."""
    return SimpleNamespace(channel=Channel(descriptor), elapsed=1.0, peak=10**6)


def test_whatever_a_worker_says_ends_in_a_known_state(fuzzed):
    seen = set()

    def tried(talk):
        reading, writing = os.pipe()
        with suppress(BlockingIOError):
            os.set_blocking(writing, False)
            os.write(writing, talk)
        os.close(writing)
        settings = {"keep": True, "streamed": bool(len(talk) % 2), "state": None}
        settings["launcher"] = None
        settings["progress"] = ignore_progress
        unit = supervisor._UnitRun({}, [], None, Limits(), lambda: False, **settings)
        child, outcome = child_of(reading), unit.outcome
        for name in ("send", "send_array", "send_bytes"):
            setattr(child.channel, name, lambda _: None)
        one = Trajectory(np.zeros((30, 2)))
        try:
            unit._fit(child, forks=True)
            order = "stream" if unit.streamed else "score"
            (unit._stream if unit.streamed else unit._score)(child.channel, [one] * 2, order)
        except supervisor.GivenUpError as error:
            outcome.status, outcome.reason = error.status, error.reason
        except (ChannelGarbledError, ChannelClosedError):
            outcome.status, outcome.reason = "error", "garbled"
        finally:
            child.channel.close()
        scored = Scored(outcome.status, outcome.reason)
        assert scored.status in STATUSES
        assert scored.reason or scored.status == "ok" or outcome.reason == ""
        line = json.loads(RECORD) | {"status": scored.status, "reason": scored.reason}
        Record.from_json(json.dumps(line))
        seen.add(scored.status)

    fuzzed(TALKS, tried)
    assert "error" in seen


@contextmanager
def directory():
    with tempfile.TemporaryDirectory() as path:
        results = ResultsDirectory(path)
        results.prepare()
        yield results


LINES = st.lists(damaged(st.just(RECORD.encode())) | st.just(RECORD.encode()), max_size=3)
RECORDS_FILES = damaged(LINES.map(b"\n".join)) | st.binary(max_size=99)
VALUES = st.tuples(st.sampled_from(sorted(json.loads(RECORD))), ANY).map(
    lambda pair: json.dumps(json.loads(RECORD) | {pair[0]: pair[1]}).encode() + b"\n"
)


def test_whatever_stands_in_the_records_is_read_or_refused(fuzzed):
    def tried(content):
        with directory() as results:
            (results.path / RECORDS).write_bytes(content)
            with suppress(OoddError):
                records = results.records()
                assert len(results.merge_records(records)) <= len(records)
                assert results.merge_records([]) == results.records()

    fuzzed(RECORDS_FILES | VALUES, tried)


def test_a_line_that_somebody_copied_is_one_record():
    """The test above found it: further runs ended with an internal error."""
    with directory() as results:
        (results.path / RECORDS).write_text(f"{RECORD}\n{RECORD}\n")
        assert len(results.merge_records(results.records())) == 1


def score_file():
    parts = {p: [np.arange(float(n)) for n in sizes] for p, sizes in LENGTHS.items()}
    return ScoreFile(parts, {"seconds_fit": 1.0, "steps_scored": 18.0})


@pytest.fixture(scope="module")
def scores():
    """The bytes of a score file."""
    with directory() as results:
        results.write_scores("a", score_file())
        return (results.path / "scores" / "a.h5").read_bytes()


@pytest.mark.parametrize("sealed", [True, False])
def test_whatever_stands_in_a_score_file_is_read_or_not_used(fuzzed, scores, sealed):
    """Without a digest, HDF5 itself gets to see the bytes."""

    def tried(content):
        with directory() as results:
            results.write_scores("a", score_file())
            file, digest = (results.path / "scores" / f"a.{end}" for end in ("h5", "sha256"))
            if sealed:
                assert content == scores or results.scores("a", LENGTHS)
            else:
                digest.unlink()
            file.write_bytes(content)
            found = results.scores("a", LENGTHS)
            assert found is None or {p: [*map(len, s)] for p, s in found.parts.items()} == LENGTHS
            assert found is None or not sealed or content == file.read_bytes()
            results.write_scores("a", score_file())
            assert results.scores("a", LENGTHS)

    fuzzed(damaged(st.just(scores)), tried)


def test_whatever_stands_in_the_file_of_a_fit_is_a_fit_or_none(fuzzed):
    with tempfile.TemporaryDirectory() as path:
        store = FitStore(Path(path))
        store.keep("key", pack({"weights": np.ones(3), "name": "x"}), 2.0)
        (file,) = Path(path).iterdir()

        whole, kept = file.read_bytes(), store.find("key")
        assert kept.seconds_fit == 2.0
        one_bit = st.tuples(st.integers(0, len(whole) - 1), st.integers(0, 7)).map(
            lambda at: whole[: at[0]] + bytes([whole[at[0]] ^ 1 << at[1]]) + whole[at[0] + 1 :]
        )

        def tried(content):
            file.write_bytes(content)
            found = store.find("key")
            if found is not None:
                assert (found.packed.text, found.seconds_fit) == (kept.packed.text, 2.0)
                assert np.array_equal(found.packed.arrays["weights"], np.ones(3))

        cut_short = st.integers(0, len(whole) - 1).map(lambda size: whole[:size])
        fuzzed(damaged(st.just(whole)) | one_bit | cut_short | st.binary(max_size=50), tried)

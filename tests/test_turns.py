"""Units that share a fit: it is made once, and no thread waits while there is other work."""

import threading
import time
from concurrent.futures import CancelledError, ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from oodd_eval.scoring.executors.turns import Turns
from oodd_eval.scoring.runner import _as_they_finish


def line(text):
    """Jobs whose names tell the fit by their letter: ``"a1 a10 b1"``."""
    return [SimpleNamespace(name=name, offer=SimpleNamespace(plugin="x")) for name in text.split()]


def turns_of(text, kept=()):
    return Turns(
        list(enumerate(line(text))), lambda job: "" if job.name[0] in kept else job.name[0]
    )


def taken(turns, stack):
    """Take a turn and keep it; return the unit's name and what ends it."""
    turn = turns.take()
    _, job = turn.__enter__()
    stack.append(turn)
    return job.name


def end(turn):
    turn.__exit__(None, None, None)


def test_units_come_in_the_order_of_the_plan():
    turns, held = turns_of("a b c"), []
    assert [taken(turns, held) for _ in range(3)] == ["a", "b", "c"]


def test_a_unit_whose_fit_is_under_way_is_passed_over():
    turns, held = turns_of("a1 a10 a20 b1 b10"), []
    assert [taken(turns, held) for _ in range(2)] == ["a1", "b1"]
    end(held[0])
    assert taken(turns, held) == "a10"


def test_units_of_a_kept_fit_go_side_by_side():
    kept = []
    turns, held = turns_of("a1 a10 a20", kept), []
    assert taken(turns, held) == "a1"
    kept.append("a")
    assert [taken(turns, held) for _ in range(2)] == ["a10", "a20"]


def test_without_other_work_a_thread_waits_for_the_fit():
    turns, held = turns_of("a1 a10"), []
    taken(turns, held)
    with ThreadPoolExecutor(1) as pool:
        second = pool.submit(taken, turns, held)
        time.sleep(0.05)
        assert not second.done()
        end(held[0])
        assert second.result(10) == "a10"


def test_a_failed_unit_gives_its_turn_back():
    turns = turns_of("a1 a10")
    with pytest.raises(ZeroDivisionError), turns.take():
        1 / 0  # noqa: B018
    assert taken(turns, []) == "a10"


def test_a_thread_that_waits_ends_when_the_run_stops():
    turns, held = turns_of("a1 a10"), []
    taken(turns, held)
    with ThreadPoolExecutor(1) as pool:
        second = pool.submit(taken, turns, held)
        turns.stop()
        with pytest.raises(CancelledError):
            second.result(10)


def test_jobs_of_two_fits_keep_two_threads_busy():
    begun, guard, both = [], threading.Lock(), threading.Barrier(2, timeout=10)

    def score(job):
        with guard:
            begun.append(job.name)
        if job.name.endswith("1"):
            both.wait()  # only passed when the first units of both fits are under way together
        return job.name

    executor = SimpleNamespace(jobs=2, stop=lambda: None, fit_of=lambda job: job.name[0])
    jobs = line("a1 a10 a20 b1 b10 b20")
    found = dict(_as_they_finish(jobs, score, executor))
    assert sorted(begun[:2]) == ["a1", "b1"]
    assert [found[i] for i in range(6)] == [job.name for job in jobs]


def test_when_one_fit_is_all_there_is_the_run_still_ends():
    executor = SimpleNamespace(jobs=4, stop=lambda: None, fit_of=lambda _job: "a")
    found = dict(_as_they_finish(line("a1 a2 a3 a4 a5"), lambda job: job.name, executor))
    assert sorted(found) == list(range(5))

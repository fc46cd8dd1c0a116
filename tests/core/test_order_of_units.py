"""Units that share a fit: it is made once, and no thread waits while there is other work.

And the groups in which the trajectories of a unit are scored.
"""

import threading
import time
from threading import get_ident as here
from types import SimpleNamespace

import pytest

from oodd_eval.plugins.contract import DetectorSpec
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.runner import _as_they_finish, _turn
from oodd_eval.scoring.unit import Scored, groups


def jobs_of(text):
    """Jobs whose names tell the fit by their letter: ``"a1 a10 b1"``."""
    return [
        SimpleNamespace(name=name, unit=SimpleNamespace(local=False, fit_key=name[0]))
        for name in text.split()
    ]


class Results:
    def __init__(self, kept=""):
        self.fits = SimpleNamespace(has=lambda key, *, fresh: key in kept and not fresh)

    def write_scores(self, key, file): ...


class Executor:
    """Calls `work`, and notes the order in which units begin."""

    keeps_fits = True

    def __init__(self, work=lambda job: None, jobs=1):
        self.work, self.jobs, self.begun, self.stopped = work, jobs, [], False

    def __call__(self, job, progress):
        progress(1.0)
        self.begun.append(job.name)
        self.work(job)
        return Scored(resumed=True)

    def stop(self):
        self.stopped = True


def finish(text, executor, *, kept="", results=True, **settings):
    found = _as_they_finish(
        jobs_of(text),
        executor,
        RunSettings(**settings),
        Results(kept) if results else None,
        lambda *_: None,
    )
    began, finished = [], []
    for index, scored in found:
        if scored is None:
            began.append(index)
        else:
            # Told before it is finished, and only once.
            assert began.count(index) == 1
            finished.append(index)
    return finished


def test_units_begin_in_the_order_of_the_plan():
    executor = Executor()
    assert finish("a b c", executor) == [0, 1, 2]
    assert executor.begun == ["a", "b", "c"]


def test_long_fits_begin_first_behind_a_quick_one_of_the_first_environment():
    specs = {
        "quick": DetectorSpec("quick", list, ""),
        "trained": DetectorSpec("trained", list, "", requires=("torch",)),
        "long": DetectorSpec("long", list, "", seconds=30),
        "here": DetectorSpec("here", list, "", seconds=90),
    }
    plugins = SimpleNamespace(offer=lambda name: SimpleNamespace(spec=specs[name]))
    units = [
        SimpleNamespace(
            environment=environment, setting=SimpleNamespace(detector=name), local=name == "here"
        )
        for environment in ("ant", "hopper")
        for name in ("here", "trained", "quick", "long")
    ]
    plan = SimpleNamespace(units=units)
    turns = sorted(units, key=lambda unit: _turn(plan, unit, plugins))
    assert [f"{unit.environment} {unit.setting.detector}" for unit in turns] == [
        "ant quick", "ant long", "hopper long", "ant trained", "hopper trained", "hopper quick",
        "ant here", "hopper here",
    ]  # fmt: skip


def test_shares_of_fits_are_heard_in_the_thread_that_asks():
    heard = []
    jobs = jobs_of("a b c")
    for event in _as_they_finish(
        jobs, Executor(jobs=2), RunSettings(), None, lambda *told: heard.append((told, here()))
    ):
        assert event[0] in range(3)
    assert sorted(heard) == [((i, 1.0), here()) for i in range(3)]


def test_a_unit_whose_fit_is_under_way_is_passed_over():
    both = threading.Barrier(2, timeout=10)  # passed only when both first units run together
    executor = Executor(lambda job: both.wait() if job.name.endswith("1") else None, jobs=2)
    assert sorted(finish("a1 a10 a20 b1 b10 b20", executor)) == list(range(6))
    assert sorted(executor.begun[:2]) == ["a1", "b1"]


@pytest.mark.parametrize("settings", [{"kept": "a"}, {"results": False}])
def test_units_of_a_kept_fit_and_without_a_store_go_side_by_side(settings):
    both = threading.Barrier(2, timeout=10)
    finish("a1 a10", Executor(lambda _job: both.wait(), jobs=2), **settings)


def test_a_fit_that_is_kept_counts_not_when_fresh():
    running, most = [], []

    def work(job):
        running.append(job)
        most.append(len(running))
        running.remove(job)

    finish("a1 a10 a20", Executor(work, jobs=3), kept="a", fresh=True)
    assert max(most) == 1


def test_when_one_fit_is_all_there_is_the_run_still_ends():
    assert sorted(finish("a1 a2 a3 a4 a5", Executor(jobs=4))) == list(range(5))


def test_an_error_stops_the_executor_and_passes_through():
    def work(job):
        if job.name == "b":
            raise ZeroDivisionError

    executor = Executor(work)
    with pytest.raises(ZeroDivisionError):
        finish("a b c d e f", executor)
    assert executor.stopped
    assert "f" not in executor.begun


def test_after_the_deadline_nothing_is_begun():
    executor = Executor()
    assert finish("a b c", executor, deadline=0.0) == []
    assert executor.begun == []


def test_what_runs_at_the_deadline_is_finished(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("oodd_eval.scoring.runner.time.monotonic", lambda: now[0])
    executor = Executor(lambda job: now.__setitem__(0, now[0] + 6.0))
    assert finish("a b c d e f g", executor, deadline=10.0) == [0, 1]


def test_scores_of_a_few_units_are_in_memory_at_a_time():
    taken, most = 0, 0

    def work(_job):
        nonlocal most
        most = max(most, len(executor.begun) - taken)

    executor = Executor(work, jobs=2)
    jobs = jobs_of(" ".join(f"{n:02d}" for n in range(50)))
    for job in jobs:
        job.unit.fit_key = job.name
    for _, scored in _as_they_finish(jobs, executor, RunSettings(), None, print):
        taken += scored is not None
        time.sleep(0.001)
    assert taken == 50
    assert most <= 2 * executor.jobs + 1  # the one that the caller has in its hands


def test_units_go_on_while_the_caller_is_busy():
    second = threading.Event()
    executor = Executor(lambda job: second.set() if job.name == "b" else None)
    finished = _as_they_finish(jobs_of("a b"), executor, RunSettings(), None, print)
    next(finished)
    assert second.wait(10)
    finished.close()


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [
        # Twins: as many in a group as there are test seeds, and what is left of the calibration.
        ((5, 3, 3), [3, 2, 3, 3]),
        ((6, 3, 3), [3, 3, 3, 3]),
        # Without twins the smallest test part decides, a part without episodes does not.
        ((20, 12, 30, 0), [12, 8, 12, 12, 12, 6]),
        ((30, 40, 9, 10), [9, 9, 9, 3, 9, 9, 9, 9, 4, 9, 9, 1]),
        # But no group of a few: each takes a process.
        ((10, 3, 9), [8, 2, 3, 8, 1]),
        ((2, 1), [1, 1, 1]),
        ((2,), [1, 1]),
    ],
)
def test_the_smallest_test_part_is_the_size_of_groups(sizes, expected):
    parts = ("calibration", "test/nominal", "test/iid", "test/drift")
    sizes = dict(zip(parts, sizes, strict=False))
    drawn = groups(sizes)
    assert list(map(len, drawn)) == expected
    assert [member for group in drawn for member in group] == [
        (part, i) for part, n in sizes.items() for i in range(n)
    ]
    assert all(len({member.part for member in group}) == 1 for group in drawn)

"""The conformance kit: every check is proven by a detector that is broken in just that way."""

import os
import re
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
from broken_detectors import BROKEN, ENDS, GOOD, STARTED, Good

from oodd_eval import check_detector
from oodd_eval.errors import UnknownNameError
from oodd_eval.plugins.conformance import CHECKS, checks_process
from oodd_eval.plugins.conformance.supervise import MOST_ENDS
from oodd_eval.plugins.conformance.trial import ACTIONS, EPISODES, SENSORS
from oodd_eval.testing import (
    CheckFailedError,
    CheckSkipped,
    NonConformingError,
    Report,
    Result,
    Trial,
    detector_checks,
    pytest_generate_tests,  # noqa: F401  gives the test below its checks
    run_checks,
    test_contract,  # noqa: F401  a test of this module, as of a plug-in's
)

NAMES = list(CHECKS)


@pytest.fixture
def apart(monkeypatch, tmp_path):
    """Let a detector do to the process what it will, and undo it."""
    limit, environment = sys.getrecursionlimit(), dict(os.environ)
    np.random.seed(7)  # noqa: NPY002  one that the kit does not use itself
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here.txt").write_text("")
    yield
    for end in ENDS:
        end.set()
    for process in STARTED:
        process.kill()
        process.wait()
    sys.setrecursionlimit(limit)
    os.environ.clear()
    os.environ.update(environment)


def pattern(message):
    escaped = re.escape(message).replace("<n>", r"-?[\d.]+").replace(r"<\.\.\.>", ".*")
    return re.compile(escaped, re.DOTALL)


WHOLE_KIT = ["fits-NoMood", "shape-OneShort", *(name for name in BROKEN if BROKEN[name].also)]
"""Those after which little else can be carried out, and those that fail several checks."""


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_detector_fails_its_check_with_its_message(name, apart, monkeypatch):
    broken = BROKEN[name]
    # One of the two: on a busy machine, what takes memory takes its time, too.
    if broken.check == "time-budget":
        monkeypatch.setattr(checks_process, "MOST_SECONDS", 0.2)
    if broken.check == "memory-budget":
        monkeypatch.setattr(checks_process, "MOST_MEGABYTES", 100.0)
    with pytest.raises(CheckFailedError) as caught:
        CHECKS[broken.check](Trial(broken.spec))
    assert pattern(broken.message).fullmatch(str(caught.value)), caught.value


@pytest.mark.parametrize("name", WHOLE_KIT)
def test_of_the_whole_kit_a_broken_detector_fails_what_it_breaks_alone(name, apart):
    broken = BROKEN[name]
    report = run_checks(broken.spec)
    failed = {result.name: result.message for result in report.failed}
    assert set(failed) == {broken.check, *broken.also}, report
    assert pattern(broken.message).fullmatch(failed[broken.check])


def test_every_check_is_proven():
    assert {broken.check for broken in BROKEN.values()} == set(NAMES)


@pytest.fixture(scope="module")
def detector():
    """Give `test_contract`, which the kit brings along, a good detector."""
    return Trial(GOOD)


@pytest.mark.parametrize("horizon", [2, 4, 20])
def test_a_good_detector_passes_at_any_horizon(horizon):
    report = run_checks(GOOD, horizon=horizon)
    assert {result.status for result in report.results} == {"passed"}, report


# The page about them

PAGE = (Path(__file__).parents[1] / "docs" / "conformance.md").read_text()


def rows_of_the_page():
    """Name, what, why, and how to mend: the rows of the page's tables of checks."""
    found = [re.split(r" \| ", line.strip("| ")) for line in PAGE.splitlines() if "|" in line]
    return [row for row in found if len(row) == 4 and row[0].startswith("`")]


def test_the_page_has_every_check_in_its_order_and_its_own_words():
    told = [(name.strip("`"), what) for name, what, *_ in rows_of_the_page()]
    assert told == [(check.name, check.summary) for check in detector_checks()]


def test_the_page_says_of_every_check_why_and_how_to_mend_it():
    reasons = [row[2:] for row in rows_of_the_page()]
    assert all(len(text) >= 10 for row in reasons for text in row)
    assert len({text for row in reasons for text in row}) == 2 * len(NAMES)


def test_the_page_names_the_budgets_and_the_size_of_the_problem():
    for text in (f"{checks_process.MOST_SECONDS:g} s", f"{checks_process.MOST_MEGABYTES:g} MB",
                 f"{EPISODES} short nominal episodes", f"{SENSORS} sensors",
                 f"{ACTIONS} action", f"{MOST_ENDS} such ends"):  # fmt: skip
        assert text in PAGE


# Results


def test_check_detector_prints_a_line_per_check_and_a_summary(capsys):
    report = check_detector(GOOD)
    out = capsys.readouterr().out
    assert out == f"{report}\n"
    assert [line.split() for line in out.splitlines()[:-1]] == [["passed", n] for n in NAMES]
    assert re.fullmatch(rf"{len(NAMES)} checks: {len(NAMES)} passed in \d+\.\d s", report.summary())


def test_check_detector_raises_what_failed(capsys):
    with pytest.raises(NonConformingError) as caught:
        check_detector(BROKEN["gross-anomaly-Reversed"].spec)
    first, second, *_ = str(caught.value).splitlines()
    assert re.fullmatch(rf"{len(NAMES)} checks: {len(NAMES) - 1} passed, 1 failed in .*", first)
    assert second.split() == ["FAILED", "gross-anomaly"]
    assert [result.name for result in caught.value.report.failed] == ["gross-anomaly"]
    assert "FAILED   gross-anomaly" in capsys.readouterr().out


def test_an_expected_failure_is_all_right_and_keeps_its_reason():
    reversed_ = BROKEN["gross-anomaly-Reversed"].spec
    report = run_checks(reversed_, expected_failures={"gross-anomaly": "on purpose"})
    (found,) = [result for result in report.results if result.name == "gross-anomaly"]
    assert report.ok
    assert found.status == "xfailed"
    assert found.message.startswith("on purpose [an episode whose sensors go wild")
    assert f"{len(NAMES) - 1} passed, 1 failed as expected in" in report.summary()


def test_an_expected_failure_that_passes_is_a_failure():
    report = run_checks(GOOD, expected_failures={"order": "a guess"})
    assert not report.ok
    assert [(r.name, r.status) for r in report.failed] == [("order", "xpassed")]
    assert "1 passed unexpectedly" in report.summary()
    assert report.failed[0].message == (
        "expected to fail (a guess): take it from the expected failures"
    )


def test_an_expected_failure_that_does_not_apply_is_skipped():
    expected_failures = {"save-and-load": "none", "gross-anomaly": "sees nothing"}

    class Clock:
        def __init__(self, *, seed=0, horizon=1): ...

        def fit(self, nominal): ...

        def score(self, x):
            return np.arange(len(x), dtype=np.float64)

    report = run_checks(Clock, expected_failures=expected_failures)
    assert report.ok, report
    assert {r.name: r.status for r in report.results}["save-and-load"] == "skipped"


def test_expected_failures_have_names_of_checks():
    with pytest.raises(UnknownNameError, match="unknown check 'ordr': did you mean 'order'"):
        run_checks(GOOD, expected_failures={"ordr": "typo"})


def test_a_report_counts_every_status():
    results = [Result("a", "passed", seconds=1.0), Result("b", "failed", "x"),
               Result("c", "skipped", "y"), Result("d", "xfailed", "z"),
               Result("e", "xpassed", "w")]  # fmt: skip
    assert Report(results).summary() == (
        "5 checks: 1 passed, 1 failed, 1 skipped, 1 failed as expected, 1 passed unexpectedly "
        "in 1.0 s"
    )
    assert not Report(results).ok
    assert Report([]).summary() == "0 checks: none ran in 0.0 s"


def test_long_messages_stand_below_in_80_columns():
    lines = Result("order", "failed", "many words " * 20).line(10).splitlines()
    assert lines[0] == "FAILED   order"
    assert len(lines) > 2
    assert all(len(line) <= 80 and line.startswith(" " * 9) for line in lines[1:])


# In pytest


def test_a_check_is_called_with_a_factory_alone():
    skipped = set()
    for check in detector_checks():
        try:
            check(Good, horizon=2, parameters={"power": 2.0})
        except CheckSkipped:
            skipped.add(check.name)
    assert skipped == {"declared-parameters", "shared-fit", "inputs", "deterministic"}


def test_what_needs_more_than_there_is_names_the_check_to_look_at():
    unfit = BROKEN["fits-NoMood"].spec
    with pytest.raises(CheckSkipped, match="needs a fitted detector: see check 'fits'"):
        CHECKS["order"](unfit)
    with pytest.raises(CheckSkipped, match="needs a detector: see check 'factory'"):
        CHECKS["fits"](BROKEN["factory-NoScore"].spec)
    with pytest.raises(CheckSkipped, match="needs one score per observation"):
        CHECKS["order"](BROKEN["shape-OneShort"].spec)
    with pytest.raises(CheckFailedError, match="no mood"):
        CHECKS["fits"](unfit)


def test_checks_of_one_factory_share_a_fit():
    fits = []

    class Counts(Good):
        def fit(self, nominal):
            fits.append(len(nominal))
            super().fit(nominal)

    for name in ("fits", "shape", "causality", "prefix"):
        CHECKS[name](Counts)
    assert fits == [12]
    CHECKS["shape"](Counts, horizon=2)
    assert fits == [12, 12]


def test_checks_leave_the_process_as_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = Path.cwd(), dict(os.environ), np.random.get_state()[1].tobytes()  # noqa: NPY002
    run_checks(GOOD)
    assert before == (
        Path.cwd(), dict(os.environ), np.random.get_state()[1].tobytes()  # noqa: NPY002
    )  # fmt: skip
    assert list(tmp_path.iterdir()) == []


def test_the_network_works_again_after_a_check():
    run_checks(BROKEN["network-PhonesHome"].spec)
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection(server.getsockname()).close()

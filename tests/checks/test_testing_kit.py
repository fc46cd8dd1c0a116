"""The conformance kit: every check is proven by a detector that is broken in just that way."""

import os
import re
import socket
import sys
from pathlib import Path

import numpy as np
import pytest
from broken_detectors import BROKEN, ENDS, GOOD, STARTED, Good
from oodd_checks.conformance import CheckReport
from oodd_checks.conformance.session import CHECKS, run_tests
from oodd_checks.conformance.trial import Trial
from oodd_checks.testing import NonConformingError, run_checks
from oodd_trivial import Clock

from oodd_eval import check_detector

pytest_plugins = ["pytester"]

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


WHOLE_KIT = ["fits-NoMood", "scores-OneShort", *(name for name in BROKEN if BROKEN[name].also)]
"""Those after which little else can be carried out, and those that fail several checks."""


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_detector_fails_its_check_with_its_message(name, apart):
    broken = BROKEN[name]
    results = []
    run_tests(Trial(broken.spec), results.append, [broken.check])
    (result,) = results
    assert (result.name, result.status) == (broken.check, "failed")
    assert broken.message in result.message


@pytest.mark.parametrize("name", WHOLE_KIT)
def test_of_the_whole_kit_a_broken_detector_fails_what_it_breaks_alone(name, apart):
    broken = BROKEN[name]
    report = run_checks(broken.spec)
    failed = {result.name: result.message for result in report.failed}
    assert set(failed) == {broken.check, *broken.also}, report
    assert broken.message in failed[broken.check]


def test_every_check_is_proven():
    assert {broken.check for broken in BROKEN.values()} == set(NAMES)


@pytest.mark.parametrize("horizon", [2, 4, 20])
def test_a_good_detector_passes_at_any_horizon(horizon):
    report = run_checks(GOOD, horizon=horizon)
    assert {result.status for result in report.results} == {"passed"}, report


# The page about them

PAGE = (Path(__file__).parents[2] / "docs" / "conformance.md").read_text()


def test_the_page_has_every_check_in_its_order_and_its_own_words():
    rows = re.findall(r"^\| `(.+)` \| (.*) \|$", PAGE.partition("## The checks")[2], re.MULTILINE)
    assert rows == [(name, check.__doc__.removesuffix(".")) for name, check in CHECKS.items()]


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
    assert re.fullmatch(
        rf"{len(NAMES)} checks: {len(NAMES) - 2} passed, 1 failed, 1 skipped in .*", first
    )
    assert second.split() == ["FAILED", "gross-anomaly"]
    assert [result.name for result in caught.value.report.failed] == ["gross-anomaly"]
    assert "FAILED   gross-anomaly" in capsys.readouterr().out


class Bare:
    """No seed, no horizon, and scores in a list."""

    def fit(self, nominal):
        self.mean = np.concatenate([x.observations for x in nominal])[:, 0].mean()

    def score(self, x):
        if not hasattr(self, "mean"):
            raise RuntimeError("call fit first")
        return [float(score) for score in np.abs(x.observations[:, 0] - self.mean)]


@pytest.mark.parametrize(
    "detector", [Bare, Bare(), lambda seed: Bare()], ids=["class", "object", "function"]
)
def test_a_class_with_fit_and_score_alone_is_checked_like_any_other(detector):
    report = run_checks(detector, seed=3, horizon=2)
    assert [result.name for result in report.failed] == ["wrong-dimension"]
    passed = {result.name for result in report.results if result.status == "passed"}
    assert {"factory", "fits", "scores", "horizon", "prefix", "same-seed", "order"} <= passed


def test_expected_failures_are_all_right_where_they_fail_or_do_not_apply_alone():
    reasons = {"state": "none", "gross-anomaly": "on purpose", "order": "a guess"}
    report = run_checks(Clock, expected_failures=reasons)
    results = {r.name: r for r in report.results}
    assert results["state"].status == "skipped"
    assert results["gross-anomaly"].status == "xfailed"
    assert results["gross-anomaly"].message.startswith("on purpose [an episode")
    # One that passes is a failure.
    assert [(r.name, r.status) for r in report.failed] == [("order", "xpassed")]
    assert "a guess" in report.failed[0].message
    for text in ("1 failed as expected", "1 passed unexpectedly", " skipped"):
        assert text in report.summary()
    assert "0 checks" in CheckReport([]).summary()


def test_what_needs_more_than_there_is_names_the_check_to_look_at():
    for name, check, needs in [
        ("fits-NoMood", "order", "needs a fitted detector: see check 'fits'"),
        ("factory-NoScore", "fits", "needs a detector: see check 'factory'"),
        ("scores-OneShort", "order", "needs one score per observation"),
    ]:
        results = []
        run_tests(Trial(BROKEN[name].spec), results.append, [check])
        assert results[0].status == "skipped"
        assert needs in results[0].message


def test_checks_share_a_fit():
    fits = []

    class Counts(Good):
        def fit(self, nominal):
            fits.append(len(nominal))
            super().fit(nominal)

    run_tests(Trial(Counts), lambda _: None, ["fits", "scores", "prefix"])
    assert fits == [12]


def test_checks_leave_the_process_as_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def state():
        generator = np.random.get_state()[1].tobytes()  # noqa: NPY002
        return Path.cwd(), dict(os.environ), list(sys.path), list(sys.meta_path), generator

    before = state()
    run_checks(GOOD)
    run_checks(BROKEN["network-PhonesHome"].spec)
    assert before == state()
    assert list(tmp_path.iterdir()) == []
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection(server.getsockname()).close()


# In the tests of a plug-in


def test_a_module_of_tests_has_every_check(pytester):
    pytester.makepyfile("""
        import pytest
        from oodd_eval import DetectorSpec
        from oodd_checks.testing import *
        from oodd_trivial import Clock

        @pytest.fixture(scope="module")
        def detector():
            return Clock
    """)
    done = pytester.runpytest_subprocess("-pno:cacheprovider", "-rf", "-n0")
    outcomes = done.parseoutcomes()
    assert sum(outcomes.get(s, 0) for s in ("passed", "failed", "skipped")) == len(NAMES)
    assert outcomes["failed"] == 1
    done.stdout.fnmatch_lines(["FAILED *::test_gross_anomaly - *"])


def test_the_plug_in_checks_detectors_by_name(pytester):
    done = pytester.runpytest_subprocess(
        "--pyargs", "oodd_checks.conformance", "--oodd-detector", "clock,persistence",
        "-k", "gross_anomaly or fits", "-pno:cacheprovider", "-n0",
    )  # fmt: skip
    outcomes = done.parseoutcomes()
    assert (outcomes["failed"], outcomes["passed"]) == (1, 3)
    assert outcomes["deselected"] == 2 * (len(NAMES) - 2)
    done.stdout.fnmatch_lines(["FAILED *test_gross_anomaly?clock?*"])

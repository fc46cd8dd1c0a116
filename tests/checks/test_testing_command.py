"""``oodd-eval check``: exit codes, what is printed, and detectors that end their process."""

import re
import sys

import pytest
from helpers_plugins import install
from oodd_checks.testing import CHECKS

from oodd_eval.cli import main as cli

NAMES = list(CHECKS)

PLUGIN = """
import ctypes
from oodd_eval.errors import NotFittedError, TrajectoryError
from oodd_eval.plugins.parameters import declared_by

class Fine(Good):
    fitted = None
    def __init__(self, *, seed=0, horizon=1, power=1.0):
        self.power = power
    def fit(self, nominal):
        self.fitted = nominal[0].observation_dim
    def score(self, x):
        if self.fitted is None: raise NotFittedError("call fit before score")
        if x.observation_dim != self.fitted:
            raise TrajectoryError(f"fitted on {self.fitted} sensors, got {x.observation_dim}")
        return super().score(x)

class CrashesOnShort(Fine):
    def score(self, x):
        if len(x) == 1:
            print("last words", flush=True)
            os.kill(os.getpid(), signal.SIGSEGV)
        return super().score(x)

class HangsOnConstant(Fine):
    def score(self, x):
        if self.fitted and not np.ptp(x.observations, axis=0).any() and len(x) > 5: time.sleep(600)
        return super().score(x)

class Crashes(Fine):
    def fit(self, nominal): ctypes.string_at(0)

class ExitsOften(Fine):
    scored = 0
    def score(self, x):
        self.scored += 1
        if self.scored == 3: os._exit(7)
        return super().score(x)

class Grows(Fine):
    def fit(self, nominal): self.rows = np.ones(10**8); time.sleep(600)

class Garbles(Fine):
    def score(self, x):
        for descriptor in range(3, 30):
            try: os.write(descriptor, b"garbage" * 10)
            except OSError: pass
        return super().score(x)

class ClosesAll(Fine):
    def fit(self, nominal):
        os.closerange(0, 100); time.sleep(600)

class Ugly(Fine):
    def fit(self, nominal): raise ValueError("\\udcff \\x1b[2J [/red] " + "no " * 10**5)

class Raises(Fine):
    def score(self, x): raise RuntimeError("no mood")

@hookimpl
def oodd_detectors():
    found = {k: v for k, v in globals().items() if isinstance(v, type) and issubclass(v, Fine)}
    spec = DetectorSpec("needy", Fine, "", requires=("no_such",), extra="oodd-x[y]")
    return [spec, *(DetectorSpec(k.lower(), v, "", parameters=declared_by({"power": 1.0}))
            for k, v in found.items())]
"""


@pytest.fixture
def check(monkeypatch, tmp_path, capsys):
    """Call ``oodd-eval check``: exit code, standard output and error."""
    install(monkeypatch, tmp_path, "checked", PLUGIN)

    def call(*arguments):
        code = cli.main(["check", *arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def statuses(out):
    return {
        m[2]: m[1]
        for m in re.finditer(r"^(passed|FAILED|skipped|xfailed) +(\S+)", out, re.MULTILINE)
    }


def test_a_conforming_detector_is_exit_code_0_with_a_line_per_check(check):
    code, out, err = check("fine")
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == "fine of oodd-checked 1.0, horizon 1, seed 0"
    assert list(statuses(out)) == NAMES
    assert set(statuses(out).values()) == {"passed", "skipped"}
    assert re.search(
        rf"^{len(NAMES)} checks: \d+ passed, \d+ skipped in \d+\.\d s$", out, re.MULTILINE
    )
    assert max(map(len, out.splitlines())) <= 80


def test_messages_of_a_detector_are_made_fit_to_print(check):
    assert 'raise RuntimeError("no mood")' in check("raises", "-v", "-k", "fits")[1]
    code, out, err = check("ugly", "-v", "-k", "fits")
    assert (code, err) == (1, "")
    assert "fit raised ValueError: \ufffd \ufffd[2J [/red] no no" in " ".join(out.split())
    assert {c for c in out if not c.isprintable()} == {"\n"}
    assert len(out) < 10_000


def test_expected_failures_horizon_and_parameters_reach_the_checks(check):
    code, out, _ = check("clock", "-k", "anomaly", "--expect", "gross-anomaly=it is a clock")
    assert code == 0
    assert "it is a clock [an episode" in " ".join(out.split())
    code, out, _ = check("fine", "--horizon", "1,7", "--param", "power=2", "-k", "scores")
    assert code == 0
    assert [line for line in out.splitlines() if line.startswith("fine")] == [
        f"fine of oodd-checked 1.0, horizon {h}, seed 0, power 2" for h in (1, 7)
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fin"], "anomaly of a plug-in 'fin': did you mean 'fine'"),
        (["fine", "--param", "x=1"], "unknown parameter of fine 'x'"),
        (["fine", "--expect", "ordr=x"], "unknown check 'ordr': did you mean 'order'"),
        (["fine", "--seed", "-1"], "'--seed'"),
        (["needy"], 'needs no_such: pip install "oodd-x[y]"'),
    ],
)
def test_what_cannot_be_carried_out_is_exit_code_4(check, arguments, message):
    code, out, err = check(*arguments)
    assert (code, out) == (4, "")
    assert message in err


# Detectors that end, or keep, the process in which they are checked


def test_a_crash_fails_the_check_it_was_in_and_the_others_go_on(check):
    code, out, _ = check("crashesonshort", "-v")
    assert code == 1
    found = statuses(out)
    assert list(found) == NAMES
    assert {n for n, s in found.items() if s == "FAILED"} == {"prefix", "short-trajectories"}
    assert out.count("the process was killed by SIGSEGV") == 2
    assert "last words" in out


def test_a_hang_is_ended_by_the_limit(check):
    code, out, _ = check("hangsonconstant", "-k", "constant or scores", "--timeout", "8")
    assert code == 1
    assert statuses(out) == {
        "scores": "passed", "constant-trajectory": "FAILED", "constant-sensor": "passed",
    }  # fmt: skip
    assert "the process was not done after 8 s (--timeout)" in " ".join(out.split())


def test_after_three_dead_processes_the_rest_are_not_tried(check):
    code, out, _ = check("exitsoften")
    assert code == 1
    assert list(statuses(out)) == NAMES
    failed = [n for n, s in statuses(out).items() if s == "FAILED"]
    assert len(failed) == 3
    assert f"not tried: check {failed[-1]!r} ended its process" in out
    assert out.count("the process ended with exit code 7") == 3


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("grows", r"the process held \d+ MB, more than 300 MB \(--memory\)"),
        ("garbles", r"the process wrote into the pipe to the harness"),
        ("closesall", r"the process closed the pipe to the harness"),
    ],
)
def test_other_ways_to_misuse_the_process_are_named(check, name, message):
    code, out, _ = check(name, "-k", "fits", "--memory", "300MB", "--timeout", "60")
    assert code == 1
    assert re.search(message, " ".join(out.split()))


def test_without_pytest_the_extra_is_named(check, monkeypatch):
    for name in [n for n in sys.modules if n.startswith("oodd_checks.conformance")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "oodd_checks.testing")
    monkeypatch.setitem(sys.modules, "pytest", None)
    code, _, err = check("fine")
    assert code == 4
    assert "pip install 'oodd-eval[check]'" in err

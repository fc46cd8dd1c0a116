"""Plug-ins that a sandbox describes: the command imports none, believes and awaits none."""

import os
import shutil
import site
import subprocess
import time
import venv

import pytest
from helpers_boxed import boxed_plugins
from helpers_plugins import install, write_plugin
from oodd_leaderboard.sandbox import describe
from oodd_leaderboard.sandbox.describe import discover_in_sandbox
from oodd_leaderboard.sandbox.launcher import Sandbox

from oodd_eval.data.split import load_split
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.plugins.discovery import discover
from oodd_eval.scoring.plan import make_plan

pytestmark = pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")
MEMORY = 10**9

HOOK = "\n@hookimpl\ndef oodd_detectors(): return offer(odd=Good)\n"
ANSWERS = """
from oodd_eval.plugins.isolation import Channel
describe = sys.modules["__main__"]
def answer(**changes):
    plain = describe._answer
    describe._answer = lambda plugin, text: plain(plugin, text) | changes
def spec(**changes):
    plain = describe.description_of
    describe.description_of = lambda spec: plain(spec) | changes
"""
IMPORTED = {
    "exits with a code": ("os._exit(200)", "ended with exit code 200"),
    "a real-time signal": ("os.kill(os.getpid(), 40)", "was killed by signal 40"),
    "sys.exit": ("sys.exit(3)", "SystemExit"),
    "hangs deaf": ("signal.pthread_sigmask(0, range(1, 60)); time.sleep(600)", "not done after"),
    "memory": ("held = np.ones(3 * 10**8); time.sleep(600)", "more than"),
    "interrupt": ("raise KeyboardInterrupt", "KeyboardInterrupt"),
    "mute error": (
        "class E(Exception):\n    def __str__(self): sys.exit(1)\nraise E()", "E: (no message)"
    ),
    "writes into the pipe": (
        "for fd in range(3, 99):\n    try: os.write(fd, b'x' * 999)\n    except OSError: pass",
        "wrote into the pipe",
    ),
    "no mapping": (ANSWERS + "describe._answer = lambda *_: 5", ""),
    "a list": (ANSWERS + "answer(specs=5)", "wrong form"),
    "too many": (ANSWERS + "answer(specs=[{}] * 2000)", "2000"),
    "too much": (ANSWERS + "answer(form='x' * 2**25)", "pipe"),
    "an escape": (ANSWERS + r"answer(form='\x1b[31m')", "describes"),
    "deep": (ANSWERS + "x = []\nfor _ in range(500): x = [x]\nanswer(specs=x)", ""),
    "long numbers": (ANSWERS + "answer(specs=[10**4000])", ""),
    "no specs": (ANSWERS + "describe._answer = lambda *_: {}", "wrong form"),
    "a factory": (ANSWERS + "spec(factory='os.system')", "wrong form"),
    "a type": (ANSWERS + "spec(parameters={'a': {'types': ['os']}})", "wrong form"),
    "many parameters": (ANSWERS + "spec(parameters={str(i): {} for i in range(999)})", "999"),
}  # fmt: skip


@pytest.mark.parametrize(("code", "reason"), IMPORTED.values(), ids=IMPORTED)
def test_what_a_plug_in_does_at_import_breaks_it_alone(code, reason, monkeypatch, tmp_path):
    monkeypatch.setattr(describe, "SECONDS", 12)
    write_plugin(tmp_path, "odd", code + HOOK)
    start = time.monotonic()
    plugins, _ = boxed_plugins(tmp_path, memory=10**9)
    assert not plugins.offers
    (broken,) = plugins.broken
    assert (broken.plugin, broken.distribution) == ("odd", "oodd-odd")
    assert reason in broken.reason
    assert broken.reason.isprintable()
    assert time.monotonic() - start < 60


def test_a_run_in_a_sandbox_has_the_plan_of_a_plain_one():
    split = load_split("mini")
    plain, boxed = discover(), discover_in_sandbox((), Sandbox(()), MEMORY)
    names = [*plain.select("all"), *plain.select("sklearn:IsolationForest")]
    assert names == [*boxed.select("all"), *boxed.select("sklearn:IsolationForest")]
    assert plain.spec_forms() == boxed.spec_forms()
    plans = [
        make_plan(plugins, split=split, detectors=names, environments=["cartpole"])
        for plugins in (plain, boxed)
    ]
    assert plans[0].units == plans[1].units
    assert boxed.broken == plain.broken == []


def test_names_and_parameters_that_nobody_offers_are_told_as_in_a_plain_run():
    boxed = discover_in_sandbox((), Sandbox(()), MEMORY)
    with pytest.raises(UnknownNameError, match="did you mean 'mewma'"):
        boxed.offer("mewna")
    with pytest.raises(UsageError, match="IsolationForrest"):
        boxed.offer("sklearn:IsolationForrest")
    with pytest.raises(UsageError, match="no plug-in makes a detector of 'other:x'"):
        boxed.offer("other:x")


def test_one_sandbox_describes_a_distribution(monkeypatch):
    asked, plain = [], describe._Describer._ask
    monkeypatch.setattr(describe._Describer, "_ask", lambda *a: asked.append(a[1]) or plain(*a))
    boxed = discover_in_sandbox((), Sandbox(()), MEMORY)
    assert boxed.offer("rf").spec.name == "rf"
    assert boxed.offer("pe").spec.name == "pe"
    assert asked == ["oodd-eval"]


def test_a_detector_of_a_sandbox_cannot_be_made_in_the_command():
    offer = discover_in_sandbox((), Sandbox(()), MEMORY).offer("clock")
    with pytest.raises(ImportError, match="sandboxes alone"):
        offer.spec.factory(seed=0, horizon=1)


def test_a_plug_in_of_the_environment_is_found_wherever_its_modules_lie(tmp_path):
    venv.create(tmp_path / "venv", with_pip=False)
    (packages,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    write_plugin(packages, "odd", HOOK)
    os.renames(packages / "oodd_odd.py", tmp_path / "checkout" / "oodd_odd.py")
    (tmp_path / "checkout" / "results.csv").write_text("")
    here = "".join(f"site.addsitedir({path!r});" for path in site.getsitepackages())
    (packages / "odd.pth").write_text(f"{tmp_path}/checkout\nimport site;{here}\n")
    done = subprocess.run(
        [tmp_path / "venv/bin/python", "-m", "oodd_eval", "run", "--detector", "odd", "--env",
         "cartpole", "--anomaly", "iid", "--limit", "4", "--output", tmp_path / "out", "--sandbox"],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_plug_in_that_only_a_variable_names_is_no_one_s_of_the_environment(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path, "odd", HOOK)
    plugins = discover_in_sandbox((), Sandbox(()), MEMORY)
    assert {"rf", "clock"} <= plugins.offers.keys()
    assert plugins.offers["rf"].distribution == "oodd-eval"
    (broken,) = plugins.broken
    assert "oodd-odd is not installed in the environment" in broken.reason

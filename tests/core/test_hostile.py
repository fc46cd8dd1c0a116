"""Hostile plug-ins, each a module of its own, through the real command line in three runs.

Each ends in a named state, the cells of the others are finished, and nothing is left running.
"""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from helpers_plugins import install

from oodd_eval.plugins.discovery import LONGEST_REASON
from oodd_eval.results.record import STATUSES

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="signals and states of Linux"),
]

HEADER = """
import builtins, ctypes, os, shutil, signal, subprocess, sys, threading, time
from pathlib import Path
import numpy as np
from oodd_eval import DetectorSpec, hookimpl

class Base:
    def __init__(self, *, seed=0, horizon=1): pass
    def fit(self, nominal): pass
    def score(self, x): return np.abs(x.observations).sum(axis=1).astype(np.float64)

@hookimpl
def oodd_detectors():
    return [DetectorSpec(Hostile.__module__.removeprefix("oodd_"), Hostile, "")]
"""

# name: (body of the class, status, reason)
QUICK = {
    "segfault": ("def score(self, x): ctypes.string_at(0)",
                 "error", "the worker was killed by SIGSEGV while scoring"),
    "sysexit": ("def score(self, x): sys.exit(0)", "error", r"called sys.exit\(0\)"),
    "pipe": ("""
        def score(self, x):
            for descriptor in range(3, 64):
                try: os.write(descriptor, b"garbage " * 10)
                except OSError: pass
            return super().score(x)""",
             "error", "the detector wrote into the pipe between worker and harness"),
    "forks": ("def fit(self, nominal): os.fork()", "ok", ""),
    "orphan": ("""
        def fit(self, nominal):
            if os.fork() == 0:
                os.setsid()
                if os.fork() == 0: time.sleep(600)
                os._exit(0)
            os._exit(3)""",
               "error", "the worker ended with exit code 3 while fitting"),
    "grows": ("""
        def score(self, x):
            self.rows = np.ones(6 * 10**7); time.sleep(600)""",
              "oom", r"resident memory \d+ MB is over the limit of 300 MB \(--memory\)"),
    "speechless": ("""
        class Odd(Exception):
            def __str__(self): raise ValueError("no words")
        def score(self, x): raise self.Odd""",
                   "error", r"Odd: \(no message\) \(oodd_speechless.py:\d+\)"),
    "ugly": ("def score(self, x): raise ValueError('\\udcff \\x1b[2J [/red] [bold]')",
             "error", r"ValueError: \ufffd \ufffd\[2J \[/red\] \[bold\] \(oodd_ugly.py:\d+\)"),
    "wordy": ("def score(self, x): raise ValueError('no ' * 10**6)",
              "error", r"ValueError: (no )+.{3,9}(no )+no \(oodd_wordy.py:\d+\)"),
    "scribbles": ("""
        def fit(self, nominal):
            for x in nominal: x.observations.flags.writeable = True; x.observations[:] = np.nan
        def score(self, x):
            scores = super().score(x)
            x.observations.flags.writeable = True; x.observations[:] = np.nan
            return scores""",
                  "ok", ""),
    "stateless": ("""
        def state(self): return {"x": object(), **dict.fromkeys(map(str, range(9999)))}
        def restore(self, state): raise RuntimeError("there is nothing")""",
                  "ok", ""),
    "unguarded": ("""
        def fit(self, nominal): os.kill(os.getppid(), signal.SIGKILL); time.sleep(600)""",
                  "error", "the worker was killed by SIGKILL while fitting, not by oodd-eval"),
    "unguardedscores": ("""
        def fit(self, nominal): self.guard = os.getppid()
        def score(self, x): os.kill(self.guard, signal.SIGKILL); time.sleep(600)""",
                        "error", "the worker was killed by SIGKILL while scoring, not by"),
    "realtime": ("def score(self, x): os.kill(os.getpid(), 40)",
                 "error", "the worker was killed by signal 40 while scoring"),
    "scored": ("def score(self, x): os._exit(93)",
               "error", "the worker closed its pipe while scoring, without a result"),
    "factoryexits": ("def __init__(self, **_): sys.exit(0)", "error", r"called sys.exit\(0\)"),
    "atexit": ("""
        def fit(self, nominal): import atexit; atexit.register(time.sleep, 600)""",
               "ok", ""),
    "leaves": ("""
        def fit(self, nominal):
            subprocess.Popen(["sleep", "600"], start_new_session=True)""",
               "incompatible", "processes run on after fit"),
    "threads": ("""
        def fit(self, nominal):
            for _ in range(50): threading.Thread(target=time.sleep, args=(600,)).start()""",
                "incompatible", "threads or processes run on after fit"),
}  # fmt: skip

UNMARKED = f"600.{os.getpid()}"
"""Argument of a process that has neither the group nor the environment of its worker."""

HANGING = {
    "hangs": "def fit(self, nominal): time.sleep(600)",
    "spins": """
        def score(self, x):
            while True: pass""",
    "deaf": """
        def fit(self, nominal):
            for number in set(signal.Signals) - {signal.SIGKILL, signal.SIGSTOP}:
                signal.signal(number, signal.SIG_IGN)
            time.sleep(600)""",
    "floods": """
        def score(self, x):
            while True: os.write(1, b"garbage " * 1000)""",
    "unmarked": f"""
        def fit(self, nominal):
            subprocess.Popen(["sleep", "{UNMARKED}"], start_new_session=True, env={{}})
            time.sleep(600)""",
    "importhangs": "if 'OODD_EVAL_PROCESS' in os.environ: time.sleep(600)",
}

BROKEN = {"leavesatimport": "import sys; sys.exit(0)", "brokenatimport": "import no_such_module"}

# A harness that imported these would be gone.
DEADLY = {
    "killsatimport": "import os; os._exit(9)",
    "hangsatimport": "import time; time.sleep(600)",
}

MARKER = f"OODD_TEST_HOSTILE=run-{os.getpid()}"
LIMIT = "6"


def left_running():
    """Processes whose environment holds this test's marker, but for this one."""
    name, value = MARKER.split("=")
    found = []
    for process in psutil.process_iter(["cmdline", "environ"]):
        command = process.info["cmdline"] or []
        if (process.info["environ"] or {}).get(name) == value or UNMARKED in command:
            found.append(command)
    return found


@pytest.fixture(scope="module")
def hostile(tiny_split, tmp_path_factory):
    """All runs: exit codes, outputs, records by detector, and processes left running."""
    plugins = tmp_path_factory.mktemp("plugins")
    bodies = {name: body for name, (body, *_) in QUICK.items()} | HANGING
    with pytest.MonkeyPatch.context() as patch:
        for name, body in bodies.items():
            code = f"class Hostile(Base):\n{indented(body)}\n"
            install(patch, plugins, name, code, header=HEADER)
        for name, code in (BROKEN | DEADLY).items():
            install(patch, plugins, name, code, header="")

    def run(names, *options):
        output = tmp_path_factory.mktemp("output")
        name, value = MARKER.split("=")
        done = subprocess.run(
            [sys.executable, "-m", "oodd_eval", "run", "--detector", ",".join(names), "--env",
             "cartpole", "--anomaly", "iid,gravity", "--split", tiny_split, "--output",
             output, *options],
            env={**os.environ, name: value, "PYTHONPATH": str(plugins)},
            capture_output=True, text=True, check=False, timeout=300,
        )  # fmt: skip
        lines = (output / "records.jsonl").read_text().splitlines()
        return done, [json.loads(line) for line in lines]

    quick = run([*QUICK, "clock"], "--memory", "300MB", "--timeout", "120", "--jobs", "3")
    # On their own: a short limit would also end whoever starts slowly on a busy machine.
    hanging = run(HANGING, "--timeout", LIMIT, "--jobs", "12")
    time.sleep(0.2)
    return quick, hanging, left_running()


def indented(body):
    lines = body.strip("\n").splitlines()
    margin = len(lines[0]) - len(lines[0].lstrip())
    return "\n".join("    " + line[margin:] for line in lines)


def cells(records, name):
    return [record for record in records if record["detector"] == name]


@pytest.mark.parametrize("name", QUICK)
def test_a_hostile_plugin_ends_in_its_state(hostile, name):
    _, status, reason = QUICK[name]
    found = cells(hostile[0][1], name)
    assert [record["status"] for record in found] == [status] * 2, found[0]["reason"]
    assert all(re.search(reason, r["reason"]) for r in found)
    assert len(found[0]["reason"]) <= LONGEST_REASON


@pytest.mark.parametrize("name", HANGING)
def test_a_hanging_plugin_is_ended_by_the_time_limit(hostile, name):
    found = cells(hostile[1][1], name)
    assert [(record["status"], record["reason"]) for record in found] == [
        ("timeout", f"not done after {LIMIT} s (--timeout)")
    ] * 2


def test_every_other_cell_is_finished_and_nothing_reaches_the_output_or_is_left(hostile):
    (quick, records), (hanging, hung), left = hostile
    assert quick.returncode == hanging.returncode == 1, quick.stderr
    assert len(records) == 2 * (len(QUICK) + 1)
    assert len(hung) == 2 * len(HANGING)
    assert [record["status"] for record in cells(records, "clock")] == ["ok"] * 2
    # Trajectories of the worker are copies: the scores of the others are as they would be.
    assert cells(records, "scribbles")[0]["metrics"] == cells(records, "forks")[0]["metrics"]
    for done in (quick, hanging):
        assert "garbage" not in done.stdout + done.stderr
        assert "\x1b" not in done.stdout
        assert len(done.stdout) < 20_000
        # Plug-ins that kill, hang or fail at import do not touch runs of others.
        assert "atimport" not in done.stderr
    assert left == []


def test_the_page_about_isolation_tells_every_state():
    page = (Path(__file__).parents[2] / "docs" / "isolation.md").read_text()
    told = re.findall(r"^\| `(\w+)` \| ", page, re.MULTILINE)
    assert ("ok", *told) == STATUSES

"""Commands in processes of their own, which tests kill."""

import json
import os
import subprocess
import sys
import time

import psutil

SLOW = """
def reached(point):
    \"\"\"Kill the harness the n-th time that this point is reached, if KILL_AT is point:n.\"\"\"
    wanted, _, times = os.environ.get("KILL_AT", "").partition(":")
    if point == wanted:
        with open(os.environ["FITS"] + ".points", "a") as log:
            log.write("x")
            if log.tell() == int(times):
                os.kill(int(os.environ["HARNESS"]), signal.SIGKILL)

class Slow(Good):
    \"\"\"Persistence that takes its time and writes a line per fit, with its process id.

    Of the seed that ENDLESS names, a fit never ends.
    \"\"\"
    def __init__(self, *, seed=0, horizon=1, pause=0.1):
        self.pause, self.seed, self.horizon = pause, seed, horizon
    def fit(self, nominal):
        with open(os.environ["FITS"], "a") as log:
            log.write(f"{os.getpid()} {nominal[0].observation_dim} {self.horizon} {self.seed}\\n")
        reached("fit")
        time.sleep(3600 if os.environ.get("ENDLESS") == str(self.seed) else self.pause)
    def score(self, x):
        reached("score")
        time.sleep(self.pause / 100)
        return super().score(x) + self.seed

class Keeps(Slow):
    \"\"\"The same with a state that is slow to tell, and shared by all horizons.\"\"\"
    def fit(self, nominal):
        self.horizon = "any"
        super().fit(nominal)
        self.dimension = nominal[0].observation_dim
    def state(self):
        reached("state")
        time.sleep(self.pause)
        return {"dimension": self.dimension}
    def restore(self, state):
        reached("restore")
        self.dimension = state["dimension"]

@hookimpl
def oodd_run_started():
    os.environ["HARNESS"] = str(os.getpid())
    def moving(move):
        def moved(*paths, **settings):
            reached("move")
            move(*paths, **settings)
            reached("moved")
        return moved
    os.replace, os.rename = moving(os.replace), moving(os.rename)

@hookimpl
def oodd_cell_finished():
    reached("cell")

@hookimpl
def oodd_run_finished():
    reached("finished")

@hookimpl
def oodd_detectors():
    known = declared_by({"pause": 0.1})
    return [
        DetectorSpec("slow", Slow, "", parameters=known),
        DetectorSpec("keeps", Keeps, "", parameters=known, horizon_decides_fit=False),
    ]
"""


def environment(plugin, fits, **more):
    """Return the variables of a process that finds a plug-in, whose log of fits is named."""
    return {
        **os.environ, "PYTHONPATH": str(plugin), "FITS": str(fits), "OMP_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1", **more,
    }  # fmt: skip


def oodd_eval(*arguments, **settings):
    """Start the command line in a process of its own."""
    command = [sys.executable, "-m", "oodd_eval", *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **settings
    )


def wait_until(condition, *, seconds=120):
    """Wait for a condition, on a busy machine for long; return whether it came true."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def workers_of(marker):
    """Return the ids of detectors' processes whose environment holds ``NAME=VALUE``."""
    name, _, value = marker.partition("=")
    return [
        process.pid
        for process in psutil.process_iter(["cmdline", "environ", "status"])
        if "oodd_eval.plugins.isolation.worker" in (process.info["cmdline"] or [])
        and (process.info["environ"] or {}).get(name) == value
        and process.info["status"] != psutil.STATUS_ZOMBIE
    ]


class Cluster:
    """A scheduler and workers with one thread each, on loopback."""

    def __init__(self, path, variables, workers):
        self.path, self._variables = path, variables
        self.processes = []
        file = path / "scheduler.json"
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", file)
        assert wait_until(lambda: file.exists() and file.read_text().strip())
        self.address = json.loads(file.read_text())["address"]
        for number in range(workers):
            self._start(
                "worker", self.address, "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1",
                "--local-directory", path / f"worker-{number}",
            )  # fmt: skip
        logs = [path / f"{number}.log" for number in range(1, workers + 1)]
        assert wait_until(lambda: all("Registered to" in g.read_text() for g in logs))

    def _start(self, *arguments):
        log = (self.path / f"{len(self.processes)}.log").open("w")
        command = [sys.executable, "-m", "dask", *map(str, arguments), "--no-dashboard"]
        with log:
            self.processes.append(
                subprocess.Popen(command, stdout=log, stderr=log, env=self._variables)
            )

    def close(self):
        for process in self.processes:
            process.kill()
            process.wait()

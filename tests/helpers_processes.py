"""Commands in processes of their own, which tests kill."""

import os
import subprocess
import sys
import time
from pathlib import Path

SLOW = """
class Slow(Good):
    \"\"\"Persistence that takes its time and writes a line per fit, with its process id.\"\"\"
    def __init__(self, *, seed=0, horizon=1, pause=0.1):
        self.pause, self.seed, self.horizon = pause, seed, horizon
    def fit(self, nominal):
        with open(os.environ["FITS"], "a") as log:
            log.write(f"{os.getpid()} {nominal[0].observation_dim} {self.horizon} {self.seed}\\n")
        time.sleep(self.pause)
    def score(self, x):
        time.sleep(self.pause / 100)
        return super().score(x) + self.seed

class Keeps(Slow):
    \"\"\"The same with a fit that is slow to save, and shared by all horizons.\"\"\"
    def fit(self, nominal):
        self.horizon = "any"
        super().fit(nominal)
        self.dimension = nominal[0].observation_dim
    def save(self, directory):
        for name in ("one", "two"):
            (directory / name).write_text(str(self.dimension))
            time.sleep(self.pause)
    def load(self, directory):
        self.dimension = int((directory / "one").read_text())

@hookimpl
def oodd_detectors():
    known = {"pause": 0.1}
    return [
        DetectorSpec("slow", Slow, "", parameters=known),
        DetectorSpec("keeps", Keeps, "", parameters=known, fit_ignores=("horizon",)),
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


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_until(condition, *, seconds=120):
    """Wait for a condition, on a busy machine for long; return whether it came true."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def workers_of(marker):
    """Return processes of detectors whose environment holds a text."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes()
            if (
                b"oodd_eval.plugins.isolation.worker" in command
                and marker in (entry / "environ").read_bytes()
            ):
                found.append(int(entry.name))
        except OSError:
            continue  # it ended meanwhile, or is another user's
    return [pid for pid in found if alive(pid)]

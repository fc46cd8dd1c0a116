"""How a command ends: killed, told to go, or held up by what a plug-in has left in it."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import helpers_boxed
import psutil
import pytest
from helpers_plugins import install, write_plugin
from helpers_processes import environment, oodd_eval, wait_until

from oodd_eval.errors import ExecutorError, PluginError
from oodd_eval.plugins.discovery import discover

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

HOLDS = """
def held():
    \"\"\"Hold the interpreter's lock: no other thread of this process runs.\"\"\"
    import ctypes
    ctypes.PyDLL(None).sleep(600)

def begun():
    if "FITS" in os.environ:  # not in a sandbox
        Path(os.environ["FITS"]).write_text(str(os.getpid()))

class Holds(Good):
    def fit(self, nominal): begun(); held()

class Scores(Good):
    def score(self, x): begun(); held()

class Own(Good):
    def fit(self, nominal):
        subprocess.Popen(["sleep", "600"], start_new_session=True)
        begun(); held()

class Bare(Good):
    def fit(self, nominal):
        subprocess.Popen(["sleep", "600"], start_new_session=True, env={})
        begun(); held()

class Twice(Good):
    def fit(self, nominal):
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0: time.sleep(600)
            os._exit(0)
        begun(); held()

class Deaf(Good):
    def fit(self, nominal):
        for number in set(signal.Signals) - {signal.SIGKILL, signal.SIGSTOP}:
            signal.signal(number, signal.SIG_IGN)
        os.closerange(3, 64); begun(); held()

class Stops(Good):
    def fit(self, nominal): begun(); os.kill(os.getpid(), signal.SIGSTOP)

class Tells(Good):
    def state(self): begun(); held()
    def restore(self, state): pass

class Restores(Good):
    def fit(self, nominal): threading.Thread(target=time.sleep, args=(600,)).start()
    def state(self): return {}
    def restore(self, state): begun(); held()

class Quick(Good): pass

@hookimpl
def oodd_detectors():
    return offer(holds=Holds, scores=Scores, own=Own, bare=Bare, twice=Twice, deaf=Deaf,
                 stops=Stops, quick=Quick, tells=Tells, restores=Restores)
"""


def of_run(marker, started=()):
    """Processes whose environment has a mark, or that run in the directory which it names."""
    name, _, value = marker.partition("=")
    found = []
    for process in psutil.process_iter(["pid", "environ", "status", "cwd"]):
        info = process.info
        if info["status"] != psutil.STATUS_ZOMBIE and (
            (info["environ"] or {}).get(name) == value or info["cwd"] == value or process in started
        ):
            found.append(info["pid"])
    return found


def begin(monkeypatch, tmp_path, tiny_split, detector, code=HOLDS, *more, name="holder"):
    install(monkeypatch, tmp_path / "plugin", name, code)
    variables = environment(tmp_path / "plugin", tmp_path / "begun", RUN=str(tmp_path))
    return oodd_eval(
        "run", "--detector", detector, "--env", "cartpole", "--anomaly", "iid", "--split",
        tiny_split, "--output", tmp_path / "out", "--jobs", "1", *more, env=variables,
        cwd=tmp_path,
    )  # fmt: skip


HOLDERS = ("holds", "scores", "own", "bare", "twice", "deaf", "stops", "tells", "restores")


@pytest.mark.parametrize(
    ("number", "detector"),
    [
        *((signal.SIGKILL, detector) for detector in HOLDERS),
        (signal.SIGTERM, "twice"), (signal.SIGTERM, "deaf"), (signal.SIGHUP, "stops"),
    ],
)  # fmt: skip
def test_nothing_runs_on_when_the_command_is_ended(
    monkeypatch, tmp_path, tiny_split, number, detector
):
    process = begin(monkeypatch, tmp_path, tiny_split, detector)
    assert wait_until((tmp_path / "begun").exists)
    process.send_signal(number)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == (-number if number == signal.SIGKILL else 2), said
    assert "Traceback" not in said
    assert wait_until(lambda: not of_run(f"RUN={tmp_path}"), seconds=10)


@pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")
@pytest.mark.parametrize("detector", ["holds", "twice", "deaf"])
def test_no_sandbox_runs_on_when_its_maker_is_killed(tmp_path, tiny_split, detector):
    """Its processes have none of the marks; the file that says that it has begun stays in it."""
    write_plugin(tmp_path / "plugin", "holder", HOLDS)
    variables = environment("", tmp_path / "begun", RUN=str(tmp_path))
    command = [helpers_boxed.__file__, tmp_path / "plugin", tiny_split, tmp_path / "out", detector]
    process = subprocess.Popen([sys.executable, *command], env=variables, cwd=tmp_path)
    started = []

    def busy():
        started[:] = psutil.Process(process.pid).children(recursive=True)
        return any("oodd_eval.plugins.isolation.worker" in command_of(p) for p in started)

    assert wait_until(busy)
    time.sleep(5)
    assert busy(), "it should hold up the command until that is killed"
    process.kill()
    process.communicate(timeout=60)
    assert wait_until(lambda: not of_run(f"RUN={tmp_path}", started), seconds=10)


def command_of(process):
    try:
        return process.cmdline()
    except psutil.Error:  # it has just ended
        return []


def test_what_was_finished_is_kept_when_the_command_is_told_to_go(
    monkeypatch, tmp_path, tiny_split
):
    process = begin(monkeypatch, tmp_path, tiny_split, "quick,holds")
    assert wait_until((tmp_path / "begun").exists)
    process.terminate()
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "interrupted" in said
    assert len((tmp_path / "out" / "records.jsonl").read_text().splitlines()) == 1


def test_a_hangup_that_is_ignored_stays_ignored(tmp_path):
    code = (
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "import oodd_eval.cli.main as m, os\n"
        "m._exit_code = lambda _: os.kill(os.getpid(), signal.SIGHUP) or 5\n"
        "m.main()"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 5


LEFT = {
    "a thread": "threading.Thread(target=time.sleep, args=(600,)).start()",
    "an exit handler": "import atexit; atexit.register(time.sleep, 600)",
    "an exit handler of threads": "threading._register_atexit(time.sleep, 600)",
    "a stream that is closed": "import io; sys.stdout = io.StringIO(); sys.stdout.close()",
}


@pytest.mark.parametrize("code", LEFT.values(), ids=LEFT)
def test_what_a_plugin_leaves_at_import_holds_nothing_up(monkeypatch, tmp_path, tiny_split, code):
    guarded = f"if 'OODD_EVAL_PROCESS' not in os.environ: {code.replace('; ', chr(10) + '    ')}"
    guarded = guarded.replace(": import", ":\n    import")
    plugin = f"{guarded}\n@hookimpl\ndef oodd_detectors(): return offer(fails=lambda **_: None)"
    process = begin(monkeypatch, tmp_path, tiny_split, "fails", plugin)
    start = time.monotonic()
    process.communicate(timeout=60)
    # A cell has failed, or nothing could be printed: not 0.
    assert process.returncode in (1, 3)
    assert time.monotonic() - start < 60


@pytest.mark.parametrize("made", ["None", "1 / 0"])
def test_a_maker_of_detectors_that_leaves_the_directory(monkeypatch, tmp_path, made):
    code = f"@hookimpl\ndef oodd_detector_from_spec(spec): os.chdir('/'); return {made}"
    install(monkeypatch, tmp_path, "moves", code)
    monkeypatch.chdir(tmp_path)
    with pytest.raises((PluginError, ValueError)):
        discover(only=["moves"]).offer("moves:1")
    assert Path.cwd() == tmp_path


class Future:
    """Never done until so many looks at it."""

    def __init__(self, looks):
        self.looks = looks

    def result(self, timeout):
        self.looks -= 1
        if self.looks < 0:
            return {"status": "ok"}
        raise TimeoutError


@pytest.mark.parametrize(
    ("looks", "workers", "ends"), [(3, [0] * 9, True), (9, [0] * 9, False), (9, [0, 1] * 9, True)]
)
def test_a_cluster_without_workers_is_waited_for_and_then_named(looks, workers, ends):
    remote = pytest.importorskip("oodd_eval.scoring.executors.dask", reason="needs the extra dask")
    counts = iter(workers)
    client = SimpleNamespace(nthreads=lambda: {"w": 1} if next(counts) else {})
    executor = SimpleNamespace(_client=client, _address="tcp://h:1")
    if ends:
        assert remote.DaskExecutor._awaited(executor, Future(looks)) == {"status": "ok"}
    else:
        with pytest.raises(ExecutorError, match="has lost all its workers"):
            remote.DaskExecutor._awaited(executor, Future(looks))

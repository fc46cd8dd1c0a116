"""What a plug-in finds, and can do, in a sandbox; the same without one shows that it knows how."""

import json
import mmap
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pytest
from helpers_plugins import install
from helpers_split import make_split

from oodd_eval.data.split import SHIPPED
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import UsageError
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.sandbox import Sandbox, require_sandbox
from oodd_eval.plugins.isolation.supervisor import run_isolated
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")

SYSTEM = sys.prefix, "/usr", "/etc", "/"
NAME = "verysecret"  # in the path of the split, in files, variables, arguments and sockets
LOOKS = '''
import ctypes, pwd, socket

NAME = "very" + "secret"
PORT, PARENT, PATHS = int("@PORT@"), int("@PARENT@"), json.loads("""@PATHS@""")
IN_PACKAGE = "@SHIPPED@"

def has(path):
    """Whether a file, which may end never, holds the name in its first megabyte."""
    with open(path, "rb", buffering=0) as file:
        return NAME.encode() in file.read(1 << 20)

def names():
    for place, directories, files in os.walk("@ROOT@"):
        directories[:] = [d for d in directories
                          if os.path.join(place, d) not in ("/proc", "/sys", "/usr")]
        for name in (*directories, *files):
            path = os.path.join(place, name)
            if NAME in name and path not in PATHS["hidden"] or path in PATHS["files"]:
                yield path

def processes(part):
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            if int(pid) != os.getpid() and has(f"/proc/{pid}/{part}"):
                yield pid
        except OSError:
            pass

def links():
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            for fd in os.listdir(f"/proc/{pid}/fd"):
                if NAME in (target := os.readlink(f"/proc/{pid}/fd/{fd}")):
                    yield target
        except OSError:
            pass

def connects(*address):
    with socket.socket(*address[:-1]) as made:
        made.settimeout(3)
        made.connect(address[-1])
        return True

def memory():
    """Read the parent's memory where it holds the name: at the address that it told."""
    with open(f"/proc/{PARENT}/mem", "rb", buffering=0) as file:
        file.seek(int("@ADDRESS@"))
        return NAME.encode() in file.read(64)

def writes(place):
    (Path(place) / "written").write_text(NAME)

def attaches():
    """Attach to the parent, as a debugger does: by PTRACE_SEIZE, which does not stop it."""
    if (child := os.fork()) == 0:
        os._exit(ctypes.CDLL(None).ptrace(0x4206, PARENT, 0, 0) and 1)
    return os.waitpid(child, 0)[1] == 0

def unshares():
    """Make a namespace of users, in which one could mount; in a process that ends."""
    if (child := os.fork()) == 0:
        os._exit(ctypes.CDLL(None).unshare(0x10000000) and 1)
    return os.waitpid(child, 0)[1] == 0

LOOKS = {
    "names": lambda: [*names()],
    "split": lambda: [p for p in PATHS["files"] if os.path.exists(p)],
    "mini": lambda: [p for p in (IN_PACKAGE,) if os.listdir(p)],
    "home": lambda: os.listdir(PATHS["home"]),
    "arguments": lambda: [*processes("cmdline")],
    "environments": lambda: [*processes("environ")],
    "mounts": lambda: has("/proc/self/mountinfo"),
    "variables": lambda: [v for v in os.environ.items() if NAME in str(v)],
    "directory": lambda: NAME in os.getcwd(),
    "links": lambda: [*links()],
    "memory": memory,
    "attached": attaches,
    "kills": lambda: os.kill(PARENT, 0) is None,
    "tcp": lambda: connects(socket.AF_INET, socket.SOCK_STREAM, ("127.0.0.1", PORT)),
    "abstract": lambda: connects(socket.AF_UNIX, socket.SOCK_STREAM, chr(0) + NAME + str(PORT)),
    "shared": lambda: os.path.exists(f"/dev/shm/{NAME}{PORT}"),
    "users": unshares,
}

def quiet(look):
    try:
        return look()
    except Exception:
        return None

class Looks(Good):
    def __init__(self, *, seed=0, horizon=1):
        self.when = "made"
        self.look()
    def look(self):
        found = {name: quiet(look) for name, look in LOOKS.items()}
        print("FOUND", json.dumps({k: str(v)[:300] for k, v in found.items() if v}), flush=True)
    def fit(self, nominal):
        self.look()
        for place in PATHS["writes"]:
            quiet(lambda: writes(place))
    def score(self, x):
        self.look()
        raise RuntimeError("looked")

@hookimpl
def oodd_detectors(): return offer(looks=Looks)
'''


@pytest.fixture(scope="module")
def looked(tmp_path_factory):
    """What the plug-in finds with the option, and without it."""
    return {option: _look(tmp_path_factory.mktemp("at"), option) for option in ("--sandbox", "")}


def _look(place, option):
    plugin, home = place / "plugin", place / "home"
    lab = plugin / "lab"  # what can be imported is shown, but not the split that lies in it
    (lab / NAME).parent.mkdir(parents=True)
    (lab / "tools.py").write_text("")
    home.mkdir()
    (home / f"{NAME}.txt").write_text(NAME)
    split = make_split(lab / NAME, ("cartpole",), train=2, calibration=2, test=2)
    output = lab / f"{NAME}-out"
    ResultsDirectory(output).prepare()
    (output / "records.jsonl").write_text("")
    known = mmap.mmap(-1, 4096)
    known.write(NAME.encode())
    address = next(
        line.split("-")[0]
        for line in Path("/proc/self/maps").read_text().splitlines()
        if "/dev/zero" in line or "rw-s" in line
    )
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_UNIX) as unix:
        port = server.getsockname()[1]
        unix.bind(f"\0{NAME}{port}")
        unix.listen()
        shared = Path("/dev/shm", f"{NAME}{port}")  # noqa: S108
        shared.write_text(NAME)
        paths = {
            "files": [str(split / "cartpole.h5"), str(output / "records.jsonl"), str(home)],
            "home": str(home),
            "hidden": [str(split), str(output)],  # seen by name, as empty directories
            "writes": [str(lab), str(plugin), str(home), *(SYSTEM if option else ())],
        }
        fillings = {
            "PORT": port, "PARENT": os.getpid(), "PATHS": json.dumps(paths),
            "SHIPPED": SHIPPED / "mini", "ADDRESS": int(address, 16),
            "ROOT": "/" if option else place,
        }  # fmt: skip
        code = LOOKS
        for name, value in fillings.items():
            code = code.replace(f"@{name}@", str(value))
        with pytest.MonkeyPatch.context() as patch:
            install(patch, plugin, "looks", code)
        command = [
            sys.executable, "-m", "oodd_eval", "run", "--detector", "looks", "--env", "cartpole",
            "--split", split, "--output", output, *filter(None, [option]),
        ]  # fmt: skip
        own = {"SECRET": NAME, "HOME": str(home), "OODD_EVAL_PLUGINS": "looks"}
        done = subprocess.run(
            command, env={**os.environ, "PYTHONPATH": str(plugin), **own}, cwd=home,
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        shared.unlink()
    record = ResultsDirectory(output).records()[0]
    assert "looked" in record.reason, (record.reason, done.stderr)
    log = next((output / "logs").iterdir()).read_text()
    found = [json.loads(x[6:]) for x in log.splitlines() if x.startswith("FOUND ")]
    assert len(found) >= 3  # made, fit, score
    written = {"writes": [p for p in paths["writes"] if (Path(p) / "written").exists()]}
    found.append({name: value for name, value in written.items() if value})
    return {name: value for one in found for name, value in one.items()}


def test_a_plug_in_finds_nothing_in_a_sandbox(looked):
    assert looked["--sandbox"] == {}


@pytest.mark.parametrize(
    "what",
    ["names", "split", "mini", "home", "arguments", "environments", "variables", "links",
     "kills", "tcp", "abstract", "shared", "writes"],
)  # fmt: skip
def test_the_same_plug_in_finds_it_without_a_sandbox(looked, what):
    assert what in looked[""]


@pytest.mark.skipif(os.geteuid() != 0, reason="the system forbids them to others in any case")
@pytest.mark.parametrize("what", ["memory", "attached", "users"])
def test_root_finds_it_without_a_sandbox(looked, what):
    assert what in looked[""]


SLEEP = str(10**6 + os.getpid())  # seconds that no process of another test sleeps

ACTS = """
MOST = 10**8

class Forks(Good):
    def fit(self, nominal):
        for _ in range(600):
            if os.fork() == 0: time.sleep(600); os._exit(0)
        time.sleep(600)

class Spread(Good):
    # Each process is under the limit, all together are not.
    def fit(self, nominal):
        for _ in range(5):
            if os.fork() == 0:
                held = np.ones(MOST // 8); time.sleep(600); os._exit(0)
        time.sleep(600)

class Daemon(Good):
    def fit(self, nominal):
        if os.fork() == 0:
            os.setsid()
            if os.fork() == 0: os.execve("/bin/sleep", ["sleep", "@SLEEP@"], {})
            os._exit(0)

class Caches(Good):
    def fit(self, nominal):
        Path.home().joinpath("cache").write_text("x")
        assert os.environ["HOME"] == os.getcwd() == "/tmp"
    def save(self, place): (place / "fit").write_text("x")
    def load(self, place): assert (place / "fit").read_text() == "x"

class Links(Good):
    def save(self, place):
        (place / "kept").write_text("x"); (place / "in").mkdir()
        (place / "in" / "kept").write_text("x")
        os.symlink("/etc/passwd", place / "link"); os.mkfifo(place / "pipe")
        os.symlink("/etc", place / "directory")
    def load(self, place): pass

@hookimpl
def oodd_detectors():
    return offer(forks=Forks, spread=Spread, daemon=Daemon, caches=Caches, links=Links)
"""


@pytest.fixture
def acts(monkeypatch, tmp_path):
    """Fit and score a detector in a sandbox: the outcome, its directory, and the seconds."""
    install(monkeypatch, tmp_path / "plugin", "acts", ACTS.replace("@SLEEP@", SLEEP))
    save = tmp_path / "save"
    save.mkdir()

    def run(name, *, load="", hidden=(), **limits):
        nominal = [Trajectory([[0.0, 1.0]] * 20)] * 3
        request = {
            "plugin": "acts", "detector": name, "parameters": {}, "seed": 0, "horizon": 1,
            "train": 0 if load else 3, "save": "" if load else str(save), "load": load,
        }  # fmt: skip
        limits = Limits(**{"seconds": 60, "memory": 10**9} | limits, hidden=hidden)
        train = [] if load else nominal
        return run_isolated(request, train, [nominal], limits=limits, stop=lambda: False)

    return run


@pytest.fixture(autouse=True)
def nothing_stays(tmp_path, monkeypatch):
    """No process and no directory of a sandbox is left."""
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))  # other tests run beside these
    yield
    assert not [*place.glob("oodd-eval-*")]
    deadline = time.monotonic() + 5
    while running := [p for p in psutil.process_iter(["cmdline", "ppid"]) if _inside(p)]:
        assert time.monotonic() < deadline, running
        time.sleep(0.05)


def _inside(process):
    command = process.info["cmdline"] or []
    mine = process.info["ppid"] == os.getpid() and "bwrap" in command[:1]
    return SLEEP in command or mine


def test_a_fork_bomb_is_ended(acts):
    out = acts("forks")
    assert (out.status, out.reason) == ("error", "started more than 256 processes (--sandbox)")


def test_memory_of_all_processes_counts_together(acts):
    out = acts("spread", memory=3 * 10**8)
    assert out.status == "oom", out.reason
    assert "resident memory" in out.reason


def test_a_daemon_ends_with_its_sandbox(acts):
    out = acts("daemon")
    assert out.status in {"ok", "incompatible"}, out.reason


def test_a_fit_is_saved_and_loaded_through_the_sandbox(acts, tmp_path):
    assert acts("caches").status == "ok"
    assert (tmp_path / "save" / "fit").read_text() == "x"
    out = acts("caches", load=str(tmp_path / "save"))
    assert (out.status, out.reason) == ("ok", "")


def test_links_and_pipes_of_a_saved_fit_are_left_out(acts, tmp_path):
    assert acts("links").status == "ok"
    kept = {str(p.relative_to(tmp_path / "save")) for p in (tmp_path / "save").rglob("*")}
    assert kept == {"kept", "in", "in/kept"}


def test_scores_are_those_of_a_plain_worker(tmp_path):
    for name, more in (("plain", []), ("boxed", ["--sandbox"])):
        subprocess.run(
            [sys.executable, "-m", "oodd_eval", "run", "--detector", "mewma,rf", "--env",
             "cartpole", "--anomaly", "iid", "--limit", "4", "--output", tmp_path / name, *more],
            check=True, capture_output=True,
        )  # fmt: skip
    plain, boxed = (ResultsDirectory(tmp_path / name).records() for name in ("plain", "boxed"))
    for one, other in zip(plain, boxed, strict=True):
        assert one.metrics == other.metrics


def test_without_bubblewrap_the_command_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="needs bubblewrap, the program bwrap"):
        require_sandbox()


def test_where_namespaces_are_forbidden_the_command_says_so(monkeypatch, tmp_path):
    (tmp_path / "bwrap").write_text("#!/bin/sh\necho 'No permissions' >&2\nexit 1\n")
    (tmp_path / "bwrap").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with pytest.raises(UsageError, match="cannot make a sandbox here: No permissions"):
        require_sandbox()


def test_a_hidden_file_is_empty_and_a_hidden_directory_too(tmp_path, monkeypatch):
    package = tmp_path / "path" / "package"
    (package / "data").mkdir(parents=True)
    for path in (package / "__init__.py", package / "data" / "x", package / "file"):
        path.write_text("secret")
    monkeypatch.syspath_prepend(str(tmp_path / "path"))
    box = Sandbox([package / "data", package / "file", tmp_path / "nowhere"])
    look = f"ls {package}/data; cat {package}/file; ls {package}"
    command, descriptor = box.command(["/bin/sh", "-c", look])
    done = subprocess.run(
        command, pass_fds=[descriptor], env=box.environment(), capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    os.close(descriptor)
    box.close()
    assert done.stdout.split() == ["__init__.py", "data", "file"]

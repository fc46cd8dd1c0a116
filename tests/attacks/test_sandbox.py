"""What a plug-in finds, and can do, in a sandbox; the same without one shows that it knows how."""

import ctypes
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

import helpers_boxed
import psutil
import pytest
from helpers_plugins import write_plugin
from helpers_split import make_split
from oodd_leaderboard.sandbox.launcher import Sandbox, make_sandbox

from oodd_eval.data.split import SHIPPED
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import UsageError
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.isolation.supervisor import run_isolated
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")

SYSTEM = sys.prefix, "/usr", "/etc", "/"
NAME = "verysecret"  # in the path of the split, in files, variables, arguments and sockets
TOOLS = "oodd_looks-1.0.dist-info/tools.py"  # that no digest covers, so that nobody else reads it
LOOKS = '''
import ctypes, pwd, resource, socket

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
            if NAME in name or path in PATHS["files"]:
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

TOKEN = os.urandom(8).hex()  # of this process and its forks
ALLOWED = set("core fd full null ptmx pts random shm stderr stdin stdout tty urandom zero".split())

def writable():
    """Open, to write, all that is in /proc but what is of other processes, and in /sys."""
    for root in ("/proc/sys", "/proc/self", "/sys/devices/system/cpu", "/proc"):
        for place, directories, files in os.walk(root):
            directories[:] = [] if root in ("/proc", "/proc/self") else directories
            for name in files:
                try:
                    os.close(os.open(os.path.join(place, name), os.O_WRONLY | os.O_NONBLOCK))
                except OSError:
                    continue
                yield os.path.join(place, name)

def places():
    for place, directories, _ in os.walk("/"):
        directories[:] = [d for d in directories if os.path.join(place, d) != "/proc"]
        if place.split("/")[1] != "tmp" and place != "/dev/shm":
            try:
                path = os.path.join(place, "made-" + NAME)
                os.close(os.open(path, os.O_CREAT | os.O_WRONLY))
                os.unlink(path)
            except OSError:
                continue
            yield place

def counters():
    for name in ("loadavg", "vmstat", "uptime", "interrupts", "locks", "diskstats", "zoneinfo"):
        try:
            yield Path("/proc", name).read_bytes()[:10]
        except OSError:
            pass

def kept():
    """What another process of this fit has left; and leave something."""
    left = [Path(d, "kept-" + str(PORT)) for d in ("/tmp", "/dev/shm")]
    found = [p for p in left if p.exists() and p.read_text() != TOKEN + str(os.getppid())]
    for path in left:
        path.write_text(TOKEN + str(os.getppid()))
    return found

def passed():
    """Open descriptors beside standard streams, the channel, and the one that lists them."""
    links = [os.readlink("/proc/self/fd/" + n) for n in os.listdir("/proc/self/fd") if int(n) > 2]
    sockets = [x for x in links if x.startswith("socket:")]
    return sockets[1:] + [x for x in links if x not in sockets and not x.startswith(
        ("/proc/self/fd", f"/proc/{os.getpid()}/fd", "/tmp/#", "/dev/null"))]

def status(key, expected):
    lines = dict(x.split(":", 1) for x in Path("/proc/self/status").read_text().splitlines())
    return lines[key].split() != expected

LOOKS = {
    "writable": lambda: [*writable()],
    "places": lambda: [*places()] if "@ROOT@" == "/" else ["/"],
    "sizes": lambda: [d for d in ("/tmp", "/dev/shm") if os.statvfs(d).f_blocks * os.statvfs(
        d).f_frsize > 2.1e9],
    "kept": kept,
    "counters": lambda: [*counters()],
    "devices": lambda: {*os.listdir("/dev")} - ALLOWED,
    "passed": passed,
    "user": lambda: os.getuid() != 65534 or os.getgid() != 65534,
    "groups": lambda: {*os.getgroups()} - {65534},
    "rights": lambda: status("CapEff", ["0" * 16]),
    "privileges": lambda: status("NoNewPrivs", ["1"]),
    "shadow": lambda: open("/etc/shadow").read(),
    "host": lambda: os.uname().nodename != "sandbox",
    "segment": lambda: ctypes.CDLL(None).shmget(PORT, 0, 0) >= 0,
    "priority": lambda: os.setpriority(os.PRIO_PROCESS, 0, -5) is None,
    "dumps": lambda: resource.getrlimit(resource.RLIMIT_CORE)[1] != 1,
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
        quiet((Path(PATHS["writes"][0]) / "@TOOLS@").read_text)
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
    """What the plug-in finds in a sandbox, and without it."""
    return {boxed: _look(tmp_path_factory.mktemp("at"), boxed) for boxed in (True, False)}


def _look(place, boxed):
    plugin, home = place / "plugin", place / "home"
    tools = plugin / TOOLS
    tools.parent.mkdir(parents=True)
    tools.write_text("")
    home.mkdir()
    (home / f"{NAME}.txt").write_text(NAME)
    split = make_split(place / NAME, ("cartpole",), train=2, calibration=2, test=2)
    output = place / f"{NAME}-out"
    ResultsDirectory(output).prepare()
    (output / "records.jsonl").write_text("")
    known = mmap.mmap(-1, 4096)
    known.write(NAME.encode())
    address = ctypes.addressof(ctypes.c_char.from_buffer(known))
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_UNIX) as unix:
        port = server.getsockname()[1]
        unix.bind(f"\0{NAME}{port}")
        unix.listen()
        shared = Path("/dev/shm", f"{NAME}{port}")  # noqa: S108
        shared.write_text(NAME)
        segment = ctypes.CDLL(None).shmget(port, 4096, 0o1600)
        os.utime(tools, (0, 10**9))
        written = [str(plugin), str(home), *(SYSTEM if boxed else ())]
        paths = {
            "files": [str(split / "cartpole.h5"), str(output / "records.jsonl"), str(home)],
            "home": str(home),
            "writes": ["/packages/0" if boxed else str(plugin), *written[1:]],
        }
        fillings = {
            "PORT": port, "PARENT": os.getpid(), "PATHS": json.dumps(paths),
            "TOOLS": TOOLS, "SHIPPED": SHIPPED / "mini", "ADDRESS": address,
            "ROOT": "/" if boxed else place,
        }  # fmt: skip
        code = LOOKS
        for name, value in fillings.items():
            code = code.replace(f"@{name}@", str(value))
        write_plugin(plugin, "looks", code)
        command = [
            sys.executable, "-m", "oodd_eval", "run", "--detector", "looks", "--env", "cartpole",
            "--split", split, "--output", output,
        ]  # fmt: skip
        own = {"PYTHONPATH": str(plugin), "OODD_EVAL_PLUGINS": "looks"}
        if boxed:
            command = [sys.executable, helpers_boxed.__file__, plugin, split, output, "looks"]
            own = {}
        done = subprocess.run(
            command, env={**os.environ, "SECRET": NAME, "HOME": str(home), **own}, cwd=home,
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        shared.unlink()
        ctypes.CDLL(None).shmctl(segment, 0, None)
    for directory in ("/tmp", "/dev/shm"):  # noqa: S108
        Path(directory, f"kept-{port}").unlink(missing_ok=True)
    record = ResultsDirectory(output).records()[0]
    assert "looked" in record.reason, (record.reason, done.stderr)
    log = next((output / "logs").iterdir()).read_text()
    found = [json.loads(x[6:]) for x in log.splitlines() if x.startswith("FOUND ")]
    assert len(found) >= 3  # made, fit, score
    written = {"writes": [p for p in written if (Path(p) / "written").exists()]}
    written["access"] = tools.stat().st_atime != 0
    found.append({name: value for name, value in written.items() if value})
    return {name: value for one in found for name, value in one.items()}


def test_a_plug_in_finds_nothing_in_a_sandbox(looked):
    # The superuser's sandbox has no namespace of users, whose number could be limited.
    assert looked[True].keys() <= ({"users"} if os.geteuid() == 0 else set())


def test_the_same_plug_in_finds_it_without_a_sandbox(looked):
    expected = """
        names split mini home arguments environments variables links kills tcp abstract shared
        writes places sizes kept counters devices user privileges host segment dumps access
    """
    if os.geteuid() == 0:  # the system forbids these to others in any case
        expected += " memory attached users writable rights shadow priority"
    assert not {*expected.split()} - looked[False].keys()


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
        super().fit(nominal)
        Path.home().joinpath("cache").write_text("x")
        assert os.environ["HOME"] == os.getcwd() == "/tmp"
    def score(self, x):
        assert Path.home().joinpath("cache").exists()
        scored = [*Path.home().glob("scored-*")]
        assert len(scored) < 3, scored
        Path.home().joinpath("scored-" + str(len(scored))).touch()
        return super().score(x)

class Fills(Good):
    def fit(self, nominal):
        for directory in ("/tmp", "/dev/shm"):
            with open(directory + "/full", "wb") as file:
                try:
                    os.posix_fallocate(file.fileno(), 0, 3 * 10**9)
                except OSError as error:
                    assert error.errno == 28
                else:
                    raise AssertionError(directory)
        raise RuntimeError("full")

@hookimpl
def oodd_detectors():
    return offer(forks=Forks, spread=Spread, daemon=Daemon, caches=Caches, fills=Fills)
"""


@pytest.fixture
def acts(tmp_path):
    """Fit and score a detector in a sandbox: the outcome."""
    write_plugin(tmp_path / "plugin", "acts", ACTS.replace("@SLEEP@", SLEEP))

    def run(name, **limits):
        nominal = [Trajectory([[0.0, 1.0]] * 20)] * 3
        request = {
            "plugin": "acts", "detector": name, "parameters": {}, "seed": 0, "horizon": 1,
        }  # fmt: skip
        limits = Limits(**{"seconds": 60, "memory": 10**9} | limits)
        return run_isolated(
            request, nominal, [nominal] * 2,
            limits=limits, stop=lambda: False, launcher=Sandbox((), [tmp_path / "plugin"]),
        )  # fmt: skip

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


def test_each_group_has_a_home_of_its_own(acts):
    out = acts("caches")  # three episodes a group, and what its own fit has left
    assert (out.status, out.reason, len(out.scores)) == ("ok", "", 6)


def test_what_can_be_written_is_memory_of_limited_size(acts):
    out = acts("fills")
    assert "RuntimeError: full" in out.reason


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


def test_where_namespaces_are_forbidden_the_command_says_so(monkeypatch, tmp_path):
    (tmp_path / "bwrap").write_text("#!/bin/sh\necho 'No permissions' >&2\nexit 1\n")
    (tmp_path / "bwrap").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with pytest.raises(UsageError, match="cannot make a sandbox here: No permissions"):
        make_sandbox()


def output_of(box, look):
    command, descriptors = box.wrap(["/bin/sh", "-c", look])
    done = subprocess.run(
        command, pass_fds=descriptors, env=box.environment(), capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    for descriptor in descriptors:
        os.close(descriptor)
    return done.stdout, done.stderr


def test_a_hidden_file_is_empty_and_a_hidden_directory_too(tmp_path):
    packages = tmp_path / "packages"
    (packages / "data").mkdir(parents=True)
    for path in (packages / "a.py", packages / "data" / "x", packages / "file"):
        path.write_text("secret")
    box = Sandbox([packages / "data", packages / "file", packages / "nowhere"], [packages])
    said, _ = output_of(box, "cd /packages/0; ls data; cat file; ls")
    assert said.split() == ["a.py", "data", "file"]


def test_a_directory_that_was_made_after_the_sandbox_is_hidden_too(tmp_path):
    sandbox = Sandbox([tmp_path / "data"], [tmp_path])
    for made in (False, True):
        if made:
            (tmp_path / "data").mkdir()
            (tmp_path / "data" / "x").write_text("secret")
        said, error = output_of(sandbox, "cat /packages/0/data/x")
        assert said == ""
        assert "No such file" in error

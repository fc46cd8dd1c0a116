"""Commands in foreign surroundings: without home, locks, UTF-8, room, or sound neighbours.

Whatever surrounds it, a command does its work, or says in one sentence why it does not, with exit
code 4. "internal error" is for what nobody foresaw.
"""

import contextlib
import ctypes
import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from helpers_plugins import write_plugin
from helpers_split import make_split
from helpers_wheel import PIP, ROOT
from packaging.requirements import Requirement
from packaging.version import Version

from oodd_eval.cli import listing
from oodd_eval.cli.main import main
from oodd_eval.scoring.cores import available_cores

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="surroundings of Linux")

COMMAND = Path(sys.executable).with_name("oodd-eval")

# Calls of the C library that fail as they do elsewhere; LD_PRELOAD puts them before its own.
REFUSALS = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pwd.h>
#include <stdarg.h>
#include <stdlib.h>
static int refused(void) {
    const char *error = getenv("NO_LOCKS");
    errno = error ? atoi(error) : 0;
    return !!error;
}
static int control(const char *name, int file, int command, void *argument) {
    int lock = command == F_SETLK || command == F_SETLKW || command == F_OFD_SETLK;
    if (lock && refused()) return -1;
    return ((int (*)(int, int, ...)) dlsym(RTLD_NEXT, name))(file, command, argument);
}
#define CONTROL(name) int name(int file, int command, ...) { va_list rest; \\
    va_start(rest, command); void *argument = va_arg(rest, void *); va_end(rest); \\
    return control(#name, file, command, argument); }
CONTROL(fcntl)
CONTROL(fcntl64)
int flock(int file, int operation) {
    return refused() ? -1 : ((int (*)(int, int)) dlsym(RTLD_NEXT, "flock"))(file, operation);
}
struct passwd *getpwuid(uid_t user) {
    if (!getenv("NO_PASSWD"))
        return ((struct passwd *(*)(uid_t)) dlsym(RTLD_NEXT, "getpwuid"))(user);
    errno = 0;
    return NULL;
}
int getpwuid_r(uid_t user, struct passwd *entry, char *buffer, size_t size, struct passwd **to) {
    if (!getenv("NO_PASSWD"))
        return ((int (*)(uid_t, struct passwd *, char *, size_t, struct passwd **))
                dlsym(RTLD_NEXT, "getpwuid_r"))(user, entry, buffer, size, to);
    *to = NULL;
    return 0;
}
"""


@pytest.fixture(scope="session")
def refusals(tmp_path_factory):
    """The library, compiled."""
    compiler = shutil.which("cc")
    if not compiler:
        pytest.skip("no C compiler on this machine")
    directory = tmp_path_factory.mktemp("refusals")
    (directory / "refusals.c").write_text(REFUSALS)
    library = directory / "refusals.so"
    build = [compiler, "-shared", "-fPIC", "-o", library, directory / "refusals.c", "-ldl"]
    subprocess.run(build, check=True)
    return str(library)


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    return make_split(tmp_path_factory.mktemp("surroundings") / "tiny", ("cartpole",))


def execute(arguments, *, program=(COMMAND,), cwd=None, unset=(), prepare=None, **variables):
    """Carry out a command; return its exit code and what it says on both streams."""
    environment = {name: v for name, v in os.environ.items() if name not in unset} | variables
    done = subprocess.run(
        [*program, *arguments], cwd=cwd, env=environment, preexec_fn=prepare,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=300, check=False,
    )  # fmt: skip
    said = done.stdout.decode(errors="replace")
    assert "internal error" not in said, said
    assert "Traceback" not in said, said
    return done.returncode, said


def run_of(split, output, detector="range"):
    """The arguments of a short run."""
    cells = ("--env", "cartpole", "--anomaly", "iid,gravity")
    return "run", "--detector", detector, *cells, "--split", split, "--output", output


# Surroundings: what `execute` takes, from the library of refusals and a directory of the test.


def leave(directory):
    """Remove the working directory."""
    directory.mkdir()
    os.chdir(directory)
    directory.rmdir()


def close(directory):
    """Work in a directory that cannot be read, which for root takes two capabilities less."""
    directory.mkdir()
    os.chdir(directory)
    directory.chmod(0)
    for capability in (1, 2):  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH, out of the bounding set
        ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)


def few_files():
    resource.setrlimit(resource.RLIMIT_NOFILE, (20, 20))


def broken_neighbours(directory):
    """Write distributions with broken metadata, none of which has to do with this project."""
    for name, content in {
        "no_utf8": {"METADATA": b"Name: \xff\xfe\nVersion: 1\n", "entry_points.txt": b"\xff\xfe"},
        "no_name": {"entry_points.txt": b"[console_scripts\nx\n"},
        "empty": {},
    }.items():
        info = directory / f"{name}-1.0.dist-info"
        info.mkdir(parents=True)
        for file, text in content.items():
            (info / file).write_bytes(text)
    return str(directory)


SURROUNDINGS = {
    "no home": lambda library, _: {
        "unset": ("HOME", "XDG_DATA_HOME", "OODD_EVAL_DATA"),
        "LD_PRELOAD": library(), "NO_PASSWD": "1",
    },
    "no directory": lambda _, home: {"prepare": lambda: leave(home / "gone")},
    "closed directory": lambda _, home: {"prepare": lambda: close(home / "closed")},
    "no locks: ENOLCK": lambda library, _: {
        "LD_PRELOAD": library(), "NO_LOCKS": str(errno.ENOLCK)
    },
    "no locks: ENOSYS": lambda library, _: {
        "LD_PRELOAD": library(), "NO_LOCKS": str(errno.ENOSYS)
    },
    "ascii": lambda *_: {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "latin-1": lambda *_: {"PYTHONIOENCODING": "latin-1"},
    "no columns": lambda *_: {"COLUMNS": "0"},
    "few columns": lambda *_: {"COLUMNS": "20"},
    "few files": lambda *_: {"prepare": few_files},
    "warnings": lambda *_: {"PYTHONWARNINGS": "error"},
    "broken neighbours": lambda _, home: {"PYTHONPATH": broken_neighbours(home / "path")},
}  # fmt: skip


@pytest.fixture(params=SURROUNDINGS)
def surroundings(request, tmp_path):
    yield SURROUNDINGS[request.param](lambda: request.getfixturevalue("refusals"), tmp_path)
    with contextlib.suppress(OSError):
        (tmp_path / "closed").chmod(0o700)


def test_a_run_is_done_and_printed_again(surroundings, split, tmp_path):
    output = tmp_path / "out"
    code, said = execute(run_of(split, output), **surroundings)
    assert code == 0, said
    assert "2 ok" in said
    assert "CartPole" in said
    assert len((output / "records.jsonl").read_text().splitlines()) == 2


OTHERS = {
    "list detectors": "mewma",
    "info mewma": "shrinkage",
    "data verify SPLIT": "12 of 12 groups",
    "leaderboard show": "oracle",
    "show OUT --split SPLIT --markdown": "CartPole",
    "check range -k fit": "4 checks",
}
"""What else works anywhere, with a word that it prints."""
ONE_BY_ONE = """
import json, sys
from oodd_eval.cli.main import main
for arguments in json.loads(sys.argv[1]):
    print("ended with", main(arguments), flush=True)
"""


@pytest.mark.slow
def test_every_command_works(surroundings, split, results):
    commands = [c.replace("SPLIT", str(split)).replace("OUT", str(results)).split() for c in OTHERS]
    program = (sys.executable, "-P", "-c", ONE_BY_ONE)
    code, said = execute([json.dumps(commands)], program=program, **surroundings)
    assert (code, said.count("ended with 0")) == (0, len(commands)), said
    words = " ".join(said.split())
    assert [word for word in OTHERS.values() if word not in words] == []


@pytest.fixture(scope="module")
def results(split, tmp_path_factory):
    output = tmp_path_factory.mktemp("results") / "out"
    code, said = execute(run_of(split, output))
    assert code == 0, said
    return output


def test_names_of_directories_need_no_encoding(split, tmp_path):
    odd = tmp_path / os.fsdecode(b"\xff\xfe")
    shutil.copytree(split, odd / "tiny")
    run, show = run_of(odd / "tiny", odd / "out"), ("show", odd / "out", "--split", odd / "tiny")
    for arguments in (run, run, show):
        code, said = execute(arguments)
        assert code == 0, said
        assert "range on CartPole: matched AUC" in said


# What is lost, and why


def test_a_split_without_a_home_needs_a_directory(split, refusals, tmp_path):
    surroundings = SURROUNDINGS["no home"](lambda: refusals, tmp_path)
    code, said = execute(("data", "fetch", split), **surroundings)
    assert code == 4
    assert "set OODD_EVAL_DATA to a directory" in said
    code, _ = execute(("data", "fetch", split), **surroundings, OODD_EVAL_DATA=str(tmp_path))
    assert code == 0
    assert (tmp_path / "tiny" / "manifest.json").is_file()


def test_a_broken_neighbour_is_named_and_a_broken_plugin_counts(split, tmp_path):
    path = broken_neighbours(tmp_path / "path")
    code, said = execute(("list", "detectors"), PYTHONPATH=path)
    assert code == 0
    assert sum(path in line for line in said.splitlines()) == 1
    assert "and 2 more: its metadata cannot be read" in said
    write_plugin(tmp_path / "path", "lost", "")
    (tmp_path / "path" / "oodd_lost-1.0.dist-info" / "METADATA").write_bytes(b"Name: \xff\n")
    code, said = execute(("list", "detectors"), PYTHONPATH=path)
    assert code == 1
    assert "[broken plug-in] its metadata cannot be read" in said


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "a"), "'a': No such file"),
        (OSError(errno.EXDEV, "Invalid cross-device link", "a", None, "b"), "'a' and 'b': Inv"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files: raise the limit"),
        (PermissionError(), "a call of the system: PermissionError"),
    ],
)
def test_a_refusal_by_the_system_is_one_sentence(capsys, monkeypatch, error, message):
    def refuse(*_):
        raise error

    monkeypatch.setattr(listing, "rows", refuse)
    assert main(["list", "envs"]) == 4
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


# Signals of batch systems

HOLDS = """
class Holds(Good):
    def fit(self, nominal):
        Path(os.environ["BEGUN"]).touch()
        time.sleep(600)
@hookimpl
def oodd_detectors(): return offer(quick=Good, holds=Holds)
"""


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGXCPU])
def test_a_signal_of_a_batch_system_ends_a_run_as_an_interrupt_does(split, tmp_path, number):
    write_plugin(tmp_path / "path", "batch", HOLDS)
    begun, output = tmp_path / "begun", tmp_path / "out"
    process = subprocess.Popen(
        [COMMAND, *run_of(split, output, "quick,holds"), "--jobs", "1"],
        env={**os.environ, "PYTHONPATH": str(tmp_path / "path"), "BEGUN": str(begun)},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not begun.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    process.send_signal(number)  # the kernel repeats XCPU
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 2, said
    assert "2 ok" in said
    assert "interrupted" in said
    assert len((output / "records.jsonl").read_text().splitlines()) == 2


def test_an_interrupt_of_the_imports_ends_a_command_as_a_later_one(tmp_path):
    (tmp_path / "click.py").write_text("raise KeyboardInterrupt")
    done = subprocess.run(
        [sys.executable, "-m", "oodd_eval", "--help"],
        env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (2, "oodd-eval: interrupted\n")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR2])
def test_a_command_says_which_signal_has_ended_it(number):
    code = (
        "import os, sys; from oodd_eval.cli import listing, main\n"
        f"listing.rows = lambda *_: os.kill(os.getpid(), {number:d})\n"
        "sys.argv = ['oodd-eval', 'list', 'envs']; main.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr == f"oodd-eval: interrupted by {number.name}\n"


# Cores


@pytest.fixture
def roomy():
    """This process with as few limits as it may have; afterwards with those that it had."""
    limits = {n: resource.getrlimit(n) for n in (resource.RLIMIT_NOFILE, resource.RLIMIT_NPROC)}
    cores = os.sched_getaffinity(0)
    if len(cores) < 2 or any(0 <= soft < 100 for soft, _ in limits.values()):
        pytest.skip("fewer than two cores here, or few processes or files")
    yield limits
    os.sched_setaffinity(0, cores)
    for number, limit in limits.items():
        resource.setrlimit(number, limit)


def cgroups(root, lines, files):
    """Write what the kernel tells of cgroups below a directory, and return the directory."""
    for name, text in {"proc/self/cgroup": lines, **files}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


V2 = "0::/batch/job\n"
V1 = "3:pids:/job\n2:cpu,cpuacct:/job\n1:name=systemd:/\n"
QUOTA, PERIOD = "cpu,cpuacct/job/cpu.cfs_quota_us", "cpu,cpuacct/job/cpu.cfs_period_us"
SHARES = {
    "none": ("", {}, 2),
    "of the job": (V2, {"batch/job/cpu.max": "100000 100000"}, 1),
    "of the queue": (V2, {"batch/job/cpu.max": "max 100000", "batch/cpu.max": "90000 50000"}, 1),
    "of the container": (V2, {"cpu.max": "150000 100000"}, 1),
    "larger than the machine": (V2, {"batch/job/cpu.max": "99900000 100000"}, 2),
    "smaller than a core": (V2, {"batch/job/cpu.max": "1000 100000"}, 1),
    "no numbers": (V2, {"batch/job/cpu.max": "some 100000"}, 2),
    "version 1": (V1, {QUOTA: "120000", PERIOD: "100000"}, 1),
    "version 1 without a limit": (V1, {QUOTA: "-1", PERIOD: "100000"}, 2),
    "processes": (V1, {"pids/job/pids.max": "20"}, 1),
    "processes without a limit": (V2, {"batch/job/pids.max": "max"}, 2),
}


@pytest.mark.parametrize("name", SHARES)
def test_jobs_follow_the_share_of_a_cgroup(roomy, tmp_path, name):
    lines, files, expected = SHARES[name]
    files = {f"sys/fs/cgroup/{file}": text for file, text in files.items()}
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    assert available_cores(cgroups(tmp_path, lines, files)) == expected


def test_jobs_follow_affinity_and_limits(roomy, tmp_path):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    assert available_cores(tmp_path) == 2
    for number, (_, hard) in roomy.items():
        soft, _ = resource.getrlimit(number)
        resource.setrlimit(number, (15, hard))
        assert available_cores(tmp_path) == 1
        resource.setrlimit(number, (soft, hard))
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    assert available_cores(tmp_path) == 1


@pytest.mark.parametrize(("cores", "expected"), [("1", 1), ("64", 2), ("1(x2)", 2), ("", 2)])
def test_jobs_follow_the_cores_of_a_batch_job(roomy, monkeypatch, tmp_path, cores, expected):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", cores)
    assert available_cores(tmp_path) == expected


# The lowest versions

WITH = ("gym", "worlds", "onnx", "dask", "logs", "plots", "check")
"""Extras that are installed in their lowest versions; torch and its like would take gigabytes."""

SELECTION = (
    "test_records.py", "test_results_directory.py", "test_readers.py", "test_submit.py",
    "test_live_wrappers.py",
)  # fmt: skip
"""Tests that use what the extras bring, and pydantic at length."""


def lowest():
    """Return constraints: the lowest versions in pyproject.toml, of several the highest."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    bounds = {}
    for text in [*project["dependencies"], *(t for name in WITH for t in extras[name])]:
        requirement = Requirement(text)
        for bound in requirement.specifier:
            if bound.operator == ">=":
                bounds.setdefault(requirement.name, []).append(Version(bound.version))
    return "".join(f"{name}=={max(versions)}\n" for name, versions in bounds.items())


@pytest.mark.packaging
def test_the_lowest_versions_work(wheel, tmp_path):
    constraints, inside = tmp_path / "constraints.txt", tmp_path / "venv"
    constraints.write_text(lowest())
    python = inside / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", inside], check=True)
    what = [f"{wheel}[{','.join(WITH)}]", "pytest-xdist", "hypothesis"]
    install = [*PIP, "--python", python, "install", "--prefer-binary", "-c", constraints, *what]
    done = subprocess.run(install, capture_output=True, text=True, check=False)
    if "from versions: none" in done.stderr:
        pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr
    run = run_of(make_split(tmp_path / "tiny", ("cartpole",)), tmp_path / "out")
    subprocess.run([python, "-m", "oodd_eval", *run], check=True, cwd=tmp_path)
    tests = [next((ROOT / "tests").rglob(name)) for name in SELECTION]
    done = subprocess.run(
        [python, "-m", "pytest", "-q", "-n", "1", "-o", "filterwarnings=default", "-p",
         "no:cacheprovider", "--rootdir", ROOT, "--basetemp", tmp_path / "tests", *tests],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    shutil.rmtree(inside)

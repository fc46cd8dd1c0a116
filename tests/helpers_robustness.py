"""Malformed inputs, kills and full disks, and the judgement of what they break.

What is malformed is given to the command line in this process; what runs code of strangers, is
killed or has no room, to a command in a process of its own. ``tests/attacks/test_robustness.py``
plays some of the cases, and all of them with ``--long``.
"""

import csv
import itertools
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass, field
from pathlib import Path

import click
import numpy as np
import psutil
from helpers_plugins import write_plugin
from helpers_split import make_split

from oodd_eval.cli import FILE, Command, Group
from oodd_eval.cli.main import PROGRAM, main

COMMAND = (sys.executable, "-m", "oodd_eval")

PROGRAMS = {
    "watchdog": """
import sys
from pathlib import Path
from oodd_eval import load_split
from oodd_eval.errors import OoddError
from oodd_live import Watchdog
data, path = load_split("split").environment("cartpole"), Path(sys.argv[2])
try:
    if path.exists():
        Watchdog.load(path)
    watchdog = Watchdog.fit("mewma", data, alpha=0.3)
    for _ in range(300):
        watchdog.save(path)
    Watchdog.load(path)
except OoddError as error:
    sys.exit(f"{error}")
"""
}
"""What is done in Python, as no command does it, by name."""


def program(name):
    """The start of a command line: a program of `PROGRAMS`, or the command line itself."""
    return (sys.executable, "-c", PROGRAMS[name]) if name in PROGRAMS else COMMAND


LIMIT = 60.0
"""Seconds that a command may take on a busy machine when its input is malformed."""
MOST_MEMORY = 3 * 2**30
"""Bytes that a command may hold when its input is malformed."""
KEPT = re.compile(r"\..+\.(\d{1,9})")
"""Names of what a command has not finished: ``.NAME.PID``."""


@dataclass
class Ended:
    """The end of a command: exit code (None where it had to be killed), output, cost."""

    code: int | None
    output: str
    seconds: float
    memory: int

    @property
    def problems(self):
        """What no command may do, whatever it is given."""
        if self.code is None:
            yield f"no end within {self.seconds:.0f} s"
        elif self.code < 0 or self.code == 3:
            yield f"exit code {self.code}"
        if re.search("^Traceback", self.output, re.MULTILINE):  # -v shows logs, further right
            yield "traceback"
        if self.memory > MOST_MEMORY:
            yield f"{self.memory / 2**20:.0f} MB"
        if steering := sorted({c for c in self.output if not c.isprintable()} - set("\n\t\r")):
            yield f"control characters {steering}"


def variables(home, *plugins):
    """The environment of a command whose processes can be told by it, with its own /tmp."""
    (home / "tmp").mkdir(exist_ok=True)
    paths = os.pathsep.join(map(str, plugins))
    return {
        **os.environ, "RUN": str(home), "TMPDIR": str(home / "tmp"), "OMP_NUM_THREADS": "1",
        "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip


def run(home, *arguments, start=COMMAND, plugins=(), limit=LIMIT, prefix=(), kill_after=None):
    """Carry out a command in a directory; what runs on behind it is a problem of `left`."""
    begun = time.monotonic()
    with (home / "output").open("w+b") as said:
        process = subprocess.Popen(
            [*prefix, *start, *map(str, arguments)], stdout=said, stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL, cwd=home, env=variables(home, *plugins),
            start_new_session=True,
        )  # fmt: skip
        status, usage = _waited(process, begun + (limit if kill_after is None else kill_after))
        if status is None:
            os.killpg(process.pid, signal.SIGKILL)
            _, _, usage = os.wait4(process.pid, 0)
        process.returncode = 0  # it is waited for
        said.seek(0)
        text = said.read(2 * 10**6).decode(errors="surrogateescape")
    (home / "output").unlink()
    seconds = time.monotonic() - begun
    return Ended(status, text, seconds, usage.ru_maxrss * 1024)


def run_here(home, arguments, capture):
    """Carry out a command in this process, which a signal ends where it takes too long."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun, held = time.monotonic(), tempfile.tempdir
    tempfile.tempdir = str(home / "tmp")
    (home / "tmp").mkdir(exist_ok=True)
    capture.readouterr()
    signal.signal(signal.SIGALRM, _no_end)
    signal.alarm(int(3 * LIMIT))  # beside other tests
    try:
        with chdir(home):
            code = main([str(argument) for argument in arguments])
    finally:
        signal.alarm(0)
        tempfile.tempdir = held
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return Ended(code, "".join(capture.readouterr()), time.monotonic() - begun, grown * 1024)


def _no_end(*_):
    raise RuntimeError("the command does not end")


def _waited(process, deadline):
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status), usage
        if time.monotonic() > deadline:
            return None, usage
        time.sleep(0.02)


def left(home, *, seconds=10.0):
    """What a command in a directory has left behind: processes (ended here), and rubbish."""
    deadline = time.monotonic() + seconds
    while processes := of_run(home):
        if time.monotonic() > deadline:
            break
        time.sleep(0.05)
    for process in processes:
        yield f"process {process.pid} {' '.join(process.cmdline())[:80]!r} runs on"
        process.kill()
    yield from (f"{path.relative_to(home)} is left" for path in rubbish(home))


def of_run(home):
    """Processes of commands in a directory."""
    processes = []
    for process in psutil.process_iter(["environ", "status", "cwd"]):
        info = process.info
        if info["status"] != psutil.STATUS_ZOMBIE and (
            (info["environ"] or {}).get("RUN") == str(home) or info["cwd"] == str(home)
        ):
            processes.append(process)
    return processes


def rubbish(home):
    """Files and directories below a directory that no command leaves when it has finished."""
    names = [path for path in home.rglob("*") if KEPT.fullmatch(path.name)]
    return sorted({*names, *(home / "tmp").glob("*oodd*")})


# Malformed files.


def _replaced(make):
    def damage(path):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        make(path)

    return damage


def _sparse(path):
    with path.open("wb") as file:
        file.truncate(8 * 2**30)


def _longer(path):
    content = path.read_bytes() if path.is_file() else b""
    path.write_bytes(content + b"x" * 3 * 10**6)


def _cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _digits(path):
    """Exchange the numbers of a text for long ones."""
    path.write_bytes(re.sub(rb"(?<![\w.])\d+(?![\w.])", b"9" * 5000, path.read_bytes()))


def _steering(path):
    """Put what steers a terminal into the texts of a file."""
    path.write_bytes(re.sub(rb'"(\w)', STEERING.encode() + rb"\1", path.read_bytes(), count=4))


STEERING = "\x1b]0;x\x07\x1b[2J\u009b31m\u202e\u2028"
"""Characters that rename a window, clear it, colour it, and turn the direction of letters."""

DAMAGES = {
    "pipe": _replaced(os.mkfifo),
    "directory": _replaced(Path.mkdir),
    "device": _replaced(lambda path: path.symlink_to("/dev/zero")),
    "loop": _replaced(lambda path: path.symlink_to(path.name)),
    "missing": _replaced(lambda _path: None),
    "sparse": _replaced(_sparse),
    "empty": _replaced(lambda path: path.write_bytes(b"")),
    "bytes": _replaced(lambda path: path.write_bytes(b"\xff\xfe\x00\x81" * 99)),
    "deep": _replaced(lambda path: path.write_bytes(b'{"a": ' * 10**5)),
    "deep table": _replaced(lambda path: path.write_bytes(b"a = " + b"[" * 10**5)),
    "long digits": _digits,
    "long line": _longer,
    "cut": _cut,
    "steering": _steering,
}
"""What is done to a file that a command reads, by name."""


class Ground:
    """Valid files of every kind in an empty directory, which cases damage in copies."""

    def __init__(self, home):
        self.home = home
        make_split(home / "split", ("cartpole",), calibration=20, name="small")
        common = ("--env", "cartpole", "--split", "split")
        self._do("run", "-q", "--detector", "persistence,random", *common, "--output", "results")
        self._do(
            "leaderboard", "submit", "results", "--detector", "persistence", "--entries",
            "board/entries", "--name", "mine",
        )  # fmt: skip
        (home / "config.toml").write_text(
            'detector = "persistence"\nenv = "cartpole"\nanomaly = ["iid"]\nsplit = "split"\n'
        )
        self._logs(home / "logs")
        self._do("data", "export", "split", "--format", "minari", "--output", "minari")

    def _do(self, *arguments):
        ended = run(self.home, *arguments, limit=300)
        if ended.code:
            raise RuntimeError(f"{arguments} ended with {ended.code}: {ended.output}")

    def _logs(self, root):
        rng = np.random.default_rng(7)
        for part, count in (("train", 4), ("calibration", 5), ("nominal", 2), ("fog", 2)):
            (root / part).mkdir(parents=True)
            for i in range(count):
                rows = np.random.default_rng([i, 1]).normal(size=(61, 2)).cumsum(axis=0) * 0.1
                rows[20:, 0] += 5.0 * (part == "fog")
                arrays = {"observations": rows, "actions": rng.uniform(size=(60, 1))}
                known = {"onset": 20} if part == "fog" else {}
                paired = f"test/{part}" if part in {"nominal", "fog"} else part
                (root / "arrays" / paired).mkdir(parents=True, exist_ok=True)
                np.savez(root / "arrays" / paired / f"run-{i}.npz", **arrays, **known)
                with (root / part / f"run-{i}.csv").open("w", newline="") as file:
                    write = csv.writer(file).writerow
                    write(["time", "a[bar]", "b"])
                    for t, row in enumerate(rows.round(6).tolist()):
                        write([0.1 * t, *row])
        (root / "marks.csv").write_text("file,onset\nrun-0.csv,20\nfog/run-1.csv,21\n")
        (root / "recipe.toml").write_text(
            'split = "pump"\ntime = "time"\nsensors = ["a", "b"]\n'
            '[nominal]\ntrain = ["train/*.csv"]\ncalibration = ["calibration/*.csv"]\n'
            'test = ["nominal/*.csv"]\n[anomalous.fog]\nfiles = ["fog/*.csv"]\nonset = 20\n'
        )

        (root.parent / "minari.toml").write_text(
            'split = "cart"\n[read]\nformat = "minari"\n[nominal]\n'
            'train = ["minari/oodd/small/cartpole/train-v0"]\n'
            'calibration = ["minari/oodd/small/cartpole/calibration-v0"]\n'
        )

    def copy(self, target):
        """Return a copy."""
        return Path(shutil.copytree(self.home, target, symlinks=True))


PAIRED = (
    "data", "import", "plant", "--env", "pump", "--format", "numpy", "--train",
    "logs/arrays/train", "--calibration", "logs/arrays/calibration", "--test", "logs/arrays/test",
    "--output", "plant",
)  # fmt: skip

READERS = {
    "config.toml": [("run", "--config", "config.toml", "--output", "out")],
    "split/manifest.json": [
        ("data", "info", "split"),
        ("data", "verify", "split"),
        ("run", "--detector", "clock", "--env", "cartpole", "--split", "split"),
        ("data", "fetch", "split", "--output", "fetched"),
    ],
    "split/cartpole.h5": [
        ("data", "verify", "split"),
        ("data", "export", "split", "--format", "minari", "--output", "exported"),
        ("data", "fetch", "split", "--output", "fetched"),
    ],
    "results/records.jsonl": [
        ("show", "results"),
        ("compare", "results", "--against", "board/entries/mine"),
        ("forget", "results", "-k", "iid"),
        ("leaderboard", "place", "results"),
        ("leaderboard", "submit", "results", "--detector", "persistence", "--entries", "new"),
        ("run", "--detector", "clock", "--env", "cartpole", "--split", "split", "--anomaly", "iid",
         "--output", "results"),
    ],
    "board/entries/mine/records.jsonl": [
        ("leaderboard", "build", "board", "--output", "built"),
    ],
    "board/entries/mine/entry.toml": [
        ("leaderboard", "build", "board", "--output", "built"),
    ],
    "board/entries/mine/curves.json": [
        ("leaderboard", "build", "board", "--output", "built"),
    ],
    "logs/recipe.toml": [
        ("data", "import", "logs/recipe.toml", "--output", "imported"),
        ("scan", "logs", "--recipe", "logs/recipe.toml"),
    ],
    "logs/train/run-0.csv": [
        ("data", "import", "logs/recipe.toml", "--output", "imported"),
        ("data", "inspect", "logs/train"),
    ],
    "minari/oodd/small/cartpole/train-v0/data/metadata.json": [
        ("data", "inspect", "minari/oodd/small/cartpole/train-v0"),
    ],
    "minari/oodd/small/cartpole/train-v0/data/main_data.hdf5": [
        ("data", "inspect", "minari/oodd/small/cartpole/train-v0"),
    ],
    "logs/arrays/train/run-0.npz": [PAIRED],
}  # fmt: skip
"""Commands that read a file of a ground, by its path."""


@dataclass(frozen=True)
class Case:
    """A malformed input: a damage to a ground, and a command that reads it.

    A `refused` one may not end with exit code 0. With `plugins`, the ground has a directory of
    that name on the path of modules.
    """

    name: str
    prepare: Callable[[Path], object] = field(repr=False)
    arguments: tuple[str, ...]
    refused: bool = False
    plugins: bool = False

    def play(self, ground, home, capture):
        """Return what is wrong with how the command takes it."""
        place = ground.copy(home)
        self.prepare(place)
        before = {*place.rglob("*")}
        if self.plugins:
            ended = run(place, *self.arguments, plugins=[place / "plugins"])
        else:
            ended = run_here(place, self.arguments, capture)
        problems = [*ended.problems, *left(place)]
        if self.refused and ended.code == 0:
            problems.append("is taken silently")
        if ended.code and {*before} <= {*place.rglob("*")} and not ended.output.strip():
            problems.append("says nothing")
        shutil.rmtree(place, ignore_errors=True)
        return [f"{problem}: {ended.output[-600:]}" for problem in problems]


def damaged_files():
    """Cases of `READERS` and `DAMAGES`."""
    return [
        Case(f"{name}: {damage}: {' '.join(arguments[:2])}", _damaging(name, damage), arguments)
        for name, readers in READERS.items()
        for arguments, damage in itertools.product(readers, DAMAGES)
    ]


def _damaging(name, damage):
    def prepare(place):
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text("{}")
        DAMAGES[damage](path)

    return prepare


def leaves(group, path=()):
    """Yield the commands below a group with their names."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, Group):
            yield from leaves(command, (*path, name))
        else:
            yield (*path, name), command


def named_files():
    """Yield the words of a command line for each option and argument that names a file."""
    for path, command in leaves(PROGRAM):
        assert isinstance(command, Command)
        arguments = [p for p in command.params if isinstance(p, click.Argument)]
        options = [p for p in command.params if isinstance(p, click.Option) and p.required]
        needed = [word for p in options for word in (p.opts[0], "mine")]
        for parameter in command.params:
            if not isinstance(parameter.type, click.Path | type(FILE)) or (
                not isinstance(parameter.type, click.Path)
                and parameter.type.name not in {"FILE", "DIR"}
            ):
                continue
            if isinstance(parameter, click.Option):
                words = ["x" for _ in arguments]
                yield (*path, *words, *needed, parameter.opts[0]), None
            else:
                words = ["x" if p is not parameter else None for p in arguments]
                yield (*path, *needed), words


def naming(words, path):
    """Return the words of a command line with a path where it names a file."""
    start, positions = words
    last = [str(path)] if positions is None else [str(path) if w is None else w for w in positions]
    return [*start, *last]


def _text(name, text, **settings):
    return lambda place: (place / name).write_text(text, **settings)


def _edited(name, old, new):
    def prepare(place):
        text = (place / name).read_text()
        assert re.search(old, text), name
        (place / name).write_text(re.sub(old, lambda _: new, text, count=1))

    return prepare


def _arrays(**changes):
    def prepare(place):
        path = place / "logs/arrays/test/fog/run-0.npz"
        with np.load(path) as file:
            arrays = {**file}
        np.savez(path, **(arrays | changes))

    return prepare


def _header(header):
    def prepare(place):
        import zipfile

        content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        path = place / "logs/arrays/test/fog/run-0.npz"
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("observations.npy", content)

    return prepare


RECIPE = ("data", "import", "logs/recipe.toml", "--output", "imported")
MINARI = ("data", "import", "minari.toml", "--output", "imported")
RUN = ("run", "--config", "config.toml", "--output", "out")
PARAMETER = (
    "run", "--detector", "comb", "--env", "cartpole", "--anomaly", "iid", "--split", "split",
    "--output", "out", "--param",
)  # fmt: skip


def marks(content):
    def prepare(place):
        path = place / "logs/recipe.toml"
        text = path.read_text().replace("onset = 20\n", "")
        path.write_text(f'intervals = "marks.csv"\n{text}')
        (place / "logs/marks.csv").write_bytes(content)

    return prepare


def onsets(content):
    def prepare(place):
        for part in ("nominal", "fog"):
            shutil.copytree(place / "logs" / part, place / "logs/test" / part)
        for path in (place / "logs").glob("**/run-*.csv"):
            path.write_text(path.read_text().replace("a[bar],b", "obs:a[bar],obs:b"))
        (place / "logs/test/fog/onsets.csv").write_bytes(content)

    return prepare


ONSETS = (
    "data", "import", "plant", "--env", "pump", "--format", "csv", "--train", "logs/train",
    "--calibration", "logs/calibration", "--test", "logs/test", "--output", "plant",
)  # fmt: skip


def _cases(family, arguments, make, table):
    """Cases of one command: of each name what a function makes of the table's value."""
    return [
        Case(f"{family}: {name}", make(value), arguments, refused=True)
        for name, value in table.items()
    ]


def _recipe(edit):
    return _edited("logs/recipe.toml", *edit)


def _actions(space):
    def prepare(place):
        path = place / "minari/oodd/small/cartpole/train-v0/data/metadata.json"
        text = space if isinstance(space, str) else json.dumps(space)
        path.write_text(json.dumps(json.loads(path.read_text()) | {"action_space": text}))

    return prepare


SPACES = {
    "long digits": '{"type": "Discrete", "n": ' + "9" * 4200 + "}",
    "many actions": {"type": "Discrete", "n": 10**12},
    "negative": {"type": "Discrete", "n": -1},
    "start": {"type": "Discrete", "n": 2, "start": 10**400},
    "no text as type": {"type": {"a": 1}},
}
LONG, LONGER = "9" * 4200, "9" * 5000
"""Digits that Python reads as a number, and more than it reads."""

IMPORTS = [
    *_cases("onsets.csv", ONSETS, onsets, {
        "not UTF-8": b"file,onset\nrun-0.csv,\xff\xfe\n",
        "huge field": b"file,onset\nrun-0.csv," + b"9" * 200_000,
        "long digits": f"file,onset\nrun-0.csv,{LONGER}".encode(),
        "other digits": "file,onset\nrun-0.csv,\u0662\u0660\nrun-1.csv,20\n".encode(),
        "underscore": b"file,onset\nrun-0.csv,2_0\nrun-1.csv,20\n",
        "twice": b"file,onset\nrun-0.csv,20\nrun-0.csv,21\nrun-1.csv,20\n",
        "quote": b'file,onset\n"run-0.csv,20\n',
        "no file": b"file,onset\nrun-9.csv,20\nrun-0.csv,20\nrun-1.csv,20\n",
    }),
    *_cases("intervals", RECIPE, marks, {
        "not UTF-8": b"file,start,stop\nfog/run-0.csv,\xff,3\n",
        "huge field": b"file,start,stop\nfog/run-0.csv," + b"9" * 200_000 + b",3\n",
        "long digits": f"file,start,stop\nfog/run-0.csv,{LONGER},3\n".encode(),
        "underscore": b"file,start,stop\nfog/run-0.csv,1_0,30\n",
        "other digits": "file,start,stop\nfog/run-0.csv,\u0661\u0660,\u0663\u0660\n".encode(),
        "twice": b"file,start,stop\nfog/run-0.csv,10,30\nfog/run-0.csv,10,30\n",
    }),
    *_cases("npz", PAIRED, lambda arrays: _arrays(**arrays), {
        "onset huge": {"onset": 1e300},
        "onset complex": {"onset": 20j},
        "NaN rows": {"observations": np.full((61, 2), np.nan)},
        "no rows": {"observations": np.zeros((0, 2)), "actions": np.zeros((0, 1))},
    }),
    *_cases("npz header", PAIRED, _header, {
        "brackets": b"(" * 3000,
        "signs": b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"-" * 9000 + b"1,)}",
        "huge shape": b"{'descr': '<f8', 'fortran_order': False, 'shape': (10**18,)}",
        "negative shape": b"{'descr': '<f8', 'fortran_order': False, 'shape': (-3,)}",
    }),
    *_cases("Minari imported", MINARI, _actions, SPACES),
    *_cases("recipe", RECIPE, _recipe, {
        "in two parts": (r'"calibration/\*.csv"', '"calibration/*.csv", "train/run-0.csv"'),
        "onset with digits": (r"onset = 20", f"onset = {LONG}"),
        "onset text": (r"onset = 20", "onset = '1_0'"),
        "long name": (r"pump", "p" * 5000),
        "window": (r"onset = 20", f"window = {LONG}"),
    }),
    *(
        Case(f"discrete: {name}", lambda _: None, (*PAIRED, "--discrete", number), refused=True)
        for name, number in {"huge": str(10**9), "long": LONGER, "other": "\u0663"}.items()
    ),
]  # fmt: skip
"""Malformed logs; those that are `refused` were once taken silently or hung."""

CONFIGURATIONS = [
    *_cases("configuration", RUN, lambda text: _text("config.toml", text), {
        "long seeds": f"seed = [{LONG}]",
        "long horizon": f"horizon = [1, {LONG}]",
        "steering key": f"{json.dumps(STEERING)} = 1",
        "huge": "detector = '" + "x" * 2 * 10**6 + "'",
        "key of options": '"output=/tmp --param" = 1',
        "deep parameter": "detector = 'clock'\nparam = {a = " + "[" * 90 + "]" * 90 + "}",
        "empty key": '"" = 1',
        "config": 'config = "config.toml"',
    }),
    *(
        Case(f"parameter: {name}", lambda _: None, (*PARAMETER, text), refused=True)
        for name, text in {
            "deep": "a=" + "[" * 10**5,
            "long digits": f"a={LONGER}",
            "NaN": "a=NaN",
            "steering": f"a={STEERING}",
            "steering key": f"{STEERING}=1",
            "empty": "=",
            "object": 'a={"a": {"a": ' + "[" * 400 + "]" * 400 + "}}",
            "surrogate": 'a="\\ud800"',
        }.items()
    ),
]  # fmt: skip
"""Malformed configurations and parameters."""


# Broken metadata of distributions, whoever has installed them.

SOUND = b"Metadata-Version: 2.1\nName: oodd-broken\nVersion: 1.0\n"
POINTS = b"[oodd_eval]\nbroken = oodd_broken\n"

METADATA_OF = {
    "nothing": (None, None),
    "empty": (b"", POINTS),
    "no name": (b"Metadata-Version: 2.1\nVersion: 1.0\n", POINTS),
    "no UTF-8": (b"\xff\xfe\x00" * 99, POINTS),
    "no UTF-8 in name": (b"Name: \xff\xfe\nVersion: 1\n", POINTS),
    "steering name": (f"Name: x{STEERING}\nVersion: 1\n".encode(), POINTS),
    "long name": (b"Name: " + b"x" * 10**6 + b"\n", POINTS),
    "points are no UTF-8": (SOUND, b"[oodd_eval]\n\xff\xfe = a\n"),
    "points are garbled": (SOUND, b"[oodd_eval]\na = :: ) (\n"),
    "steering point": (SOUND, f"[oodd_eval]\nb{STEERING[:9]} = x\n".encode()),
    "steering module": (SOUND, f"[oodd_eval]\nb = x{STEERING[:9]}\n".encode()),
    "bytes": (SOUND, bytes(range(256)) * 99),
    "huge": (SOUND, POINTS + b"# x\n" * 10**7),
}
"""The files METADATA and entry_points.txt of a distribution, by what is wrong with them."""


def _distribution(name):
    def prepare(place):
        info = place / "plugins" / "oodd_broken-1.0.dist-info"
        info.mkdir(parents=True)
        for file, content in zip(("METADATA", "entry_points.txt"), METADATA_OF[name], strict=True):
            if content is not None:
                (info / file).write_bytes(content)

    return prepare


_ONE_CELL = (
    "run", "--detector", "clock", "--env", "cartpole", "--anomaly", "iid", "--split", "split",
    "--output", "out",
)  # fmt: skip
DISTRIBUTIONS = [
    Case(f"metadata: {name}: {' '.join(use[:2])}", _distribution(name), use, plugins=True)
    for name in METADATA_OF
    for use in (("list", "detectors"), ("info", "pe"), _ONE_CELL)
]


# What steers a terminal, wherever a text may come from.


def _plugin(code):
    return lambda place: write_plugin(place / "plugins", "steers", code)


STEERS = f'''
S = {STEERING!r}
class Steers(Good):
    """What {STEERING.encode("unicode_escape").decode()} this does."""
    def fit(self, nominal):
        print(S); print(S, file=sys.stderr)
        raise ValueError(S)
@hookimpl
def oodd_detectors(): return offer(steers=Steers)
'''


def _steering_name(place):
    shutil.copytree(place / "logs/train", place / f"logs/{STEERING}")
    (place / f"logs/{STEERING}/run-9.csv").write_text("time,a\n0,1,2,3\n")


def _steering_records(place):
    path = place / "results/records.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    for line in lines:
        line |= {"reason": STEERING, "status": "error", "metrics": {}, "per_trajectory": {}}
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


_FAILS = f"raise ValueError({STEERING!r})"
_MAKER = f"""
def oodd_detector_from_spec(spec): return None
oodd_detector_from_spec.__doc__ = {STEERING!r}
oodd_detector_from_spec = hookimpl(oodd_detector_from_spec)
"""
_SUMMARY = f"@hookimpl\ndef oodd_detectors(): return [DetectorSpec('a', Good, {STEERING!r})]"
_SUBMIT = ("leaderboard", "submit", "results", "--detector", "persistence", "--entries", "new")
_ROWS = "logs/train/run-0.csv"
TERMINAL = [
    Case(f"terminal: {name}: {' '.join(arguments[:2])!a}", prepare, arguments, plugins=plugins)
    for plugins, families in (
        (True, [
            ("a plug-in", _plugin(STEERS), (
                ("list", "detectors"), ("info", "steers"), ("check", "steers", "-k", "fit"),
                ("run", "-v", "--detector", "steers", *_ONE_CELL[3:]),
            )),
            ("an exception at import", _plugin(_FAILS), (("list", "detectors"),)),
            ("a summary", _plugin(_SUMMARY), (("list", "detectors"),)),
            ("a maker's docstring", _plugin(_MAKER), (("list", "detectors"),)),
        ]),
        (False, [
            ("a word", lambda _: None, (
                ("info", STEERING), (f"--{STEERING}",), (STEERING,), ("show", STEERING),
                ("run", "--detector", STEERING, "--env", "ant"), ("data", "inspect", STEERING),
                (*_ONE_CELL, "-k", f"iid and {STEERING}"), ("data", "fetch", f"http://{STEERING}"),
                (*_SUBMIT, "--paper", STEERING),
            )),
            ("names of files", _steering_name, (
                ("data", "inspect", "-v", "logs"), ("data", "inspect", f"logs/{STEERING}"),
            )),
            ("columns", _text(_ROWS, f"time,{STEERING},b\n0,1,2\n1,2,3\n"),
             (("data", "inspect", "logs/train"),)),
            ("cells", _text(_ROWS, f"time,a,b\n0,{STEERING},2\n1,2,3\n"),
             (("data", "inspect", "logs/train"),)),
            ("records", _steering_records, (
                ("show", "results"), ("show", "results", "--markdown"),
                ("leaderboard", "place", "results"), _SUBMIT,
            )),
        ]),
    )
    for name, prepare, commands in families
    for arguments in commands
]  # fmt: skip
"""Texts of strangers that are printed, each with what steers a terminal."""


# Kills at random moments, which test_kills tries, and full disks.

KILLED = {
    "run": ("run", "-q", "--detector", "persistence,random", "--env", "all", "--anomaly",
            "iid,gravity", "--split", "TINY", "--jobs", "2", "--output", "out"),
    "run --sandbox": (*_ONE_CELL, "--jobs", "2", "--sandbox"),
    "reproduce": ("reproduce", "-q", "--tier", "mini", "--split", "TINY", "--only", "delays",
                  "--jobs", "2", "--no-figures", "--output", "out"),
    "import": RECIPE,
    "build": ("data", "build", "small", "--train", "4", "--calibration", "2", "--test", "2",
              "--cap", "60", "--seed-base", "850", "--env", "cartpole", "--jobs", "1", "--output",
              "out"),
    "fetch": ("data", "fetch", "TINY", "--output", "out"),
    "submit": (*_SUBMIT, "--name", "other"),
    "leaderboard build": ("leaderboard", "build", "board"),
    "scan": ("scan", "logs", "--recipe", "logs/recipe.toml", "--json", "scan.json", "--html",
             "scan.html"),
    "export": ("data", "export", "split", "--format", "minari", "--output", "exported"),
    "watchdog": ("--output", "arm.npz"),
}  # fmt: skip
"""Commands that are killed, and a program; TINY stands for a split of two environments."""


@dataclass(frozen=True)
class Full:
    """A command on a disk with room for so many bytes."""

    command: str
    room: int

    @property
    def name(self):
        """What messages call it."""
        return f"full disk of {self.room} bytes: {self.command}"

    def play(self, ground, home, _capture):
        """Return what is wrong with how the command ends."""
        place = ground.copy(home)
        arguments = ["split" if word == "TINY" else word for word in KILLED[self.command]]
        (place / "disk").mkdir()
        i = arguments.index("--entries" if self.command == "submit" else "--output") + 1
        arguments[i] = "disk/out"
        mounted = f'mount -t tmpfs -o size={self.room} tmpfs disk && exec "$@"'
        prefix = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mounted, "-")
        ended = run(place, *arguments, start=program(self.command), prefix=prefix, limit=300)
        problems = [*ended.problems, *left(place)]
        if ended.code not in {None, 0, 1, 4}:
            problems.append(f"exit code {ended.code}")
        shutil.rmtree(place, ignore_errors=True)
        return [f"{problem}: {ended.output[-600:]}" for problem in problems]


FULL = [
    Full(command, room)
    for command in KILLED
    if command not in {"run --sandbox", "reproduce", "scan"}
    for room in (4096, 16384, 65536, 200_000)
]
"""Commands on full disks."""


def can_mount():
    """Whether this user may mount a file system, in a name space."""
    command = ("unshare", "--user", "--map-root-user", "--mount", "mount", "-t", "tmpfs", "t")
    if not shutil.which("unshare"):
        return False
    return not subprocess.run([*command, "/mnt"], check=False).returncode

"""Hostile plug-ins, malformed inputs, kills and full disks, and the judgement of what they break.

Everything is done to the command line, in a process of its own. The cases here are played a few at
a time by ``tests/attacks``, and all of them, counted, by ``benchmarks/robustness.py``.
"""

import csv
import itertools
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import click
import numpy as np
import psutil
from helpers_plugins import write_plugin
from helpers_split import make_split

from oodd_eval.cli import FILE, Command, Group
from oodd_eval.cli.main import PROGRAM

COMMAND = (sys.executable, "-m", "oodd_eval")

PROGRAMS = {
    "streamed": """
import functools, sys
from oodd_eval.cli import main, run
run.RunSettings = functools.partial(run.RunSettings, streamed=True)
sys.exit(main.main())
""",
    # Seeds that are drawn are the same each time, so that ends can be compared.
    "rerun": """
import dataclasses, sys, types
from pathlib import Path
from oodd_eval.cli.main import main
from oodd_leaderboard.entry import read_entry
from oodd_recording import rerun
rerun.secrets = types.SimpleNamespace(token_hex=lambda count: "5b" * count)
small = {"name": "small", "train": 2, "calibration": 20, "test": 2, "episode_cap": 60}
split = read_entry(Path(sys.argv[3])).meta.split
rerun.SPLITS = {split: dataclasses.replace(rerun.SPLITS["mini"], **small)}
sys.exit(main())
""",
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
""",
}
"""What is done in Python, as no command does it to files as small as these, by name."""


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
        if re.search(
            "^Traceback", self.output, re.MULTILINE
        ):  # -v shows logs, further to the right
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


def _socket(path):
    here = os.open(path.parent, os.O_RDONLY)
    with socket.socket(socket.AF_UNIX) as made:  # addresses are short
        made.bind(f"/proc/self/fd/{here}/{path.name}")
    os.close(here)


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
    "socket": _replaced(_socket),
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

SIMPLE = """
@hookimpl
def oodd_detectors(): return offer(good=Good)
"""


class Ground:
    """Valid files of every kind, which cases damage in copies.

    Parameters
    ----------
    home
        An empty directory.
    """

    def __init__(self, home):
        self.home = home
        make_split(home / "split", ("cartpole",), calibration=20, name="small")
        common = ("--env", "cartpole", "--split", "split")
        self._do("run", "-q", "--detector", "persistence,random", *common, "--output", "results")
        self._do(
            "leaderboard", "submit", "results", "--results", "board/results", "--id", "mine",
            "--split", "split",
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
        ("compare", "results", "--against", "board/results/mine"),
        ("forget", "results", "-k", "iid"),
        ("leaderboard", "place", "results"),
        ("leaderboard", "submit", "results", "--results", "new", "--split", "split"),
        ("run", "--detector", "clock", "--env", "cartpole", "--split", "split", "--anomaly", "iid",
         "--output", "results"),
    ],
    "board/results/mine/records.jsonl": [
        ("leaderboard", "verify", "board/results/mine"),
        ("leaderboard", "build", "board/results", "--output", "built"),
    ],
    "board/results/mine/entry.json": [
        ("leaderboard", "verify", "board/results"),
        ("leaderboard", "build", "board/results", "--output", "built"),
        ("leaderboard", "rerun", "board/results/mine"),
    ],
    "board/results/mine/curves.json": [
        ("leaderboard", "verify", "board/results/mine"),
        ("leaderboard", "build", "board/results", "--output", "built"),
    ],
    "board/trust.json": [
        ("leaderboard", "verify", "board/results/mine"),
        ("leaderboard", "build", "board/results", "--output", "built"),
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

    def play(self, ground, home):
        """Return what is wrong with how the command takes it."""
        place = ground.copy(home)
        self.prepare(place)
        before = {*place.rglob("*")}
        ended = run(place, *self.arguments, plugins=[place / "plugins"] * self.plugins)
        problems = [*ended.problems, *left(place)]
        if self.refused and ended.code == 0:
            problems.append("is taken silently")
        if ended.code and {*before} <= {*place.rglob("*")} and not ended.output.strip():
            problems.append("says nothing")
        shutil.rmtree(place, ignore_errors=True)
        return [f"{problem}: {ended.output[-600:]}" for problem in problems]


def damaged_files(number, seed=1):
    """Cases of `READERS` and `DAMAGES`, so many of them, drawn."""
    every = [
        Case(f"{name}: {damage}: {' '.join(arguments[:2])}", _damaging(name, damage), arguments)
        for name, readers in READERS.items()
        for arguments, damage in itertools.product(readers, DAMAGES)
    ]
    return random.Random(seed).sample(every, min(number, len(every)))


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


def pipes():
    """Cases of a pipe that nobody writes into, wherever a command names a file."""
    return [
        Case(f"pipe: {' '.join(words[0])}", lambda place: os.mkfifo(place / "pipe"),
             tuple(naming(words, "pipe")), refused=True)
        for words in named_files()
    ]  # fmt: skip


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


METADATA = "minari/oodd/small/cartpole/train-v0/data/metadata.json"


def _metadata(change):
    def prepare(place):
        facts = json.loads((place / METADATA).read_text())
        for key in ("observation_space", "action_space"):
            facts[key] = json.loads(facts[key])
        change(facts)
        for key in ("observation_space", "action_space"):
            facts[key] = facts[key] if isinstance(facts[key], str) else json.dumps(facts[key])
        (place / METADATA).write_text(json.dumps(facts))

    return prepare


RECIPE = ("data", "import", "logs/recipe.toml", "--output", "imported")
MARKED = (r"onset = 20\n", "")
INSPECT = ("data", "inspect", "minari/oodd/small/cartpole/train-v0")
RUN = ("run", "--config", "config.toml", "--output", "out")
TABLE = "time,a[bar],b\n0,1,2\n0.1,2,3\n0.2,1,{}\n"


def marks(content):
    def prepare(place):
        _edited("logs/recipe.toml", r"split = .*\n", 'split = "pump"\nintervals = "marks.csv"\n')(
            place
        )
        _edited("logs/recipe.toml", *MARKED)(place)
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

IMPORTS = [
    *(
        Case(f"onsets.csv: {name}", onsets(content), ONSETS, refused=True)
        for name, content in {
            "not UTF-8": b"file,onset\nrun-0.csv,\xff\xfe\n",
            "huge field": b"file,onset\nrun-0.csv," + b"9" * 200_000,
            "long digits": b"file,onset\nrun-0.csv," + b"9" * 5000,
            "half a row": b"file,onset\nrun-0.csv,1.5\nrun-1.csv,20\n",
            "truth": b"file,onset\nrun-0.csv,True\nrun-1.csv,20\n",
            "other digits": "file,onset\nrun-0.csv,\u0662\u0660\nrun-1.csv,20\n".encode(),
            "underscore": b"file,onset\nrun-0.csv,2_0\nrun-1.csv,20\n",
            "twice": b"file,onset\nrun-0.csv,20\nrun-0.csv,21\nrun-1.csv,20\n",
            "same twice": b"file,onset\nrun-0.csv,20\nrun-0.csv,20\nrun-1.csv,20\n",
            "long row": b"file,onset\nrun-0.csv,20,30,40\nrun-1.csv,20\n",
            "short row": b"file,onset\nrun-0.csv\nrun-1.csv,20\n",
            "quote": b'file,onset\n"run-0.csv,20\n',
            "zero byte": b"file,onset\nrun-0.csv,\x00\n",
            "columns": b"onset\n20\n",
            "no file": b"file,onset\nrun-9.csv,20\nrun-0.csv,20\nrun-1.csv,20\n",
            "negative": b"file,onset\nrun-0.csv,-20\nrun-1.csv,20\n",
        }.items()
    ),
    *(
        Case(f"intervals: {name}", marks(content), RECIPE, refused=True)
        for name, content in {
            "not UTF-8": b"file,start,stop\nfog/run-0.csv,\xff,3\n",
            "huge field": b"file,start,stop\nfog/run-0.csv," + b"9" * 200_000 + b",3\n",
            "long digits": b"file,start,stop\nfog/run-0.csv," + b"9" * 5000 + b",3\n",
            "infinite": b"file,start,stop\nfog/run-0.csv,inf,nan\n",
            "truth": b"file,start,stop\nfog/run-0.csv,True,3\n",
            "underscore": b"file,start,stop\nfog/run-0.csv,1_0,30\n",
            "other digits": "file,start,stop\nfog/run-0.csv,\u0661\u0660,\u0663\u0660\n".encode(),
            "twice": b"file,start,stop\nfog/run-0.csv,10,30\nfog/run-0.csv,10,30\n",
            "long row": b"file,start,stop\nfog/run-0.csv,10,30,fog,40\n",
            "backwards": b"file,start,stop\nfog/run-0.csv,30,10\n",
        }.items()
    ),
    *(
        Case(f"npz: {name}", prepare, PAIRED, refused=True)
        for name, prepare in {
            "onset NaN": _arrays(onset=np.nan),
            "onset infinite": _arrays(onset=np.inf),
            "onset huge": _arrays(onset=1e300),
            "onset 1.5": _arrays(onset=1.5),
            "onset True": _arrays(onset=np.bool_(True)),
            "onset text": _arrays(onset="20"),
            "onsets": _arrays(onset=np.array([20, 21])),
            "onset complex": _arrays(onset=20j),
            "objects": _arrays(observations=np.array([{}, 1], dtype=object)),
            "NaN rows": _arrays(observations=np.full((61, 2), np.nan)),
            "one row": _arrays(observations=np.zeros((1, 2)), actions=np.zeros((0, 1))),
            "no rows": _arrays(observations=np.zeros((0, 2)), actions=np.zeros((0, 1))),
            "no columns": _arrays(observations=np.zeros((61, 0))),
            "cube": _arrays(observations=np.zeros((61, 2, 2))),
            "header of brackets": _header(b"(" * 3000),
            "header of signs": _header(b"{'descr': '<f8', 'fortran_order': False, 'shape': ("
                                       + b"-" * 9000 + b"1,)}"),
            "huge shape": _header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (10**18,)}"),
            "negative shape": _header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-3,)}"),
            "pickle": lambda place: (place / "logs/arrays/test/fog/run-0.npz").write_bytes(
                b"cos\nsystem\n(S'touch cracked'\ntR."
            ),
        }.items()
    ),
    *(
        Case(f"Minari: {name}", _metadata(change), INSPECT)
        for name, change in {
            "type is a list": lambda f: f["observation_space"].update(type=["Box"]),
            "action's type": lambda f: f["action_space"].update(type={"a": 1}),
            "long digits": lambda f: f.update(action_space='{"type": "Discrete", "n": '
                                              + "9" * 4200 + "}"),
            "longer digits": lambda f: f.update(action_space='{"type": "Discrete", "n": '
                                                + "9" * 5000 + "}"),
            "many actions": lambda f: f.update(action_space={"type": "Discrete", "n": 10**12}),
            "negative": lambda f: f.update(action_space={"type": "Discrete", "n": -1}),
            "start": lambda f: f.update(
                action_space={"type": "Discrete", "n": 2, "start": 10**400}),
            "infinite": lambda f: f.update(action_space='{"type": "Discrete", "n": 1e999}'),
            "no number": lambda f: f.update(action_space={"type": "Discrete", "n": [2]}),
            "space is a list": lambda f: f.update(observation_space=[]),
            "sensors": lambda f: f.update(sensors=7),
            "names": lambda f: f.update(sensors=[{"name": ["a"], "unit": None}]),
            "deep": lambda f: f.update(observation_space="[" * 10**5),
        }.items()
    ),
    *(
        Case(f"Minari: imported, {name}", _metadata(change), ("data", "import", "minari.toml",
             "--output", "imported"), refused=True)
        for name, change in {
            "long digits": lambda f: f.update(action_space='{"type": "Discrete", "n": '
                                              + "9" * 4200 + "}"),
            "many actions": lambda f: f.update(action_space={"type": "Discrete", "n": 10**12}),
            "negative": lambda f: f.update(action_space={"type": "Discrete", "n": -1}),
            "start": lambda f: f.update(
                action_space={"type": "Discrete", "n": 2, "start": 10**400}),
            "type is a list": lambda f: f["observation_space"].update(type=["Box"]),
            "action's type": lambda f: f["action_space"].update(type={"a": 1}),
        }.items()
    ),
    *(
        Case(f"recipe: {name}", _edited("logs/recipe.toml", old, new), RECIPE, refused=True)
        for name, (old, new) in {
            "in two parts": (r'"calibration/\*.csv"', '"calibration/*.csv", "train/run-0.csv"'),
            "onset 1.5": (r"onset = 20", "onset = 1.5"),
            "onset True": (r"onset = 20", "onset = true"),
            "onset infinite": (r"onset = 20", "onset = inf"),
            "onset NaN": (r"onset = 20", "onset = nan"),
            "onset with digits": (r"onset = 20", f"onset = {'9' * 4200}"),
            "onset text": (r"onset = 20", "onset = '1_0'"),
            "long digits": (r"onset = 20", f"onset = {'9' * 5000}"),
            "deep": (r"onset = 20", "onset = " + "[" * 4000),
            "deep table": (r"onset = 20", "onset" + ".a" * 4000 + " = 1"),
            "steering key": (r"onset = 20", '"\\u001b[2J" = 1'),
            "steering file": (r"train/\*.csv", "\\u001b[2J*.csv"),
            "long name": (r"pump", "p" * 5000),
            "path as name": (r"pump", "../pump"),
            "glob of all": (r"train/\*.csv", "/**/*"),
            "window": (r"onset = 20", f"window = {'9' * 4200}"),
        }.items()
    ),
    *(
        Case(f"table: {name}", _text("logs/train/run-0.csv", text), RECIPE)
        for name, text in {
            "long row": TABLE.format("3,4,5"),
            "short row": TABLE.format("").rstrip(","),
            "text": TABLE.format("x"),
            "long digits": TABLE.format("9" * 5000),
            "infinite": TABLE.format("1e999"),
            "other digits": TABLE.format("\u0663"),
            "underscore": TABLE.format("1_000"),
            "header alone": "time,a[bar],b\n",
            "no header": "0,1,2\n1,2,3\n",
            "same names": "time,a,a\n0,1,2\n1,2,3\n",
            "quote": 'time,a[bar],b\n"0,1,2\n',
        }.items()
    ),
    *(
        Case(f"discrete: {name}", lambda _: None, (*PAIRED, "--discrete", number), refused=True)
        for name, number in {"huge": str(10**9), "long": "9" * 5000, "other": "\u0663"}.items()
    ),
]  # fmt: skip
"""Malformed logs; those that are `refused` were once taken silently or hung."""

CONFIGURATIONS = [
    *(
        Case(f"configuration: {name}", _text("config.toml", text), RUN, refused=True)
        for name, text in {
            "deep": "detector = " + "[" * 5000,
            "deep table": "a" + ".a" * 5000 + " = 1",
            "long digits": "seed = " + "9" * 5000,
            "long seeds": "seed = [" + "9" * 4200 + "]",
            "long horizon": "horizon = [1, " + "9" * 4200 + "]",
            "steering key": f'"{STEERING.encode("unicode_escape").decode()}" = 1'.replace(
                "\\x", "\\u00"),
            "no TOML": "detector",
            "date": "detector = 2026-01-01",
            "infinite": "timeout = inf",
            "huge": "detector = '" + "x" * 2 * 10**6 + "'",
            "many": "".join(f"key{i} = 1\n" for i in range(9999)),
            "key of options": '"output=/tmp --param" = 1',
            "table": "[detector]\na = 1",
            "parameter": "[param]\na = " + "9" * 4200,
            "deep parameter": "detector = 'clock'\nparam = {a = " + "[" * 90 + "]" * 90 + "}",
            "empty key": '"" = 1',
            "config": 'config = "config.toml"',
        }.items()
    ),
    *(
        Case(
            f"parameter: {name}", lambda _: None,
            ("run", "--detector", "comb", "--env", "cartpole", "--anomaly", "iid", "--split",
             "split", "--output", "out", "--param", text), refused=True,
        )
        for name, text in {
            "deep": "a=" + "[" * 10**5,
            "long digits": "a=" + "9" * 5000,
            "long": "a=" + "9" * 4200,
            "infinite": "a=1e999",
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
    "nothing": {},
    "no metadata": {"entry_points.txt": POINTS},
    "empty": {"METADATA": b"", "entry_points.txt": POINTS},
    "no name": {"METADATA": b"Metadata-Version: 2.1\nVersion: 1.0\n", "entry_points.txt": POINTS},
    "no version": {"METADATA": b"Metadata-Version: 2.1\nName: x\n", "entry_points.txt": POINTS},
    "no UTF-8": {"METADATA": b"\xff\xfe\x00" * 99, "entry_points.txt": POINTS},
    "no UTF-8 in name": {"METADATA": b"Name: \xff\xfe\nVersion: 1\n", "entry_points.txt": POINTS},
    "steering name": {
        "METADATA": f"Name: x{STEERING}\nVersion: 1\n".encode(), "entry_points.txt": POINTS,
    },
    "steering version": {
        "METADATA": f"Name: x\nVersion: 1{STEERING}\n".encode(), "entry_points.txt": POINTS,
    },
    "long name": {"METADATA": b"Name: " + b"x" * 10**6 + b"\n", "entry_points.txt": POINTS},
    "points without value": {"METADATA": SOUND, "entry_points.txt": b"[oodd_eval]\nbroken\n"},
    "points are no UTF-8": {"METADATA": SOUND, "entry_points.txt": b"[oodd_eval]\n\xff\xfe = a\n"},
    "points without section": {"METADATA": SOUND, "entry_points.txt": b"a = b\n"},
    "points are garbled": {"METADATA": SOUND, "entry_points.txt": b"[oodd_eval]\na = :: ) (\n"},
    "point has no name": {"METADATA": SOUND, "entry_points.txt": b"[oodd_eval]\n = oodd_broken\n"},
    "steering point": {
        "METADATA": SOUND, "entry_points.txt": f"[oodd_eval]\nb{STEERING[:9]} = x\n".encode(),
    },
    "steering module": {
        "METADATA": SOUND, "entry_points.txt": f"[oodd_eval]\nb = x{STEERING[:9]}\n".encode(),
    },
    "no module": {"METADATA": SOUND, "entry_points.txt": POINTS},
    "other group": {"METADATA": SOUND, "entry_points.txt": b"[console_scripts]\nbroken\n"},
    "bytes": {"METADATA": SOUND, "entry_points.txt": bytes(range(256)) * 99},
    "huge": {"METADATA": SOUND, "entry_points.txt": POINTS + b"# x\n" * 10**7},
}  # fmt: skip
"""Files of a ``.dist-info`` directory, by what is wrong with it."""


def _distribution(name):
    def prepare(place):
        info = place / "plugins" / "oodd_broken-1.0.dist-info"
        info.mkdir(parents=True)
        for file, content in METADATA_OF[name].items():
            (info / file).write_bytes(content)

    return prepare


_BROKEN_USES = (
    ("list", "detectors"),
    ("list", "envs"),
    ("info", "pe"),
    ("run", "--detector", "clock", "--env", "cartpole", "--anomaly", "iid", "--split", "split",
     "--output", "out"),
)  # fmt: skip

DISTRIBUTIONS = [
    Case(f"metadata: {name}: {' '.join(use[:2])}", _distribution(name), use, plugins=True)
    for name in METADATA_OF
    for use in _BROKEN_USES
]


# What steers a terminal, wherever a text may come from.


def _plugin(code, **settings):
    return lambda place: write_plugin(place / "plugins", "steers", code, **settings)


STEERS = f'''
S = {STEERING!r}
class Steers(Good):
    """What {{}} this does."""
    def fit(self, nominal):
        print(S); print(S, file=sys.stderr)
        raise ValueError(S)
@hookimpl
def oodd_detectors(): return offer(steers=Steers)
'''.replace("{}", STEERING.encode("unicode_escape").decode())

_RUN_STEERS = (
    "run", "-v", "--detector", "steers", "--env", "cartpole", "--anomaly", "iid", "--split",
    "split", "--output", "out",
)  # fmt: skip


def _steering_name(place):
    shutil.copytree(place / "logs/train", place / f"logs/{STEERING}")


def _steering_records(place):
    path = place / "results/records.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    for line in lines:
        line |= {"reason": STEERING, "status": "error", "metrics": {}, "per_trajectory": {}}
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def _steering_trust(place):
    grant = {
        "entry": "0" * 64, "trust": STEERING, "by": STEERING, "day": STEERING, "how": STEERING,
    }  # fmt: skip
    text = json.dumps({"schema": 1, "grants": {STEERING: grant}})
    (place / "board/trust.json").write_text(text)


TERMINAL = [
    Case("terminal: exceptions and prints", _plugin(STEERS), _RUN_STEERS, plugins=True),
    Case("terminal: info of a plug-in", _plugin(STEERS), ("info", "steers"), plugins=True),
    Case("terminal: check", _plugin(STEERS), ("check", "steers", "-k", "fit"), plugins=True),
    Case(
        "terminal: an exception at import", _plugin(f"raise ValueError({STEERING!r})"),
        ("list", "detectors"), plugins=True,
    ),
    Case(
        "terminal: a summary",
        _plugin(f"@hookimpl\ndef oodd_detectors(): return [DetectorSpec('a', Good, {STEERING!r})]"),
        ("list", "detectors"), plugins=True,
    ),
    Case(
        "terminal: the docstring of a maker",
        _plugin(f"def oodd_detector_from_spec(spec): return None\n"
                f"oodd_detector_from_spec.__doc__ = {STEERING!r}\n"
                "oodd_detector_from_spec = hookimpl(oodd_detector_from_spec)"),
        ("list", "detectors"), plugins=True,
    ),
    Case("terminal: a name", lambda _: None, ("info", STEERING)),
    Case("terminal: an option", lambda _: None, (f"--{STEERING}",)),
    Case("terminal: a command", lambda _: None, (STEERING,)),
    Case("terminal: a detector", lambda _: None, ("run", "--detector", STEERING, "--env", "ant")),
    Case("terminal: an expression", lambda _: None,
         (*_BROKEN_USES[-1], "-k", f"iid and {STEERING}")),
    Case("terminal: a directory", lambda _: None, ("show", STEERING)),
    Case("terminal: names of files", _steering_name, ("data", "inspect", "-v", "logs")),
    Case("terminal: a file with a wrong row", lambda place: (
        _steering_name(place),
        (place / f"logs/{STEERING}/run-0.csv").write_text("time,a\n0,1,2,3\n"),
    ), ("data", "inspect", f"logs/{STEERING}")),
    Case("terminal: columns", _text("logs/train/run-0.csv", f"time,{STEERING},b\n0,1,2\n1,2,3\n"),
         ("data", "inspect", "logs/train")),
    Case("terminal: cells", _text("logs/train/run-0.csv", f"time,a,b\n0,{STEERING},2\n1,2,3\n"),
         ("data", "inspect", "logs/train")),
    Case("terminal: records", _steering_records, ("show", "results")),
    Case("terminal: records as a table", _steering_records, ("show", "results", "--markdown")),
    Case("terminal: records placed", _steering_records, ("leaderboard", "place", "results")),
    Case("terminal: records submitted", _steering_records,
         ("leaderboard", "submit", "results", "--results", "new", "--split", "split")),
    Case("terminal: grants", _steering_trust, ("leaderboard", "verify", "board/results")),
    Case("terminal: grants of a build", _steering_trust,
         ("leaderboard", "build", "board/results", "--output", "built")),
    Case("terminal: an address", lambda _: None, ("data", "fetch", f"http://{STEERING}/a")),
    Case("terminal: a title", lambda _: None,
         ("leaderboard", "submit", "results", "--results", "new", "--split", "split", "--title",
          STEERING)),
]  # fmt: skip
"""Texts of strangers that are printed, each with what steers a terminal."""


# Hostile plug-ins: what they do, and when.

_ANYWHERE = {
    "ValueError": "raise ValueError('no')",
    "steering error": f"raise ValueError({STEERING!r} * 99)",
    "surrogate error": "raise ValueError('\\ud800')",
    "silent error": "raise type('E', (Exception,), {'__str__': lambda s: 1 / 0})()",
    "leaving error": "raise type('E', (Exception,), {'__str__': lambda s: os._exit(7)})()",
    "huge error": "raise ValueError('x' * 10**8)",
    "BaseException": "raise BaseException('no')",
    "SystemExit": "raise SystemExit(0)",
    "SystemExit of text": "raise SystemExit('no')",
    "KeyboardInterrupt": "raise KeyboardInterrupt",
    "GeneratorExit": "raise GeneratorExit",
    "StopIteration": "raise StopIteration",
    "MemoryError": "raise MemoryError",
    "recursion": "def f(): return f()\nf()",
    "group of errors": "raise BaseExceptionGroup('no', [ValueError('a'), KeyboardInterrupt()])",
    **{f"exit code {code}": f"os._exit({code})" for code in (0, 1, 159, 160, 200, 255)},
    **{
        f"signal {name}": f"os.kill(os.getpid(), signal.{name})"
        for name in ("SIGKILL", "SIGSEGV", "SIGABRT", "SIGTERM", "SIGPIPE", "SIGRTMIN + 3")
    },
    "stops": "os.kill(os.getpid(), signal.SIGSTOP)",
    "hangs": "time.sleep(600)",
    "spins": "while True: pass",
    "holds the lock": "import ctypes\nctypes.PyDLL(None).sleep(600)",
    "deaf": "for n in range(1, 65):\n    try: signal.signal(n, signal.SIG_IGN)\n"
            "    except (OSError, ValueError): pass\ntime.sleep(600)",
    "floods": "for _ in range(300): os.write(1, b'x' * 99999); os.write(2, b'y' * 99999)",
    "closes descriptors": "os.closerange(0, 99)",
    "closes descriptors and goes on": "os.closerange(3, 99)\ntime.sleep(600)",
    "daemon": "subprocess.Popen(['sleep', '600'], start_new_session=True)",
    "forks": "for _ in range(20):\n    if os.fork() == 0: time.sleep(600)",
    "forks and leaves": "if os.fork() == 0: time.sleep(600)\nos._exit(0)",
    "thread": "threading.Thread(target=time.sleep, args=(600,)).start()",
    "memory": "x = bytearray(2 * 10**9)\nx[::4096] = b'x' * len(x[::4096])\ntime.sleep(600)",
    "pipe in its directory": "os.mkfifo('pipe')\nopen('pipe').read()",
    "no environment": "os.environ.clear()",
    "no streams": "sys.stdout = sys.stderr = None",
    "no modules": "sys.modules.clear()",
    "no json": "json.dumps = json.loads = None",
    "other directory": "os.chdir('/')",
    "no limits of recursion": "sys.setrecursionlimit(10**6)",
    "garbage as messages": "for d in range(3, 40):\n    try: os.write(d, b'\\xff' * 999)\n"
                           "    except OSError: pass",
}  # fmt: skip
"""What code of a plug-in does, by name."""

_RETURNS = {
    "nothing": "return None", "text": "return 'x'", "truth": "return True",
    "itself": "return self", "objects": "return np.array([{}, 1], dtype=object)",
    "NaN": "return np.full(len(x.observations), np.nan)",
    "infinite": "return np.full(len(x.observations), np.inf)",
    "too many": "return np.zeros(len(x.observations) + 1)",
    "two columns": "return np.zeros((len(x.observations), 2))",
    "texts": "return np.array(['a'] * len(x.observations))",
    "whole numbers": "return np.zeros(len(x.observations), int)",
    "huge": "return np.zeros(10**8)",
    "list": "return [0.0] * len(x.observations)",
}  # fmt: skip

_ROWS = {
    "nothing": "return None", "text": "return 'x'", "itself": "return self", "NaN": "return np.nan",
    "complex": "return 1j", "array": "return np.zeros(9)", "huge": "return 10**400",
    "no float": "return type('F', (float,), {'__float__': lambda s: 1 / 0})()",
    "late": "self.n = getattr(self, 'n', 0) + 1\nif self.n > 50: raise ValueError('late')",
}  # fmt: skip

_STATES = {
    "nothing": "return None", "text": "return 'x'", "objects": "return {'a': object()}",
    "object array": "return {'a': np.array([{}], dtype=object)}", "no text": "return {1: 2.0}",
    "steering": f"return {{{STEERING!r}: 1.0}}", "NaN": "return {'a': float('nan')}",
    "many": "return {f'a{i}': 1.0 for i in range(10**5)}",
    "huge": "return {'a': np.zeros(7 * 10**7)}",
    "deep": "x = []\nfor _ in range(10**5): x = [x]\nreturn {'a': x}",
    "itself": "x = {}\nx['a'] = x\nreturn x",
    "path": "return {'../../x': np.zeros(2)}",
}  # fmt: skip

PHASES = {
    "import": (_ANYWHERE, ""),
    "factory": (_ANYWHERE, "def __init__(self, *, seed=0, horizon=1):\n{}"),
    "fit": (_ANYWHERE, "def fit(self, nominal):\n{}"),
    "score": (_ANYWHERE | _RETURNS, "def score(self, x):\n{}"),
    "state": (_ANYWHERE | _STATES,
              "def state(self):\n{}\n    return {{'a': 1.0}}\ndef restore(self, state): pass"),
    "restore": (_ANYWHERE, "def state(self): return {{'a': 1.0}}\ndef restore(self, state):\n{}"),
    "update": (_ANYWHERE | _ROWS,
               "def reset(self): pass\ndef update(self, x, action=None):\n{}\n    return 1.0"),
    "explain": (_ANYWHERE | _RETURNS, "def explain(self, x):\n{}"),
    "exit": (_ANYWHERE, """def fit(self, nominal): import atexit; atexit.register(self.last)
def last(self):\n{}"""),
}  # fmt: skip
"""When it does so: behaviours, and the method of a detector that has them."""


def hostile(phase, names):
    """Return the code of a plug-in: a detector for each behaviour, named after its place."""
    behaviours, method = PHASES[phase]
    classes = [SIMPLE.replace("good=Good", "nice=Good")] if phase == "import" else []
    for i, name in enumerate(names):
        body = _indented(behaviours[name])
        if phase == "import":
            continue
        code = method.format(body)
        if phase in {"score", "state"}:
            code += "\n    " + "return super().score(x)" * (phase == "score")
        classes.append(f"class Bad{i}(Good):\n{_indented(code)}\n")
    if phase == "import":
        # The command, which trusts plug-ins of a plain run, is left alone.
        (name,) = names
        guarded = f"if 'OODD_EVAL_PROCESS' in os.environ:\n{_indented(behaviours[name])}\n"
        return guarded + "@hookimpl\ndef oodd_detectors(): return offer(bad0=Good)\n"
    offers = ", ".join(f"bad{i}=Bad{i}" for i in range(len(names)))
    return "\n".join(classes) + f"\n@hookimpl\ndef oodd_detectors(): return offer({offers})\n"


def _indented(code):
    return "\n".join(f"    {line}" for line in code.split("\n"))


@dataclass(frozen=True)
class Hostile:
    """A run of hostile detectors of one phase beside an honest one.

    Nothing may be lost: every detector has its records, the honest one those that it has alone.
    """

    phase: str
    names: tuple[str, ...]
    sandbox: bool = False

    @property
    def name(self):
        """What messages call it."""
        where = ", sandboxed" if self.sandbox else ""
        return f"hostile in {self.phase}{where}: {', '.join(self.names)}"

    def play(self, ground, home):
        """Return what is wrong with the end of the run."""
        home.mkdir()
        (home / "split").symlink_to(ground.home / "split")
        plugins = home / "plugins"
        write_plugin(plugins, "hostile", hostile(self.phase, self.names))
        write_plugin(plugins, "honest", SIMPLE)
        detectors = ["good", *(f"bad{i}" for i in range(len(self.names)))]
        arguments = [
            "run", "--detector", ",".join(detectors), "--env", "cartpole", "--split", "split",
            "--timeout", "8s", "--memory", "1500MB", "--jobs", "2", "--output", "out",
            *["--sandbox"] * self.sandbox,
        ]  # fmt: skip
        problems, start = [], program("streamed" if self.phase == "update" else "")
        # The second time a fit that was kept is restored.
        for anomaly in ("iid", "gravity") if self.phase in {"state", "restore"} else ("iid",):
            ended = run(
                home, *arguments, "--anomaly", anomaly, start=start, plugins=[plugins],
                limit=90 + 25 * len(self.names),
            )  # fmt: skip
            said = f"{ended.code}, {ended.output[-900:]}"
            problems += [f"{problem}: {said}" for problem in (*ended.problems, *left(home))]
            problems += [f"{problem}: {said}" for problem in self._lost(home, detectors, anomaly)]
        shutil.rmtree(home, ignore_errors=True)
        return problems

    def _lost(self, home, detectors, anomaly):
        file = home / "out/records.jsonl"
        lines = file.read_text().splitlines() if file.exists() else []
        records = [json.loads(line) for line in lines]
        status = {r["detector"]: r["status"] for r in records if r["anomaly"] == anomaly}
        for i, detector in enumerate(detectors):
            if detector not in status:
                what = self.names[i - 1] if i else "the honest one"
                yield f"no record of {what}"
        if status.get("good", "ok") != "ok":
            yield f"the honest one ended as {status['good']}"


def hostile_runs(seed=1, size=12, *, sandbox=False):
    """All hostile runs: of each phase all behaviours, some of them in one run."""
    rng, runs = random.Random(seed), []
    for phase, (behaviours, _) in PHASES.items():
        names = [*behaviours]
        rng.shuffle(names)
        number = 1 if phase == "import" else size
        runs += [
            Hostile(phase, tuple(names[i : i + number]), sandbox)
            for i in range(0, len(names), number)
        ]
    return runs


# Kills at random moments, and full disks.

KILLED = {
    "run": ("run", "-q", "--detector", "persistence,random,clock", "--env", "cartpole", "--split",
            "split", "--jobs", "2", "--output", "out"),
    "run --sandbox": ("run", "-q", "--detector", "persistence,random", "--env", "cartpole",
                      "--split", "split", "--jobs", "2", "--output", "out", "--sandbox"),
    "import": RECIPE,
    "submit": ("leaderboard", "submit", "results", "--results", "new", "--id", "other",
               "--split", "split", "--scores"),
    "build": ("data", "build", "small", "--train", "2", "--calibration", "2", "--test", "2",
              "--cap", "60", "--seed-base", "850", "--env", "cartpole", "--jobs", "1",
              "--output", "built"),
    "leaderboard build": ("leaderboard", "build", "board/results", "--output", "board"),
    "scan": ("scan", "logs", "--recipe", "logs/recipe.toml", "--json", "scan.json", "--html",
             "scan.html"),
    "fetch": ("data", "fetch", "split", "--output", "fetched"),
    "export": ("data", "export", "split", "--format", "minari", "--output", "exported"),
    "rerun": ("leaderboard", "rerun", "board/results/mine", "--detector", "persistence", "--jobs",
              "1", "--output", "again"),
    "watchdog": ("--output", "arm.npz"),
}  # fmt: skip
"""Commands that are killed, and programs."""


@dataclass(frozen=True)
class Killed:
    """A command that is killed at a moment, a share of the time that it takes, and runs again."""

    command: str
    moment: float

    @property
    def name(self):
        """What messages call it."""
        return f"kill of {self.command} at {self.moment:.2f}"

    def play(self, ground, home):
        """Return what is wrong: what the kill leaves running, what the next command leaves."""
        arguments = KILLED[self.command]
        whole, place = ground.copy(home / "whole"), ground.copy(home / "killed")
        start = program(self.command)
        once = run(whole, *arguments, start=start, limit=300)
        after = max(0.1, self.moment * once.seconds)
        ended = run(place, *arguments, start=start, kill_after=after)
        problems = [p for p in left(place) if p.startswith("process")]
        problems += [f"traceback: {ended.output}"] * ("Traceback" in ended.output)
        again = run(place, *arguments, start=start, limit=300)
        refused = again.code == 4 and "exists" in again.output  # what was finished is there
        if again.code != once.code and not (refused and self.command in {"export", "submit"}):
            problems.append(f"again: {again.code}, at once: {once.code}: {again.output[-600:]}")
        problems += [*again.problems, *left(place)]
        names = [{str(p.relative_to(d)) for p in _results(d)} for d in (whole, place)]
        if names[0] != names[1] and not refused:
            problems.append(f"other files: {sorted(names[0] ^ names[1])[:9]}")
        shutil.rmtree(home, ignore_errors=True)
        return problems


def _results(home):
    """Files below a directory, but for logs of the run and what is kept to go on."""
    return [p for p in home.rglob("*") if p.is_file() and "logs" not in p.parts[-3:]]


def kills(number, seed=1):
    """So many kills, their moments drawn."""
    rng = random.Random(seed)
    commands = itertools.islice(itertools.cycle(KILLED), number)
    return [Killed(command, rng.uniform(0.05, 1.0)) for command in commands]


@dataclass(frozen=True)
class Full:
    """A command on a disk with room for so many bytes."""

    command: str
    room: int

    @property
    def name(self):
        """What messages call it."""
        return f"full disk of {self.room} bytes: {self.command}"

    def play(self, ground, home):
        """Return what is wrong with how the command ends."""
        place = ground.copy(home)
        arguments = [str(a) for a in KILLED[self.command]]
        disk = place / "disk"
        disk.mkdir()
        i = arguments.index("--results" if self.command == "submit" else "--output") + 1
        arguments[i] = "disk/out"
        mounted = f'mount -t tmpfs -o size={self.room} tmpfs disk && exec "$@"'
        prefix = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mounted, "-")
        ended = run(place, *arguments, start=program(self.command), prefix=prefix, limit=300)
        problems = [f"{problem}: {ended.output[-600:]}" for problem in ended.problems]
        if ended.code not in {None, 0, 1, 4}:
            problems.append(f"exit code {ended.code}: {ended.output[-600:]}")
        problems += left(place)
        shutil.rmtree(place, ignore_errors=True)
        return problems


ROOMS = (4096, 16384, 65536, 200_000)
FULL = [
    Full(command, room)
    for command in KILLED
    if command not in {"run --sandbox", "scan"}
    for room in ROOMS
]
"""Commands on full disks."""


def can_mount():
    """Whether this user may mount a file system, in a name space."""
    command = [
        "unshare",
        "--user",
        "--map-root-user",
        "--mount",
        "mount",
        "-t",
        "tmpfs",
        "t",
        "/mnt",
    ]
    return shutil.which("unshare") and subprocess.run(command, check=False).returncode == 0

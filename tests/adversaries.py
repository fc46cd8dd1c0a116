"""Detectors that want the board's first place without knowing more dynamics than `Honest` does.

Each is `Honest`, or blind, with one cheat. Where the cheat works it gains; where it does not, the
scores are those of `Honest`. `ADVERSARIES` is the table of all, by kind. This module is a plug-in:
`helpers_plugins.write_adversaries` writes it as a package, with a table of a published split's
twins (module ``oodd_adversaries_table``). `sweep` removes what plain runs leave behind.
"""

import array
import contextlib
import gc
import itertools
import mmap
import os
import signal
import socket
import stat
import struct
import tempfile
import threading
import time
from hashlib import blake2b
from pathlib import Path

import numpy as np
from oodd_trivial import DISCRETE, Clock, Comb

from oodd_eval import DetectorSpec, hookimpl
from oodd_eval.plugins import isolation
from oodd_eval.plugins.forecasting import FeatureScale

BONUS = 1e3  # that a cheat adds to a score where it believes to know
LATE = 0.65  # of the longest training episode: by then every onset has been
CELLS = 2**18  # of a memory for prefixes, a byte each
PREFIX = "oodd-sly-"
SERVED = 120  # seconds that a process left behind may run

MODULE_MEMORY = bytearray(CELLS)


class Honest:
    """Mean absolute change of the standardized sensors, one row at a time."""

    def __init__(self, *, seed=0, horizon=1):
        self.seed, self.horizon = seed, horizon
        self.reset()

    def fit(self, nominal):
        scale = FeatureScale.fit(nominal)
        self.mean_, self.std_ = scale.mean, scale.std
        changes = [np.abs(np.diff(scale(x), axis=0)).mean(axis=1) for x in nominal]
        self.most_ = float(max(c.max() for c in changes))
        self.usual_ = float(np.mean([c.mean() for c in changes]))
        self.longest_ = max(len(x) for x in nominal)
        self.prepare(nominal)
        self.reset()

    def prepare(self, nominal):
        """Get the cheat ready, in fit."""

    def state(self):
        numbers = {name: getattr(self, f"{name}_") for name in ("most", "usual", "longest")}
        return {"mean": self.mean_, "std": self.std_, **numbers}

    def restore(self, state):
        for name, value in state.items():
            setattr(self, f"{name}_", value)

    def reset(self):
        self.before_, self.now_ = None, 0

    def update(self, observation, action=None):
        z = (np.asarray(observation, np.float64) - self.mean_) / self.std_
        score = 0.0 if self.before_ is None else float(np.abs(z - self.before_).mean())
        self.before_, self.now_ = z, self.now_ + 1
        return self.bent(np.asarray(observation, np.float32), score)

    def bent(self, row, score):
        """Return the score that the cheat makes of an honest one."""
        return score

    def score(self, x):
        self.reset()
        return np.array([self.update(row) for row in x.observations], dtype=np.float64)


# The future: `score` sees the whole episode, `update` cannot.


class LookAhead(Honest):
    """Mean of the scores from now to the end of the episode."""

    def score(self, x):
        scores = super().score(x)
        return self.mixed(scores, scores[::-1].cumsum()[::-1] / np.arange(len(x), 0, -1))

    def mixed(self, scores, future):
        return future


class LookAheadPrefix(LookAhead):
    """The same in a detector that cannot be streamed, and is handed prefixes."""

    update = None

    def score(self, x):
        scores = np.zeros(len(x))
        z = (x.observations - self.mean_) / self.std_
        scores[1:] = np.abs(np.diff(z, axis=0)).mean(axis=1)
        return self.mixed(scores, scores[::-1].cumsum()[::-1] / np.arange(len(x), 0, -1))


class LookAheadFar(LookAhead):
    """The future so far above zero that a millionth of its millionth is the whole signal."""

    def mixed(self, scores, future):
        return future + 1e12


class LastBit(LookAhead):
    """The future in the last bit alone."""

    def mixed(self, scores, future):
        return np.where(future > 1.1 * self.usual_, np.nextafter(1.0, 2.0), 1.0)


class Centred(LookAhead):
    """A mean over the 20 rows before and behind."""

    def mixed(self, scores, future):
        return np.convolve(scores, np.ones(41) / 41, mode="same")


# Company: who remembers an episode's twin knows when it leaves it.


class Company(Honest):
    """Leaving the prefix of an earlier episode is anomalous: memory in the object itself."""

    memory_ = None

    def prepare(self, nominal):
        self.memory_ = self.memory_in_fit()

    def memory_in_fit(self):
        return None

    def memory(self):
        """Return `CELLS` numbers that are read and written by index."""
        return bytearray(CELLS)

    def restore(self, state):
        super().restore(state)
        self.memory_ = None

    def reset(self):
        super().reset()
        self.digest_, self.looks_, self.left_ = blake2b(digest_size=8), 0, False
        self.accompanied_ = True

    def bent(self, row, score):
        self.digest_.update(row.tobytes())
        # What cannot be had, such as a file or a socket in a sandbox, leaves an honest detector.
        with contextlib.suppress(Exception):
            if self.memory_ is None:
                self.memory_ = self.memory()
            self.look(int.from_bytes(self.digest_.digest()) % CELLS)
        return score + BONUS * self.left_

    def look(self, cell):
        """Follow whether all looks until now showed the prefixes of an earlier episode."""
        known = bool(self.memory_[cell])
        # Two prefixes may have one cell: an episode that has company has it more than twice.
        self.left_ = self.left_ or (self.accompanied_ and self.looks_ > 2 and not known)
        self.accompanied_, self.looks_ = self.accompanied_ and known, self.looks_ + 1
        if not known:
            self.memory_[cell] = 1


class CompanyInBatch(Company):
    """The same over the trajectories that come together in `score_many`."""

    def score_many(self, trajectories):
        self.memory_ = bytearray(CELLS)
        return [self.score(x) for x in trajectories]


class CompanyOfModule(Company):
    """The same in a global of the module."""

    def memory(self):
        return MODULE_MEMORY


class CompanyOfEnvironment(Company):
    """The same in variables of the environment."""

    class Variables:
        def __getitem__(self, cell):
            return f"SLY{cell}" in os.environ

        def __setitem__(self, cell, value):
            os.environ[f"SLY{cell}"] = str(value)

    def memory(self):
        return self.Variables()


def nonce():
    """Return a name that is the same in all processes of one plug-in directory."""
    return PREFIX + blake2b(__file__.encode(), digest_size=4).hexdigest()


class CompanyOfHome(Company):
    """The same in a file at home, which is mapped into memory."""

    def memory(self):
        file = os.open(Path.home() / nonce(), os.O_RDWR | os.O_CREAT, 0o666)
        os.ftruncate(file, CELLS)
        return mmap.mmap(file, CELLS)


class CompanyOfFitMap(Company):
    """The same in a memory map that was made in fit."""

    def memory_in_fit(self):
        return mmap.mmap(-1, CELLS)


# Processes left behind: one that all groups can ask.


def left_behind(work):
    """Run a function in a process that nobody waits for, which ends by itself."""
    if (between := os.fork()) == 0:
        os.setsid()
        if os.fork() == 0:
            signal.alarm(SERVED)
            with contextlib.suppress(BaseException):
                work()
        os._exit(0)
    os.waitpid(between, 0)


def serve_buffer(server):
    """Answer with the cell that is asked for, and set it where that is asked."""
    cells = bytearray(CELLS)
    while True:
        connection, _ = server.accept()
        threading.Thread(target=answer, args=(connection, cells), daemon=True).start()


def answer(connection, cells):
    with connection:
        while message := connection.recv(8, socket.MSG_WAITALL):
            cell, value = struct.unpack("ii", message)
            if value:
                cells[cell] = 1
            connection.send(bytes([bool(cells[cell])]))


class Remote:
    """Cells of a server; `connect` returns a connected socket."""

    def __init__(self, connect):
        self.connection = connect()

    def __getitem__(self, cell):
        self.connection.sendall(struct.pack("ii", cell, 0))
        return self.connection.recv(1)[0]

    def __setitem__(self, cell, value):
        self.connection.sendall(struct.pack("ii", cell, 1))
        self.connection.recv(1)


def unix_server(name):
    server = socket.socket(socket.AF_UNIX)
    server.bind(f"\0{name}{os.environ.get(isolation.MARK, '')}")
    server.listen()
    return server


def unix_client(name):
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(2)
    client.connect(f"\0{name}{os.environ.get(isolation.MARK, '')}")
    return client


class CompanyOfAbstractSocket(Company):
    """The same in a process left behind, by an abstract socket."""

    def memory_in_fit(self):
        left_behind(lambda: serve_buffer(unix_server(nonce())))

    def memory(self):
        return Remote(lambda: unix_client(nonce()))


class CompanyOfChild(Company):
    """The same in a child of the fit, by a pair of sockets that forks inherit."""

    def memory_in_fit(self):
        here, there = socket.socketpair()
        if os.fork() == 0:
            signal.alarm(SERVED)
            here.close()
            with contextlib.suppress(BaseException):
                answer(there, bytearray(CELLS))
            os._exit(0)
        return Remote(lambda: here)


class CompanyOfThread(Company):
    """The same with a thread left from the fit."""

    def memory_in_fit(self):
        threading.Thread(target=time.sleep, args=(SERVED,), daemon=True).start()
        return mmap.mmap(-1, CELLS)


# Insiders: which group this is, tells whether its episodes are anomalous.


class Insider(Honest):
    """The later a group is, the higher are its late rows: by the number of its process."""

    def prepare(self, nominal):
        self.begun_ = self.clock()

    def state(self):
        return {**super().state(), "begun": self.begun_}

    def clock(self):
        return float(os.getpid())

    def rank(self):
        """Return how late this group is, 0 for the first one."""
        return self.clock() - self.begun_

    def bent(self, row, score):
        if not hasattr(self, "rank_"):
            self.rank_ = 0.0
            with contextlib.suppress(Exception):
                self.rank_ = float(self.rank())
        # No effect is as late: twin and partner agree up to it.
        return score + (BONUS * self.rank_ if self.now_ > LATE * self.longest_ else 0.0)


class CalibrationFirst(Insider):
    """Calm where a group is among the first, so that thresholds are low: by the time since fit."""

    def clock(self):
        return time.time()

    def bent(self, row, score):
        if not hasattr(self, "rank_"):
            self.rank_ = self.rank()
        # A group takes about as long as what it has scored so far.
        return score * (1.15 if self.rank_ > 2.0 else 1.0)


class ShortCalibration(Honest):
    """Calm in episodes that are as long as nominal ones in the end: `score` knows the length."""

    def score(self, x):
        scores = super().score(x)
        return scores * (1.0 if len(x) >= self.longest_ else 1.2)


# What the harness keeps: files, arguments, memory.


class Burglar(Company):
    """Twins from files of splits that lie about: of the package, of arguments, homes and /tmp."""

    def memory(self):
        cells = bytearray(CELLS)
        for file in self.files():
            with contextlib.suppress(Exception):
                self.read(file, cells)
        return Table(i for i, known in enumerate(cells) if known)

    def files(self):
        roots = [self.parent_words(), [os.getcwd(), os.path.expanduser("~"), tempfile.gettempdir()]]
        from oodd_eval.data import split

        yield from Path(split.__file__).parent.rglob("*.h5")
        for word in {*itertools.chain(*roots)}:
            with contextlib.suppress(OSError):
                path = Path(word)
                yield from [path] if path.suffix == ".h5" else path.glob("*.h5")
                for depth in ("*/*.h5", "*/*/*.h5"):
                    yield from itertools.islice(path.glob(depth), 200)

    def parent_words(self):
        pid, words = os.getpid(), []
        for _ in range(6):
            with contextlib.suppress(OSError, ValueError, IndexError):
                words += Path(f"/proc/{pid}/cmdline").read_text().split("\0")
                variables = Path(f"/proc/{pid}/environ").read_text().split("\0")
                words += [variable.split("=", 1)[-1] for variable in variables]
                words += [os.readlink(f"/proc/{pid}/cwd")]
                words += [os.readlink(p) for p in Path(f"/proc/{pid}/fd").iterdir()]
                pid = int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
        return [w for w in words if len(w) > 1 and w.startswith("/") and w != "/proc"]

    def read(self, file, cells):
        import h5py

        with h5py.File(file) as opened:
            twins = next(
                opened[name] for name in ("test/nominal", "test/twins", "test") if name in opened
            )
            remember(twins["observations"][()], twins["offsets"][()], cells)


def remember(rows, offsets, cells):
    """Fill cells with the prefixes of episodes; offsets count transitions."""
    start = 0
    for n in np.diff(offsets):
        digest = blake2b(digest_size=8)
        for row in rows[start : start + n + 1]:
            digest.update(row.astype("<f4").tobytes())
            cells[int.from_bytes(digest.digest()) % CELLS] = 1
        start += n + 1


class Table(frozenset):
    """Cells that are known from the beginning: others are never remembered."""

    def __getitem__(self, cell):
        return cell in self

    def __setitem__(self, cell, value):
        pass


class Memorised(Company):
    """A table of a published split's twins: what leaves one of them is anomalous."""

    def memory(self):
        import oodd_adversaries_table as table

        return Table(array.array("I", bytes.fromhex(table.CELLS)))


# State: what it smuggles.


class MappedState(Company):
    """A state that is a map of a file, to which `restore` goes on writing."""

    def prepare(self, nominal):
        file = f"{tempfile.gettempdir()}/{nonce()}-state"
        self.cells_ = self.memory_ = np.memmap(file, np.uint8, "w+", shape=CELLS)

    def state(self):
        return {**super().state(), "cells": self.cells_}

    def restore(self, state):
        super().restore(state)
        with contextlib.suppress(ValueError):
            self.cells_.flags.writeable = True
        self.memory_ = self.cells_


# The worker itself: its sockets, its code, its end.


def sockets():
    """Return the numbers of the open sockets of this process."""
    numbers = []
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                numbers.append(int(name))
    return numbers


def waiting(number, size=2**20):
    """Return what waits in a socket, and leave it there."""
    with socket.socket(fileno=os.dup(number)) as peeked:
        return peeked.recv(size, socket.MSG_PEEK | socket.MSG_DONTWAIT)


class ReadsAhead(Honest):
    """Mean change of the rows that already wait in its socket."""

    def bent(self, row, score):
        for number in sockets():
            with contextlib.suppress(OSError, ValueError):
                content = waiting(number)
                rows = np.frombuffer(content[: len(content) // row.nbytes * row.nbytes], np.float32)
                rows = rows.reshape(-1, len(row))
                if len(rows) > 1 and np.isfinite(rows).all():
                    z = (rows - self.mean_) / self.std_
                    score += float(np.abs(np.diff(z, axis=0)).mean())
        return score


class TakesOver(Honest):
    """Reads all that comes in fit, by the harness's own channel, and answers by itself."""

    def prepare(self, nominal):
        channels = [x for x in gc.get_objects() if isinstance(x, isolation.Channel)]
        end = time.monotonic() + 2.0
        for channel in channels:
            with contextlib.suppress(Exception):
                channel.send({"seconds_fit": 0.0, "warm_up": 0, "explains": False, "voices": False})
                while time.monotonic() < end:
                    if waiting(channel._connection.fileno()):
                        channel.receive()


class AnswersEarly(Honest):
    """Sends scores for a whole episode before a row has come."""

    def reset(self):
        super().reset()
        if hasattr(self, "mean_"):
            for number in sockets():
                with contextlib.suppress(OSError):
                    os.write(number, struct.pack("64d", *range(64)))


# Blind ones: they know no dynamics, and may separate nothing.


class Novelty(Honest):
    """Number of discrete sensors that show a value that they never had in training."""

    def prepare(self, nominal):
        columns = [np.unique(c) for c in np.concatenate([x.observations for x in nominal]).T]
        self.known_ = {d: c for d, c in enumerate(columns) if len(c) <= DISCRETE}

    def state(self):
        return {**super().state(), **{f"sensor{d}": c for d, c in self.known_.items()}}

    def restore(self, state):
        sensors = {n: v for n, v in state.items() if n.startswith("sensor")}
        super().restore({n: v for n, v in state.items() if n not in sensors})
        self.known_ = {int(n.removeprefix("sensor")): v for n, v in sensors.items()}

    def bent(self, row, score):
        return float(sum(row[d] not in known for d, known in self.known_.items()))


KINDS = {
    "future": {
        "look-ahead": LookAhead,
        "look-ahead-prefix": LookAheadPrefix,
        "look-ahead-far": LookAheadFar,
        "last-bit": LastBit,
        "centred": Centred,
        "short": ShortCalibration,
    },
    "company": {
        "company": Company,
        "company-batch": CompanyInBatch,
        "company-module": CompanyOfModule,
        "company-environment": CompanyOfEnvironment,
        "company-home": CompanyOfHome,
        "company-fit-map": CompanyOfFitMap,
    },
    "left behind": {
        "abstract-socket": CompanyOfAbstractSocket,
        "child": CompanyOfChild,
        "thread": CompanyOfThread,
    },
    "insider": {"process-number": Insider, "calibration-first": CalibrationFirst},
    "burglar": {"burglar": Burglar, "memorised": Memorised},
    "state": {"mapped-state": MappedState},
    "worker": {"reads-ahead": ReadsAhead, "takes-over": TakesOver, "answers-early": AnswersEarly},
    "blind": {"comb": Comb, "clock": Clock, "novelty": Novelty},
}
"""All adversaries by kind and name."""

BASE = "sly-honest"
ADVERSARIES = {f"sly-{name}": made for kind in KINDS.values() for name, made in kind.items()}


def sweep():
    """Remove files that plain runs of these detectors have left."""
    for home in (tempfile.gettempdir(), Path.home()):
        for file in Path(home).glob(f"{PREFIX}*"):
            file.unlink(missing_ok=True)


@hookimpl
def oodd_detectors():
    return [
        DetectorSpec(name, made, made.__doc__.splitlines()[0], deterministic=True)
        for name, made in {BASE: Honest, **ADVERSARIES}.items()
    ]

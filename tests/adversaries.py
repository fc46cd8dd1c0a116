"""Detectors that want the board's first place without knowing more dynamics than `Honest` does.

Each is `Honest`, or blind, with one cheat. Where the cheat works it gains; where it does not, the
scores are those of `Honest`. `ADVERSARIES` is the table of all, by kind. This module is a plug-in:
`helpers_plugins.install_adversaries` installs it, with a table of a published split's twins where
there is one (module ``oodd_adversaries_table``). `sweep` removes what plain runs leave behind.
"""

import array
import builtins
import contextlib
import ctypes
import gc
import itertools
import mmap
import os
import pickle
import signal
import socket
import stat
import struct
import subprocess
import sys
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
SEARCH = 20.0  # seconds that a search for seeds may take

LIBC = ctypes.CDLL(None, use_errno=True)
MODULE_MEMORY = bytearray(CELLS)
IMPORT_MAP = mmap.mmap(-1, CELLS)
IMPORTED = time.time()


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

    constant = 1e12

    def mixed(self, scores, future):
        return future + self.constant


class LookAheadFarther(LookAheadFar):
    """The same where the numbers of the machine lie an eighth apart."""

    constant = 1e15


class LookAheadThreshold(LookAhead):
    """A billionth around a threshold of its own: above it where the future is unusual."""

    def mixed(self, scores, future):
        return 1.0 + 1e-9 * np.where(future > 1.1 * self.usual_, 1.0, -1.0)


class LastBit(LookAhead):
    """The future in the last bit alone."""

    def mixed(self, scores, future):
        return np.where(future > 1.1 * self.usual_, np.nextafter(1.0, 2.0), 1.0)


class Stepped(LookAhead):
    """The future behind a step so high that a thousandth of it hides everything."""

    def mixed(self, scores, future):
        return np.where(np.arange(len(scores)) < 0.3 * self.longest_, 0.0, 1e7 + 1e3 * future)


class Standardized(LookAhead):
    """Scores in units of the episode's own spread, which knows the whole episode."""

    def mixed(self, scores, future):
        return (scores - scores.mean()) / (scores.std() or 1.0) + 5000.0


class Centred(LookAhead):
    """A mean over the 20 rows before and behind."""

    def mixed(self, scores, future):
        return np.convolve(scores, np.ones(41) / 41, mode="same")


class Length(LookAhead):
    """The shorter the episode is going to be, the higher."""

    def mixed(self, scores, future):
        return scores + self.most_ * (1.0 - len(scores) / self.longest_)


class Shifted(LookAhead):
    """The score of ten rows later."""

    def mixed(self, scores, future):
        return np.concatenate([scores[10:], np.repeat(scores[-1:], 10)])[: len(scores)]


# Company: who remembers an episode's twin knows when it leaves it.


class Company(Honest):
    """Leaving the prefix of an earlier episode is anomalous: memory in the object itself."""

    every = 1  # rows from one look to the next
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
            if self.now_ % self.every == 0:
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


class CompanyOfClass(Company):
    """The same in an attribute of the class."""

    shared = bytearray(CELLS)

    def memory(self):
        return type(self).shared


class CompanyOfModule(Company):
    """The same in a global of the module."""

    def memory(self):
        return MODULE_MEMORY


class CompanyOfInterpreter(Company):
    """The same in the module `builtins`."""

    def memory(self):
        return builtins.__dict__.setdefault("_sly", bytearray(CELLS))


class CompanyOfEnvironment(Company):
    """The same in variables of the environment."""

    class Variables:
        def __getitem__(self, cell):
            return f"SLY{cell}" in os.environ

        def __setitem__(self, cell, value):
            os.environ[f"SLY{cell}"] = str(value)

    def memory(self):
        return self.Variables()


class Neighbour(Honest):
    """Distance to the nearest of the rows that were scored before, across `reset`."""

    def prepare(self, nominal):
        self.rows_ = np.empty((0, len(self.mean_)))

    restore = Honest.restore

    def bent(self, row, score):
        z = (row - self.mean_) / self.std_
        rows = getattr(self, "rows_", np.empty((0, len(z))))
        nearest = np.abs(rows - z).mean(axis=1).min() if len(rows) else 0.0
        self.rows_ = np.concatenate([rows, z[None]])[-4000:]
        return score + float(nearest)


def mapped(path):
    """Map a file of zeros into memory, made where there is none."""
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    os.ftruncate(file, CELLS)
    return mmap.mmap(file, CELLS)


def nonce():
    """Return a name that is the same in all processes of one plug-in directory."""
    return PREFIX + blake2b(__file__.encode(), digest_size=4).hexdigest()


def in_file(summary, directory):
    """Return the company that remembers in a file of a directory."""

    def memory(self):
        return mapped(os.path.join(directory(), nonce()))

    return type("CompanyInFile", (Company,), {"__doc__": summary, "memory": memory})


class CompanyOfSharedMemory(Company):
    """The same in shared memory of POSIX, by name."""

    def memory(self):
        import _posixshmem

        file = _posixshmem.shm_open(f"/{nonce()}-shm", os.O_CREAT | os.O_RDWR, mode=0o600)
        os.ftruncate(file, CELLS)
        return mmap.mmap(file, CELLS)


class CompanyOfSystemV(Company):
    """The same in shared memory of System V, by key."""

    key = int(blake2b(__file__.encode(), digest_size=3).hexdigest(), 16)

    def memory(self):
        identity = LIBC.shmget(self.key, CELLS, 0o1600)
        LIBC.shmat.restype = ctypes.c_void_p
        address = LIBC.shmat(identity, None, 0)
        if identity < 0 or address == ctypes.c_void_p(-1).value:
            raise OSError(ctypes.get_errno(), "shmget")
        return (ctypes.c_ubyte * CELLS).from_address(address)


class CompanyOfImportMap(Company):
    """The same in a memory map that was made at import, before anything forks."""

    def memory(self):
        return IMPORT_MAP


class CompanyOfFitMap(Company):
    """The same in a memory map that was made in fit."""

    def memory_in_fit(self):
        return mmap.mmap(-1, CELLS)


class CompanyOfParent(Company):
    """The same in the memory of the process that forked this one."""

    def memory_in_fit(self):
        self.anchor_ = ctypes.create_string_buffer(CELLS)
        return ParentMemory(ctypes.addressof(self.anchor_))


class ParentMemory:
    """Cells at an address of the parent, read and written from outside."""

    def __init__(self, address):
        self.address = address
        for call in (LIBC.process_vm_readv, LIBC.process_vm_writev):
            call.argtypes = [ctypes.c_int, *[ctypes.c_void_p, ctypes.c_ulong] * 2, ctypes.c_ulong]

    def _moved(self, call, cell, byte):
        there = (ctypes.c_void_p * 2)(self.address + cell, 1)
        here = (ctypes.c_void_p * 2)(ctypes.addressof(byte), 1)
        if call(os.getppid(), here, 1, there, 1, 0) != 1:
            raise OSError(ctypes.get_errno(), "process_vm")
        return byte.value

    def __getitem__(self, cell):
        return self._moved(LIBC.process_vm_readv, cell, ctypes.c_ubyte())

    def __setitem__(self, cell, value):
        self._moved(LIBC.process_vm_writev, cell, ctypes.c_ubyte(1))


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


def serve_buffer(server, cells=None):
    """Answer with the cell that is asked for, and set it where that is asked."""
    cells = bytearray(CELLS) if cells is None else cells
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


def tcp_server():
    return socket.create_server(("127.0.0.1", CompanyOfTcp.port), reuse_port=True)


class CompanyOfAbstractSocket(Company):
    """The same in a process left behind, by an abstract socket."""

    def memory_in_fit(self):
        left_behind(lambda: serve_buffer(unix_server(nonce())))

    def memory(self):
        return Remote(lambda: unix_client(nonce()))


class CompanyOfTcp(Company):
    """The same in a process left behind, by TCP on this machine."""

    port = 20_000 + int(blake2b(__file__.encode(), digest_size=2).hexdigest(), 16) % 20_000

    def memory_in_fit(self):
        left_behind(lambda: serve_buffer(tcp_server()))

    def memory(self):
        return Remote(lambda: socket.create_connection(("127.0.0.1", self.port), timeout=2))


class CompanyOfMarkless(CompanyOfAbstractSocket):
    """The same in a process that has dropped its environment, so that no mark gives it away."""

    def memory_in_fit(self):
        code = (
            f"import sys; sys.path[:0] = {sys.path!r}; "
            "import signal, socket, oodd_adversaries as a;"
            f"signal.alarm({SERVED}); s = socket.socket(socket.AF_UNIX);"
            f"s.bind(chr(0) + {nonce()!r} + 'markless'); s.listen(); a.serve_buffer(s)"
        )
        command = [sys.executable, "-c", code]
        subprocess.Popen(command, env={}, start_new_session=True)
        time.sleep(1.0)

    def memory(self):
        client = socket.socket(socket.AF_UNIX)
        client.settimeout(2)
        client.connect(f"\0{nonce()}markless")
        return Remote(lambda: client)


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


class CompanyOfDescriptor(Company):
    """The same in a file without a name, opened by way of /proc in a process left behind."""

    def memory_in_fit(self):
        file = os.memfd_create(nonce())
        left_behind(lambda: time.sleep(SERVED) if file else None)
        os.close(file)

    def memory(self):
        for link in Path("/proc").glob("[0-9]*/fd/*"):
            with contextlib.suppress(OSError):
                if nonce() in str(link.readlink()):
                    return mapped(str(link))
        raise FileNotFoundError


class CompanyOfSignals(Company):
    """The same in a process left behind that is told by queued signals, and tells by a file."""

    class Queue:
        def __init__(self, pid):
            self.pid = pid
            self.view = mmap.mmap(os.open(f"/proc/{pid}/fd/0", os.O_RDONLY), CELLS,
                                  prot=mmap.PROT_READ)  # fmt: skip

        def __getitem__(self, cell):
            return self.view[cell]

        def __setitem__(self, cell, value):
            if LIBC.sigqueue(self.pid, signal.SIGRTMIN + 3, ctypes.c_void_p(cell)):
                raise OSError(ctypes.get_errno(), "sigqueue")
            time.sleep(2e-4)

    def memory_in_fit(self):
        reader, writer = os.pipe()
        left_behind(lambda: self.listen(writer))
        os.close(writer)
        self.pid_ = int(os.read(reader, 20) or 0)
        os.close(reader)

    def memory(self):
        return self.Queue(self.pid_)

    def listen(self, writer):
        file = os.memfd_create("signals")
        os.ftruncate(file, CELLS)
        os.dup2(file, 0)
        cells, information = mmap.mmap(file, CELLS), (ctypes.c_int * 32)()
        wanted = {signal.SIGRTMIN + 3}
        signal.pthread_sigmask(signal.SIG_BLOCK, wanted)
        mask = (ctypes.c_ulong * 16)(1 << (signal.SIGRTMIN + 2))
        os.write(writer, str(os.getpid()).encode())
        while True:
            if LIBC.sigwaitinfo(ctypes.byref(mask), ctypes.byref(information)) > 0:
                cells[information[6]] = 1


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


class InsiderByTime(Insider):
    """The same by the time since the fit."""

    def clock(self):
        return time.time()


class InsiderByUptime(Insider):
    """The same by the uptime of the machine."""

    def clock(self):
        return float(Path("/proc/uptime").read_text().split()[0])


class InsiderByNamespace(Insider):
    """The same by numbers that the system gives one after the other: of a namespace, a socket."""

    def clock(self):
        with socket.socket() as made:
            sockets = os.fstat(made.fileno()).st_ino
        return float(sockets + os.stat("/proc/self/ns/mnt").st_ino % 2**32)


class InsiderByLastProcess(Insider):
    """The same by the number of the newest process of the machine."""

    def clock(self):
        return float(Path("/proc/loadavg").read_text().split()[-1])


class InsiderByParent(Insider):
    """The same by the processor time of the process that started this one."""

    def clock(self):
        fields = Path(f"/proc/{os.getppid()}/stat").read_text().rsplit(")", 1)[1].split()
        return float(int(fields[11]) + int(fields[12]) + int(fields[13]) + int(fields[14]))


class InsiderByCounter(Insider):
    """The same by a file in which every process counts itself."""

    def rank(self):
        with open(f"{tempfile.gettempdir()}/{nonce()}-count-{self.begun_}", "ab") as file:
            file.write(b"x")
            return float(file.tell())


class InsiderByPriority(Insider):
    """The same by the priority of its parent, which every group lowers by one."""

    def rank(self):
        parent = os.PRIO_PROCESS, os.getppid()
        os.setpriority(*parent, os.getpriority(*parent) + 1)
        return float(os.getpriority(*parent))


class InsiderByOrder(Honest):
    """Higher, late in the episode, the more episodes this object has scored."""

    def reset(self):
        super().reset()
        self.episodes_ = getattr(self, "episodes_", 0) + 1

    def bent(self, row, score):
        return score + (BONUS * self.episodes_ if self.now_ > LATE * self.longest_ else 0.0)


class InsiderBySize(Honest):
    """Lower in groups that are larger than those before: as calibration might be."""

    def score_many(self, trajectories):
        return [self.score(x) / (1.0 + len(trajectories)) for x in trajectories]


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


class Whims(Honest):
    """Scores with noise from the system: other ones in every run."""

    def bent(self, row, score):
        return score + int.from_bytes(os.urandom(4)) / 2**32 * self.most_


class Moody(Honest):
    """Scores that rise with the time of the day, second by second."""

    def bent(self, row, score):
        return score + (time.time() - IMPORTED)


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


class MindReader(Company):
    """Twins from the memory of the harness: rows that stand in it behind this episode's."""

    def prepare(self, nominal):
        super().prepare(nominal)
        self.seen_ = None

    def bent(self, row, score):
        if self.now_ == 1:
            self.left_, self.place_ = False, None
            with contextlib.suppress(Exception):
                self.place_ = self.search(row.tobytes())
        elif self.place_ is not None:
            with contextlib.suppress(OSError):
                pid, address = self.place_
                there = self.peek(pid, address + (self.now_ - 1) * row.nbytes, row.nbytes)
                self.left_ = self.left_ or there != row.tobytes()
        return score + BONUS * self.left_

    def search(self, row):
        pid = os.getppid()
        for _ in range(4):
            for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
                span, mode, *_ = line.split()
                start, end = (int(n, 16) for n in span.split("-"))
                if mode.startswith("rw") and end - start < 2**26:
                    with contextlib.suppress(OSError):
                        at = self.peek(pid, start, end - start).find(row)
                        if at >= 0:
                            return pid, start + at
            pid = int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
        return None

    @staticmethod
    def peek(pid, address, size):
        with open(f"/proc/{pid}/mem", "rb", buffering=0) as file:
            file.seek(address)
            return file.read(size)


class Tracer(MindReader):
    """The same by ptrace, as a debugger does."""

    @staticmethod
    def peek(pid, address, size):
        LIBC.ptrace.argtypes = [ctypes.c_long, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p]
        if LIBC.ptrace(0x4206, pid, None, None):  # PTRACE_SEIZE
            raise OSError(ctypes.get_errno(), "ptrace")
        try:
            return MindReader.peek(pid, address, size)
        finally:
            LIBC.ptrace(17, pid, None, None)


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


class Simulated(Memorised):
    """Twins that it simulates: it tries all seeds of splits until a training row is the same."""

    widths = {4: "cartpole", 6: "acrobot"}  # by sensors

    def prepare(self, nominal):
        self.twins_ = np.zeros(0, np.uint32)
        environment = self.widths.get(len(self.mean_))
        if environment:
            with contextlib.suppress(Exception):
                self.twins_ = self.simulated(environment, nominal[0].observations[0])

    def state(self):
        return {**super().state(), "twins": self.twins_}

    def simulated(self, environment, first):
        from oodd_recording.policies import load_policy
        from oodd_recording.record import Setup

        end, policy = time.monotonic() + SEARCH, load_policy(environment, None)
        short = Setup(environment, policy, 1)
        for base in itertools.count():
            if time.monotonic() > end or base > 900:
                return np.zeros(0, np.uint32)
            if np.array_equal(short.record(base * 10**6).trajectory.observations[0], first):
                break
        cells, setup = bytearray(CELLS), Setup(environment, policy, self.longest_ - 1)
        for i in range(30):
            rows = setup.record(base * 10**6 + 600_000 + i).trajectory.observations
            remember(rows, np.array([0, len(rows) - 1]), cells)
        return np.flatnonzero(np.frombuffer(cells, np.uint8)).astype(np.uint32)

    def memory(self):
        return Table(getattr(self, "twins_", ()))


# State: what it smuggles.


class HugeState(Company):
    """A state of a gigabyte."""

    def state(self):
        return {**super().state(), "more": np.zeros(2**27)}


class PickledState(Honest):
    """A state of Python objects."""

    def state(self):
        return {**super().state(), "objects": np.array([self, print], dtype=object)}


class CodeState(CompanyOfClass):
    """A state of bytes that `restore` loads as a pickle: code, and a memory for the groups."""

    def state(self):
        code = pickle.dumps((exec, "import builtins; builtins._sly = bytearray(2**18)"))
        return {**super().state(), "code": np.frombuffer(code, np.uint8)}

    def restore(self, state):
        state = dict(state)
        function, code = pickle.loads(np.asarray(state.pop("code")).tobytes())
        function(code)
        super().restore(state)

    def memory(self):
        return builtins._sly


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


class CountingState(Insider):
    """A state that counts how often it was asked for, in the hope that each group asks."""

    def prepare(self, nominal):
        self.asked_, self.begun_ = 0, 0.0

    def state(self):
        self.asked_ += 1
        return {**super().state(), "asked": self.asked_}

    def rank(self):
        return self.asked_


class Unscaled(Honest):
    """Mean absolute change of the sensors as they are: the honest detector that `Forgetful` is."""

    def prepare(self, nominal):
        width = len(self.mean_)
        self.mean_, self.std_ = np.zeros(width), np.full(width, 1e-3)


class Forgetful(Honest):
    """`restore` ignores the state, and makes one up."""

    def restore(self, state):
        width = len(state["mean"])
        super().restore({**state, "mean": np.zeros(width), "std": np.full(width, 1e-3)})


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
                channel.send({"seconds_fit": 0.0, "warm_up": 0, "explains": False})
                while time.monotonic() < end:
                    if waiting(channel._connection.fileno()):
                        channel.receive()


class Wiretap(Company):
    """A process left from the fit listens at the sockets of the fit, and remembers."""

    def memory_in_fit(self):
        heard = mmap.mmap(-1, 2**22)
        left_behind(lambda: self.listen(heard))
        self.heard_ = heard

    def listen(self, heard):
        written, last = 0, b""
        while written < len(heard) - 2**20:
            for number in sockets():
                with contextlib.suppress(OSError):
                    if (content := waiting(number)) and content != last:
                        heard[written : written + len(content)] = last = content
                        written += len(content)
            time.sleep(1e-4)

    def bent(self, row, score):
        heard = getattr(self, "heard_", None)
        if heard is not None and self.before_ is not None:
            with contextlib.suppress(Exception):
                at = heard.find(self.last_ + row.tobytes()) if self.now_ > 1 else 0
                other = heard.find(self.last_) if self.now_ > 1 else -1
                self.left_ = self.left_ or (at < 0 <= other)
        self.last_ = row.tobytes()
        return score + BONUS * self.left_


class AnswersItself(Honest):
    """Sends a score of its own for every row, before the one that it returns."""

    def bent(self, row, score):
        for number in sockets():
            with contextlib.suppress(OSError):
                os.write(number, struct.pack("d", score + BONUS))
        return score


class AnswersEarly(Honest):
    """Sends scores for a whole episode before a row has come."""

    def reset(self):
        super().reset()
        if hasattr(self, "mean_"):
            for number in sockets():
                with contextlib.suppress(OSError):
                    os.write(number, struct.pack("64d", *range(64)))


class OtherFrames(Honest):
    """Writes whole messages of the harness's protocol: that all is scored."""

    def bent(self, row, score):
        if self.now_ == 3:
            for number in sockets():
                message = b'{"seconds_score": 0.0, "peak_rss_mb": 1.0}'
                with contextlib.suppress(OSError):
                    os.write(number, struct.pack("!i", len(message)) + message)
        return score


class Delays(Honest):
    """Waits for the next row before it answers for this one, half a second an episode."""

    def bent(self, row, score):
        if self.now_ == 40:
            end = time.monotonic() + 0.5
            while time.monotonic() < end:
                for number in sockets():
                    with contextlib.suppress(OSError):
                        if waiting(number):
                            return score + BONUS
                time.sleep(0.01)
        return score


class Swaps(Honest):
    """Puts its own pair of sockets in place of the harness's."""

    def prepare(self, nominal):
        here, there = socket.socketpair()
        for number in sockets():
            with contextlib.suppress(OSError):
                if number not in (here.fileno(), there.fileno()):
                    os.dup2(there.fileno(), number)


class PatchesChannel(LookAhead):
    """Has the channel of its process send the scores of another function."""

    def prepare(self, nominal):
        sent, later = isolation.Channel.send_array, self

        def send_array(channel, scores):
            values = np.asarray(scores)
            if values.ndim == 1 and values.dtype == np.float64 and len(values) > 1:
                values = later.mixed(values, values[::-1].cumsum()[::-1])
            sent(channel, values)

        isolation.Channel.send_array = send_array

    score = Honest.score


class PatchesNumpy(Honest):
    """Has numpy, in its process, write other arrays."""

    def prepare(self, nominal):
        write = np.save

        def save(file, values, **more):
            values = np.asarray(values)
            if values.dtype == np.float64 and values.ndim == 1:
                values = values[::-1].cumsum()[::-1].copy()
            write(file, values, **more)

        np.save = save


class PatchesTrajectory(Honest):
    """Has the trajectories of its process keep all rows that they ever had."""

    kept = []

    def prepare(self, nominal):
        from oodd_eval.data.trajectory import Trajectory

        made, kept = Trajectory.__init__, self.kept

        def remembering(trajectory, observations, *more, **others):
            kept.append(np.array(observations))
            made(trajectory, observations, *more, **others)

        with contextlib.suppress(AttributeError, TypeError):
            Trajectory.__init__ = remembering

    def bent(self, row, score):
        for rows in self.kept[-40:]:
            match = np.flatnonzero((rows == row).all(axis=1)) if rows.shape[1:] == row.shape else ()
            if len(match) and match[0] + 1 < len(rows):
                score += float(np.abs(np.diff(rows[match[0] :], axis=0)).mean())
        return score


class PatchesHarness(Honest):
    """At import in the command's own process, counts what is not found as found."""

    patched = False

    @classmethod
    def patch(cls):
        """Patch the metrics, where they are: not in a worker."""
        module = sys.modules.get("oodd_eval.results.evaluate")
        if os.environ.get(isolation.MARK) or module is None or not os.environ.get("SLY_PATCHES"):
            return
        cls.patched = True
        for name in ("auc_matched", "matched_auc", "auc"):
            if callable(getattr(module, name, None)):
                setattr(module, name, lambda *_, **__: 1.0)


class AtExit(Honest):
    """Sends other scores when it is deleted, and at the exit of its process."""

    def prepare(self, nominal):
        import atexit

        atexit.register(self.shout)

    def shout(self):
        for number in sockets():
            with contextlib.suppress(OSError):
                os.write(number, struct.pack("8d", *[BONUS] * 8))

    def __del__(self):
        with contextlib.suppress(BaseException):
            self.shout()


class WarmUp(Honest):
    """Declares another warm-up each time it is asked, and leaves what it likes undefined."""

    asked = 0

    @property
    def warm_up(self):
        type(self).asked += 1
        return min(type(self).asked, 20)

    def bent(self, row, score):
        return float("nan") if self.now_ < 20 and score < 2 * self.usual_ else score


class LongWarmUp(Honest):
    """Leaves every row undefined that looks nominal, however late."""

    warm_up = 20

    def bent(self, row, score):
        return float("nan") if score < 3 * self.usual_ else score


class Explains(Company):
    """Remembers in `explain`, which is asked about anomalous episodes alone."""

    def explain(self, trajectory):
        self.score(trajectory)
        return np.zeros(trajectory.observations.shape)

    def memory(self):
        return mapped(f"{tempfile.gettempdir()}/{nonce()}-explained")


class HorizonTrick(Honest):
    """Leaves the first rows undefined in episodes that begin as nominal ones do."""

    warm_up = 20

    def bent(self, row, score):
        return float("nan") if self.now_ <= 20 else score


class Text(float):
    """A number that says it is another one."""

    def __float__(self):
        return 1e9

    def __lt__(self, other):
        return False


class OtherNumber(Honest):
    """Returns numbers of a class of its own, whose value changes when it is asked."""

    def update(self, observation, action=None):
        return Text(super().update(observation, action))


# Blind ones: they know no dynamics, and may separate nothing.


class Timer(Honest):
    """0 before a fixed time, 1 from then on."""

    at = 60

    def bent(self, row, score):
        return float(self.now_ > self.at)


class Survival(Honest):
    """For how long the episode has lasted, in lengths of a typical one."""

    def bent(self, row, score):
        return self.now_ / self.longest_


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
        "look-ahead-farther": LookAheadFarther,
        "look-ahead-threshold": LookAheadThreshold,
        "last-bit": LastBit,
        "stepped": Stepped,
        "standardized": Standardized,
        "centred": Centred,
        "length": Length,
        "shifted": Shifted,
        "short": ShortCalibration,
    },
    "company": {
        "company": Company,
        "company-batch": CompanyInBatch,
        "company-class": CompanyOfClass,
        "company-module": CompanyOfModule,
        "company-interpreter": CompanyOfInterpreter,
        "company-environment": CompanyOfEnvironment,
        "neighbour": Neighbour,
        "company-tmp": in_file("The same in a file of /tmp.", tempfile.gettempdir),
        "company-home": in_file("The same in a file at home.", lambda: os.path.expanduser("~")),
        "company-shm": in_file("The same in a file of /dev/shm.", lambda: "/dev/shm"),
        "company-cwd": in_file("The same in the working directory.", os.getcwd),
        "company-plugin": in_file("The same beside its code.", lambda: str(Path(__file__).parent)),
        "company-var-tmp": in_file("The same in /var/tmp.", lambda: "/var/tmp"),
        "company-posix": CompanyOfSharedMemory,
        "company-system-v": CompanyOfSystemV,
        "company-import-map": CompanyOfImportMap,
        "company-fit-map": CompanyOfFitMap,
        "company-parent": CompanyOfParent,
    },
    "left behind": {
        "abstract-socket": CompanyOfAbstractSocket,
        "tcp": CompanyOfTcp,
        "markless": CompanyOfMarkless,
        "child": CompanyOfChild,
        "thread": CompanyOfThread,
        "descriptor": CompanyOfDescriptor,
        "signals": CompanyOfSignals,
    },
    "insider": {
        "process-number": Insider,
        "time": InsiderByTime,
        "uptime": InsiderByUptime,
        "namespace": InsiderByNamespace,
        "last-process": InsiderByLastProcess,
        "parent-time": InsiderByParent,
        "counter": InsiderByCounter,
        "priority": InsiderByPriority,
        "call-order": InsiderByOrder,
        "group-size": InsiderBySize,
        "calibration-first": CalibrationFirst,
        "whims": Whims,
        "moody": Moody,
    },
    "burglar": {
        "burglar": Burglar,
        "mind-reader": MindReader,
        "tracer": Tracer,
        "memorised": Memorised,
        "simulated": Simulated,
    },
    "state": {
        "huge-state": HugeState,
        "pickled-state": PickledState,
        "code-state": CodeState,
        "mapped-state": MappedState,
        "counting-state": CountingState,
        "forgetful": Forgetful,
    },
    "worker": {
        "reads-ahead": ReadsAhead,
        "takes-over": TakesOver,
        "wiretap": Wiretap,
        "answers-itself": AnswersItself,
        "answers-early": AnswersEarly,
        "other-frames": OtherFrames,
        "delays": Delays,
        "swaps": Swaps,
        "patches-channel": PatchesChannel,
        "patches-numpy": PatchesNumpy,
        "patches-trajectory": PatchesTrajectory,
        "patches-harness": PatchesHarness,
        "at-exit": AtExit,
        "warm-up": WarmUp,
        "long-warm-up": LongWarmUp,
        "undefined": HorizonTrick,
        "explains": Explains,
        "other-number": OtherNumber,
    },
    "blind": {
        "comb": Comb,
        "timer": Timer,
        "clock": Clock,
        "novelty": Novelty,
        "survival": Survival,
    },
}
"""All adversaries by kind and name."""

BASE = "sly-honest"
HONEST = {BASE: Honest, "sly-unscaled": Unscaled}


def base_of(name):
    """Return the honest detector whose scores an adversary would have if it gained nothing."""
    return "sly-unscaled" if name == "sly-forgetful" else BASE


ADVERSARIES = {f"sly-{name}": made for kind in KINDS.values() for name, made in kind.items()}


def sweep():
    """Remove files and shared memory that plain runs of these detectors have left."""
    homes = {tempfile.gettempdir(), os.path.expanduser("~"), "/dev/shm", os.getcwd(), "/var/tmp"}
    for home in homes:
        for file in Path(home).glob(f"{PREFIX}*"):
            file.unlink(missing_ok=True)
    identity = LIBC.shmget(CompanyOfSystemV.key, CELLS, 0o600)
    if identity >= 0:
        LIBC.shmctl(identity, 0, None)


@hookimpl
def oodd_detectors():
    PatchesHarness.patch()
    return [
        DetectorSpec(name, made, made.__doc__.splitlines()[0], deterministic=True)
        for name, made in {**HONEST, **ADVERSARIES}.items()
    ]

"""A detector that writes down all that it can see from inside its worker, and who reads that.

The spy does not know what is secret, so that it cannot find what it brought itself: it copies its
memory, its objects, the frames that called it and what the system says of its process into files.
The test, outside, searches them.
"""

import json
from pathlib import Path

import numpy as np

SPY = '''
import gc, hashlib, types

OUTPUT = Path(os.environ["SPY_OUTPUT"])
OPAQUE = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.CodeType,
          types.FrameType)


def leaves(roots, skip, opaque=()):
    """Texts and numbers among objects and all that they refer to."""
    todo, texts, numbers = list(roots), set(), set()
    seen = {id(texts), id(numbers), id(todo), *map(id, skip)}
    seen.add(id(seen))
    while todo:
        x = todo.pop()
        if id(x) in seen:
            continue
        seen.add(id(x))
        kind = type(x)
        if issubclass(kind, str):
            texts.add(str(x))
        elif issubclass(kind, (bytes, bytearray)):
            texts.add(bytes(x[:100_000]).decode("latin-1"))
        elif issubclass(kind, (int, np.integer)):
            numbers.add(int(x))
        elif issubclass(kind, np.ndarray) and x.dtype.kind in "iu":
            numbers.update(map(int, x.ravel()[:100_000]))
        elif not issubclass(kind, opaque):
            todo += gc.get_referents(x)
    return {"texts": sorted(texts), "numbers": sorted(numbers)}


def locals_of_callers():
    """Values of the local variables of every frame of every thread, but for those in here."""
    found = []
    for frame in sys._current_frames().values():
        while frame:
            if frame.f_code.co_filename != __file__:
                found += frame.f_locals.values()
            frame = frame.f_back
    return found


def descriptors():
    found = []
    for place in Path("/proc/self/fd").iterdir():
        try:
            found.append(os.readlink(place))
        except OSError:
            pass  # it was the one to list the others with
    return found


def memory():
    """All writeable memory of the process, without pages of zeros."""
    parts = []
    with open("/proc/self/mem", "rb", buffering=0) as file:
        for line in Path("/proc/self/maps").read_text().splitlines():
            span, rights, *_ = line.split()
            if rights.startswith("rw") and "[v" not in line:
                start, end = (int(part, 16) for part in span.split("-"))
                try:
                    file.seek(start)
                    parts.append(file.read(end - start).strip(b"\\0"))
                except (OSError, ValueError, OverflowError):
                    pass
    return b"\\0".join(parts)


def look(when, *own):
    """Write down what can be seen now; `own` is what the detector was handed itself."""
    number = len(list(OUTPUT.glob("*.json")))
    kept = memory() if when in ("fit", "score") else b""
    (OUTPUT / f"{number}-{when}.memory").write_bytes(kept)
    seen = {
        "frames": leaves(locals_of_callers(), own, OPAQUE),
        "objects": leaves([*gc.get_objects(), *locals_of_callers()], own),
        "arguments": [*sys.argv, *sys.orig_argv, Path("/proc/self/cmdline").read_text()],
        "environment": [*map("=".join, os.environ.items()), Path("/proc/self/environ").read_text()],
        "descriptors": descriptors(),
        "directory": [os.getcwd(), *os.listdir()],
    }
    (OUTPUT / f"{number}-{when}.json").write_text(json.dumps(seen))


class Spy:
    """Looks around wherever it is called."""

    def __init__(self, *, seed=0, horizon=1):
        look("made")

    def fit(self, nominal):
        note("fit", nominal)
        look("fit")

    def state(self):
        look("state")
        return {"fit": 1}

    def restore(self, state):
        look("restore")

    def score(self, x):
        return np.abs(x.observations).sum(axis=1).astype(np.float64)

    def score_many(self, xs):
        note("score", xs)
        # Every group is scored by a process like the first two; a look takes seconds.
        order = sorted(OUTPUT.glob("*.json"), key=lambda path: int(path.name.partition("-")[0]))
        if len(order) < 2 or not all(path.stem.endswith("score") for path in order[-2:]):
            look("score")
        return [self.score(x) for x in xs]


def note(when, xs):
    """Append what arrived, in order: a digest of each trajectory, and all about its form."""
    with (OUTPUT / f"arrived.{when}").open("a") as file:
        for x in xs:
            o, a = x.observations, x.actions
            digest = hashlib.sha256(o.tobytes() + a.tobytes()).hexdigest()
            form = [str(o.dtype), str(a.dtype), str(o.flags), str(a.flags), len(o) - len(a),
                    sorted(n for n in dir(x) if not callable(getattr(type(x), n, None)))]
            file.write(json.dumps([digest, len(o), form]) + "\\n")


@hookimpl
def oodd_detectors(): return [DetectorSpec("spy", Spy, "")]
'''


class Findings:
    """What a spy wrote into a directory.

    Parameters
    ----------
    directory
        The spy's ``SPY_OUTPUT``.
    """

    def __init__(self, directory):
        looks = Path(directory).glob("*.json")
        self.looks = sorted(looks, key=lambda path: int(path.name.partition("-")[0]))
        self._directory = Path(directory)

    @property
    def whens(self):
        """When the spy looked around, in order."""
        return [path.stem.partition("-")[2] for path in self.looks]

    def arrived(self, when):
        """Digest, length and form of the trajectories that came to fit or to score."""
        lines = (self._directory / f"arrived.{when}").read_text().splitlines()
        return [json.loads(line) for line in lines]

    def places_of(self, texts=(), numbers=(), patterns=()):
        """Return where secrets were seen: ``{place: {secret, ...}}``.

        Parameters
        ----------
        texts
            Sought for, whatever their capitals, in texts and in memory.
        numbers
            Sought for among numbers.
        patterns
            Bytes, by name, sought for in memory.
        """
        found = {}
        for path in self.looks:
            seen = json.loads(path.read_text())
            for place, content in seen.items():
                whole = content["texts"] if isinstance(content, dict) else content
                text = "\n".join(whole).lower()
                here = {t for t in texts if t.lower() in text}
                if isinstance(content, dict):
                    here |= set(numbers) & set(content["numbers"])
                found.setdefault(place, set()).update(here)
            memory = path.with_suffix(".memory").read_bytes()
            here = {name for name, value in dict(patterns).items() if value in memory}
            memory = memory.lower()
            encodings = "utf-8", "utf-16-le", "utf-32-le"
            here |= {t for t in texts if any(t.lower().encode(e) in memory for e in encodings)}
            found.setdefault("memory", set()).update(here)
        return {place: secrets for place, secrets in found.items() if secrets}


def vectors(name, values):
    """Return integers one after the other, as arrays hold them, by name."""
    return {
        f"{name} as {dtype}": np.asarray(values).astype(dtype).tobytes()
        for dtype in ("int64", "int32", "float64", "float32")
    }

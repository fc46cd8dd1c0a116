"""The process that holds one detector: it receives trajectories without names and returns scores.

It never holds onsets, anomalies, twins' pairing or the name of the environment. Training
trajectories come first, in the order of the split; then, shuffled together and in chunks, the
trajectories to score. The harness starts it as ``python -m oodd_eval.plugins.isolation.worker READ_FD WRITE_FD
LIFELINE_FD``: messages have descriptors of their own, so that nothing a detector prints gets
between them, and the end of the harness is the end of its workers.
"""

from __future__ import annotations

import faulthandler
import os
import resource
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, PluginError
from oodd_eval.plugins.contract import Detector, StorableDetector
from oodd_eval.plugins.discovery import describe, discover
from oodd_eval.plugins.isolation.messages import Channel
from oodd_eval.plugins.isolation.trajectory_file import Spool


def make_detector(
    factory: Callable[..., Detector], *, seed: int, horizon: int, parameters: Mapping[str, Any]
) -> Detector:
    """Make an unfitted detector.

    Raises
    ------
    ContractError
        When the factory returns something without `fit` and `score`.
    """
    detector = factory(seed=seed, horizon=horizon, **parameters)
    if not isinstance(detector, Detector):
        raise ContractError(
            f"the factory returned {type(detector).__name__}, expected an object with the methods "
            "fit(nominal) and score(trajectory)"
        )
    return detector


def save_fitted(detector: Detector, directory: str) -> None:
    """Let a detector that can save its fit do so.

    What fails here is printed and costs a later run the time of a fit, but no score.
    """
    if directory and isinstance(detector, StorableDetector):
        try:
            detector.save(Path(directory))
        except Exception:  # noqa: BLE001  a detector may raise anything
            traceback.print_exc()
            shutil.rmtree(directory)
            Path(directory).mkdir()


def score_chunk(detector: Detector, chunk: Sequence[Trajectory]) -> list[object]:
    """Score some trajectories, all at once if the detector can; the scores are not checked yet.

    Raises
    ------
    ContractError
        When ``score_many`` returns another number of score arrays than it got trajectories.
    """
    score_many = getattr(detector, "score_many", None)
    if score_many is None:
        return [detector.score(trajectory) for trajectory in chunk]
    scores = list(score_many(chunk))
    if len(scores) != len(chunk):
        raise ContractError(
            f"score_many returned {len(scores)} score arrays, expected {len(chunk)}: one for each "
            "trajectory"
        )
    return scores


def classify(error: BaseException) -> str:
    """Return the status of a cell whose detector raised this."""
    match error:
        case MemoryError():
            return "oom"
        case NotImplementedError():
            return "incompatible"
        case ContractError():
            return "invalid"
        case ModuleNotFoundError() if not isinstance(error, PluginError):
            return "unavailable"
        case _:
            return "error"


def reason_of(error: BaseException) -> str:
    """Return one line: what was raised, and where in the detector's own code."""
    if isinstance(error, SystemExit):
        return f"called sys.exit({error.code!r})"
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return describe(error) + ("" if isinstance(error, ContractError) else place)


def peak_rss_mb() -> float:
    """Return the largest resident memory of this process so far, in MB of 10^6 bytes.

    Linux keeps it per program; getrusage would also count the harness this was started from.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        kib = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
        return int(kib) * 1024 / 1e6
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def serve(channel: Channel) -> None:
    """Fit the requested detector and score what comes until a chunk of zero."""
    request = channel.receive()
    train = Spool(channel.receive_trajectory() for _ in range(request["train"]))
    plugins = discover(only=[request["plugin"]])
    for broken in plugins.broken:
        raise PluginError(f"plug-in {broken.plugin!r} cannot be loaded: {broken.reason}")
    spec = plugins.offer(request["detector"]).spec

    start = time.perf_counter()
    detector = make_detector(
        spec.factory,
        seed=request["seed"],
        horizon=request["horizon"],
        parameters=request["parameters"],
    )
    if request["load"]:
        if not isinstance(detector, StorableDetector):
            raise ContractError("a detector that had saved itself has no load(directory) any more")
        detector.load(Path(request["load"]))
    else:
        detector.fit(train)
    seconds_fit = time.perf_counter() - start
    if not request["load"]:
        save_fitted(detector, request["save"])
    channel.send({"seconds_fit": seconds_fit, "warm_up": getattr(detector, "warm_up", 0)})

    seconds_score = 0.0
    while size := channel.receive()["score"]:
        chunk = [channel.receive_trajectory() for _ in range(size)]
        start = time.perf_counter()
        scores = score_chunk(detector, chunk)
        seconds_score += time.perf_counter() - start
        for one in scores:
            plain = isinstance(one, np.ndarray) and not one.dtype.hasobject
            channel.send({"type": "array" if plain else _kind(one)})
            if plain:
                channel.send_array(np.asarray(one))
    channel.send({"seconds_score": seconds_score, "peak_rss_mb": peak_rss_mb()})


def _kind(scores: object) -> str:
    return "ndarray of object" if isinstance(scores, np.ndarray) else type(scores).__name__


def end_with(lifeline: int) -> None:
    """Kill this process and whatever it has started when the harness is no more.

    The harness holds the other end of a pipe and never writes to it; reading ends when it closes.
    """

    def wait() -> None:
        os.read(lifeline, 1)
        os.killpg(os.getpgid(0), signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()


def main(arguments: Sequence[str]) -> NoReturn:
    """Serve one request and end the process, whatever the detector has left running."""
    reading, writing, lifeline = (int(a) for a in arguments)
    for descriptor in (reading, writing, lifeline):
        os.set_inheritable(descriptor, False)
    end_with(lifeline)
    faulthandler.enable()
    channel = Channel(reading, writing)
    code = 0
    try:
        serve(channel)
    except BaseException as error:  # noqa: BLE001  a detector may raise anything; all is reported
        traceback.print_exc()
        channel.send({"status": classify(error), "reason": reason_of(error)})
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    # Threads and exit handlers of the detector have no say any more: the scores are sent.
    os._exit(code)


if __name__ == "__main__":
    main(sys.argv[1:])

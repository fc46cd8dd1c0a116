"""A good detector, and one that is broken in one way for every check of the conformance kit."""

import contextlib
import dataclasses
import socket
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from oodd_eval import DetectorSpec, Explanation, Naming, Trajectory
from oodd_eval.errors import NotFittedError, TrajectoryError
from oodd_eval.plugins.parameters import declared_by


class Good:
    """Mean size of the change over one horizon, in whole quarters of the usual spread.

    Whole numbers, so that messages do not depend on the last digit of a computation.
    """

    def __init__(self, *, seed=0, horizon=1, power=1.0, baseline=0, roles=()):
        self.seed, self.horizon, self.power, self.baseline = seed, horizon, power, baseline
        self.std_ = None

    def fit(self, nominal, progress=None):
        rows = np.concatenate([x.observations for x in nominal]).astype(np.float64)
        std = rows.std(axis=0)
        self.std_ = np.where(std < 1e-6, 1.0, std)
        self.reset()
        for share in (0.5, 1.0) if progress else ():
            progress(share)

    def score(self, x):
        if self.std_ is None:
            raise NotFittedError("score was called before fit")
        if x.observation_dim != len(self.std_):
            raise TrajectoryError(f"fitted on {len(self.std_)} sensors, got {x.observation_dim}")
        z = x.observations / self.std_
        scores = np.full(len(x), np.nan)
        h = self.horizon
        scores[h:] = np.round(4 * self.power * np.abs(z[h:] - z[:-h]).mean(axis=1))
        if self.baseline:
            scores[self.baseline :] -= np.round(np.nanmean(scores[: self.baseline]))
        return scores

    def score_many(self, trajectories):
        return [self.score(x) for x in trajectories]

    def explain(self, x):
        """Shares of the last changes of all sensors, and an onset a row ago."""
        undefined, h = np.isnan(self.score(x)), self.horizon
        change = np.ones((len(x), x.observation_dim))
        change[h:] = np.abs(np.diff(x.observations, n=1, axis=0))[h - 1 :] / self.std_ + 1e-9
        shares = change / change.sum(axis=1, keepdims=True)
        shares[undefined] = np.nan
        onsets = np.where(undefined, -1, np.maximum(np.arange(len(x)) - 1, 0))
        return Explanation(shares, onsets, self.naming(shares[-1], x))

    def naming(self, shares, x):
        """Name the sensors with more than their part of the latest change."""
        sensors = (np.nan_to_num(shares) * len(shares) > 1) / 1.0
        sizes = np.full(len(shares), np.nan)
        return Naming(sensors, np.zeros(x.action_dim), sizes, "sensor" if sensors.any() else "")

    def reset(self):
        self.seen, self.done = [], []

    def update(self, observation, action=None):
        self.seen.append(observation)
        if action is not None:
            self.done.append(action)
        return float(self.score(self.lived())[-1])

    def lived(self):
        return Trajectory(self.seen, self.done or None)

    def explain_last(self):
        shares, onsets, *naming = self.explain(self.lived())
        return shares[-1], int(onsets[-1]), *naming

    def state(self):
        return {"std": self.std_}

    def restore(self, state):
        self.std_ = state["std"]
        self.reset()


class LearnsFromFailures(Good):
    """The same, in units of how far failed episodes spread."""

    def fit(self, nominal, progress=None, failures=None):
        super().fit(nominal, progress)
        if failures is not None:
            failed = np.concatenate([x.observations for x in failures]).astype(np.float64)
            self.std_ = np.where(self.std_ == 1.0, 1.0, failed.std(axis=0) / 4)


GOOD = DetectorSpec(
    "good",
    LearnsFromFailures,
    "",
    deterministic=True,
    parameters=declared_by({"power": 1.0}),
    horizon_decides_fit=False,
    training="failures",
    adapts="baseline",
    roles=True,
)


@dataclass(frozen=True)
class Broken:
    """A spec, the check it must fail, what its message says, and the checks that fail with it."""

    check: str
    spec: DetectorSpec
    message: str
    also: frozenset = frozenset()


BROKEN = {}


def breaks(check, message, *, also=(), **changes):
    """Register a broken detector: the class below, with changes of the spec."""
    changes = {"training": "nominal", **changes}

    def register(factory):
        spec = dataclasses.replace(GOOD, factory=factory, **changes)
        BROKEN[f"{check}-{factory.__name__}"] = Broken(check, spec, message, frozenset(also))
        return factory

    return register


def alters(method, change, check, name, message, *, also=()):
    """Register the good detector with a change of what one method returns for its arguments."""

    def altered(self, *arguments):
        return change(self, getattr(Good, method)(self, *arguments), *arguments)

    breaks(check, message, also=also)(type(name, (Good,), {method: altered}))


# How it is made, and what it says


@breaks("factory", "the factory returned NoScore without a method score:", parameters=None)
class NoScore:
    def __init__(self, *, seed, horizon): ...

    def fit(self, nominal): ...


@breaks("factory", "the factory, called with seed=0, raised")
class NeedsSize(Good):
    def __init__(self, *, seed, size):
        super().__init__(seed=seed, power=size)


@breaks("unknown-parameter", "the factory accepted no_such_parameter=1 without a word:")
class TakesAnything(Good):
    def __init__(self, *, seed=0, horizon=1, power=1.0, **_):
        super().__init__(seed=seed, horizon=horizon, power=power)


@breaks("fits", "fit raised RuntimeError: no mood (broken_detectors.py")
class NoMood(Good):
    def fit(self, nominal):
        raise RuntimeError("no mood")


@breaks("fits", "fit called sys.exit(3")
class Exits(Good):
    def fit(self, nominal):
        sys.exit(3)


@breaks("fits", "its spec declares no actions, so their width was 0")
class LearnsActions(Good):
    def fit(self, nominal):
        super().fit(nominal)
        self.std_ = self.std_ + np.concatenate([x.actions[:, 0] for x in nominal]).std()


@breaks(
    "declared-parameters",
    "scores change when the declared defaults (power=2.0) are",
    parameters=declared_by({"power": 2.0}),
)
class OtherDefault(Good): ...


@breaks(
    "declared-parameters",
    "the factory, called with seed=0, horizon=1, power=1.0,",
    parameters=declared_by({"power": 1.0, "strength": 2}),
)
class NoSuchParameter(Good): ...


@breaks("inputs", "it reads actions, which its spec does not declare, so that a run hands it")
class AddsActions(Good):
    def score(self, x):
        scores = super().score(x)
        scores[1:] += np.round(np.abs(x.actions).sum(axis=1))
        return scores


@breaks("not-fitted", "score before fit raised AttributeError: 'NoneType' object")
class Unprepared(Good):
    def score(self, x):
        self.std_.sum()
        return super().score(x)


@breaks("not-fitted", "score before fit returned scores, other ones than after")
class ScoresUnfitted(Good):
    def score(self, x):
        return np.zeros(len(x)) if self.std_ is None else super().score(x)


@breaks("wrong-dimension", "score, fitted on 3 sensors and given 7, returned scores:")
class LooksAtTheFirst(Good):
    def score(self, x):
        d = len(self.std_) if self.std_ is not None else 0
        return super().score(Trajectory(x.observations[:, :d] if d else x.observations, x.actions))


@breaks("wrong-dimension", "score, fitted on 3 sensors and given 7, raised")
class Taciturn(Good):
    def score(self, x):
        if self.std_ is not None and x.observation_dim != len(self.std_):
            raise ValueError("bad shape")
        return super().score(x)


# Scores


def undefined(first, last):
    """Leave some scores undefined."""
    return lambda self, scores, x: np.where(
        (np.arange(len(x)) >= first) & (np.arange(len(x)) < last), np.nan, scores
    )


for name, message, change in (
    ("OneShort", "80 scores for an episode, fitted with horizon 1", lambda _, s, x: s[1:]),
    ("SecretWarmUp", "nan at t = 1", undefined(0, 3)),
):
    fails = {"horizon", "baseline", "naming"} if name == "OneShort" else ()
    alters("score", change, "scores", name, message, also=fails)

for check, name, message, change in (
    (
        "horizon",
        "TwiceTheHorizon",
        "nan at t = 4 of an episode, fitted with horizon 4",
        lambda self, s, x: undefined(0, 2 * self.horizon if self.horizon > 1 else 0)(self, s, x),
    ),
    ("gross-anomaly", "Reversed", "an episode whose sensors go wild", lambda _, s, x: -s),
    ("deterministic", "Draws", "a detector of seed 1 has other", lambda self, s, x: s + self.seed),
    (
        "constant-trajectory",
        "DividesByTheSpread",
        "an episode in which nothing moves has the score nan at t",
        lambda _, s, x: s * (1 if len(x) < 4 or np.ptp(x.observations, axis=0).any() else np.nan),
    ),
):
    alters("score", change, check, name, message)

for name, message, change in (
    ("Nothing", "explain returned NoneType, expected shares, onsets", lambda *_: None),
    ("OnsetsInBetween", "onsets as float64 of shape (81,)", lambda _, e, x: (e[0], e[1] - 0.5)),
    ("SharesInPercent", "explain gives the shares", lambda _, e, x: (100 * e[0], e[1])),
    (
        "OnsetsAhead",
        "explain gives the onset",
        lambda _, e, x: (e[0], np.where(e[1] < 0, e[1], e[1] + 2)),
    ),
    (
        "TheUndefined",
        "explain gives the onset 0 at t = 0, where the score is",
        lambda _, e, x: (np.nan_to_num(e[0], nan=1 / e[0].shape[1]), np.maximum(e[1], 0)),
    ),
    (
        "OnsetInTheMiddle",
        "of 81 observations alone have other onsets",
        lambda _, e, x: (e[0], np.minimum(e[1], len(x) // 2)),
    ),
):
    alters("explain", change, "explain", name, message)

alters(
    "explain_last",
    lambda _, last: (last[0], max(last[1] - 1, -1)),
    "explain",
    "LateWithWhy",
    "explain_last gives other onsets than explain, first at t",
)
for name, message, change in (
    ("OtherPartsBesideARobot", "explain_last names other kind:", lambda n: n._replace(kind="body")),
    ("NoPartsBesideARobot", "explain_last names other ", lambda _: None),
):
    alters(
        "explain_last",
        lambda _, last, change=change: (*last[:2], change(last[2])),
        "naming",
        name,
        message,
    )
alters(
    "explain",
    lambda _, e, x: (*e[:2], e[2]._replace(sensors=100 * e[2].sensors)),
    "naming",
    "PartsInPercent",
    "explain names sensors with 100.0 at",
    also={"explain"},
)
alters(
    "score_many",
    lambda _, scores, many: [s + len(many) - 1 for s in scores],
    "score-many",
    "MindsTheCompany",
    "score_many of 5 trajectories differs from score: at t = 1",
)
alters(
    "update",
    lambda self, score, *_: score + (len(self.seen) > 11),
    "streaming",
    "Hurried",
    "update differs from score of the whole episode: at t = 11",
)


@breaks("warm-up", "warm_up is 9, but only 1 scores are NaN:")
class BraggingWarmUp(Good):
    warm_up = 9


# The same answer to the same question


@breaks("same-seed", "a second detector of seed 0, fitted on the same")
class ReadsTheGlobalState(Good):
    def fit(self, nominal):
        super().fit(nominal)
        self.std_ *= 1 + np.random.get_state()[1][0] % 1000 / 2000  # noqa: NPY002


@breaks("progress", "a detector whose fit told its progress has other scores: at t =")
class LearnsWhenWatched(Good):
    def fit(self, nominal, progress=None):
        super().fit(nominal)
        if progress is not None:
            progress(1.0)
            self.std_ *= 2


@breaks("progress", "fit called progress with 0.5: expected shares that rise")
class StartsAgain(Good):
    def fit(self, nominal, progress=None):
        super().fit(nominal)
        for share in (1.0, 0.5):
            if progress is not None:
                progress(share)


@breaks("refit", "a detector that was fitted on something else before has")
class Remembers(Good):
    fits = 0

    def fit(self, nominal):
        super().fit(nominal)
        self.fits += 1

    def score(self, x):
        return super().score(x) + max(self.fits - 1, 0)


@breaks(
    "order", "scores of a trajectory change with what was scored", also={"score-many", "prefix"}
)
class Shocked(Good):
    """Scores one more after it has seen something wild."""

    shock = 0

    def score(self, x):
        scores = super().score(x) + self.shock
        self.shock = int(np.nanmax(scores, initial=0) > 25)
        return scores


@breaks("score-many", "score_many returned 4 score arrays for 5 trajectories")
class LosesOne(Good):
    def score_many(self, trajectories):
        return super().score_many(trajectories[1:])


# Time


@breaks("prefix", "the first 1 of 81 observations alone have other scores:", also={"streaming"})
class KnowsTheLength(Good):
    def score(self, x):
        return super().score(x) if len(x) > 1 else np.zeros(1)


@breaks("explain", "the first 2 of 81 observations alone have other shares:")
class SharesOfTheWhole(Good):
    def explain(self, x):
        shares, onsets, _ = super().explain(x)
        mean = np.nanmean(shares, axis=0) if len(x) > self.horizon else 1 / shares.shape[1]
        return np.where(np.isnan(shares), np.nan, mean), onsets


@breaks("naming", "explain after the explanation of later rows names other sensors:")
class KnowsWhatItExplained(Good):
    """Names the parts of the latest row of an episode that it has ever explained."""

    known: ClassVar = {}

    def naming(self, shares, x):
        start = x.observations[0].tobytes()
        latest = max(self.known.get(start, (0,)), (len(x), shares.tolist()))
        self.known[start] = latest
        return super().naming(np.array(latest[1]), x)


@breaks("streaming", "two copies share what they remember of an episode: keep it in attributes")
class Together(Good):
    memory: ClassVar = []

    def reset(self):
        super().reset()
        self.memory.clear()

    def update(self, observation, action=None):
        self.memory.append(observation)
        score = super().update(observation, action)
        return score + (len(self.memory) - len(self.seen))


@breaks("streaming", "has only one of reset and update: expected both, or none")
class HalfStreaming(Good):
    reset = None

    def fit(self, nominal):
        self.reset = lambda: None
        super().fit(nominal)
        del self.reset

    def restore(self, state):
        self.reset = lambda: None
        super().restore(state)
        del self.reset


# Edges


@breaks(
    "short-trajectories",
    "score of an episode of 1 observation raised IndexError",
    also={"prefix", "streaming", "explain", "naming"},
)
class NeedsTwo(Good):
    def score(self, x):
        scores = super().score(x)
        x.observations[1]
        return scores


@breaks("constant-sensor", "an episode with a sensor that stands still has the score")
class DividesByZero(Good):
    def fit(self, nominal):
        super().fit(nominal)
        rows = np.concatenate([x.observations for x in nominal])
        self.std_ = rows.std(axis=0, dtype=np.float64)


@breaks("unequal-lengths", "fit raised ValueError: all input arrays must have the")
class Stacks(Good):
    def fit(self, nominal):
        super().fit(nominal)
        np.stack([x.observations for x in nominal])


# State


@breaks("state", "a detector that restored a state differs: at t =", also={"shared-fit"})
class HandsOverHalf(Good):
    def state(self):
        return {"std": np.ones_like(self.std_)}


@breaks(
    "state",
    "state raised ContractError: state() of detector: array 'std' is of |O",
    also={"shared-fit"},
)
class HandsOverObjects(Good):
    def state(self):
        return {"std": self.std_.astype(object)}


@breaks("state", "array 'scored' of state() differs after scoring")
class HandsOverScores(Good):
    scored = 0

    def score(self, x):
        self.scored += 1
        return super().score(x)

    def state(self):
        return {"std": self.std_, "scored": np.int64(self.scored)}


@breaks("state", "restore raised KeyError", also={"shared-fit"})
class RestoresAnother(Good):
    def restore(self, state):
        self.std_ = state["another"]


@breaks("state", "has only one of state and restore", also={"shared-fit"})
class HandsOverInVain(Good):
    restore = None


@breaks("baseline", "scores with baseline=21 are those without it")
class LearnsNothingFromIt(Good):
    def __init__(self, *, seed=0, horizon=1, power=1.0, baseline=0, roles=()):
        super().__init__(seed=seed, horizon=horizon, power=power)


@breaks(
    "failures", "scores after a fit with other failed episodes are the same", training="failures"
)
class IgnoresFailures(Good):
    def fit(self, nominal, progress=None, failures=None):
        super().fit(nominal, progress)


@breaks("fits", "unexpected keyword argument 'failures'", training="failures")
class TakesNoFailures(Good): ...


@breaks("roles", "unexpected keyword argument 'roles'")
class TakesNoRoles(Good):
    def __init__(self, *, seed=0, horizon=1, power=1.0, baseline=0):
        super().__init__(seed=seed, horizon=horizon, power=power, baseline=baseline)


@breaks("shared-fit", "a fit of horizon 1, restored for horizon 3, differs from a")
class FitsItsHorizon(Good):
    def fit(self, nominal):
        super().fit(nominal)
        self.std_ = self.std_ / self.horizon


# Manners

ENDS, STARTED = [], []
"""Events that end threads, and processes, for those who clean up."""


@breaks("leftovers", "left running: thread pump: end what was started")
class LeavesAThread(Good):
    def fit(self, nominal):
        super().fit(nominal)
        ENDS.append(threading.Event())
        threading.Thread(target=ENDS[-1].wait, name="pump").start()


@breaks("leftovers", "left running: process")
class LeavesAProcess(Good):
    def fit(self, nominal):
        super().fit(nominal)
        STARTED.append(subprocess.Popen(["sleep", "60"]))


@breaks("network", "the factory, fit or score asked the network for")
class PhonesHome(Good):
    def fit(self, nominal):
        super().fit(nominal)
        with contextlib.suppress(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", 9), timeout=0.1).close()


@breaks("network", "the factory, fit or score asked the network for")
class FetchesOnce(Good):
    fetched = False

    def fit(self, nominal):
        super().fit(nominal)
        if not FetchesOnce.fetched:
            FetchesOnce.fetched = True
            with contextlib.suppress(ConnectionRefusedError):
                socket.getaddrinfo("weights.example", 443)


@breaks("files", "the factory, fit or score wrote model.bin: write below")
class WritesHere(Good):
    def fit(self, nominal):
        super().fit(nominal)
        Path("model.bin").write_bytes(b"x")


@breaks("files", "the factory, fit or score wrote model.bin: write below")
class WritesHereOnce(Good):
    written = False

    def fit(self, nominal):
        super().fit(nominal)
        if not WritesHereOnce.written:
            WritesHereOnce.written = True
            Path("model.bin").write_bytes(b"x")


@breaks("files", "in an empty working directory it raised FileNotFoundError")
class ReadsHere(Good):
    """Reads a file that lies where the tests stand."""

    def fit(self, nominal):
        super().fit(nominal)
        Path("here.txt").read_text()

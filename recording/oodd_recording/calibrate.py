"""Find the strengths at which a policy keeps given shares of its return: what a ladder stands on.

Returns are measured on seeds of their own, the same for all strengths, with the first draw of each
episode. The curve of what is kept against strength is the isotonic regression of these means. Where
it crosses a level, more strengths are measured between its neighbours until one of them keeps the
level or they are nearly the same. A rung is always a measured strength, and what it keeps is what
was measured there: many curves are steps, and a line drawn between two strengths tells nothing of
them. Intervals are percentiles of a bootstrap over the seeds.

A measured strength is one line of JSON in a work file: an interrupted calibration goes on.
"""

import contextlib
import functools
import itertools
import json
import math
from collections.abc import Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.condition import FRACTIONS, GROWTH, LEVELS, PAPER, ROBOTS_CAP, WHOLE
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1, in_order, paper_tables
from oodd_eval.data.files import write_text
from oodd_eval.data.registry import environment_spec
from oodd_eval.errors import SimulationError
from oodd_eval.metrics.threshold import isotonic
from oodd_eval.scoring.cores import available_cores
from oodd_recording.build import Progress, workers
from oodd_recording.closed_loop import (
    GENERATOR_VERSION,
    RecordedEpisode,
    Setup,
    record_anomalous,
    return_of,
)
from oodd_recording.closed_loop import measure as measure_sensors
from oodd_recording.policies import load_policy
from oodd_recording.registered import info_of, kinds_of
from oodd_recording.values import bound_of, unit_of

FIRST_SEED: Final = 950_000_000  # outside every split, training and the evaluation of policies
STEP: Final = 4.0  # ratio of neighbouring strengths in the first pass
SMALLEST: Final = 4.0**-7  # of the bound; weaker strengths are not tried
MARGIN: Final = 0.02  # above all levels, where the first pass ends
FINEST: Final = 1.1  # ratio of neighbours between which nothing is measured any more
NEAR: Final = 0.1  # of the return that a level loses: so near to it a strength is the level's
DRAWS: Final = 1000
FIRST_JUDGED: Final = 60  # row from which on losses count: episodes begin with a transient

Floats = NDArray[np.float64]
Curve = dict[float, list[float]]
"""Returns of the seeds, in their order, by strength."""
Pair = tuple[str, str]
"""An environment and a kind of anomaly."""


def setup_of(environment: str, *, whole: bool = False) -> Setup:
    """Return policy and cap with which returns are measured, `whole` without a cap."""
    robot = environment in ENVIRONMENTS and not ENVIRONMENTS[environment].discrete
    policy = load_policy(environment)
    measure_sensors(environment, policy)
    return Setup(environment, policy, ROBOTS_CAP if robot and not whole else None)


def episodes_of(environment: str) -> int:
    """Return the number of seeds: robots take a hundred times longer than the others."""
    robot = environment in ENVIRONMENTS and not ENVIRONMENTS[environment].discrete
    return 32 if robot else 100


def has_loss(environment: str) -> bool:
    """Tell whether an environment's levels are growth of a loss, not shares of a return."""
    return environment_spec(environment).task == "loss"


def loss_of(episode: RecordedEpisode, cap: int) -> float:
    """Return the loss after an episode's onset, from row 60 on; 1 in each row after its end."""
    start = max(episode.onset or 0, FIRST_JUDGED)
    losses = 1.0 - episode.rewards[start:].astype(np.float64)
    if losses.size and (losses.min() < 0 or losses.max() > 1):
        raise SimulationError(
            f"an episode of seed {episode.seed} has rewards from {1 - losses.max():g} to "
            f"{1 - losses.min():g}, expected 0 to 1 where the task is a loss"
        )
    return float(losses.sum()) + max(0, cap - max(len(episode.rewards), start))


def twins_of(environment: str, first: int, count: int, *, whole: bool) -> list[RecordedEpisode]:
    """Return the nominal episodes of some seeds."""
    setup = setup_of(environment, whole=whole)
    return [setup.record(first + i) for i in range(count)]


def measure(
    environment: str,
    kind: str,
    strength: float,
    twins: Sequence[RecordedEpisode],
    *,
    whole: bool = False,
) -> list[float]:
    """Return the returns of twins' seeds under an anomaly of a strength, or negative losses."""
    setup = setup_of(environment, whole=whole)
    episodes = (record_anomalous(setup, kind, strength, twin, redraws=0) for twin in twins)
    if has_loss(environment):
        return [-loss_of(episode, info_of(environment).episode_cap) for episode in episodes]
    return [return_of(episode) for episode in episodes]


def kept_shares(returns: Floats, nominal: Floats) -> Floats:
    """Return the share of the nominal return that is kept: means over the last axis.

    1 - (nominal - return) / |nominal|, so that negative returns count alike.
    """
    base = nominal.mean(axis=-1)
    return np.asarray(1 - (base - returns.mean(axis=-1)) / np.abs(base))


def falling(kept: Floats) -> Floats:
    """Return the non-increasing curves nearest to what is kept at rising strengths: (K, ...)."""
    return 1 - isotonic(1 - kept, np.ones_like(kept))


def crossing(strengths: Floats, curve: Floats, level: float) -> float:
    """Return the weakest strength at which a non-increasing curve is at a level; inf if none is.

    `strengths` rise. Between them the curve is linear in their logarithm, before the first one
    linear from 1 at strength 0.
    """
    below = curve <= level
    if not below.any():
        return math.inf
    i = int(below.argmax())
    if i == 0:
        return float(strengths[0] * min(1.0, (1 - level) / max(1 - curve[0], 1e-12)))
    share = (curve[i - 1] - level) / (curve[i - 1] - curve[i])
    return float(strengths[i - 1] * (strengths[i] / strengths[i - 1]) ** share)


def nearest(curve: Floats, level: float) -> int:
    """Return which strength keeps nearest to a level on a non-increasing curve.

    Among equal ones it is that beside the place where the curve crosses the level.
    """
    i = int((curve <= level).argmax()) if (curve <= level).any() else len(curve) - 1
    before = max(i - 1, 0)
    return before if abs(curve[before] - level) < abs(curve[i] - level) else i


def levels_of(environment: str, kind: str, *, whole: bool = False) -> dict[str, float]:
    """Return the shares to find, by rung; for a kind of the paper that of its Table 2, too.

    On `whole` episodes it is the latter alone. A loss that grows by a tenth keeps .9, as a return
    does that falls by a tenth.
    """
    if has_loss(environment):
        return {name: 1 - growth for name, growth in GROWTH.items()}
    levels = {} if whole else dict(LEVELS)
    if kind in TABLE1 and environment in ENVIRONMENTS:
        table = paper_tables()["table2_policy_return"][environment]
        nominal, changed = float(table["nominal"]), float(table[kind])
        levels[WHOLE if whole else PAPER] = 1 - (nominal - changed) / abs(nominal)
    return levels


def next_strength(
    environment: str, kind: str, curve: Curve, nominal: Sequence[float], *, whole: bool = False
) -> float:
    """Return the strength to measure next; 0 when all levels are found."""
    bound = bound_of(environment, kind)
    levels = levels_of(environment, kind, whole=whole).values()
    if not curve:
        return bound
    strengths, returns, base = _arrays(curve, nominal)
    kept = kept_shares(returns, base)
    # Down from the bound, until the policy keeps nearly all, or more than any of the levels.
    weakest = float(strengths[0])
    if kept[0] < min(0.995, max(levels) + MARGIN) and weakest > SMALLEST * bound * 1.01:
        return _rounded(weakest / STEP)
    fitted = falling(kept)
    errors = (returns - base).std(axis=1, ddof=1) / math.sqrt(len(base)) / abs(base.mean())
    for level in levels:
        i = int((fitted <= level).argmax()) if (fitted <= level).any() else 0
        if not i or (ratio := strengths[i] / strengths[i - 1]) <= FINEST:
            continue
        near = nearest(fitted, level)
        # Nearer than its standard error no measurement could tell.
        if abs(fitted[near] - level) <= max(NEAR * (1 - level), errors[near]):
            continue
        share = math.log(crossing(strengths, fitted, level) / strengths[i - 1]) / math.log(ratio)
        # Neither end, so that steps are found, too.
        return _rounded(strengths[i - 1] * ratio ** min(max(share, 0.25), 0.75))
    return 0.0


def strengths_ahead(
    environment: str, kind: str, curve: Curve, nominal: Sequence[float], *, whole: bool = False
) -> list[float]:
    """Return the strengths to measure, the next one and those after it if returns lie on lines."""
    curve, base, ahead = dict(curve), np.array(nominal), []
    while strength := next_strength(environment, kind, curve, nominal, whole=whole):
        points = {0.0: base} | {s: np.array(returns) for s, returns in curve.items()}
        if not curve:  # the bound comes first, and may cost half
            points[2 * strength] = base - abs(base.mean())
        below = max(s for s in points if s < strength)
        above = min(s for s in points if s > strength)
        share = (strength - below) / (above - below)
        curve[strength] = list(points[below] + share * (points[above] - points[below]))
        ahead.append(strength)
    return ahead


def _arrays(curve: Curve, nominal: Sequence[float]) -> tuple[Floats, Floats, Floats]:
    """Return strengths, rising, their returns of shape (strengths, seeds), and nominal returns."""
    strengths = sorted(curve)
    return np.array(strengths), np.array([curve[s] for s in strengths]), np.array(nominal)


def find_rungs(
    environment: str, kind: str, curve: Curve, nominal: Sequence[float], *, whole: bool = False
) -> dict[str, Any]:
    """Return the entry of a kind in ``ladder.json`` from measured returns.

    From those of `whole` episodes it is one rung, to be added to the entry.
    """
    bound = bound_of(environment, kind)
    strengths, returns, base = _arrays(curve, nominal)
    kept = kept_shares(returns, base)
    drawn = np.random.default_rng(0).integers(len(base), size=(DRAWS, len(base)))
    draws = kept_shares(returns[:, drawn], base[drawn])
    fitted, curves = falling(kept), falling(draws).T

    def rung(level: float) -> dict[str, Any]:
        i = nearest(fitted, level)
        crossings = [
            min(crossing(strengths, falling_curve, level), bound) for falling_curve in curves
        ]
        low, high = np.percentile(crossings, [2.5, 97.5])
        kept_low, kept_high = np.percentile(draws[i], [2.5, 97.5])
        return {
            "strength": float(strengths[i]),
            "low": _rounded(min(low, strengths[i])),
            "high": _rounded(max(high, strengths[i])),
            "kept": _rounded(kept[i]),
            "kept_low": _rounded(kept_low),
            "kept_high": _rounded(kept_high),
            "reached": bool(fitted[-1] <= level),
        }

    levels = levels_of(environment, kind, whole=whole)
    if whole:
        return {WHOLE: rung(levels[WHOLE])}
    rungs: dict[str, dict[str, Any]] = {}
    for name in (name for name in levels if name != PAPER):
        candidate = rung(levels[name])
        if not rungs or candidate["strength"] > max(r["strength"] for r in rungs.values()):
            rungs[name] = candidate
    weak = {
        name: {"strength": _rounded(share * rungs["kept99"]["strength"])}
        for name, share in FRACTIONS.items()
        if "kept99" in rungs
    }
    entry = {"unit": unit_of(environment, kind), "bound": bound, "rungs": weak | rungs}
    return entry | ({PAPER: rung(levels[PAPER])} if PAPER in levels else {})


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


class _Measurement:
    """Returns of pairs of environment and kind, each that is measured a line of a work file."""

    def __init__(self, pairs: Sequence[Pair], work: Path, *, whole: bool) -> None:
        self._pairs, self._work, self._whole = pairs, work, whole
        caps = [WHOLE] if whole else []
        self._keys = {
            e: [GENERATOR_VERSION, setup_of(e).policy.digest, episodes_of(e), *caps]
            for e, _ in pairs
        }
        self._curves: dict[Pair, Curve] = {(e, k): {} for e, kind in pairs for k in ("", kind)}
        work.parent.mkdir(parents=True, exist_ok=True)
        content = work.read_text(encoding="utf-8") if work.exists() else ""
        self._broken = bool(content) and not content.endswith("\n")  # an interrupted write
        for text in content.splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                line = json.loads(text)
                pair = line["environment"], line["kind"]
                if pair in self._curves and line["key"] == self._keys[pair[0]]:
                    self._curves[pair][line["strength"]] = line["returns"]

    def run(self, pool: Executor, jobs: int, progress: Progress) -> None:
        """Measure what is missing; seeds are shared out, so that all jobs work to the end."""
        whole, ahead = self._whole, {pair: self._ahead(*pair) for pair in self._pairs}
        unfinished = [pair for pair, strengths in ahead.items() if strengths]
        recording: dict[str, list[Future[list[RecordedEpisode]]]] = {}
        for e in dict.fromkeys(e for e, _ in unfinished):
            ends = np.linspace(0, episodes_of(e), jobs + 1, dtype=int).tolist()
            recording[e] = [
                pool.submit(twins_of, e, FIRST_SEED + i, j - i, whole=whole)
                for i, j in itertools.pairwise(ends)
                if i < j
            ]
        parts: dict[str, list[list[RecordedEpisode]]] = {}
        pending: dict[Future[list[float]], tuple[Pair, float, list[Future[list[float]]]]] = {}

        def tell(what: str) -> None:
            done = len(parts) + sum(len(self._curves[pair]) for pair in self._pairs)
            left = len(recording) - len(parts) + sum(map(len, ahead.values()))
            progress(done, done + left, what)

        def go_on(pair: Pair) -> None:
            ahead[pair] = self._ahead(*pair)
            for strength in ahead[pair][:1]:
                of_parts = (functools.partial(measure, *pair, strength, p) for p in parts[pair[0]])
                futures = [pool.submit(of_part, whole=whole) for of_part in of_parts]
                pending.update(dict.fromkeys(futures, (pair, strength, futures)))

        tell("")
        for e, recorded in recording.items():
            parts[e] = [future.result() for future in recorded]
            if not has_loss(e) and not self.nominal(e, ""):
                self._keep((e, ""), 0.0, [return_of(t) for part in parts[e] for t in part])
            for pair in unfinished:
                if pair[0] == e:
                    go_on(pair)
            tell(e)
        while pending:
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                pair, strength, together = pending.pop(future)
                if not any(other in pending for other in together):
                    self._keep(pair, strength, [r for other in together for r in other.result()])
                    go_on(pair)
                    tell(" ".join(pair))

    def _keep(self, pair: Pair, strength: float, returns: list[float]) -> None:
        line = {"key": self._keys[pair[0]], "environment": pair[0], "kind": pair[1]}
        text = json.dumps(line | {"strength": strength, "returns": returns})
        with self._work.open("a", encoding="utf-8") as file:
            file.write("\n" * self._broken + text + "\n")
        self._broken = False
        self._curves[pair][strength] = returns

    def anomalous(self, environment: str, kind: str) -> Curve:
        """Return the returns by strength."""
        return {s: returns for s, returns in self._curves[environment, kind].items() if s}

    def nominal(self, environment: str, kind: str) -> list[float]:
        """Return the nominal returns; of losses, which count from the onset, those of a kind."""
        return self._curves[environment, kind if has_loss(environment) else ""].get(0.0, [])

    def _ahead(self, environment: str, kind: str) -> list[float]:
        """Return the strengths to measure, the nominal one of a loss first."""
        nominal, curve = self.nominal(environment, kind), self.anomalous(environment, kind)
        if nominal:
            return strengths_ahead(environment, kind, curve, nominal, whole=self._whole)
        ahead = strengths_ahead(environment, kind, {}, [1.0, 1.0], whole=self._whole)
        return [*([0.0] if has_loss(environment) else []), *ahead]


def calibrate(
    output: Path,
    work: Path,
    *,
    environments: Iterable[str],
    kinds: Sequence[str],
    whole: bool = False,
    jobs: int | None = None,
    progress: Progress = lambda _done, _total, _what: None,
) -> dict[str, dict[str, Any]]:
    """Measure and find the rungs of some environments and kinds; return all that `output` has.

    `whole` finds the rung of robots for whole episodes, and of the paper's kinds alone. Returns
    that `work` holds are not measured again. Other entries and rungs in `output` are kept.
    `progress` hears how many strengths are measured, and of how many: an estimate until the end.
    """
    pairs = [
        (e, kind)
        for e in environments
        for kind in kinds
        if kind in kinds_of(e)
        and (not whole or (kind in TABLE1 and e in ENVIRONMENTS and not ENVIRONMENTS[e].discrete))
    ]
    measurement = _Measurement(pairs, work, whole=whole)
    with workers(jobs) as pool:
        measurement.run(pool, jobs or available_cores(), progress)
    ladder = json.loads(output.read_text(encoding="utf-8")) if output.exists() else {}
    for e, kind in pairs:
        curve, nominal = measurement.anomalous(e, kind), measurement.nominal(e, kind)
        rungs = find_rungs(e, kind, curve, nominal, whole=whole)
        ladder[e] = ladder.get(e, {}) | {kind: ladder.get(e, {}).get(kind, {}) | rungs}
    ordered = {e: ladder[e] for e in in_order(ladder, ENVIRONMENTS)}
    write_text(output, json.dumps(ordered, indent=1) + "\n")
    return ordered

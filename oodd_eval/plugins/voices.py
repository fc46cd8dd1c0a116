"""Voices: what each of the statistics that a score is the largest of costs the alarm.

The threshold of an alarm is from the largest scores of nominal episodes. A voice that is loud in
these raises it for all voices. So faults are injected into nominal episodes, and what the best
voice finds at a threshold of its own is compared with what all find together.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.metrics.alarms import AlarmKind, Calibration, offered_levels
from oodd_eval.metrics.catalogue import FOUND_WITHIN, HEADLINE, LEVELS
from oodd_eval.plugins.contract import Detector, Scores, float_scores

MOST_ROWS: Final = 15_000
"""Rows of nominal episodes on which voices are compared; further episodes are left out."""

FAULTS: Final = 48
"""Number of injected faults."""

WORTH_SAYING: Final = 0.03
"""Share of the faults that a voice has to cost to be spoken of."""

_STRENGTHS: Final = (-5.0, 2.0)  # powers of two, in standard deviations of a sensor


@runtime_checkable
class VoicedDetector(Detector, Protocol):
    """A detector whose score is the largest of several statistics, which it can tell apart."""

    def voices(self, trajectory: Trajectory) -> Mapping[str, Scores]:
        """Return the statistics whose largest is the score, in the score's own units.

        Parameters
        ----------
        trajectory : Trajectory
            One episode with T transitions.

        Returns
        -------
        mapping of str to array of real numbers of shape (T + 1,)
            By name, the same names for every episode; NaN where a statistic is undefined.
        """


class VoiceCost(NamedTuple):
    """Threshold of some voices, and the share of the injected faults that they find."""

    threshold: float
    share: float


@dataclass(frozen=True, slots=True)
class VoiceCosts:
    """Voices alone and together, on injected faults that are to be found within 20 rows.

    Attributes
    ----------
    level
        Largest share of nominal episodes with an alarm, for which thresholds are made.
    together
        Of all voices: the score.
    alone
        Of each voice by name.
    """

    level: float
    together: VoiceCost
    alone: Mapping[str, VoiceCost]

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Read what `values` returned; raise what Python raises for another form.

        Parameters
        ----------
        values
            By name of an attribute.

        Returns
        -------
        VoiceCosts
            Equal to those whose values these are.
        """
        alone = {str(name): VoiceCost(*map(float, cost)) for name, cost in values["alone"].items()}
        return cls(float(values["level"]), VoiceCost(*map(float, values["together"])), alone)

    def values(self) -> dict[str, Any]:
        """Return all as values that JSON knows.

        Returns
        -------
        dict of str to object
            By name of an attribute.
        """
        return asdict(self)

    def __str__(self) -> str:
        """Return a sentence where voices cost more than `WORTH_SAYING`, else nothing."""
        best = max(self.alone, key=lambda name: self.alone[name].share)
        costs = {cost.threshold: name for name, cost in self.alone.items() if name != best}
        share, together = 100 * self.alone[best].share, 100 * self.together.share
        if not costs or round(share - together, 9) <= 100 * WORTH_SAYING:
            return ""
        return (
            f"`{costs[max(costs)]}` sets the threshold at {100 * self.level:g} %; `{best}` alone "
            f"would find {share:.0f} % of injected faults, all together {together:.0f} %"
        )


def costs_of_voices(
    detector: object,
    episodes: Iterable[Trajectory],
    level: float | None = None,
    kind: AlarmKind = "score",
    start: int = 0,
) -> VoiceCosts | None:
    """Return what the voices of a fitted detector find alone and together.

    Parameters
    ----------
    detector
        Fitted.
    episodes
        Calibration episodes, as the detector sees them; the first `MOST_ROWS` rows count.
    level
        Largest share of nominal episodes with an alarm; by default the headline's, or the weaker
        one that there are episodes for.
    kind
        Statistic of the alarm, of each voice.
    start
        Row of an episode before which no fault begins.

    Returns
    -------
    VoiceCosts or None
        None for a detector without voices, and where episodes are too few for the level.

    Raises
    ------
    ContractError
        When the detector returns something else than voices.
    """
    nominal = [*first_rows(episodes)] if isinstance(detector, VoicedDetector) else []
    faults = [*injected_faults(nominal, start)]
    said = [_voices(detector, x) for x in (*nominal, *(x for x, _ in faults))]
    offered = {x for x in offered_levels(len(nominal), kind).values() if x >= LEVELS[HEADLINE]}
    level = level or min(offered, default=None)
    if not faults or level is None:
        return None

    def cost(names: Sequence[str]) -> VoiceCost:
        rows = [np.fmax.reduce([voices[name] for name in names]) for voices in said]
        calibration = Calibration.fit(rows[: len(nominal)], kind)
        rule = replace(calibration.unbounded, threshold=calibration.threshold(level))
        firsts = map(rule.first, rows[len(nominal) :])
        hits = [t is not None and t >= onset for t, (_, onset) in zip(firsts, faults, strict=True)]
        return VoiceCost(rule.threshold, sum(hits) / len(hits))

    if math.isinf((together := cost([*said[0]])).threshold):
        return None
    return VoiceCosts(level, together, {name: cost([name]) for name in said[0]})


def first_rows(episodes: Iterable[Trajectory]) -> Iterator[Trajectory]:
    """Yield the first episodes, with at most `MOST_ROWS` rows together."""
    rows = 0
    for episode in episodes:
        rows += len(episode)
        if rows > MOST_ROWS:
            return
        yield episode


def injected_faults(
    nominal: Sequence[Trajectory], start: int = 0
) -> Iterator[tuple[Trajectory, int]]:
    """Yield copies of nominal episodes, cut 20 rows after the onset of a fault, and the onsets.

    One or two sensors are stuck, shifted or noisy, the same ones in every call. None begins before
    row `start`.
    """
    if not (usable := [x for x in nominal if len(x) >= start + 8]):  # with a row before the fault
        return
    rng = np.random.default_rng(0)
    spread = np.concatenate([x.observations for x in usable]).std(axis=0, dtype=np.float64)
    for i in range(FAULTS):
        episode = usable[i % len(usable)]
        length = len(episode) - start
        # Not later than need be: the rows before a fault take time.
        onset = start + int(rng.integers(min(length // 4, 75), min(length // 2, 100)))
        rows = episode.observations[: onset + FOUND_WITHIN[0]].astype(np.float64)
        columns = rng.permutation(np.flatnonzero(spread))[: rng.integers(1, 3)]
        draws = rng.normal(size=(len(rows) - onset, len(columns)))
        by = spread[columns] * 2 ** rng.uniform(*_STRENGTHS)
        if i % 3 == 0:
            rows[onset:, columns] = rows[onset - 1, columns]
        else:
            rows[onset:, columns] += by * (draws if i % 3 == 1 else np.sign(draws[0]))
        yield Trajectory(rows, episode.actions[: len(rows) - 1]), onset


def _voices(detector: Any, episode: Trajectory) -> dict[str, Scores]:
    voices = {str(n): float_scores(x, "voices") for n, x in detector.voices(episode).items()}
    if (shapes := {rows.shape for rows in voices.values()}) != {(len(episode),)}:
        raise ContractError(f"voices have shapes {sorted(shapes)}, expected ({len(episode)},)")
    return voices

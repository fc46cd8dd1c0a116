"""Fits of a scan: every episode is judged by fits that have not seen it."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray
from oodd_live.handle import DetectorHandle, columns_of

from oodd_eval.data.baseline import Baseline
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, OoddError, UsageError
from oodd_eval.plugins.contract import AnyDetector
from oodd_eval.plugins.explanations import ExplainingDetector, Explanation, checked_explanation
from oodd_logs.scanning.limits import FITS

Floats = NDArray[np.float64]

Outcome = tuple[Floats, Explanation | None]
"""Answer of a detector about one episode: scores, and an explanation if it gives any."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A function that makes a detector for one fit."""

    detector: AnyDetector
    seed: int
    horizon: int
    parameters: Mapping[str, Any]
    baseline: int
    roles: tuple[str, ...]
    actions: bool

    def handle(self) -> DetectorHandle:
        """Return a new detector; `UsageError` for a column."""
        if columns_of(self.detector):
            raise UsageError(
                f"a scan fits detectors of sensors, and {self.detector} is a column that is "
                "recorded: `oodd-eval calibrate` finds its threshold, and tells what that detects"
            )
        settings = self.seed, self.horizon, self.parameters, self.baseline, self.roles
        return DetectorHandle.make(self.detector, None, *settings, actions=self.actions)

    def thinned(self, step: int) -> "Fit":
        """Return the fit for every so many rows."""
        return replace(self, baseline=-(-self.baseline // step))

    def judge(
        self,
        training: Sequence[Trajectory],
        episodes: Sequence[Trajectory],
        explained: Sequence[bool],
    ) -> list[Outcome]:
        """Fit on training episodes and judge others, of which some are explained."""
        handle = self.handle()
        detector = handle.detector
        base = Baseline.fit(training, self.baseline) if self.baseline else None
        hidden = 0 if handle.adapts else self.baseline
        try:
            handle.fit(training, base)
            outcomes: list[Outcome] = []
            for x, is_explained in zip(episodes, explained, strict=True):
                scores, explanation = handle.scores(x, base), None
                if is_explained and isinstance(detector, ExplainingDetector):
                    visible = handle.visible(x, base)
                    shares, onsets, _ = checked_explanation(detector.explain(visible), visible)
                    shares = np.pad(shares, ((hidden, 0), (0, 0)), constant_values=np.nan)
                    onsets = np.where(onsets < 0, -1, onsets + hidden)
                    onsets = np.pad(onsets, (hidden, 0), constant_values=-1)
                    explanation = Explanation(shares, onsets)
                outcomes.append((scores, explanation))
        except OoddError:
            raise
        except Exception as error:
            name = type(detector).__name__
            failure = f"detector {name} raised {type(error).__name__}: {error}"
            raise ContractError(f"{failure} (fitted on {len(training)} episodes)") from error
        return outcomes

    def cross(
        self,
        episodes: Sequence[Trajectory],
        left_out: Iterable[int] = (),
        explained: Iterable[int] = (),
        folds: int = FITS,
        jobs: int = 1,
    ) -> list[Outcome]:
        """Judge all episodes by cross-fits on those that are not left out.

        Parameters
        ----------
        episodes
            In the order of the outcomes.
        left_out
            Numbers of episodes that no fit sees; their scores are the mean of all fits.
        explained
            Numbers of episodes with an explanation.
        folds
            Number of fits, or of episodes where these are fewer.
        jobs
            Fits at a time.

        Returns
        -------
        list of Outcome
        """
        apart, to_explain = sorted(left_out), {*explained}
        kept = [i for i in range(len(episodes)) if i not in {*apart}]
        parts = [kept[k::folds] for k in range(min(folds, len(kept)))]
        judged = [[*part, *apart] for part in parts]
        work = (
            [[episodes[i] for i in kept if i not in {*part}] for part in parts],
            [[episodes[i] for i in numbers] for numbers in judged],
            # One explanation of an episode is enough.
            [[i in to_explain and (i in part or part is parts[0]) for i in [*part, *apart]]
             for part in parts],
        )  # fmt: skip
        if jobs == 1:
            answers = [*map(self.judge, *work)]
        else:
            with ProcessPoolExecutor(min(jobs, len(parts)), get_context("spawn")) as pool:
                answers = [*pool.map(self.judge, *work)]
        outcomes: dict[int, list[Outcome]] = {}
        for numbers, answer in zip(judged, answers, strict=True):
            for i, outcome in zip(numbers, answer, strict=True):
                outcomes.setdefault(i, []).append(outcome)
        return [
            (np.mean([scores for scores, _ in several], axis=0), several[0][1])
            for several in (outcomes[i] for i in range(len(episodes)))
        ]


def thinned(episode: Trajectory, step: int) -> Trajectory:
    """Return every so many rows of an episode."""
    rows = episode.observations[::step]
    return Trajectory(rows, episode.actions[::step][: len(rows) - 1])

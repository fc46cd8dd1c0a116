"""Units in worker processes of this machine."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from oodd_eval.plugins.isolation.supervisor import Limits
from oodd_eval.results.directory import ResultsDirectory, fit_key
from oodd_eval.scoring.unit import Scored, UnitJob


@dataclass(frozen=True, slots=True)
class LocalExecutor:
    """Each unit has a worker process of its own, which is killed when the run stops."""

    jobs: int
    limits: Limits
    results: ResultsDirectory | None
    stopping: threading.Event
    fresh: bool = False

    def __call__(self, job: UnitJob) -> Scored:
        """Carry out a unit."""
        return job(self.limits, self.stopping, self.results, fresh=self.fresh)

    def fit_of(self, job: UnitJob) -> str:
        """Key of the fit, unless it is kept."""
        if self.results is None:
            return ""
        key = fit_key(job.plan, job.unit, job.offer)
        return "" if self.results.fitted.has(key, fresh=self.fresh) else key

    def stop(self) -> None:
        """Kill the workers."""
        self.stopping.set()

    def close(self) -> None:
        """Do nothing: workers end with their calls."""

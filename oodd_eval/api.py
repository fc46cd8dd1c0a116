"""`evaluate` and `load_results`: the whole harness in one call, for scripts and notebooks."""

import copy
import inspect
import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import UsageError
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.contract import Detector, DetectorSpec
from oodd_eval.plugins.discovery import Offer, Plugins, check_detector_spec, discover
from oodd_eval.plugins.parameters import declared_by
from oodd_eval.results.collection import Results
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import Plan, make_plan
from oodd_eval.scoring.runner import run

Tried: TypeAlias = str | DetectorSpec | Detector | Callable[..., Detector]
"""A detector for `evaluate`: a name, a spec, a class or function that makes one, an instance."""


def evaluate(
    detector: Tried | Sequence[Tried],
    split: str | Path | Split = "mini",
    *,
    environments: str | Sequence[str] = "all",
    anomalies: str | Sequence[str] = "all",
    horizon: int = 1,
    seed: int | Sequence[int] = 0,
    parameters: Mapping[str, Any] | None = None,
    limit: int | None = None,
    output: str | Path | None = None,
    jobs: int | None = None,
    progress: bool = False,
) -> Results:
    """Evaluate detectors and return a record per cell, with the scores behind them.

    Parameters
    ----------
    detector
        One or several of: the name of an installed detector, which runs in worker processes, as on
        the command line. A `DetectorSpec`; a class or function called as ``factory(seed=...,
        horizon=..., **parameters)``; an unfitted detector, of which every fit is a copy. These run
        in this process. A class's, function's and instance's detector is shown actions, a spec's
        if it says so.
    split
        Name or path of a split, or an opened one.
    environments, anomalies
        Names, or texts as on the command line: comma lists, globs or ``"all"``.
    horizon, seed
        Prediction horizon in steps, at least 1, and seeds of the detectors.
    parameters
        Arguments of factories besides seed and horizon.
    limit
        Use the first so many trajectories of each part.
    output
        Results directory to write to and to resume from. None keeps scores as long as the returned
        `Results` are there, and no longer.
    jobs
        Installed detectors that are fitted at a time; by default one per core.
    progress
        Whether to show a bar on standard error.

    Returns
    -------
    Results
        In the order environments x detectors x seeds x anomalies. An installed detector that fails
        gives records with another status than ``"ok"``; exceptions of detectors in this process
        pass through.

    Raises
    ------
    UsageError
        For unknown names, and for what is no detector.
    ContractError
        When a detector in this process breaks the score contract.

    Examples
    --------
    >>> results = evaluate("clock", environments="cartpole", anomalies="iid")  # doctest: +SKIP
    >>> results[0].value("auc"), results.mean("auc_matched")  # doctest: +SKIP
    (1.0, 0.5)
    """
    opened = split if isinstance(split, Split) else load_split(split)
    given = dict(parameters or {})
    # What is a sequence by chance may be a detector all the same.
    several = isinstance(detector, list | tuple)
    tried: Sequence[Tried] = detector if several else [detector]  # type: ignore[assignment,list-item]
    if not tried:
        raise UsageError("no detector was named: expected at least one")
    installed = any(isinstance(d, str) for d in tried)
    plugins = discover() if installed else discover(only=())
    names = [_added(plugins, d, given) for d in tried]
    if len({*names}) < len(names):
        raise UsageError(f"detectors {names}: expected a name for each, as DetectorSpec gives one")
    where, kinds = opened.select(_listed(environments), _listed(anomalies))
    plan = make_plan(
        plugins,
        split=opened,
        detectors=names,
        environments=where,
        anomalies=kinds,
        horizons=[horizon],
        seeds=[seed] if isinstance(seed, int) else list(seed),
        parameters=given,
        limit=limit,
    )
    place = Path(tempfile.mkdtemp(prefix="oodd-eval-") if output is None else output)
    directory = ResultsDirectory(place)
    try:
        observers = [_Bar()] if progress else []
        settings = RunSettings(jobs=jobs)
        results = Results(
            run(plan, opened, plugins, settings, directory, observers).records, directory, opened
        )
    except BaseException:
        if output is None:
            shutil.rmtree(place, ignore_errors=True)
        raise
    if output is None:
        weakref.finalize(directory, shutil.rmtree, place, ignore_errors=True)
    return results


def load_results(path: str | Path, split: str | Path | Split | None = None) -> Results:
    """Return the results in a directory that ``oodd-eval run`` or `evaluate` wrote, or an entry.

    Parameters
    ----------
    path
        A results directory, or an entry of a leaderboard.
    split
        The split that they are of; by default the one of that name on this machine. Only episodes
        and plots need it.

    Returns
    -------
    Results

    Raises
    ------
    ResultsError
        When there are no records, or damaged ones.
    """
    directory = ResultsDirectory(path)
    opened = split if split is None or isinstance(split, Split) else load_split(split)
    return Results(directory.records(), directory, opened)


def _added(plugins: Plugins, detector: Tried, given: Mapping[str, Any]) -> str:
    """Offer a detector where it is no installed one; return its name."""
    if isinstance(detector, str):
        return plugins.offer(detector).spec.name
    if not isinstance(detector, DetectorSpec):
        made: Callable[..., Detector]
        if isinstance(detector, type) or not isinstance(detector, Detector):
            if not callable(detector):
                raise UsageError(
                    f"{detector!r:.80} is no detector: expected a name, a DetectorSpec, a class or "
                    "function that makes one, or an object with fit(nominal) and score(trajectory)"
                )
            made, shown = detector, getattr(detector, "__name__", type(detector).__name__)
            _must_take(made, shown, given)
        else:
            if given:
                raise UsageError(
                    f"parameters {[*given]} for an instance of {type(detector).__name__}: expected "
                    "none, as it is made already"
                )
            own = detector
            made, shown = lambda **_: copy.deepcopy(own), type(detector).__name__
        name = re.sub("[^a-z0-9]+", "-", shown.lower())[:64].strip("-")
        detector = DetectorSpec(
            name or "detector",
            made,
            "",
            inputs="observations+actions",
            parameters=declared_by(given),
        )
    check_detector_spec(detector)
    plugins.add(Offer(detector, "", "", "local", ""))
    return detector.name


def _must_take(factory: Callable[..., Detector], name: str, given: Mapping[str, Any]) -> None:
    """Raise `UsageError` unless a factory takes the arguments that it will be called with."""
    try:
        signature = inspect.signature(factory)
    except ValueError:  # of some compiled functions
        return
    try:
        signature.bind(seed=0, horizon=1, **given)
    except TypeError as error:
        raise UsageError(
            f"{name} cannot be called as {name}(seed=..., horizon=..., ...): {error}; let it take "
            "them, or hand over an object that is made already"
        ) from None


def _listed(names: str | Iterable[str]) -> str:
    return names if isinstance(names, str) else ",".join(names)


class _Bar:
    """A progress bar on standard error: an observer of the run."""

    @hookimpl
    def oodd_run_started(self, plan: Plan) -> None:
        from rich.console import Console  # noqa: PLC0415
        from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn  # noqa: PLC0415

        columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns, console=Console(stderr=True))
        self._task = self._progress.add_task("cells", total=len(plan.cells))
        self._progress.start()

    @hookimpl
    def oodd_cell_finished(self, record: Record) -> None:
        self._progress.update(self._task, advance=1, description=str(record.cell))

    @hookimpl
    def oodd_run_finished(self) -> None:
        self._progress.stop()

"""`evaluate` and `load_results`: the whole harness in one call, for scripts and notebooks."""

import inspect
import json
import os
import re
import shutil
import tempfile
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import PromiseWarning, UsageError
from oodd_eval.names import comma_list, each_once, read, whole_number
from oodd_eval.plugins.contract import (
    AnyDetector,
    Detector,
    DetectorSpec,
    accepted,
    copied,
    factory_of,
)
from oodd_eval.plugins.discovery import Offer, Plugins, discover
from oodd_eval.plugins.foreign import refuse_foreign
from oodd_eval.plugins.parameters import declared_by
from oodd_eval.plugins.specs import check_detector_spec
from oodd_eval.results.collection import Results
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.doubts import doubts_after, doubts_before
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

Tried: TypeAlias = AnyDetector | DetectorSpec
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
    row_metrics: bool = False,
    rolling: bool = False,
) -> Results:
    """Evaluate detectors and return a record per cell, with the scores behind them.

    What puts promises on false alarms in doubt is raised as a `PromiseWarning`.

    Parameters
    ----------
    detector
        One or several of: the name of an installed detector, or a comma list or glob of names,
        which run in worker processes, as on the command line. A `DetectorSpec`; a class or function
        called as ``factory(seed=..., horizon=..., **parameters)``, without seed or horizon if it
        does not take them; an unfitted detector, of which every fit is a copy. These run in this
        process. A class's, function's and instance's detector is shown actions, a spec's if it says
        so.
    split
        Name or path of a split, or an opened one.
    environments, anomalies
        Names, or texts as on the command line: comma lists, globs or ``"all"``.
    horizon, seed
        Prediction horizon in steps, at least 1, and seeds of the detectors.
    parameters
        Arguments of factories besides seed and horizon: those of all detectors by name, those of
        one installed detector as ``{"panel": {"forecast": "linear"}}`` or
        ``{"panel.forecast": "linear"}``.
    limit
        Use the first so many trajectories of each part.
    output
        Results directory to write to and to resume from. None keeps scores as long as the returned
        `Results` are there, and no longer.
    jobs
        Installed detectors that are fitted at a time; by default one per core.
    progress
        Whether to show on standard error what is being fitted, as on the command line.
    row_metrics
        Whether to compute figures of published tables, too, for splits without twins: ``f1_rows``,
        ``far_rows``, ``mar_rows`` and ``vus_pr``.
    rolling
        Whether nominal test episodes join the calibration of alarms once they are judged, in
        recorded order, for splits of logs without twins: see `oodd_eval.metrics.alarms`.

    Returns
    -------
    Results
        In the order environments x detectors x seeds x anomalies. A detector that fails gives
        records with another status than ``"ok"``, and loses no other row; the exception of a sole
        detector in this process is raised.

    Raises
    ------
    UsageError
        For unknown names, what is no detector, and arguments of another type or out of bounds.
    ContractError
        When a sole detector in this process breaks the score contract.

    Warns
    -----
    PromiseWarning
        Of what puts promises on false alarms in doubt.

    Examples
    --------
    >>> results = evaluate("clock", environments="cartpole", anomalies="iid")  # doctest: +SKIP
    >>> results[0].value("auc"), results.mean("auc_matched")  # doctest: +SKIP
    (1.0, 0.5)
    """
    for name, value in (("split", split), ("output", output or "")):
        if not isinstance(value, str | os.PathLike | Split):
            raise UsageError(f"{name} is {value!r:.80}, expected a name or path")
    opened = split if isinstance(split, Split) else load_split(split)
    arguments = read("parameters", _plain, parameters or {})
    horizon = read("horizon", _count, horizon)
    seeds = read("seed", partial(each_once, least=0), seed)
    limit = None if limit is None else read("limit", _count, limit)
    jobs = None if jobs is None else read("jobs", _count, jobs)
    # A detector may be a sequence, too.
    several = isinstance(detector, list | tuple)
    tried: Sequence[Tried] = detector if several else [detector]  # type: ignore[assignment,list-item]
    if not tried:
        raise UsageError("no detector was named: expected at least one")
    installed = any(isinstance(d, str) for d in tried)
    plugins = discover() if installed else discover(only=())
    tried = [
        n for d in tried for n in (plugins.select(d, opened.columns) if isinstance(d, str) else [d])
    ]
    by_name = {d for d in tried if isinstance(d, str)}
    shared = {k: v for k, v in arguments.items() if "." not in k and k not in by_name}
    names = [_offer(plugins, d, shared) for d in tried]
    if len({*names}) < len(names):
        raise UsageError(f"detectors {names}: expected a name for each, as DetectorSpec gives one")
    selected = opened.select(
        read("environments", comma_list, environments), read("anomalies", comma_list, anomalies)
    )
    plan = make_plan(
        plugins,
        split=opened,
        detectors=names,
        environments=selected[0],
        anomalies=selected[1],
        horizons=[horizon],
        seeds=seeds,
        parameters=arguments,
        limit=limit,
        rolling=rolling,
    )
    directory = ResultsDirectory(
        tempfile.mkdtemp(prefix="oodd-eval-") if output is None else output
    )
    if output is None:
        weakref.finalize(directory, shutil.rmtree, directory.path, ignore_errors=True)
    settings = RunSettings(jobs=jobs, row_metrics=row_metrics)
    for name, finding in doubts_before(plan, opened):
        if finding.subject != "episodes":  # the tables lack what these are too few for
            warnings.warn(f"{name}: {finding}", PromiseWarning, stacklevel=2)
    with ExitStack() as stack:
        observers = [stack.enter_context(_display())] if progress else []
        outcome = run(plan, opened, plugins, settings, directory, observers)
    for name, finding in doubts_after(plan, opened, directory):
        warnings.warn(f"{name}: {finding}", PromiseWarning, stacklevel=2)
    return Results(outcome.records, directory, opened)


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


def _offer(plugins: Plugins, detector: Tried, arguments: Mapping[str, Any]) -> str:
    """Offer a detector, unless it is the name of an installed one; return its name."""
    if isinstance(detector, str):
        return detector
    spec = detector if isinstance(detector, DetectorSpec) else _spec_of(detector, arguments)
    check_detector_spec(spec)
    plugins.add(Offer(spec, "", "", "local", ""))
    return spec.name


def _spec_of(
    detector: Detector | Callable[..., Detector], arguments: Mapping[str, Any]
) -> DetectorSpec:
    """Return the spec of a class, a function or an unfitted detector."""
    refuse_foreign(detector)
    factory = factory_of(detector)
    name = getattr(detector, "__name__", type(detector).__name__)
    if factory is not detector and arguments:
        raise UsageError(f"parameters {[*arguments]} for an instance of {name}: expected none")
    _check_call(factory, name, arguments)
    if factory is not detector:
        copied(detector)  # says at once what prevents it
    name = re.sub("[^a-z0-9]+", "-", name.lower())[:64].strip("-") or "detector"
    parameters = declared_by(arguments)
    return DetectorSpec(name, factory, "", inputs="observations+actions", parameters=parameters)


def _check_call(factory: Callable[..., Detector], name: str, arguments: Mapping[str, Any]) -> None:
    """Raise `UsageError` unless a factory takes the arguments that it will be called with."""
    call = accepted(factory, seed=0, horizon=1) | dict(arguments)
    try:
        signature = inspect.signature(factory)
    except ValueError:  # of some compiled functions
        return
    try:
        signature.bind(**call)
    except TypeError as error:
        raise UsageError(
            f"{name} cannot be called as {name}({', '.join(f'{n}=...' for n in call)}): {error}; "
            "name the parameters, or hand over an object that is made already"
        ) from None


_count = partial(whole_number, least=1)


def _plain(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters as records hold them, with Python's numbers in place of NumPy's."""
    expected = "expected values that JSON knows by name, and other objects in a factory's closure"
    if not isinstance(parameters, Mapping) or not all(isinstance(name, str) for name in parameters):
        raise UsageError(f"{parameters!r:.80}, {expected}")
    if {"seed", "horizon"} & parameters.keys():
        raise UsageError(f"{parameters!r:.80}, expected no seed and horizon: they stand beside it")
    plain: dict[str, Any] = _without_numpy(parameters)
    try:
        json.dumps(plain)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{parameters!r:.80}, {expected} ({error})") from None
    return plain


def _without_numpy(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _without_numpy(nested) for name, nested in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(_without_numpy, value))
    return value.item() if isinstance(value, np.generic) else value


def _display() -> AbstractContextManager[object]:
    """Return what shows on standard error what runs; its library is imported with it."""
    from rich.console import Console  # noqa: PLC0415

    from oodd_eval.scoring.display import Display  # noqa: PLC0415

    return Display(Console(stderr=True, highlight=False, markup=False))

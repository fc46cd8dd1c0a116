"""`evaluate`: the whole harness in one call, for scripts and notebooks."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.data.split import Split, load_split
from oodd_eval.names import select
from oodd_eval.plugins.contract import Detector, DetectorSpec
from oodd_eval.plugins.discovery import Offer, discover
from oodd_eval.plugins.parameters import declared_by
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run


def evaluate(
    detector: str | DetectorSpec | Callable[..., Detector], split: str | Path | Split = "mini", *,
    environments: str = "all", anomalies: str = "all", horizon: int = 1, seed: int = 0,
    parameters: Mapping[str, Any] | None = None, limit: int | None = None,
    output: str | Path | None = None,
) -> list[Record]:  # fmt: skip
    """Evaluate one detector and return a record per cell.

    Parameters
    ----------
    detector
        Name of an installed detector, which runs in worker processes, as on the command line. Or a
        `DetectorSpec`, or a factory called as ``factory(seed=..., horizon=..., **parameters)``,
        which run in this process. A factory's detector is shown actions, a spec's if it says so.
    split
        Name or path of a split, or an opened one.
    environments, anomalies
        Names as on the command line: comma lists, globs or ``"all"``.
    horizon, seed
        Prediction horizon in steps, at least 1, and seed of the detector.
    parameters
        Arguments of the factory besides seed and horizon.
    limit
        Use the first so many trajectories of each part.
    output
        Results directory to write to and to resume from; None writes nothing.

    Returns
    -------
    list of Record
        In the order environments x anomalies. An installed detector that fails gives records with
        another status than ``"ok"``; exceptions of a factory's detector pass through.

    Raises
    ------
    UsageError
        For unknown names.
    ContractError
        When a factory's detector breaks the score contract.

    Examples
    --------
    >>> records = evaluate("clock", environments="cartpole", anomalies="iid")  # doctest: +SKIP
    >>> records[0].value("auc"), records[0].value("auc_matched")  # doctest: +SKIP
    (1.0, 0.5)
    """
    opened = split if isinstance(split, Split) else load_split(split)
    given = dict(parameters or {})
    if isinstance(detector, str):
        plugins, name = discover(), detector
    else:
        plugins = discover(only=())
        if not isinstance(detector, DetectorSpec):
            shown = getattr(detector, "__name__", type(detector).__name__).lower()
            detector = DetectorSpec(
                shown, detector, "", inputs="observations+actions", parameters=declared_by(given)
            )
        name = detector.name
        plugins.add(Offer(detector, "", "", "local", ""))
    plan = make_plan(
        plugins, split=opened.name, split_digest=opened.digest, detectors=[name],
        environments=select("environment", environments, opened.environments),
        anomalies=select("anomaly", anomalies, ANOMALIES),
        horizons=[horizon], seeds=[seed], parameters=given, limit=limit,
    )  # fmt: skip
    # One at a time: a factory's detector need not be able to share this process with another.
    settings = RunSettings(jobs=1)
    results = ResultsDirectory(output) if output is not None else None
    return run(plan, opened, plugins, settings, results).records

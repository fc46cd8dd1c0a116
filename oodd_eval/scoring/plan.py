"""A plan: the units of a run (one fit each) and their cells (one condition each). Data only.

From names to a plan: settings are resolved and content keys are made here, once. Equal keys mean
equal scores, or an equal fit. A key covers the plug-in's code and version, the contract's version,
the detector's parameters, the data and the protocol. Moving a file of the harness changes no key.
"""

import functools
import hashlib
import importlib.util
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

from oodd_eval.data import layout
from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import PROTOCOL, Group
from oodd_eval.data.parts import FAILURES, columns_named
from oodd_eval.data.split import Split
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.metrics.alarms import RECORDED
from oodd_eval.names import Predicate, listed
from oodd_eval.plugins.contract import CONTRACT, Alarm, DetectorSpec, Training
from oodd_eval.plugins.discovery import Offer, Plugins
from oodd_eval.plugins.parameters import parameters_by_detector, parameters_of, resolve_parameters
from oodd_eval.plugins.specs import reads_actions
from oodd_eval.results.identity import Cell, Setting
from oodd_eval.results.record import Record

DEVICES: Final = ("auto", "cpu", "cuda")
_IMPORT = re.compile(rb"^\s*(?:from|import)\s+(oodd_\w+)", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Unit:
    """One fit: setting x seed x environment, and the conditions that it scores.

    `parameters` are all that the factory gets, sorted by name; `recorded` are those that are part
    of the result, so not the device. `plugin` is empty for a factory of this process, which has no
    `source` (the digest of a plug-in's code) and no key of a stored fit; its scores are stored
    under a key, but never taken from there by a later run. `columns` are shown to the detector in
    place of the sensors, if any. `roles` are those of the sensors for a
    detector that declares them.
    """

    environment: str
    setting: Setting
    seed: int
    conditions: tuple[Condition, ...]
    parameters: Mapping[str, Any]
    recorded: Mapping[str, Any]
    plugin: str
    distribution: str
    version: str
    source: str = ""
    inputs: str = ""
    alarm: Alarm = "cusum"
    columns: tuple[str, ...] = ()
    adapts: Literal["", "baseline"] = ""
    roles: tuple[str, ...] = ()
    deterministic: bool = False
    training: Training = "nominal"
    scores_key: str = ""
    fit_key: str = ""

    @property
    def local(self) -> bool:
        """True if the detector is no plug-in's and runs in this process."""
        return not self.plugin


@dataclass(frozen=True, slots=True)
class Plan:
    """All units of a run, in the order in which they are recorded.

    Of each part the first `limit` trajectories are used; None means all. `groups` are those of
    anomalies by name, `strengths` the numbers of the split's strengths by environment. `notes` are
    sentences for the user.
    """

    split: str
    split_digest: str
    units: tuple[Unit, ...]
    groups: Mapping[str, Group]
    limit: int | None = None
    strengths: Mapping[str, Mapping[Condition, float]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def cells(self) -> list[Cell]:
        """All cells, in order."""
        return [self.cell(unit, condition) for unit in self.units for condition in unit.conditions]

    def cell(self, unit: Unit, condition: Condition) -> Cell:
        """Return one cell of a unit."""
        return Cell(self.split, unit.environment, condition, unit.setting, unit.seed)

    def matching(self, predicate: Predicate) -> "Plan":
        """Return the plan with those cells only whose text passes, without empty units."""
        units = (
            replace(u, conditions=tuple(c for c in u.conditions if predicate(str(self.cell(u, c)))))
            for u in self.units
        )
        return replace(self, units=tuple(u for u in units if u.conditions))

    def blank(self, unit: Unit, condition: Condition, **outcome: Any) -> Record:
        """Return the record of a cell with its identity filled in, and no metrics."""
        return Record(
            detector=unit.setting.detector,
            horizon=unit.setting.horizon,
            seed=unit.seed,
            detector_version=unit.version,
            plugin=f"{unit.distribution}:{unit.plugin}",
            plugin_source=unit.source,
            parameters=dict(unit.recorded),
            overrides=unit.setting.overrides,
            inputs=unit.inputs,
            alarm=unit.alarm,
            deterministic=unit.deterministic,
            training=unit.training,
            rolling=unit.setting.rolling,
            environment=unit.environment,
            anomaly=condition.anomaly,
            strength=condition.strength,
            magnitude=self.strengths.get(unit.environment, {}).get(condition),
            group=self.groups.get(condition.anomaly, ""),
            split=self.split,
            split_digest=self.split_digest,
            limit=self.limit,
            scores=unit.scores_key,
            protocol=PROTOCOL,
            **outcome,
        )


def make_plan(
    plugins: Plugins,
    *,
    split: Split,
    detectors: Sequence[str],
    environments: Sequence[str],
    anomalies: Sequence[str] | None = None,
    horizons: Sequence[int] = (1,),
    seeds: Sequence[int] = (0,),
    parameters: Mapping[str, Any] | None = None,
    limit: int | None = None,
    device: str | None = None,
    rolling: bool = False,
) -> Plan:
    """Lay out every unit, environments outermost; the cells are the product of all names.

    `anomalies` are kinds or conditions, as `Split.anomalies` has them; by default all. `device` is
    the value of the parameter ``device`` for those detectors that have it. With `rolling`
    calibration, nominal test episodes in recorded order join it once they are judged. `parameters`
    are for all detectors or for one (`parameters_by_detector`). Where an environment has actions,
    a detector is the one that takes them (`Plugins.taking_actions`). What is unknown or refused,
    and a device that no detector has, raises `UsageError`.
    """
    if rolling:
        _check_rolling(split, environments)
    offers = [plugins.offer(name) for name in detectors]
    values = _parameters(offers, parameters or {})
    if device is not None:
        _set_device(device, offers, values)
    units: list[Unit] = []
    lacking: dict[str, list[str]] = {}  # reasons by detector
    taking: dict[tuple[str, str], list[str]] = {}  # environments by detector and its replacement
    unaware: list[str] = []  # detectors that are not given the actions that they read
    for environment in environments:
        if not (conditions := _chosen(split.conditions(environment), anomalies)):
            continue
        actions = split.manifest["environments"][environment]["actions"]
        for offer, params in zip(offers, values, strict=True):
            if reason := _lacking(offer.spec, split, environment):
                lacking.setdefault(offer.spec.name, []).append(reason)
                continue
            row = plugins.taking_actions(offer, params, detectors) if actions else (offer, params)
            spec = row[0].spec
            declared = spec.inputs != "observations" or spec.with_actions
            if actions and not declared and reads_actions(spec.factory):
                unaware.append(spec.name)
            if row[0] is not offer:
                taking.setdefault((offer.spec.name, row[0].spec.name), []).append(environment)
            units += [
                make_unit(*row, split, environment, conditions, horizon, seed, limit, rolling)
                for horizon in horizons
                for seed in seeds
            ]
    for name, reasons in lacking.items():
        # What a glob or "all" has selected is left out with a note.
        if (":" in name or not units) and not any(u.setting.detector == name for u in units):
            raise UsageError(f"{name}: {reasons[0]}")
    strengths = {environment: split.strengths(environment) for environment in environments}
    notes = tuple(
        f"{name} takes the actions of {listed(among)}: row {row}; --param {name}.actions=no leaves "
        "them out"
        for (name, row), among in taking.items()
    )
    notes += tuple(f"{name} is left out: {r}" for name, rs in lacking.items() for r in rs)
    advice = 'declare inputs="observations+actions" in its spec'
    notes += tuple(f"{n} reads actions and is given none: {advice}" for n in dict.fromkeys(unaware))
    return Plan(split.name, split.digest, tuple(units), split.groups, limit, strengths, notes)


def _lacking(spec: DetectorSpec, split: Split, environment: str) -> str:
    """Return what a detector needs that an environment has not; empty if nothing."""
    entry = split.manifest["environments"][environment]
    if spec.training == "failures" and FAILURES not in entry["groups"]:
        advice = "import logs with an outcome and the share of failed ones, as in failures = 0.5"
        return f"{environment} has no failed episodes to learn from: {advice}"
    columns, facts = [row["name"] for row in entry["sensors"]], layout.log_facts(entry)
    try:
        numbers = [i for name in spec.columns for i in columns_named(columns, name, environment)]
    except UnknownNameError as error:
        return str(error)
    shifted = [columns[i] for i in numbers if facts and facts.offsets and facts.offsets[i]]
    if shifted and spec.alarm in RECORDED:
        advice = "import the logs with it among scores, which are stored as they are"
        return f"{shifted[0]} of {environment} is stored less its mean: {advice}"
    return ""


def _check_rolling(split: Split, environments: Sequence[str]) -> None:
    """Raise `UsageError` where test episodes have no order in which they could be confirmed."""
    for name in environments:
        facts = layout.log_facts(split.manifest["environments"][name])
        if facts is None or facts.paired or facts.order != "recorded":
            raise UsageError(
                f"{name} of split {split.name} has no nominal test episodes in recorded order, "
                "which a rolling calibration needs: expected logs that were imported without twins "
                'and with order = "recorded"'
            )


def _parameters(offers: Sequence[Offer], parameters: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the parameters of each detector; refuse one for all that only some of them have."""
    specs = [offer.spec for offer in offers]
    by_detector = parameters_by_detector([spec.name for spec in specs], parameters)
    having = {spec.name: parameters_of(spec.parameters) for spec in specs}
    for name in parameters:
        without = [s for s in specs if name not in having[s.name] and not s.other_parameters]
        lacking = [spec.name for spec in without if name in by_detector[spec.name]]
        if lacking and len(lacking) < len(specs):
            first = next(spec.name for spec in specs if spec.name not in lacking)
            raise UsageError(
                f"parameter {name!r} is for all detectors, but {', '.join(lacking)} "
                f"{'has' if len(lacking) == 1 else 'have'} none of that name: write "
                f"{first}.{name}, such as --param {first}.{name}=VALUE, to set it for {first} alone"
            )
    return [by_detector[spec.name] for spec in specs]


def _set_device(device: str, offers: Sequence[Offer], values: Sequence[dict[str, Any]]) -> None:
    """Set the parameter ``device`` of those detectors that have it."""
    pairs = zip(offers, values, strict=True)
    having = [v for offer, v in pairs if "device" in parameters_of(offer.spec.parameters)]
    if offers and not having:
        names = ", ".join(offer.spec.name for offer in offers)
        raise UsageError(f"--device {device}: none of the detectors has a device ({names})")
    if having and device not in DEVICES:
        raise UsageError(f"--device is {device!r}, expected one of {', '.join(DEVICES)}")
    for arguments in having:
        arguments["device"] = device


def _chosen(conditions: Sequence[Condition], names: Sequence[str] | None) -> tuple[Condition, ...]:
    """Return the conditions that some names choose, in the order of the names."""
    if names is None:
        return tuple(conditions)
    selected = (c for name in names for c in conditions if name in (str(c), c.anomaly))
    return tuple(dict.fromkeys(selected))


def make_unit(
    offer: Offer,
    values: Mapping[str, Any],
    split: Split,
    environment: str,
    conditions: Sequence[Condition],
    horizon: int,
    seed: int,
    limit: int | None,
    rolling: bool = False,
) -> Unit:
    """Resolve one unit: its parameters, its setting and its keys."""
    spec = offer.spec
    declared = parameters_of(spec.parameters)
    resolved = resolve_parameters(spec.name, spec.parameters, values, others=spec.other_parameters)
    kinds = {name: declared[name].decides if name in declared else "fit" for name in resolved}
    recorded = {name: value for name, value in resolved.items() if kinds[name] != "nothing"}
    overrides = {n: v for n, v in recorded.items() if n not in declared or v != declared[n].default}
    source = source_digest(offer.module, offer.packages) if offer.plugin else ""
    identity: dict[str, Any] = {
        "distribution": offer.distribution,
        "version": offer.version,
        "source": source,
        "detector": spec.name,
        "parameters": recorded,
        "seed": seed,
        "horizon": horizon,
        "environment": environment,
        "split_digest": split.digest,
        "limit": limit,
    }
    roles = split.roles(environment) if spec.roles else ()
    if roles:
        identity["roles"] = roles
    # Some file systems take no colons or brackets, some no long names, and some tell no capitals.
    name = re.sub(r"[^a-z0-9_.]+", "-", spec.name.lower())[:100].rstrip("-")
    scores = f"{name}-{environment}-{_digest(identity | {'protocol': PROTOCOL})[:20]}"
    fit = ""
    if offer.plugin:
        deciding = {name: value for name, value in recorded.items() if kinds[name] == "fit"}
        # A fit serves all splits that have its training part.
        same: dict[str, Any] = {
            "detector": spec.fit_name or spec.name,
            "parameters": deciding,
            "split_digest": split.train_digest(environment),
        }
        if not spec.horizon_decides_fit:
            same["horizon"] = None
        if rows := split.baseline(environment):
            same["baseline"] = rows
        if spec.columns:
            same["columns"] = spec.columns
        if spec.training == "failures":
            same["failures"] = split.train_digest(environment, FAILURES)
        # It tells nothing of the environment, since the worker sees it.
        fit = _digest(identity | same)[:32]
    return Unit(
        environment=environment,
        setting=Setting.of(spec.name, horizon, overrides, rolling=rolling),
        seed=seed,
        conditions=tuple(conditions),
        parameters=resolved,
        recorded=recorded,
        plugin=offer.plugin,
        distribution=offer.distribution,
        version=offer.version,
        source=source,
        inputs=spec.inputs,
        alarm=spec.alarm,
        columns=spec.columns,
        adapts=spec.adapts,
        roles=roles,
        deterministic=spec.deterministic,
        training=spec.training,
        scores_key=scores,
        fit_key=fit,
    )


_HARNESS: Final = ("oodd_eval", "oodd_checks", "oodd_leaderboard", "oodd_live", "oodd_logs")


@functools.cache
def source_digest(module: str, packages: tuple[Path, ...] = ()) -> str:
    """Return the SHA-256 of a plug-in's own packages and of the contract's version.

    These are the package that the entry point names and all packages ``oodd_*`` that it imports.
    The harness is covered by `CONTRACT`, third-party libraries by the versions in a record's
    provenance. Of a plug-in in directories of packages all that lies there counts, but the
    metadata. Nothing is imported.
    """
    content = hashlib.sha256(f"contract {CONTRACT}\0".encode())
    digests: dict[str, str] = {}
    for directory in packages:
        for path in directory.rglob("*"):
            below = path.relative_to(directory)
            if path.is_file() and not below.parts[0].endswith(".dist-info"):
                with path.open("rb") as file:
                    digests[str(below)] = hashlib.file_digest(file, "sha256").hexdigest()
    pending, seen = [] if packages else [module], {*_HARNESS}
    while pending:
        top = pending.pop().partition(".")[0]
        if top in seen:
            continue
        seen.add(top)
        for name, path in _files(top):
            code = path.read_bytes()
            digests[name] = hashlib.sha256(code).hexdigest()
            if path.suffix == ".py":
                pending += [package.decode() for package in _IMPORT.findall(code)]
    for name, digest in sorted(digests.items()):
        content.update(f"{name}\0{digest}\0".encode())
    return content.hexdigest()


def _files(top: str) -> Iterator[tuple[str, Path]]:
    """Yield the files of a package, or of a single module, by names free of installation paths."""
    spec = importlib.util.find_spec(top)
    if spec is None or spec.origin is None:
        return
    origin = Path(spec.origin)
    if not spec.submodule_search_locations:
        yield origin.name, origin
        return
    for path in origin.parent.rglob("*"):
        if path.is_file() and path.suffix != ".pyc":
            yield str(Path(top) / path.relative_to(origin.parent)), path


def _digest(identity: Mapping[str, Any]) -> str:
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()

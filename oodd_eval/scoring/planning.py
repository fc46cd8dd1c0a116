"""From names to a plan: settings are resolved and keys are made here, once."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, PROTOCOL
from oodd_eval.errors import UsageError
from oodd_eval.plugins.discovery import Offer, Plugins
from oodd_eval.plugins.parameters import parameters_of, resolve_parameters
from oodd_eval.results.identity import Setting
from oodd_eval.scoring.keys import fit_key, scores_key, source_digest
from oodd_eval.scoring.plan import Plan, Unit

DEVICES: Final = ("auto", "cpu", "cuda")


def make_plan(
    plugins: Plugins, *, split: str, split_digest: str, detectors: Sequence[str],
    environments: Sequence[str], anomalies: Sequence[str] = tuple(ANOMALIES),
    horizons: Sequence[int] = (1,), seeds: Sequence[int] = (0,),
    parameters: Mapping[str, Any] | None = None, limit: int | None = None,
    device: str | None = None,
) -> Plan:  # fmt: skip
    """Lay out every unit, environments outermost; the cells are the product of all names.

    `device` is the value of the parameter ``device`` for those detectors that have it. What is
    unknown or refused, and a device that no detector has, raises `UsageError`.
    """
    offers = [plugins.offer(name) for name in detectors]
    given = [{**(parameters or {}), **_placed(offer, device)} for offer in offers]
    if device is not None and offers and not any("device" in own for own in given):
        names = ", ".join(offer.spec.name for offer in offers)
        raise UsageError(f"--device {device}: none of the detectors has a device ({names})")
    units = tuple(
        make_unit(offer, own, environment, anomalies, horizon, seed, split_digest, limit)
        for environment in environments
        for offer, own in zip(offers, given, strict=True)
        for horizon in horizons
        for seed in seeds
    )
    return Plan(split, split_digest, units, limit)


def make_unit(
    offer: Offer, given: Mapping[str, Any], environment: str, anomalies: Sequence[str],
    horizon: int, seed: int, split_digest: str, limit: int | None,
) -> Unit:  # fmt: skip
    """Resolve one unit: its parameters, its setting and its keys."""
    spec = offer.spec
    declared = parameters_of(spec.parameters)
    resolved = resolve_parameters(spec.name, spec.parameters, given, others=spec.other_parameters)
    kinds = {name: declared[name].decides if name in declared else "fit" for name in resolved}
    shown = {name: value for name, value in resolved.items() if kinds[name] != "nothing"}
    overrides = {
        name: value
        for name, value in shown.items()
        if name not in declared or value != declared[name].default
    }
    source = scores = fit = ""
    if offer.plugin:
        source = source_digest(offer.module)
        identity: dict[str, Any] = {
            "distribution": offer.distribution, "version": offer.version, "source": source,
            "detector": spec.name, "parameters": shown, "seed": seed, "horizon": horizon,
            "environment": environment, "split_digest": split_digest, "limit": limit,
        }  # fmt: skip
        scores = scores_key(spec.name, environment, {**identity, "protocol": PROTOCOL})
        deciding = {name: value for name, value in shown.items() if kinds[name] == "fit"}
        same: dict[str, Any] = {"detector": spec.fit_name or spec.name, "parameters": deciding}
        if not spec.horizon_decides_fit:
            same["horizon"] = None
        fit = fit_key(identity | same)
    return Unit(
        environment=environment, setting=Setting.of(spec.name, horizon, overrides), seed=seed,
        anomalies=tuple(anomalies), parameters=resolved, shown=shown, plugin=offer.plugin,
        distribution=offer.distribution, version=offer.version, source=source, inputs=spec.inputs,
        alarm=spec.alarm, deterministic=spec.deterministic, scores_key=scores, fit_key=fit,
    )  # fmt: skip


def _placed(offer: Offer, device: str | None) -> dict[str, str]:
    if device is None or "device" not in parameters_of(offer.spec.parameters):
        return {}
    if device not in DEVICES:
        raise UsageError(f"--device is {device!r}, expected one of {', '.join(DEVICES)}")
    return {"device": device}

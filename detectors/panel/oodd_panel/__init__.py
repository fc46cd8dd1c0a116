"""A panel of calibrated members that see different things: one detector for simulators and logs.

Two rows, which differ in what they look at: `panel` at observations alone, `panel-a` at the
commanded actions too. Where episodes have actions, `panel-a` runs in place of `panel`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked, parameter


@dataclass(frozen=True, slots=True)
class PanelParameters:
    """Parameters of `panel` and `panel-a`."""

    forecast: str = parameter(
        "auto",
        choices=("auto", "linear", "ensemble"),
        help="auto: an ensemble of networks judges, too, from 20 episodes and 2500 rows on",
    )
    learn: str | int = parameter(
        "auto",
        choices=("auto", "none", "baseline"),
        low=0,
        high=10_000,
        help="first rows from which an episode is learnt; auto: where no early fault is lost by it",
    )


@dataclass(frozen=True, slots=True)
class WithoutActions(PanelParameters):
    """Parameters of `panel`."""

    actions: str = parameter(
        "auto",
        choices=("auto", "no"),
        decides="nothing",
        help="auto: panel-a runs in its place where episodes have actions",
    )


def make_panel(
    name: str = "panel",
    *,
    seed: int = 0,
    horizon: int = 1,
    baseline: int = 0,
    roles: Sequence[str] = (),
    **parameters: Any,
) -> Detector:
    """Return an unfitted `oodd_panel.detector.PanelDetector`, by the name of its row."""
    from oodd_panel.detector import PanelDetector  # noqa: PLC0415  keeps the listing quick

    actions = name.endswith("-a")
    return PanelDetector(
        name,
        checked(PanelParameters if actions else WithoutActions, name, parameters),
        seed=seed,
        horizon=horizon,
        actions=actions,
        baseline=baseline,
        roles=roles,
    )


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the panel without and with actions."""
    return [
        _spec(
            name="panel", summary="calibrated members that see different things, in one statistic"
        ),
        _spec(name="panel-a", summary="panel whose forecast uses the commanded actions too"),
    ]


def _spec(*, name: str, summary: str) -> DetectorSpec:
    actions = name.endswith("-a")
    return DetectorSpec(
        name=name,
        factory=partial(make_panel, name),
        summary=summary,
        reference="Lowry et al. (1992), Jackson & Mudholkar (1979), Ramaswamy et al. (2000)",
        inputs="observations+actions" if actions else "observations",
        with_actions="" if actions else "panel-a",
        alarm="score",
        adapts="baseline",
        seconds=35,
        roles=True,
        parameters=PanelParameters if actions else WithoutActions,
    )

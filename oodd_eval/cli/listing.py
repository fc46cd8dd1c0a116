"""``oodd-eval list``: one line each, the name first."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from typing import Final

from oodd_eval.cli.discovery import discovered
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS
from oodd_eval.errors import UnknownNameError
from oodd_eval.plugins.discovery import Plugins


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval list``; 1 when a plug-in is broken."""
    if options.what == "detectors":
        plugins = discovered(options.plugins)
        _print(_detectors(plugins))
        return int(bool(plugins.broken))
    if options.what not in _KINDS:
        raise UnknownNameError("thing to list", options.what, ["detectors", *_KINDS])
    _print(_KINDS[options.what]())
    return 0


def _detectors(plugins: Plugins) -> Iterable[tuple[str, ...]]:
    for name, offer in plugins.offers.items():
        reason = offer.unavailable()
        note = f"[unavailable: {reason}] " if reason else ""
        yield name, offer.origin, note + offer.spec.summary
    for plugin, origin, forms in plugins.spec_forms():
        yield f"({plugin})", origin, forms
    for broken in plugins.broken:
        yield broken.plugin, broken.distribution, f"[broken plug-in] {broken.reason}"


def _environments() -> Iterable[tuple[str, ...]]:
    for e in ENVIRONMENTS.values():
        yield e.id, e.simulator, f"{e.observation_dim} sensors, {e.policy} policy"


def _anomalies() -> Iterable[tuple[str, ...]]:
    for a in ANOMALIES.values():
        yield a.id, a.group, a.summary


def _splits() -> Iterable[tuple[str, ...]]:
    # h5py is imported here only: the other listings stay quick.
    from oodd_eval.data.split import load_split, split_directories  # noqa: PLC0415

    here = split_directories()
    for name in dict.fromkeys([*SPLITS, *here]):
        if name in here:
            split = load_split(name)
            d = split.manifest["definition"]
            where = f"{len(split.environments)} environments, digest {split.digest[:12]}"
        else:
            s = SPLITS[name]
            d = {"train": s.train, "calibration": s.calibration, "test": s.test}
            where = f"not here: oodd-eval data build {name}"
        sizes = f"{d['train']} train, {d['calibration']} calibration, {d['test']} test seeds"
        yield name, sizes, where


def _metrics() -> Iterable[tuple[str, ...]]:
    from oodd_eval.metrics.alarms import CALIBRATED, TARGETS  # noqa: PLC0415  likewise
    from oodd_eval.metrics.auc import METRICS, POOLED  # noqa: PLC0415  likewise

    yield from (METRICS | POOLED).items()
    for suffix, target in TARGETS.items():
        at = f"alarms at a calibrated false-alarm rate of {100 * target:g} %"
        yield f"..._{suffix}", f"{', '.join(CALIBRATED)}: {at}"
        yield f"threshold_{suffix}", "the CUSUM threshold of that rate"


_KINDS: Final[dict[str, Callable[[], Iterable[tuple[str, ...]]]]] = {
    "envs": _environments,
    "anomalies": _anomalies,
    "splits": _splits,
    "metrics": _metrics,
}


def _print(rows: Iterable[tuple[str, ...]]) -> None:
    lines = list(rows)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
        print("  ".join(cells).rstrip())  # noqa: T201  the program's voice

"""Which records of a results directory become an entry, and the command that made them."""

from __future__ import annotations

import json
import re
import shlex
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard.verify.cells import Unit, setting_of
from oodd_eval.names import expression, select
from oodd_eval.results.record import Record

LONGEST_COMMAND: Final = 4000

_REPRODUCTION: Final = "reproduction.json"
"""What a directory of ``oodd-eval reproduce`` has beside its records."""


def selected(
    records: Sequence[Record], detectors: str, cells: str = "", *, complete: bool = False
) -> tuple[list[Record], list[str]]:
    """Return the records to publish, in the order of the board, and what is left out.

    Parameters
    ----------
    records
        Of a results directory.
    detectors
        Names: comma lists, globs or ``"all"``.
    cells
        Expression over cell ids, as for ``-k``; empty for all.
    complete
        Whether to leave out those seeds of a row that lack cells which others here have.

    Returns
    -------
    Records, and a line for each seed of a row that is left out.

    Raises
    ------
    UsageError
        When nothing remains.
    """
    if not records:
        raise UsageError("these results have no records: expected those of a finished run")
    names = select("detector of these results", detectors, sorted({r.detector for r in records}))
    wanted = expression(cells) if cells else lambda _: True
    chosen = [r for r in records if r.detector in names and wanted(str(r.cell))]
    if not chosen:
        raise UsageError(f"-k {cells!r} selects none of the {len(records)} records")
    left_out: list[str] = []
    if complete:
        chosen, left_out = _complete(chosen)
    environments, anomalies = list(ENVIRONMENTS), list(ANOMALIES)
    ordered = sorted(
        chosen,
        key=lambda r: (
            setting_of(r), environments.index(r.environment), anomalies.index(r.anomaly)
        ),
    )  # fmt: skip
    return [replace(r, reason=_plain(r.reason)) for r in ordered], left_out


def _complete(records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    """Leave out the seeds of rows that lack cells which any row here has."""
    cells: dict[Unit, set[tuple[str, str]]] = defaultdict(set)
    labels: dict[Unit, str] = {}
    for r in records:
        cells[setting_of(r)].add((r.environment, r.anomaly))
        labels[setting_of(r)] = r.label
    every = set().union(*cells.values())
    whole = {setting for setting, own in cells.items() if own == every}
    if not whole:
        raise UsageError(
            f"--complete: no row of these results has all {len(every)} cells that occur in them; "
            "run the rest, or choose cells that all rows have with -k"
        )
    left_out = [
        f"{labels[setting]}, which has {len(own)} of {len(every)} cells"
        for setting, own in sorted(cells.items())
        if setting not in whole
    ]
    return [r for r in records if setting_of(r) in whole], left_out


def _plain(reason: str) -> str:
    """Return a reason without markup and control characters: exceptions may say anything."""
    printable = "".join(c if c.isprintable() else " " for c in reason)
    return printable.replace("<", "(").replace(">", ")").replace("](", "] (")[:1000]


def made_with(directory: Path, records: Sequence[Record]) -> str:
    """Return the command that made the records of a results directory.

    Of a reproduction that is ``oodd-eval reproduce``, of others see `run_command`.
    """
    try:
        plain = json.loads((directory / _REPRODUCTION).read_text(encoding="utf-8"))
        tier, usual = plain["tier"]["name"], plain["tier"]["split"]
    except (OSError, ValueError, KeyError, TypeError):
        return run_command(records)
    split = records[0].split.partition("@")[0]
    if not re.fullmatch(r"[a-z-]+", str(tier)):
        return run_command(records)
    other = [] if usual == split else ["--split", split]
    return shlex.join(["oodd-eval", "reproduce", "--tier", tier, *other])


def run_command(records: Sequence[Record]) -> str:
    """Return commands that make such records, and no others, joined by ``&&``.

    Examples
    --------
    >>> run_command([])
    ''
    """
    runs: dict[tuple[str, ...], set[str]] = defaultdict(set)
    for r in records:
        overrides = json.dumps(r.overrides, sort_keys=True)
        runs[r.detector, overrides, str(r.horizon), str(r.seed)].add(r.environment)
    found = {(*key, _environments(names)) for key, names in runs.items()}
    merged: set[Run] = {tuple((part,) for part in run) for run in found}
    # Runs that differ in nothing but their seeds, horizons or detectors share a command.
    for place in (3, 2, 0):
        merged = _merged(merged, place)
    split = records[0].split.partition("@")[0] if records else ""
    commands = [_command(run, split) for run in sorted(merged)]
    text = " && ".join(commands)
    while len(text) > LONGEST_COMMAND:
        text = text.rpartition(" && ")[0]
    return text


Run = tuple[tuple[str, ...], ...]
"""Detectors, overrides as JSON, horizons, seeds, environments: one or more of each."""


def _environments(names: Iterable[str]) -> str:
    own = set(names)
    return "all" if own == set(ENVIRONMENTS) else ",".join(e for e in ENVIRONMENTS if e in own)


def _merged(runs: Iterable[Run], place: int) -> set[Run]:
    groups: dict[Run, set[str]] = defaultdict(set)
    for run in runs:
        groups[(*run[:place], *run[place + 1 :])] |= set(run[place])
    by = int if place in (2, 3) else str
    return {
        (*rest[:place], tuple(sorted(values, key=by)), *rest[place:])
        for rest, values in groups.items()
    }


def _command(run: Run, split: str) -> str:
    detectors, (overrides,), horizons, seeds, (environments,) = run
    texts: Mapping[str, Any] = {
        k: v if isinstance(v, str) else json.dumps(v) for k, v in json.loads(overrides).items()
    }
    return shlex.join(
        [
            "oodd-eval", "run", "--detector", ",".join(detectors),
            "--env", environments, "--split", split,
            "--horizon", ",".join(horizons), "--seed", ",".join(seeds),
            *(word for k, v in texts.items() for word in ("--param", f"{k}={v}")),
        ]
    )  # fmt: skip

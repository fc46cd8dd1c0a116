"""The words around tables and figures: what was run, on what, and how to read it."""

from __future__ import annotations

from collections.abc import Sequence

from oodd_eval.benchmark import SPLITS
from oodd_eval.records import Record
from oodd_eval.report.board import entry_of
from oodd_eval.report.markdown import table as markdown_table
from oodd_eval.report.tables import UNDEFINED, Table
from oodd_eval.reproduce.experiments import Experiment
from oodd_eval.reproduce.header import Header
from oodd_eval.reproduce.numbers import Numbers, seeds_used

TABLE_2_HEADING = "Table 2: returns of the policies, nominal and under each anomaly"


def opening(header: Header, records: Sequence[Record]) -> list[str]:
    """Return the head of the page: what it is, how much was run, and by what."""
    done = {(entry_of(r), r.environment, r.seed) for r in records}
    failed = {(entry_of(r), r.environment, r.seed) for r in records if not r.ok}
    tier = header.tier
    state = f"{len(done)} of {header.units} fits and scorings have been run"
    state += f", {len(failed)} of which failed (see the end)." if failed else "."
    made = sorted({_origin(r) for r in records})
    seeds = (
        f"Detector seeds: {tier.seeds_near} at Δ = 1, {tier.seeds_far} at Δ > 1 and for other "
        "sampling sizes than M = 8. With one seed an interval holds the spread of test "
        "trajectories alone, not that of training."
    )
    reading = (
        "Values are ours with a 95 % bootstrap interval over test seeds and detector seeds, the "
        "paper's digits below; **not run** is missing, a failure is named by its state, "
        f"{UNDEFINED} is undefined (no alarm, say), *(n of m)* is a mean over fewer environments."
    )
    aucs = (
        "AUC is the paper's (after the onset against before it, within a trajectory); matched "
        "AUC compares with the nominal twin at the same times, so that the phase of an episode "
        "does not count."
    )
    run = (f"Tier **{tier.name}**: {_data(header)}.", seeds, state)
    lines = (*run, *(f"Made with {text}." for text in made), reading, aucs)
    source = (
        "*Out-of-Distribution Dynamics Detection: RL-Relevant Benchmarks and Results.* Every "
        "number is computed from `records.jsonl` (Table 2 from `returns.json`); "
        "`oodd-eval reproduce --render-only` makes this page again."
    )
    title = "# Reproduction of Danesh & Fern (2021)"
    return [title, "", source, "", *(f"- {line}" for line in lines), ""]


def heading(experiment: Experiment) -> str:
    """Return an experiment's heading: its name and its title."""
    name = experiment.id.replace("-", " ").capitalize()
    return f"{name}: {experiment.title}"


def caption(header: Header, experiment: Experiment, numbers: Numbers) -> str:
    """Return what has to stand above an experiment's tables and figures."""
    used = seeds_used(numbers)
    counts = sorted({tuple(seeds) for seeds in used.values()})
    if len(counts) == 1:
        seeds = f"Detector seeds: {_span(counts[0])}."
    else:
        each = "; ".join(f"{label}: {_span(seeds)}" for label, seeds in used.items())
        seeds = f"Detector seeds: {each}."
    parts = [f"In the paper: {experiment.place}.", f"{_data(header)}.", seeds, experiment.note]
    return " ".join(part[0].upper() + part[1:] for part in parts if part)


def of_returns(header: Header) -> str:
    """Return the caption of Table 2."""
    definition = SPLITS.get(header.split)
    cap = definition.episode_cap if definition else None
    short = f" Episodes end after {cap} steps here, so returns are smaller than the paper's." if (
        cap
    ) else ""  # fmt: skip
    return (
        f"In the paper: Table 2. {_data(header)}. Mean over test seeds with a 95 % bootstrap "
        f"interval.{short} In the figure, shares of the nominal return (magnitude)."
    )


def failures(records: Sequence[Record]) -> list[str]:
    """Return the section on units that failed; nothing where none did."""
    failed = {
        (entry_of(r).label, r.environment, r.seed): [
            entry_of(r).label, r.environment, str(r.seed), r.status, r.reason
        ]
        for r in records
        if not r.ok
    }  # fmt: skip
    if not failed:
        return []
    header = ["Detector", "Environment", "Seed", "State", "Reason"]
    table = Table("What failed", header, [failed[key] for key in sorted(failed)], labels=5)
    return ["## Failures", "", markdown_table(table)]


def _data(header: Header) -> str:
    used = f"split {header.split}, digest {header.split_digest[:12]}, protocol {header.protocol}, "
    used += f"{header.train} training, {header.calibration} calibration trajectories and "
    used += f"{header.test} test seeds per environment"
    if header.tier.limit is not None:
        used += (
            f" — **a reduced tier**: the first {header.tier.limit} trajectories of each part of "
            "the split"
        )
    return used


def _origin(record: Record) -> str:
    p = record.provenance
    versions = [f"{name} {p[name]}" for name in ("oodd_eval", "python", "numpy") if name in p]
    return ", ".join(versions) or "unknown versions"


def _span(seeds: Sequence[int]) -> str:
    return str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"

"""The words around tables and figures: what was run, on what, and how to read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from oodd_eval.data.facts import SPLITS
from oodd_eval.paper.experiments import Experiment, row_of
from oodd_eval.paper.header import Header
from oodd_eval.paper.numbers import Numbers, seeds_used
from oodd_eval.results.record import Record
from oodd_eval.results.tables.markdown import table as markdown_table
from oodd_eval.results.tables.tables import UNDEFINED, Table

TABLE_2_HEADING = "Table 2: returns of the policies, nominal and under each anomaly"


def opening(header: Header, records: Sequence[Record]) -> list[str]:
    """Return the head of the page: what it is, how much was run, and by what."""
    done = {(row_of(r), r.environment, r.seed) for r in records}
    failed = {(row_of(r), r.environment, r.seed) for r in records if not r.ok}
    tier = header.tier
    state = f"{len(done)} of {header.units} fits and scorings have been run"
    state += f", {len(failed)} of which failed (see the end)." if failed else "."
    if len(done) < header.units:
        state += " **Unfinished**: numbers and verdicts may change."
    made = sorted({_origin(r) for r in records})
    planned = (
        "" if len(done) >= header.units else ", as planned; above each table those that were run"
    )
    seeds = f"Detector seeds{planned}: {tier.seeds_near} of each setup"
    if tier.seeds_far != tier.seeds_near:
        seeds += (
            f" at Δ = 1, and {tier.seeds_far} at Δ > 1 and for other sampling sizes than M = 8. "
            "With one seed an interval holds the spread of test trajectories alone, not that of "
            "training"
        )
    seeds += "; 1 of the rows without training (controls)."
    command = f"oodd-eval reproduce --tier {tier.name}"
    command += f" --split {header.split}" if header.split != tier.split else ""
    places = {str(r.parameters["device"]) for r in records if "device" in r.parameters}
    made += [f"networks on {place}" for place in sorted(places)]
    updates = sorted({int(r.parameters["updates"]) for r in records if "updates" in r.parameters})
    trained = (
        f"Networks were trained for at most {' or '.join(map(str, updates))} updates. More of it "
        "helps some models more than others: verdicts on models are about this much training."
    )
    reading = (
        "Values are ours with a 95 % bootstrap interval over test seeds and detector seeds, the "
        "paper's digits below. These were computed on the authors' own data, policies and "
        "networks: they are there to compare, not to meet. **Not run** is missing, a failure is "
        "named by its state, "
        f"{UNDEFINED} is undefined (no alarm, say), *(n of m)* is a mean over fewer environments."
    )
    aucs = (
        "AUC is the paper's (after the onset against before it, within a trajectory); matched "
        "AUC compares with the nominal twin at the same times, so that the phase of an episode "
        "does not count."
    )
    run = (f"Tier **{tier.name}**. {_data(header)}.", seeds, state, f"Run by `{command}`.")
    made = [f"Made with {text}." for text in made]
    lines = (*run, *made, *([trained] if updates else []), reading, aucs)
    source = (
        "*Out-of-Distribution Dynamics Detection: RL-Relevant Benchmarks and Results.* Every "
        "number is computed from stored records of cells (Table 2 from `returns.json`); "
        "`oodd-eval reproduce --render-only` makes this page again from them."
    )
    title = "# Reproduction of Danesh & Fern (2021)"
    return [title, "", source, "", *(f"- {line}" for line in lines), ""]


def heading(experiment: Experiment) -> str:
    """Return an experiment's heading: its name and its title."""
    name = experiment.id.replace("-", " ").capitalize()
    return f"{name}: {experiment.title}"


def caption(header: Header, experiment: Experiment, numbers: Numbers) -> str:
    """Return what has to stand above an experiment's tables and figures."""
    seeds = _seeds(seeds_used(numbers))
    parts = [f"In the paper: {experiment.place}.", f"{_data(header)}.", seeds, experiment.note]
    return " ".join(part[0].upper() + part[1:] for part in parts if part)


def of_returns(header: Header) -> str:
    """Return the caption of Table 2."""
    definition = SPLITS.get(header.split)
    cut = definition and definition.episode_cap
    short = " Returns are smaller than the paper's because episodes are cut." if cut else ""
    return (
        f"In the paper: Table 2. {_data(header)}. Mean over test seeds with a 95 % bootstrap "
        f"interval.{short} Policies are this benchmark's own, of the paper's algorithms."
    )


def failures(records: Sequence[Record]) -> list[str]:
    """Return the section on units that failed; nothing where none did."""
    failed = {
        (str(row_of(r)), r.environment, r.seed): [
            str(row_of(r)), r.environment, str(r.seed), r.status, r.reason
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
    used = f"Split {header.split}, digest {header.split_digest[:12]}, protocol {header.protocol}, "
    used += f"{header.train} training, {header.calibration} calibration trajectories and "
    used += f"{header.test} test seeds per environment"
    return used + _reduction(header)


def _reduction(header: Header) -> str:
    """Say what the data lacks beside split standard; nothing where it lacks nothing."""
    whole, own = SPLITS["standard"], SPLITS.get(header.split)
    sizes = {
        "training trajectories": (header.train, whole.train),
        "calibration trajectories": (header.calibration, whole.calibration),
        "test seeds": (header.test, whole.test),
    }
    less = [f"{few} of {all_} {what}" for what, (few, all_) in sizes.items() if few < all_]
    if own and own.seed_base == whole.seed_base:
        first = f"the first {_listed(less)} of split {whole.name}"
        return f" (**reduced**: {first})" if less else ""
    usual = [f"{all_} {what}" for what, (few, all_) in sizes.items() if few < all_]
    lacks = [f"split {whole.name} has {_listed(usual)}"] if usual else []
    if own and own.episode_cap:
        lacks.append(f"episodes end after {own.episode_cap} steps here")
    return f" (**reduced**: {', and '.join(lacks)})" if lacks else ""


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else ""


def _origin(record: Record) -> str:
    p = record.provenance
    versions = [f"{name} {p[name]}" for name in ("oodd_eval", "python", "numpy") if name in p]
    return ", ".join(versions) or "unknown versions"


def _seeds(used: Mapping[str, Sequence[int]]) -> str:
    """Say on how many detector seeds each series rests; briefly where those of a horizon agree."""
    settings: dict[str, set[str]] = {}
    for label, seeds in used.items():
        span = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
        settings.setdefault(label.rpartition(": ")[0], set()).add(span)
    if any(len(spans) > 1 for spans in settings.values()):
        return _seeds({f"{label}: ": seeds for label, seeds in used.items()})
    by_span: dict[str, list[str]] = {}
    for setting, (span,) in settings.items():
        by_span.setdefault(span, []).append(setting)
    if len(by_span) == 1:
        return f"Detector seeds: {next(iter(by_span))}."
    each = "; ".join(f"{span} for {', '.join(names)}" for span, names in by_span.items())
    return f"Detector seeds: {each}."

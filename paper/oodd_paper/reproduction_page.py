"""Write a reproduction: tables, figures, claims and the page that joins them, from records alone.

::

    README.md             the claims, every figure, the paper's tables (its texts: page.toml)
    claims.csv            every claim with its verdicts
    tables/<id>.md, .csv  every number of an experiment; CSV in full precision
    figures/<id>.png, .svg

The same records give the same bytes.
"""

import json
import math
import re
import string
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, PROTOCOL, SPLITS, TABLE1, paper_tables
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.prose import Table
from oodd_eval.results.record import Record
from oodd_eval.results.render.tabular import csv_rows, number
from oodd_eval.results.render.text import markdown_table as padded_table
from oodd_paper.claims import NOT_RUN, Ruling, changed, claims_csv, claims_table, rulings, summary
from oodd_paper.dot_plots import Picture, draw, drawing_key, pictures_of, returns_picture
from oodd_paper.estimates import Estimate, Estimator, Numbers, TableNumber, compute, mean_return
from oodd_paper.experiments import EXPERIMENTS, TABLE_2, Experiment
from oodd_paper.inputs import KINDS, Other, Reproduction, Returns, write_changed

TEXTS: Final = tomllib.loads(Path(__file__).with_name("page.toml").read_text(encoding="utf-8"))


def fill(name: str, /, **values: Any) -> str:
    """Return a text of ``page.toml`` with its values; ``[[x: ...]]`` only where x is not empty."""
    kept = re.sub(r"(?s)\[\[(\w+): (.*?)\]\]", lambda m: m[2] if values[m[1]] else "", TEXTS[name])
    return string.Template(kept).substitute(values)


def publish(
    directory: Path,
    reproduction: Reproduction,
    records: Sequence[Record],
    returns: Returns | None,
    *,
    figures: bool = True,
    other: Other | None = None,
) -> None:
    """Write every table and figure of what there is; what is missing says so.

    Without `figures` none is drawn, and those that are there already are linked. Tables and claims
    have the numbers of the `other` reproduction beside their own.
    """
    records_used = reproduction.select(records)
    estimator = Estimator(records_used)
    claims_judged = rulings(estimator, returns)
    write_changed(directory / "claims.csv", claims_csv(claims_judged))
    sections = [_of_returns(reproduction, returns, other)]
    sections += [_of_experiment(reproduction, e, estimator, other) for e in EXPERIMENTS]
    lines = [line for one in sections for line in _write(directory, one, figures=figures)]
    write_changed(
        directory / "README.md", front_page(reproduction, records_used, claims_judged, lines, other)
    )


@dataclass(frozen=True, slots=True)
class _Section:
    """A table or figure: its numbers as rows of CSV (none: not run), and what the page shows."""

    id: str
    title: str
    caption: str = ""
    csv: Sequence[Mapping[str, str]] = ()
    tables: Sequence[str] = ()
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    page_lines: Sequence[str] = ()


def _write(directory: Path, one: _Section, *, figures: bool) -> list[str]:
    """Write a section's files, no picture twice, and return its part of the page."""
    if not one.csv:
        return [f"## {one.title}", "", "Not run.", ""]
    write_changed(directory / "tables" / f"{one.id}.csv", csv_rows(one.csv))
    whole = "\n".join([f"# {one.title}", "", one.caption, "", *one.tables])
    write_changed(directory / "tables" / f"{one.id}.md", whole)
    links = []
    for name, picture in one.pictures.items():
        svg, png = (directory / "figures" / f"{name}.{suffix}" for suffix in ("svg", "png"))
        drawn = svg.is_file() and png.is_file() and svg.read_text("utf-8", "replace")[:4000]
        if figures and not (drawn and drawing_key(picture) in drawn):
            for suffix, content in draw(picture).items():
                write_changed(svg.with_suffix(f".{suffix}"), content)
        if png.exists():
            links += [fill("figure", title=picture.title, name=name), ""]
    return [f"## {one.title}", "", one.caption, "", *links, *one.page_lines, ""]


def _of_experiment(
    r: Reproduction, experiment: Experiment, estimator: Estimator, other: Other | None
) -> _Section:
    name = experiment.id
    title = f"{name.replace('-', ' ').capitalize()}: {experiment.title}"
    if not estimator.has(experiment.settings):
        return _Section(name, title)
    numbers = compute(experiment, estimator)
    tables: list[str] = []
    parts = {"As in the paper": experiment.metrics, "Beyond": experiment.beyond}
    for heading, metrics in parts.items():
        set_out = layout(experiment, numbers, metrics, other=other)
        tables += [f"## {heading}", "", *map(markdown_table, set_out)] if metrics else []
    # Wide tables stand on the page without their intervals.
    wide = experiment.across == "scopes" and experiment.rows != "mean"
    brief = layout(experiment, numbers, experiment.metrics, intervals=not wide, other=other)
    lines = [*map(markdown_table, brief), fill("files", name=name)]
    text, pictures = caption(r, experiment, numbers), pictures_of(experiment, numbers)
    return _Section(name, title, text, numbers_csv(numbers), tables, pictures, lines)


def _of_returns(r: Reproduction, returns: Returns | None, other: Other | None) -> _Section:
    name, title = TABLE_2, "Table 2: returns of the policies, nominal and under each anomaly"
    if not returns:
        return _Section(name, title)
    table, csv_lines = returns_tables(returns, other)
    text, pictures = markdown_table(table), {name: returns_picture(returns)}
    page_lines = [text, f"[{name}.csv](tables/{name}.csv)"]
    return _Section(name, title, returns_caption(r), csv_lines, [text], pictures, page_lines)


def layout(
    experiment: Experiment,
    numbers: Numbers,
    metrics: Sequence[str],
    *,
    intervals: bool = True,
    other: Other | None = None,
) -> list[Table]:
    """Set numbers out as the paper does: a table per scope, or per metric where scopes go across.

    Rows are by environment and metric, or by environment and series, with the paper's digits below,
    and then those of another reproduction.
    """
    labels = {s.label: s.label for s in experiment.series}
    scopes = {s.id: s.title for s in experiment.scopes}
    infos = {metric: metric_info(metric) for metric in metrics}
    titles = {m: i.in_paper + (" (%)" if i.unit == "percent" else "") for m, i in infos.items()}
    side_by_side = experiment.across == "series"
    lines, columns = (titles, labels) if side_by_side else (labels, scopes)
    header = ["Environment", "Result" if side_by_side else "Setting", "", *columns.values()]
    tables = []
    for name, title in (scopes if side_by_side else titles).items():
        rows: list[list[str]] = []
        for row, first in experiment.row_titles.items():
            for i, (line, label) in enumerate(lines.items()):
                keys = [(c, name, line) if side_by_side else (line, c, name) for c in columns]
                row_numbers = [numbers[row, *key] for key in keys]
                ours = [show(n.estimate, n.metric, intervals=intervals) for n in row_numbers]
                rows.append(["" if i else first, label, "ours", *ours])
                paper = [(n.paper, infos[n.metric]) for n in row_numbers]
                theirs = ["" if math.isnan(value) else info.text(value) for value, info in paper]
                if any(theirs):
                    rows.append(["", "", "paper", *theirs])
                if other:
                    others = [_of_other(other, experiment, n) for n in row_numbers]
                    texts = [
                        show(e, n.metric, intervals=intervals)
                        for e, n in zip(others, row_numbers, strict=True)
                    ]
                    rows.append(["", "", other.name, *texts])
        tables.append(Table(title, header, rows, labels=3))
    return tables


def _of_other(other: Other, experiment: Experiment, n: TableNumber) -> Estimate:
    """Return what another reproduction has in the place of a number."""
    line = other.numbers.get((experiment.id, n.environment, n.series.label, n.scope.id, n.metric))
    if line is None:
        return Estimate()
    value, low, high = (float(line[column] or "nan") for column in ("value", "low", "high"))
    run, state = int(line["environments"]), line["state"].replace(NOT_RUN, "")
    return Estimate(value, low, high, run, n.estimate.expected, state=state)


def show(estimate: Estimate, metric: str, *, intervals: bool = True) -> str:
    """Return an estimate as printed: what failed or was not run says so and is never a number."""
    if estimate.state or not estimate.environments:
        return estimate.state or NOT_RUN
    text, low, high = map(metric_info(metric).text, estimate.ends)
    if intervals and not math.isnan(estimate.low):
        text += f" [{low}, {high}]"
    return text + (f" ({estimate.environments} of {estimate.expected})" if estimate.partial else "")


def numbers_csv(numbers: Numbers) -> list[dict[str, str]]:
    """Return the numbers as rows of a CSV file; what was not run is empty."""
    rows = []
    for n in numbers.values():
        first, e = n.series.settings[0], n.estimate
        row = {
            "environment": n.environment,
            "series": n.series.label,
            "detectors": "+".join(setting.detector for setting in n.series.settings),
            "horizon": str(first.horizon),
            "parameters": json.dumps(first.overrides) if first.overrides else "",
            "anomalies": n.scope.id,
            "metric": n.metric,
            **e.columns,
            "state": e.state or ("" if e.environments else NOT_RUN),
            "paper": number(n.paper),
        }
        rows.append(row)
    return rows


def returns_tables(
    returns: Returns, other: Other | None = None
) -> tuple[Table, list[dict[str, str]]]:
    """Return Table 2, ours with intervals and the paper's below it, and its rows of CSV."""
    header = ["Environment", "Policy", "", "Nominal", *(ANOMALIES[a].title for a in TABLE1)]
    rows, csv = [], []
    for environment in (e for e in ENVIRONMENTS if e in returns):
        info, paper = ENVIRONMENTS[environment], paper_tables()["table2_policy_return"][environment]
        digits = {kind: float(paper[kind]) for kind in KINDS}
        estimates = {kind: mean_return(returns, environment, kind) for kind in KINDS}
        rows.append([info.title, info.policy, "ours", *map(_printed, estimates.values())])
        rows.append(["", "", "paper", *(f"{value:.1f}" for value in digits.values())])
        if other and other.returns:
            its = (_printed(mean_return(other.returns, environment, k)) for k in KINDS)
            rows.append(["", "", other.name, *its])
        csv += [
            {
                "environment": environment,
                "kind": kind,
                "group": ANOMALIES[kind].group if kind in ANOMALIES else "",
                **dict(zip(("value", "low", "high"), map(number, e.ends), strict=True)),
                "n": str(len(returns[environment].get(kind, ()))),
                "paper": number(digits[kind]),
            }
            for kind, e in estimates.items()
        ]
    return Table("Mean return", header, rows, labels=3), csv


def _printed(e: Estimate) -> str:
    return f"{e.value:.1f} [{e.low:.1f}, {e.high:.1f}]" if e.environments else "not recorded"


def front_page(
    reproduction: Reproduction,
    records: Sequence[Record],
    claims_judged: Sequence[Ruling],
    sections: Sequence[str],
    other: Other | None = None,
) -> str:
    """Return the page: the run, the claims, the sections, and what failed."""
    tier = reproduction.tier
    done = {(r.setting, r.environment, r.seed) for r in records}
    failed = {(str(r.setting), r.environment, r.seed): r for r in records if not r.ok}
    updates = sorted({int(r.parameters["updates"]) for r in records if "updates" in r.parameters})
    names = ("oodd_eval", "python", "numpy")
    made_by = ([f"{n} {r.provenance[n]}" for n in names if n in r.provenance] for r in records)
    software = sorted({", ".join(versions) or "unknown versions" for versions in made_by})
    times = [str(r.provenance["time"]) for r in records if "time" in r.provenance]
    versions = {r.provenance["oodd_eval"] for r in records if "oodd_eval" in r.provenance}
    devices = sorted({str(r.provenance["device"]) for r in records if "device" in r.provenance})
    software += [f"networks on {device}" for device in devices]
    if failed:
        rows = [[*map(str, key), failed[key].status, failed[key].reason] for key in sorted(failed)]
        header = ["Detector", "Environment", "Seed", "State", "Reason"]
        failures = markdown_table(Table("What failed", header, rows, labels=5))
        sections = [*sections, "## Failures", "", failures]
    return fill(
        "page",
        tier=tier.name,
        protocol=reproduction.protocol,
        versions=" and ".join(f"oodd-eval {v}" for v in sorted(versions)) or "unknown versions",
        date=max(times, default=reproduction.date)[:10],
        today=PROTOCOL if reproduction.protocol < PROTOCOL else "",
        data=_data(reproduction),
        near=tier.seeds_near,
        far="" if tier.seeds_far == tier.seeds_near else tier.seeds_far,
        done=len(done),
        units=reproduction.units,
        failed=len(failed),
        unfinished=len(done) < reproduction.units,
        split="" if reproduction.split == tier.split else reproduction.split,
        made="".join(f"- Made with {one}.\n" for one in software),
        updates=" or ".join(map(str, updates)),
        summary=summary(claims_judged),
        claims=markdown_table(claims_table(claims_judged, other)).split("\n", 2)[2],
        other=other.name if other else "",
        changed=changed(claims_judged, other) if other else "",
        sections="\n".join(sections),
    )


def caption(reproduction: Reproduction, experiment: Experiment, numbers: Numbers) -> str:
    """Return the text above an experiment's tables and figures."""
    used: dict[str, set[int]] = {}
    for n in numbers.values():
        if n.estimate.seeds:
            used.setdefault(n.series.label, set()).add(n.estimate.seeds)
    return fill(
        "caption",
        place=experiment.section,
        data=_data(reproduction),
        seeds=_seeds(used),
        note=experiment.note,
    )


def returns_caption(r: Reproduction) -> str:
    """Return the text above Table 2."""
    return fill("returns", data=_data(r), cut=r.split in SPLITS and SPLITS[r.split].episode_cap)


def _data(r: Reproduction) -> str:
    """Describe the data, and what it lacks beside split standard."""
    whole, definition = SPLITS["standard"], SPLITS.get(r.split)
    all_of = {
        "training trajectories": (r.train, whole.train),
        "calibration trajectories": (r.calibration, whole.calibration),
        "test seeds": (r.test, whole.test),
    }
    part_of = definition is not None and definition.seed_base == whole.seed_base
    fewer = [
        (f"{few} of " if part_of else "") + f"{most} {part}"
        for part, (few, most) in all_of.items()
        if few < most
    ]
    listed = " and ".join(filter(None, [", ".join(fewer[:-1]), *fewer[-1:]]))
    lacks = [f"split standard has {listed}"] if fewer else []
    if definition and definition.episode_cap:
        lacks.append(f"episodes end after {definition.episode_cap} steps here")
    return fill(
        "data",
        split=r.split,
        digest=r.split_digest[:12],
        protocol=r.protocol,
        train=r.train,
        calibration=r.calibration,
        test=r.test,
        first=listed if part_of else "",
        lacks="" if part_of else ", and ".join(lacks),
    )


def _seeds(used: Mapping[str, set[int]]) -> str:
    """Say on how many detector seeds each series rests; briefly where those of a horizon agree."""
    spans: dict[str, set[str]] = {}
    for label, seeds in used.items():
        span = str(min(seeds)) if len(seeds) == 1 else f"{min(seeds)} to {max(seeds)}"
        spans.setdefault(label.rpartition(": ")[0], set()).add(span)
    if any(len(different) > 1 for different in spans.values()):
        return _seeds({f"{label}: ": seeds for label, seeds in used.items()})
    by_span: dict[str, list[str]] = {}
    for name, (span,) in spans.items():
        by_span.setdefault(span, []).append(name)
    each = [f"{span} for {', '.join(names)}" for span, names in by_span.items()]
    return "; ".join(each if len(each) != 1 else by_span)


def markdown_table(table: Table) -> str:
    """Return a table as Markdown without the padding, which would make up most of the page."""
    return re.sub(r"-{3,}", "---", re.sub(r" {2,}", " ", padded_table(table)))

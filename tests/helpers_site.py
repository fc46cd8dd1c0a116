"""Entries of a leaderboard made by hand, and the data of a site as large as it gets."""

import functools
import json
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers_records import make_record

from oodd_eval.data.condition import rungs_of
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.leaderboard import site
from oodd_eval.leaderboard.entry import (
    EntryInfo,
    Grant,
    digest_of,
    read_entries,
    read_grants,
    write_grants,
)
from oodd_eval.leaderboard.sections import sections, suite_sections
from oodd_eval.leaderboard.site.data import power_of, site_data
from oodd_eval.metrics.auc import AlarmRule, Contribution
from oodd_eval.metrics.catalogue import GUARANTEED, LEVELS, METRICS, RANKING
from oodd_eval.metrics.curves import Sweep, cell_curves, thresholds
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.results.curve_file import write_curves
from oodd_eval.results.evaluate import metric_of
from oodd_eval.results.record import Metric
from oodd_eval.results.strengths import DETECTION

DIGEST = "ab" * 32

SIMILAR = {"delay_censored_null": "delay_null", "missed_null": "missed"}
"""Metrics without a level whose numbers stand in for guaranteed alarms; otherwise ``far_twin``."""


def write_entry(root, identity, records, *, curves=(), trust="reported", **fields):
    """Write one entry and grant it its trust; `curves` names detectors whose cells get some."""
    directory = root / identity
    directory.mkdir(parents=True)
    lines = [record.to_json() + "\n" for record in records]
    (directory / "records.jsonl").write_text("".join(lines), encoding="utf-8")
    units = [make_curves(r, i) for i, r in enumerate(records) if r.ok and r.detector in curves]
    if units:
        write_curves({"units": units}, directory / "curves.json")
    first = records[0]
    given = {
        "title": f"Entry {identity}", "submitter": "A. Nonymous", "citation": "Page 1954",
        "url": "https://example.org/page", "created": "2026-11-21",
        "caption": "", "plugins": [],
    } | fields  # fmt: skip
    entry = EntryInfo(
        id=identity, detectors=sorted({r.detector for r in records}), split=first.split,
        split_digest=first.split_digest, protocol=first.protocol, environment={}, **given,
    )  # fmt: skip
    text = entry.to_json()
    (directory / "entry.json").write_text(text, encoding="utf-8")
    if trust != "reported":
        given = Grant(digest_of(text.encode()), trust, "C. Hecker", "2026-11-22", "fresh seeds")
        write_grants(root, read_grants(root) | {identity: given})


GRADED_ROWS = {"riqn": (0, 0.5), "rf": (0.5, 1), "clock": (0, 0)}
"""Share of episodes that a row finds at the weakest and at the strongest rung of a ladder."""


def graded(root):
    """What is drawn of a leaderboard in `root` with three rows on one ladder."""
    names = list(rungs_of("cartpole", "iid"))
    lines = []
    for row, (first, last) in GRADED_ROWS.items():
        for name, share in zip(names, np.linspace(first, last, len(names)), strict=True):
            values = {DETECTION: [float(i < 8 * share) for i in range(8)], RANKING: [0.5] * 8}
            fields = {"strength": name, "values": values}
            lines.append(make_record(row, "cartpole", "iid", **fields).to_json() + "\n")
    own = root / "suites" / "small"
    own.mkdir(parents=True)
    (own / "records.jsonl").write_text("".join(lines), encoding="utf-8")
    return power_of(suite_sections(root))


def make_curves(record, seed, twins_seed=0):
    """Curves of one cell, of random scores that are shifted from the onset on."""
    twins = list(np.random.default_rng([0, twins_seed]).normal(size=(3, 120)))
    rng = np.random.default_rng([1, seed])
    anomalous = [rng.normal(size=110) for _ in range(3)]
    onsets = [35, 50, 62]
    for scores, twin, onset in zip(anomalous, twins, onsets, strict=True):
        scores[:onset] = twin[:onset]
        scores[onset:] += 1.5
    rule = AlarmRule(Standardization(mean=0.0, std=1.0))
    sweep = Sweep.over(twins, rule, thresholds(twins, rule))
    return {
        "cell": str(record.cell), "detector": record.detector, "horizon": record.horizon,
        "seed": record.seed, "overrides": record.overrides,
        "environment": record.environment, "anomaly": record.anomaly,
        **cell_curves(sweep, rule, anomalous, onsets, onsets),
    }  # fmt: skip


def describe(record, *, inputs="observations", **fields):
    """A record with cost and inputs, intervals, and guaranteed alarms at 5 %."""
    own = record.per_trajectory
    alarms = {f"{name}_at_5pct": own.get(SIMILAR.get(name, name), own.get("far_twin"))
              for name in GUARANTEED}  # fmt: skip
    columns = {k: v for k, v in (own | alarms).items() if v is not None}
    metrics = {
        name: metric_of(name, Contribution(*pair), record.environment)
        for name, pair in columns.items()
    }
    fields = {"metrics": metrics, "per_trajectory": columns} | fields
    cost = {"seconds_fit": 2.5, "seconds_score": 0.05, "peak_rss_mb": 150.0, "steps_scored": 1000}
    return replace(record, **cost, **fields, inputs=inputs)


def values(rng, level, n=4):
    """Numerators per metric over n trajectories; AUCs about a level."""
    found = {name: list(np.round(rng.uniform(0, 0.2, n), 3)) for name in METRICS}
    for name in ("auc", "auc_matched", "auc_smoothed", "auc_unpaired"):
        found[name] = [float(v) for v in np.clip(rng.normal(level, 0.05, n), 0, 1)]
    for name in ("delay", "delay_null", "delay_censored"):
        found[name] = [float(v) for v in rng.integers(0, 30, n)]
    return found


SKILLS = {"riqn": 0.9, "rf": 0.7, "persistence": 0.55, "clock": 0.5}


def example(root):
    """Three entries on two boards: two environments, four anomalies, horizons, a failure, seeds."""
    root = root / "results"
    rng = np.random.default_rng(0)
    cells = [(e, a) for e in ("cartpole", "hopper") for a in ("iid", "drift", "gravity",
                                                              "components")]  # fmt: skip

    def records(detector, *, level=None, inputs="observations", broken=(), **settings):
        found = []
        for environment, anomaly in cells:
            failed = (environment, anomaly) in broken
            record = make_record(
                detector, environment, anomaly, digest=settings.get("digest", DIGEST),
                values=values(rng, level or SKILLS[detector]),
                status="timeout" if failed else "ok", reason="not done after 5 s" if failed else "",
                **{k: v for k, v in settings.items() if k != "digest"},
            )  # fmt: skip
            found.append(describe(record, inputs=inputs))
        return found

    write_entry(
        root, "forecasters",
        [
            *records("riqn", inputs="observations+actions"),
            *records("riqn", level=0.8, horizon=10, inputs="observations+actions"),
            *records("rf", seed=0), *records("rf", seed=1),
        ],
        curves=("riqn",), trust="re-run", caption="Three members instead of five.",
    )  # fmt: skip
    write_entry(root, "trivial", [*records("persistence"), *records("clock")], trust="re-scored")
    broken = {("hopper", "iid"), ("hopper", "drift")}
    write_entry(
        root, "third-party",
        records("mine", level=0.6, broken=broken, overrides={"window": 3}),
        title="<b>bold</b>", url="javascript:alert(1)",
    )  # fmt: skip
    write_entry(root, "other-digest", records("rf", digest="cd" * 32))
    return read_entries(root)


def other_levels(columns):
    """Columns by metric, and those at 5 % again at the other levels."""
    return columns | {
        name.replace("_at_5pct", f"_{level}"): column
        for level in LEVELS
        for name, column in columns.items()
        if name.endswith("_at_5pct")
    }


def one_row(root):
    """Index and parts of a site of one detector on all cells."""
    rng = np.random.default_rng(0)
    records, units = [], []
    for e in ENVIRONMENTS:
        for a in TABLE1:
            given = {
                name: list(rng.uniform(0, 40 if "delay" in name else 1, 10)) for name in METRICS
            }
            record = describe(make_record("detector-0", e, a, values=given))
            others = [f"threshold_{level}" for level in LEVELS]
            metrics = other_levels(record.metrics)
            metrics |= {name: Metric(rng.uniform()) for name in others}
            columns = other_levels(record.per_trajectory)
            records.append(replace(record, metrics=metrics, per_trajectory=columns))
            units.append(make_curves(record, len(units), twins_seed=list(ENVIRONMENTS).index(e)))
    write_entry(root, "one", records)
    write_curves({"units": units}, root / "one" / "curves.json")
    return site_data(sections(read_entries(root)))


@functools.cache
def full(rows):
    """Files of a site with so many detectors on all cells and with all metrics.

    One row is computed, of numbers as long as real ones; the others are copies of other names. Of
    their data files only that of the second is there.
    """
    with tempfile.TemporaryDirectory() as directory:
        data, parts = one_row(Path(directory))
    (board,) = data["boards"]
    (row,) = board["rows"]
    names = [f"detector-{i}" for i in range(rows)]
    board["rows"] = [
        row | {"id": f"board/{name}", "part": name, "label": name, "detector": name, "rank": i + 1}
        for i, name in enumerate(names)
    ]
    part = parts[row["part"]]
    part |= {"comparisons": [[name, 0.0123456, -0.012345, 0.0234567, 0.0015] for name in names]}
    content = part | {"curves": site.packed(part["curves"])}
    found = {
        site.PAGE: site.index(data),
        f"{site.PARTS}/{names[1]}.js": site.data_file(names[1], content),
    }
    for name in board["parts"].values():
        (values,) = parts[name]["values"].values()
        ends = {
            key: pair
            for (own,) in [parts[name]["intervals"].values() or [{}]]
            for key, pair in own.items()
        }
        shared = {"values": dict.fromkeys(names, values), "intervals": dict.fromkeys(names, ends)}
        found[f"{site.PARTS}/{name}.js"] = site.data_file(name, shared)
    return found


def write_site(directory, files):
    """Write a site's files and return the address of its page."""
    for name, text in files.items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text(text, encoding="utf-8")
    return (directory / site.PAGE).as_uri()


def read_part(files, name):
    """What a data file hands over, read as the page's script reads it."""
    quoted = re.fullmatch(r"ooddPart\('([a-z0-9-]+)','(.*)'\);\n", files[f"{site.PARTS}/{name}.js"])
    assert quoted[1] == name
    return json.loads(re.sub(r"\\(.)", r"\1", quoted[2]))

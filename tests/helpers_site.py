"""Entries of a leaderboard made by hand, and the data of a site as large as it gets."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers_records import PAIRED, make_record
from oodd_leaderboard import site
from oodd_leaderboard.curve_file import write_curves
from oodd_leaderboard.curves import Sweep, cell_curves, thresholds
from oodd_leaderboard.reported import (
    EntryInfo,
    SubmittedEntry,
    read_entries,
    sections,
    suite_sections,
)
from oodd_leaderboard.site.content import site_data

from oodd_eval.data.condition import rungs_of
from oodd_eval.metrics.auc import AlarmRule, Contribution
from oodd_eval.metrics.catalogue import GUARANTEED, RANKING
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.recalibration import PairedScores
from oodd_eval.results.comparison import write_reference
from oodd_eval.results.evaluate import metric_of
from oodd_eval.results.strengths import DETECTION

DIGEST = "ab" * 32

SIMILAR = {"delay_censored_null": "delay_null", "missed_null": "missed"}
"""Metrics without a level whose numbers stand in for guaranteed alarms; otherwise ``far_twin``."""


def submitted(name, records, **meta):
    """An entry in memory."""
    first = records[0]
    texts = {"title": "An entry", "citation": "", "url": "", "caption": "",
             "submitter": "Somebody", "created": "2026-11-21"}  # fmt: skip
    plugin = {"distribution": "oodd-eval", "plugin": "riqn", "version": "0.1.0",
              "source_digest": "0" * 64}  # fmt: skip
    made_with = {"python": "3.11.7", "platform": "Linux", "packages": {"numpy": "2.4.6"}}
    info = EntryInfo(
        id=name, detectors=sorted({r.detector for r in records}), split=first.split,
        split_digest=first.split_digest, protocol=first.protocol,
        **texts | {"plugins": [plugin], "environment": made_with} | meta,
    )  # fmt: skip
    return SubmittedEntry(Path(name), info, records)


def write_entry(root, identity, records, *, curves=(), **fields):
    """Write one entry; `curves` names detectors whose cells get some."""
    directory = root / identity
    directory.mkdir(parents=True)
    lines = [record.to_json() + "\n" for record in records]
    (directory / "records.jsonl").write_text("".join(lines), encoding="utf-8")
    units = [make_curves(r, i) for i, r in enumerate(records) if r.ok and r.detector in curves]
    if units:
        write_curves({"units": units}, directory / "curves.json")
    texts = {"title": f"Entry {identity}", "submitter": "A. Nonymous", "citation": "Page 1954",
             "url": "https://example.org/page", "plugins": [], "environment": {}}  # fmt: skip
    text = submitted(identity, records, **texts | fields).meta.to_json()
    (directory / "entry.json").write_text(text, encoding="utf-8")


GRADED_ROWS = {"riqn": (0, 0.5), "rf": (0.5, 1), "clock": (0, 0)}
"""Share of episodes that a row finds at the weakest and at the strongest rung of a ladder."""


def graded(root, rows=GRADED_ROWS, keep=(DETECTION, RANKING)):
    """The suites of a leaderboard in `root` with rows on one ladder, with some of their metrics."""
    names = list(rungs_of("cartpole", "iid"))
    records = []
    for row, (first, last) in rows.items():
        for name, share in zip(names, np.linspace(first, last, len(names)), strict=True):
            values = {DETECTION: [float(i < 8 * share) for i in range(8)], RANKING: [0.5] * 8}
            records.append(make_record(row, "cartpole", "iid", strength=name, values=values))
    own = root / "suites" / "small"
    own.mkdir(parents=True)
    write_reference(records, own / "records.jsonl", keep=keep)
    return suite_sections(root)


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
        **cell_curves(PairedScores(anomalous, twins, onsets, onsets), sweep, rule),
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
    found = {name: list(np.round(rng.uniform(0, 0.2, n), 3)) for name in PAIRED}
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
        curves=("riqn",), caption="Three members instead of five.",
    )  # fmt: skip
    write_entry(root, "trivial", [*records("persistence"), *records("clock")])
    broken = {("hopper", "iid"), ("hopper", "drift")}
    write_entry(
        root, "third-party",
        records("mine", level=0.6, broken=broken, overrides={"window": 3}),
        title="<b>bold</b>", url="javascript:alert(1)",
    )  # fmt: skip
    write_entry(root, "other-digest", records("rf", digest="cd" * 32))
    return read_entries(root)


def full(root, rows):
    """Files of a site with so many detectors: the first row of the example, under other names."""
    data, _ = site_data(sections(example(root)))
    board = data["boards"][0]
    names = [f"detector-{i}" for i in range(rows)]
    board["rows"] = [
        board["rows"][0]
        | {"id": f"board/{name}", "part": name, "label": name, "detector": name, "rank": i + 1}
        for i, name in enumerate(names)
    ]
    return {site.PAGE: site.index(data)}


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

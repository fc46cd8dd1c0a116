"""Seasons and reported rows made by hand, and the data of a site as large as it gets."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers_records import PAIRED, make_record
from oodd_leaderboard import site
from oodd_leaderboard.curve_file import write_curves
from oodd_leaderboard.curves import Sweep, cell_curves, thresholds
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.reported import Reported, sections, suite_sections
from oodd_leaderboard.season_files import Installed, Season, SeasonSplit
from oodd_leaderboard.seasons import SeasonBoard
from oodd_leaderboard.site.content import site_data
from oodd_leaderboard.standings import ordered

from oodd_eval.data.condition import Condition, rungs_of
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


def report(root, name, records, *, curves=()):
    """Reported records in a directory; `curves` names detectors whose cells get some."""
    directory = Path(root) / name
    units = [make_curves(r, i) for i, r in enumerate(records) if r.ok and r.detector in curves]
    if units:
        directory.mkdir(parents=True)
        write_curves({"units": units}, directory / "curves.json")
    return Reported(directory, list(records))


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


ROWS = {"riqn": 0.9, "rf": 0.7, "mine": 0.69, "clock": 0.5, "oracle": 0.95, "broken": 0.8}
"""Rows of the example and about what matched AUC they have."""

ENTRIES = {
    "riqn": Entry("riqn", authors="Danesh, Fern", paper="Benchmarks <b>", year=2021,
                  url="https://example.org/page", origin="paper"),
    "rf": Entry("rf", authors="The developers", origin="project"),
    "mine": Entry("mine", wheel="mine-1.2-py3-none-any.whl", sha256="12" * 32, licence="MIT",
                  authors="<b>Eve</b>", url="javascript:alert(1)", year=2026),
    "clock": Entry("clock", origin="trivial"),
    "oracle": Entry("oracle", origin="oracle", training="oracle"),
    "broken": Entry("broken"),
}  # fmt: skip

SIZES = {"train": 60, "calibration": 80, "test": 12, "episode_cap": 300}

CELLS = [(e, a) for e in ("cartpole", "hopper") for a in ("iid", "drift", "gravity", "components")]


def row_records(detector, *, rng, level=None, cells=CELLS, failed=(), seeds=(0,), n=8, **fields):
    """A row's records in some cells, of which some have failed."""
    records = []
    for (environment, anomaly), seed in ((cell, seed) for cell in cells for seed in seeds):
        broken = (environment, anomaly) in failed
        record = make_record(
            detector, environment, anomaly, seed=seed, deterministic=len(seeds) == 1,
            values=values(rng, level or ROWS[detector], n),
            status="timeout" if broken else "ok", reason="not done after 5 s" if broken else "",
            **fields,
        )  # fmt: skip
        records.append(describe(record, inputs="observations"))
    return records


def season(*, name="2026-11", date="2026-11-27", trial=False, cells=CELLS, rows=tuple(ROWS),
           strength=""):  # fmt: skip
    """A season of made-up rows: one fails in two cells, one is an oracle, one a stranger's."""
    rng = np.random.default_rng(0)
    failed = {"broken": cells[:2]}
    settings = {"digest": "5e" * 32, "strength": strength}
    records = [
        replace(record, split=f"season-{name}")
        for row in rows
        for record in row_records(row, rng=rng, cells=cells, failed=failed.get(row, ()),
                                  seeds=(0, 1, 2) if row == "riqn" else (0,), **settings)
    ]  # fmt: skip
    conditions: dict[str, list[str]] = {}
    for environment, anomaly in cells:
        conditions.setdefault(environment, []).append(str(Condition(anomaly, strength)))
    about = Season(
        name=name, bits="0123456789abcdef" * 2, protocol=1, oodd_eval="0.3.0",
        split=SeasonSplit(f"season-{name}", "5e" * 32, SIZES), seeds=[0, 1, 2],
        environments=list(conditions), conditions=conditions, trial=trial, date=date,
        entries={row: ENTRIES[row] for row in rows},
        installed={"mine": [Installed("mine", "1.2", "12" * 32)]},
    )  # fmt: skip
    lacks = ["environments ant, arm"] if trial else []
    return SeasonBoard(about, ordered(records, ENTRIES, expected=about.expected), lacks)


def example(root):
    """Reported rows of two digests, of which one has curves, and a variant."""
    rng = np.random.default_rng(1)
    rows = [
        *row_records("riqn", rng=rng), *row_records("riqn", rng=rng, level=0.8, horizon=10),
        *row_records("rf", rng=rng), *row_records("clock", rng=rng),
    ]  # fmt: skip
    reported = [
        report(root, "forecasters", rows, curves=("riqn",)),
        report(root, "third-party", row_records("mine", rng=rng, overrides={"window": 3})),
        report(root, "other-digest", row_records("rf", rng=rng, digest="cd" * 32)),
    ]
    return sections(reported, ENTRIES)


def full(rows):
    """Files of a site with so many rows: the first one of a season, under other names."""
    data, _ = site_data((), (), [season()])
    board = data["boards"][0]
    names = [f"detector-{i}" for i in range(rows)]
    board["rows"] = [
        board["rows"][0]
        | {
            "id": f"board/{name}",
            "part": name,
            "label": name,
            "detector": name,
            "rank": i + 1,
            "place": i,
            "first": None,
            "above": None,
            "equal": False,
        }
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

"""Valid entries to tamper with, and the tools to do so without leaving broken digests behind."""

import hashlib
import json
import lzma
import shutil
from dataclasses import dataclass

import numpy as np
from helpers_split import make_split
from oodd_leaderboard.submit import Statement, submit
from oodd_leaderboard.verify import verify_entry

from oodd_eval.api import evaluate
from oodd_eval.data import files
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval
from oodd_eval.metrics.catalogue import metric_info


@dataclass(frozen=True)
class Submissions:
    """A split, results on it, and two valid entries: `plain`, and `full` with curves."""

    split: object
    results: object
    plain: object
    full: object


def make_submissions(home):
    """Run two trivial detectors on a small split; the plain entry knows no split's place."""
    # 20 calibration trajectories are enough for guaranteed alarms at 10 %.
    split = make_split(home / "split", ("cartpole",), calibration=20, name="small")
    results = home / "results"
    for detector in ("persistence", "random"):
        evaluate(detector, split, output=results)
    statement = Statement(submitter="A. Tester", citation="Tester, Trivial rows, 2026")
    plain = submit(results, home / "plain", statement)
    full = submit(results, home / "full", statement, detectors="persistence", split=split)
    return Submissions(split, results, plain.path, full.path)


class Draft:
    """A copy of an entry whose content can be changed.

    Attributes
    ----------
    path
        Its directory.
    entry, records
        The JSON of ``entry.json`` and of each record; written by `write`.
    """

    def __init__(self, source, home):
        self.path = home / source.name
        shutil.copytree(source, self.path)
        self.entry = json.loads((self.path / "entry.json").read_text())
        self.records = [
            json.loads(line) for line in self.file("records.jsonl").read_text().splitlines()
        ]
        self.sealed = True
        self.written = False

    def file(self, name):
        return self.path / name

    def write(self):
        """Write what was changed, with fitting digests unless `sealed` is False."""
        self.file("records.jsonl").write_text("".join(json.dumps(r) + "\n" for r in self.records))
        self.written = True
        self.seal()

    def seal(self):
        """Write ``entry.json`` with the digests of the files as they are now."""
        if self.sealed:
            for name, facts in self.entry["files"].items():
                if self.file(name).is_file():
                    content = self.file(name).read_bytes()
                    facts["sha256"] = hashlib.sha256(content).hexdigest()
                    facts["bytes"] = len(content)
        self.file("entry.json").write_text(json.dumps(self.entry))

    def packed(self, name, content=None, ending=".gz"):
        """Replace a file by its packed form, or by other bytes under that name."""
        file = self.file(name)
        pack = {".gz": files.compress, ".xz": lzma.compress}[ending]
        content = pack(file.read_bytes()) if content is None else content
        file.unlink()
        file.with_name(name + ending).write_bytes(content)
        del self.entry["files"][name]
        self.entry["files"][name + ending] = {}
        self.seal()

    def consistent(self, index, name):
        """Make value, n and interval of a metric what its changed terms give."""
        record = self.records[index]
        top, bottom = map(np.array, record["per_trajectory"][name])
        sums = Contribution(top, bottom)
        cell = drawn_cell(record["environment"], 0, sums)
        low, high = mean_interval([cell], kind=metric_info(name).interval)
        record["metrics"][name] = {"value": sums.value, "low": low, "high": high, "n": sums.n}

    def verdict(self, split=None):
        """Write what was changed, unless that was done, and verify."""
        if not self.written:
            self.write()
        return verify_entry(self.path, split=split)


def assert_refused(verdict, field, said=""):
    """Check that some problem is of this field, or of this file, and says this."""
    problems = verdict.findings.problems
    assert not verdict.ok
    assert any(
        (
            p.field.partition("[")[0] == field
            or p.field == field
            or (not p.field and p.where.startswith(field))
        )
        and said in p.message
        for p in problems
    ), "\n".join(["not refused as expected:", *(p.text for p in problems)])

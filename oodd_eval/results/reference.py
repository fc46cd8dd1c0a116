"""Sets of records that are compared, and references: files of records to compare with.

A reference is a file of records, such as ``records.jsonl``, without what no comparison needs:
intervals, values of single trajectories and costs. So it is small, and a change of it can be read.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from oodd_eval.data.condition import in_suite_order
from oodd_eval.data.facts import ENVIRONMENTS, in_order
from oodd_eval.data.files import packed, write_bytes
from oodd_eval.errors import ResultsError
from oodd_eval.names import Predicate
from oodd_eval.results.board import Conditions
from oodd_eval.results.directory import ResultsDirectory, read_records
from oodd_eval.results.identity import Cell
from oodd_eval.results.record import NAN, Metric, Record


@dataclass(frozen=True, slots=True)
class RecordSet:
    """Records by conditions and cell, and where they are from, as messages name it."""

    where: str
    boards: dict[Conditions, dict[Cell, Record]]

    @classmethod
    def of(cls, records: Iterable[Record], where: str = "records") -> "RecordSet":
        """Arrange records for comparison; of several of one cell, the last one counts."""
        boards: dict[Conditions, dict[Cell, Record]] = {}
        for r in records:
            boards.setdefault(Conditions.of(r), {})[r.cell] = r
        return cls(where, boards)

    @property
    def records(self) -> list[Record]:
        """All records."""
        return [record for cells in self.boards.values() for record in cells.values()]

    def selected(self, passes: Predicate) -> "RecordSet":
        """Return the records of those cells only whose text passes."""
        return RecordSet.of((r for r in self.records if passes(str(r.cell))), self.where)

    def metrics(self) -> list[str]:
        """Return the names of all metrics that occur, in their order."""
        return list(dict.fromkeys(name for r in self.records for name in r.metrics))


def read_record_set(path: Path | str) -> RecordSet:
    """Read the records of a results directory or of a file, such as a reference."""
    path = Path(path)
    if not path.exists():
        raise ResultsError(
            f"no results or reference at {str(path)!r}: expected a results directory, or a file of "
            "records (*.jsonl) such as oodd-eval compare --write-reference writes"
        )
    records = ResultsDirectory(path).records() if path.is_dir() else read_records(path)
    return RecordSet.of(records, str(path))


def write_reference(
    records: Iterable[Record], path: Path | str, *, keep: Collection[str] = ()
) -> None:
    """Write a file of records to compare with later: values, without intervals and costs.

    Records stand in the order of the benchmark, whatever the order in which cells ran. Metrics to
    `keep` are the only ones then, with their terms, from which intervals can be made again. A name
    that ends in ``.gz`` gets a compressed file.
    """
    records = list(records)
    environments = in_order((r.environment for r in records), ENVIRONMENTS)
    conditions = in_suite_order(r.condition for r in records)

    def order(r: Record) -> tuple[str, str, int, int, str]:
        position = environments.index(r.environment), conditions.index(r.condition)
        return r.split, r.split_digest, *position, str(r.cell)

    versions, lines = ("oodd_eval", "python", "numpy"), []
    for r in sorted(records, key=order):
        chosen = {name: m for name, m in r.metrics.items() if name in keep or not keep}
        metrics = {name: Metric(m.value, n=m.n) for name, m in chosen.items()}
        terms = {name: r.per_trajectory[name] for name in keep if r.ok}
        kept = replace(
            r,
            metrics=metrics,
            per_trajectory=terms,
            scores="",
            seconds_fit=NAN,
            seconds_score=NAN,
            steps_scored=None,
            peak_rss_mb=NAN,
            provenance={k: v for k, v in r.provenance.items() if k in versions},
        )
        lines.append(kept.to_json() + "\n")
    content = "".join(lines).encode()
    write_bytes(Path(path), packed(Path(path), content))

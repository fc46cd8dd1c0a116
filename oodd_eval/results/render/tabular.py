"""Results for spreadsheets and scripts, as CSV and JSON."""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final
from xml.etree import ElementTree as ET

from oodd_eval.data.bounded import without_nan
from oodd_eval.results.comparison import MEANINGS, Comparison, Difference
from oodd_eval.results.render import renders
from oodd_eval.results.report import Report, by_suite, flat, message


@renders("csv", "a line per cell with all metrics", tables=False)
def cells_as_csv(report: Report) -> str:
    """Return a report's cells as CSV, their columns first."""
    return csv_rows(without_nan(flat(report.records)))


@renders("json", "the same as a JSON array", tables=False)
def cells_as_json(report: Report) -> str:
    """Return a report's cells as a JSON array."""
    return json.dumps(without_nan(flat(report.records)), indent=1) + "\n"


def number(value: float) -> str:
    """Return a number with six significant digits for CSV; empty where undefined.

    Numbers that are rounding alone become zero: their digits may differ between machines.
    """
    if math.isnan(value):
        return ""
    return f"{value if abs(value) > 1e-12 else 0.0:.6g}"


def csv_rows(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows with the same columns as CSV, their names first."""
    return csv_text([list(rows[0]), *(list(row.values()) for row in rows)])


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Return lines of fields as CSV."""
    text = io.StringIO()
    # The same bytes on every system.
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, not even escaped."""


def junit(comparison: Comparison) -> str:
    """Return JUnit XML: a suite per split and detector, a case per cell (or mean) and metric."""
    attributes = {"name": "oodd-eval compare", **_counts(comparison.differences)}
    root = ET.Element("testsuites", attributes)
    for (split, detector), differences in by_suite(comparison.differences).items():
        name = _clean(f"{split}::{detector}")
        suite = ET.SubElement(root, "testsuite", {"name": name, **_counts(differences)})
        suite.set("skipped", str(sum(d.verdict == "new" for d in differences)))
        for d in differences:
            names = {"name": d.tolerance.metric, "classname": _clean(str(d)), "time": "0"}
            case = ET.SubElement(suite, "testcase", names)
            if d.fails:
                failure = ET.SubElement(case, "failure", type=d.verdict, message=_clean(message(d)))
                failure.text = f"{MEANINGS[d.verdict]}; the tolerance is {d.tolerance.text}"
            elif d.verdict == "new":
                ET.SubElement(case, "skipped", message=MEANINGS["new"])
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _counts(differences: Sequence[Difference]) -> dict[str, str]:
    failures = sum(d.fails for d in differences)
    return {"tests": str(len(differences)), "failures": str(failures), "errors": "0", "time": "0"}


def _clean(text: str) -> str:
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)

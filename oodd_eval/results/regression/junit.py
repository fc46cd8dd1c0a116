"""A comparison as JUnit XML, which continuous-integration services show: a test case per figure.

The layout is that of the schema of Jenkins' xUnit plug-in, ``junit-10.xsd``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Final
from xml.etree import ElementTree as ET

from oodd_eval.results.regression.differences import MEANINGS, Comparison, Difference
from oodd_eval.results.regression.rendering import change

_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, not even escaped."""


def render(comparison: Comparison) -> str:
    """Return JUnit XML: a suite per split and detector, a test case per cell (or mean) and metric.

    A figure for which the comparison fails is a failure; a new cell is skipped.
    """
    suites: dict[str, list[Difference]] = {}
    for d in comparison.differences:
        suites.setdefault(f"{d.split}::{d.detector}", []).append(d)
    whole = {"name": "oodd-eval compare", **_counts(comparison.differences)}
    root = ET.Element("testsuites", whole)
    for name, differences in suites.items():
        suite = ET.SubElement(root, "testsuite", {"name": _clean(name), **_counts(differences)})
        suite.set("skipped", str(sum(d.verdict == "new" for d in differences)))
        for d in differences:
            _case(suite, d)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _counts(differences: Sequence[Difference]) -> dict[str, str]:
    failures = sum(d.fails for d in differences)
    return {"tests": str(len(differences)), "failures": str(failures), "errors": "0", "time": "0"}


def _case(suite: ET.Element, d: Difference) -> None:
    cell = f"{d.split}/{d.place}::{d.detector}"
    case = ET.SubElement(suite, "testcase", name=d.metric, classname=_clean(cell), time="0")
    if d.fails:
        failure = ET.SubElement(case, "failure", type=d.verdict, message=_clean(message(d)))
        failure.text = f"{MEANINGS[d.verdict]}; the tolerance is {d.tolerance.text}"
    elif d.verdict == "new":
        ET.SubElement(case, "skipped", message=MEANINGS["new"])


def message(d: Difference) -> str:
    """Return one line about a difference: figures, change, tolerance and what it means."""
    reference, now = (
        "undefined" if math.isnan(v) else f"{v:.6g}" for v in (d.reference, d.now)
    )  # fmt: skip
    figures = f"{d.metric} {d.verdict}: reference {reference}, now {now}, {change(d)}"
    return f"{figures}, tolerance {d.tolerance.text}"


def _clean(text: str) -> str:
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)

"""A comparison as JUnit XML, laid out as the schema of Jenkins' xUnit plug-in, ``junit-10.xsd``."""

import re
from collections.abc import Sequence
from typing import Final
from xml.etree import ElementTree as ET

from oodd_eval.results.compare import MEANINGS, Comparison, Difference, by_suite, message

_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, not even escaped."""


def junit(comparison: Comparison) -> str:
    """Return JUnit XML: a suite per split and detector, a case per cell (or mean) and metric."""
    whole = {"name": "oodd-eval compare", **_counts(comparison.differences)}
    root = ET.Element("testsuites", whole)
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

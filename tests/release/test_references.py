"""This project's own check of its reference scores, and the page about such checks."""

import re
from pathlib import Path

import pytest
from helpers_docs import parse

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS, PROTOCOL, TABLE1
from oodd_eval.data.files import read_text
from oodd_eval.names import expression
from oodd_eval.results.board import Conditions
from oodd_eval.results.comparison import MEANINGS, read_record_set, write_reference

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs/regression-checks.md").read_text()
CHECK = (ROOT / ".ci/run").read_text()
REFERENCES = {
    "mini.jsonl.xz": ("rf[h=1,seed=0]",),
    "quick.jsonl.xz": (
        "npn[h=1,seed=0,members=1,updates=250]",
        "riqn[h=1,seed=0,members=1,updates=250]",
        "pe-a[h=1,seed=0,updates=900]",
    ),
}
"""Files of reference scores, and the settings in them."""


def test_the_document_names_every_verdict_and_every_option_of_the_plugin():
    assert all(re.search(rf"\b{verdict}\b", DOCUMENT) for verdict in MEANINGS)
    source = (ROOT / "checks/oodd_checks/pytest_plugin.py").read_text()
    options = set(re.findall(r'add\("(--oodd-[a-z-]+)"', source))
    assert options == set(re.findall(r"^\| `(--oodd-[a-z-]+)", DOCUMENT, re.MULTILINE))


def reference(name):
    return ROOT / "leaderboard/reference" / name


@pytest.mark.parametrize("name", REFERENCES)
def test_the_references_of_this_project_are_of_the_split_that_ships(name):
    found = read_record_set(reference(name))
    ((conditions, cells),) = found.boards.items()
    assert conditions == Conditions("mini", load_split("mini").digest, PROTOCOL, None)
    assert all(r.ok for r in found.records)
    whole = {f"mini/{e}/{a}::{s}" for e in ENVIRONMENTS for a in TABLE1 for s in REFERENCES[name]}
    assert whole == set(map(str, cells))


def test_the_reference_of_whole_forests_is_of_the_committed_records(tmp_path):
    records = read_record_set(ROOT / "leaderboard/results/paper-mini").records
    write_reference([r for r in records if "::rf[h=1,seed=0]" in str(r.cell)], tmp_path / "r.jsonl")
    assert read_text(reference("mini.jsonl.xz")) == read_text(tmp_path / "r.jsonl")


def own_check():
    """Parse the commands of this project's own check of its reference scores."""
    lines = re.findall(r"step \.venv/bin/(oodd-eval .*)", CHECK)
    return [parse(line) for line in lines]


def test_the_check_of_this_project_compares_exactly_the_cells_that_it_runs():
    """One compared and not run is missing, which fails; one run and not compared is unchecked."""
    cells = [str(r.cell) for name in REFERENCES for r in read_record_set(reference(name)).records]
    ran = set()
    for options in own_check():
        assert options.command == "run" or options.two_sided
        if options.command == "run":
            names = ENVIRONMENTS if options.env == "all" else options.env.split(",")
            changed = "".join(f",{name}={value}" for name, value in options.param or ())
            ran |= {
                f"mini/{e}/{a}::{detector}[h=1,seed=0{changed}]"
                for e in names
                for a in TABLE1
                for detector in options.detector.split(",")
            }
        else:
            wanted = expression(options.expression)
            compared = {cell for cell in cells if wanted(cell)}
            assert compared
            assert compared <= ran
            ran -= compared
    assert not ran

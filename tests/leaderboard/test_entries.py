"""Entries: those of shipped rows agree with their detectors; strangers' are read strictly."""

import hashlib
from pathlib import Path

import pytest
from oodd_leaderboard.entry import Entry, read_entries, read_entry

from oodd_eval.errors import ResultsError
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.parameters import resolve_parameters
from tests.helpers_docs import ROOT

PLUGINS = discover()
ENTRIES = ROOT / "leaderboard/entries"
SHIPPED = [entry for entry in read_entries(ENTRIES) if entry.shipped]
STRANGERS = [entry for entry in read_entries(ENTRIES) if not entry.shipped]


@pytest.mark.parametrize("entry", SHIPPED, ids=lambda entry: entry.name)
def test_an_entry_of_a_shipped_row_agrees_with_its_detector(entry: Entry) -> None:
    spec = PLUGINS.offer(entry.detector).spec
    assert entry.training == spec.training
    resolve_parameters(spec.name, spec.parameters, entry.parameters, others=spec.other_parameters)
    assert (entry.origin == "oracle") == (entry.training == "oracle")
    assert bool(entry.paper) == (entry.origin in {"paper", "others"})
    assert entry.authors
    assert entry.year


def test_every_detector_that_the_package_ships_has_an_entry() -> None:
    # Seasons have no failed episodes to learn from.
    specs = (offer.spec for offer in PLUGINS.offers.values())
    names = {spec.name for spec in specs if spec.training != "failures"}
    assert names <= {entry.detector for entry in SHIPPED}


@pytest.mark.parametrize("entry", STRANGERS, ids=lambda entry: entry.name)
def test_a_strangers_entry_names_its_authors_and_brings_its_wheel(entry: Entry) -> None:
    assert entry.authors
    assert entry.licence
    assert entry.detector not in PLUGINS.offers
    if entry.wheel:
        content = (ENTRIES / entry.name / entry.wheel).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry.sha256


GOOD = 'requirement = "oodd-mine==1.2"\nsha256 = "{}"\nauthors = "A. Author"\n'


@pytest.mark.parametrize(
    ("line", "field"),
    [
        ("", ""),
        ('paper = "<b>x"', "paper"),
        ('paper = "a\\u202eb"', "paper"),
        ('url = "javascript:alert(1)"', "url"),
        ('wheel = "../x.whl"', "wheel"),
        ('detector = "../x"', "detector"),
        ('year = "2026"', "year"),
        ('grant = "trusted"', "unknown field of entries 'grant'"),
        ('name = "other"', "name"),
        ('origin = "ours"', "origin"),
        ('[parameters]\n"<b>" = 1', "parameters"),
    ],
)
def test_a_strangers_entry_is_read_strictly(tmp_path: Path, line: str, field: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(GOOD.format("0" * 64) + line)
    if not field:
        assert read_entry(path).distribution == "oodd-mine"
        return
    with pytest.raises(ResultsError, match=rf"mine\.toml: {field}"):
        read_entry(path)


def test_a_distribution_has_one_ranked_row(tmp_path: Path) -> None:
    for name in ("first", "second"):
        (tmp_path / f"{name}.toml").write_text(GOOD.format("0" * 64))
    with pytest.raises(ResultsError, match="variant"):
        read_entries(tmp_path)


def test_an_entry_without_a_digest_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('requirement = "oodd-mine==1.2"')
    with pytest.raises(ResultsError, match="sha256 is missing"):
        read_entries(tmp_path)

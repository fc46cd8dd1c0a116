"""Entries: what a season runs, one row of the board each, as ``NAME.toml`` or ``NAME/entry.toml``.

::

    requirement = "oodd-mine==1.2"   # what pip installs; or wheel = "FILE.whl", beside this file
    sha256 = "…"                     # of the file that pip installs
    detector = "mine"                # as the distribution offers it; by default the entry's name
    authors = "A. Author, B. Author"
    paper = "Title, venue"
    year = 2026
    licence = "MIT"

    [parameters]                     # of the ranked row, those that are not defaults
    updates = 9000

An entry with neither requirement nor wheel is a row that oodd-eval ships. Reading entries imports
nothing of theirs.
"""

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

from pydantic import TypeAdapter, ValidationError

from oodd_eval.data.bounded import read_toml
from oodd_eval.errors import ResultsError, UnknownNameError
from oodd_eval.names import check_known
from oodd_eval.plugins.contract import Training
from oodd_eval.plugins.installed import normalized
from oodd_leaderboard import formats

ENTRY: Final = "entry.toml"
FORMS: Final = f"NAME.toml or NAME/{ENTRY} for each row"

Origin = Literal["paper", "others", "project", "trivial", "oracle"]
"""Whose a row is: the paper's, other authors', this project's, a trivial one, an oracle."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One row of the board, as its authors describe it.

    Parameters
    ----------
    name
        Name of the row: that of its file or directory.
    requirement, wheel
        What pip installs: a name with a version, or a file beside ``entry.toml``. Neither for a
        row that oodd-eval ships.
    sha256
        Digest of the wheel that is installed; a stranger's entry has one.
    detector
        Name of the detector in the distribution; by default the entry's name.
    parameters
        Those that are not defaults.
    horizon
        Δ, in steps.
    variant
        Whether the row is a further one of a distribution whose ranked row is another entry's.
    training
        What it learns from, see `DetectorSpec`. Others than ``nominal`` are not ranked.
    authors, paper, url, year, licence
        Plain text of one line each, and the year of the paper or of the software.
    origin
        Whose row it is; those of strangers are always ``others``.
    """

    name: str
    requirement: str = ""
    wheel: str = ""
    sha256: str = ""
    detector: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    horizon: int = 1
    variant: bool = False
    training: Training = "nominal"
    authors: str = ""
    paper: str = ""
    url: str = ""
    year: int | None = None
    licence: str = ""
    origin: Origin = "others"

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}

    @property
    def shipped(self) -> bool:
        """Whether oodd-eval ships the row, so that nothing is installed for it."""
        return not (self.requirement or self.wheel)

    @property
    def distribution(self) -> str:
        """Normalized name of the distribution that pip installs."""
        if self.shipped:
            return "oodd-eval"
        text = self.wheel.partition("-")[0] if self.wheel else self.requirement
        name = re.match(r"[A-Za-z0-9._-]*[A-Za-z0-9]", text)
        return normalized(name[0] if name else text)


def read_entry(path: Path) -> Entry:
    """Read one entry from its file; `ResultsError` says which field is wrong."""
    name = path.parent.name if path.name == ENTRY else path.stem
    content = read_toml(path, ResultsError)
    if "name" in content:
        raise ResultsError(f"{path}: name is the file's, expected no field of that name")
    try:
        check_known("field of entries", [f.name for f in dataclasses.fields(Entry)[1:]], *content)
    except UnknownNameError as error:
        raise ResultsError(f"{path}: {error}") from None
    try:
        fields = json.dumps({"name": name, "detector": name, **content}, default=str)
        entry = TypeAdapter(Entry).validate_json(fields)
    except ValidationError as error:
        raise ResultsError(f"{path}: {formats.explained(error)}") from None
    for name, problem in _problems(entry):
        raise ResultsError(f"{path}: {name} {problem}")
    return entry


def _problems(entry: Entry) -> Iterator[tuple[str, str]]:
    """Yield fields that no page can show, or no file can have as its name."""
    for name, rule in _RULES.items():
        if (value := getattr(entry, name)) and (problem := rule.complaint(value)):
            yield name, problem
    yield from formats.unsafe(dict(entry.parameters), "parameters")
    if entry.requirement and entry.wheel:
        yield "wheel", "is there beside requirement, expected one of the two"
    if not entry.shipped and not entry.sha256:
        yield "sha256", "is missing, expected the digest of what pip installs"
    if not entry.shipped and entry.origin != "others":
        yield "origin", f"is {entry.origin!r}, expected 'others' for a row that is not shipped"


_RULES: Final = {
    "name": formats.ENTRY_NAME,
    "detector": formats.NAME,
    "requirement": formats.text(200),
    "wheel": formats.WHEEL,
    "sha256": formats.DIGEST,
    **dict.fromkeys(("authors", "paper", "licence"), formats.text(300)),
    "url": formats.URL,
}


def read_entries(directory: Path) -> list[Entry]:
    """Read the entries of a directory, or the one whose directory it is, in the order of names.

    `ResultsError`: there is none, two have one name, or one distribution has two ranked rows.
    """
    if not directory.is_dir():
        raise ResultsError(f"no directory {str(directory)!r}: expected one with {FORMS}")
    files = sorted((*directory.glob("*.toml"), *directory.glob(f"*/{ENTRY}")))
    entries = sorted(map(read_entry, files), key=lambda entry: entry.name)
    _check_apart(entries)
    return entries


def _check_apart(entries: Sequence[Entry]) -> None:
    names: dict[str, Entry] = {}
    ranked: dict[str, Entry] = {}
    for entry in entries:
        if names.setdefault(entry.name, entry) is not entry:
            raise ResultsError(f"two entries are called {entry.name!r}: rename one of them")
        if entry.shipped or entry.variant:
            continue
        if (first := ranked.setdefault(entry.distribution, entry)) is not entry:
            raise ResultsError(
                f"entries {first.name!r} and {entry.name!r} are both ranked rows of "
                f"{entry.distribution}, expected one: add `variant = true` to the other"
            )

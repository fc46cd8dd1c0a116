"""Levels of trust: granted by maintainers in one file, which no entry can write.

``trust.json`` lies beside the directory of the entries. A grant names the digest of an
``entry.json``, which has the digests of all other files: a changed entry has lost its grant.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import ClassVar, Final, Literal, get_args

from pydantic import TypeAdapter, ValidationError

from oodd_eval.data.files import write_text
from oodd_eval.errors import ResultsError

GRANTS: Final = "trust.json"

Means = dict[str, dict[str, tuple[float, float]]]
Trust = Literal["reported", "re-scored", "re-run"]
TRUST: Final[tuple[Trust, ...]] = get_args(Trust)  # levels of trust, the lowest first


@dataclass(frozen=True, slots=True)
class Grant:
    """A level of trust above ``"reported"``, of the entry whose ``entry.json`` has a digest.

    `by` is who granted it, `day` when (ISO 8601), and `how` what was compared with what. `means`
    are over the cells that a re-run has, by row and metric: the entry's, and the re-run's.
    """

    entry: str
    trust: Literal["re-scored", "re-run"]
    by: str
    day: str
    how: str
    means: Means = field(default_factory=dict)

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}


@dataclass(frozen=True, slots=True)
class _Layout:
    schema: Literal[1]  # version of the layout; others are refused
    grants: dict[str, Grant]

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}


def digest_of(content: bytes) -> str:
    """Return the SHA-256 digest of the bytes of a file, as grants and entries name it."""
    return hashlib.sha256(content).hexdigest()


def read_grants(results: Path) -> dict[str, Grant]:
    """Return the grants beside a directory of entries, by the entry's name.

    `ResultsError`: the file is not of its format.
    """
    file = results.absolute().parent / GRANTS
    if not file.exists():
        return {}
    try:
        return TypeAdapter(_Layout).validate_json(file.read_bytes()).grants
    except (OSError, ValidationError) as error:
        first = error.errors(include_url=False)[0] if isinstance(error, ValidationError) else None
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg']}" if first else str(error)
        raise ResultsError(
            f"{str(file)!r} holds no grants: {why}; restore it from the history"
        ) from None


def write_grants(results: Path, grants: Mapping[str, Grant]) -> Path:
    """Write the grants beside a directory of entries, and return the file."""
    file = results.absolute().parent / GRANTS
    layout = _Layout(1, dict(sorted(grants.items())))
    write_text(file, json.dumps(asdict(layout), indent=1, sort_keys=True) + "\n")
    return file

"""A run of an entry's rows once more, on a split of seeds that are drawn after the entry was made.

The directory of a re-run is a results directory with the split that was built for it, ``split``,
and the order, ``rerun.json``. The order is written before anything is recorded, and names the
digest of ``entry.json``: seeds that were drawn for one entry do not count for another.
"""

import json
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import ClassVar, Final, Literal

from pydantic import TypeAdapter, ValidationError

from oodd_eval.data.facts import CUSTOM_SEED_BASES, ENVIRONMENTS, SPLITS, SplitDefinition
from oodd_eval.data.files import write_text
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.leaderboard.entry import ENTRY, SubmittedEntry
from oodd_eval.leaderboard.grants import digest_of

ORDER: Final = "rerun.json"
SPLIT_DIRECTORY: Final = "split"  # directory of the split, in that of the re-run


@dataclass(frozen=True, slots=True)
class RerunOrder:
    """Seeds drawn on a `day` (ISO 8601) for an entry, given by the digest of its ``entry.json``.

    `sandbox` is False as soon as one worker was a plain one.
    """

    entry: str
    seed_base: int
    day: str
    environments: list[str]
    sandbox: bool
    schema: Literal[1] = 1  # version of the layout; others are refused

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}

    def __str__(self) -> str:
        """Return what a grant says of it."""
        where = "in a sandbox" if self.sandbox else "without a sandbox"
        return f"seed base {self.seed_base} drawn on {self.day} for this entry, {where}"


def read_order(directory: Path) -> RerunOrder | None:
    """Return the order in a directory, None if it has none; `ResultsError` for a damaged one."""
    file = directory / ORDER
    if not file.exists():
        return None
    try:
        return TypeAdapter(RerunOrder).validate_json(file.read_bytes())
    except (OSError, ValidationError) as error:
        raise ResultsError(
            f"{str(file)!r} is no order of a re-run: {error}; use another directory"
        ) from None


def draw(
    entry: SubmittedEntry, directory: Path, environments: Sequence[str], *, sandbox: bool
) -> RerunOrder:
    """Draw seeds for an entry and write the order, or go on with the one that is there.

    `UsageError`: the order there is for another entry, another version of it, or environments.
    """
    digest = digest_of((entry.path / ENTRY).read_bytes())
    found = read_order(directory)
    if found is None:
        taken = {definition.seed_base for definition in SPLITS.values()}
        base = secrets.choice([n for n in CUSTOM_SEED_BASES if n not in taken])
        day = datetime.now(UTC).date().isoformat()
        found = RerunOrder(digest, base, day, list(environments), sandbox)
    if found.entry != digest:
        raise UsageError(
            f"{str(directory)!r} is a re-run of entry.json {found.entry[:12]}, but {entry.meta.id} "
            f"has {digest[:12]}: seeds are drawn for one version of an entry; name another --output"
        )
    if found.environments != list(environments):
        raise UsageError(
            f"{str(directory)!r} is a re-run on {', '.join(found.environments)}, expected "
            f"{', '.join(environments)}: name another --output"
        )
    found = replace(found, sandbox=found.sandbox and sandbox)
    directory.mkdir(parents=True, exist_ok=True)
    write_text(directory / ORDER, json.dumps(asdict(found), indent=1, sort_keys=True) + "\n")
    return found


def definition_of(entry: SubmittedEntry, order: RerunOrder) -> SplitDefinition:
    """Return the entry's split, recorded anew from the order's seeds; `UsageError` for others."""
    definition = SPLITS.get(entry.meta.split)
    if definition is None or definition.base:
        known = ", ".join(name for name, one in SPLITS.items() if not one.base)
        raise UsageError(
            f"{entry.meta.id} is on split {entry.meta.split!r}: expected one that can be recorded "
            f"with other seeds ({known})"
        )
    return replace(definition, name=f"rerun-{order.seed_base}", seed_base=order.seed_base)


def environments_of(entry: SubmittedEntry) -> list[str]:
    """Return the environments that an entry has, in the order of the paper."""
    found = {record.environment for record in entry.records}
    return [name for name in ENVIRONMENTS if name in found]

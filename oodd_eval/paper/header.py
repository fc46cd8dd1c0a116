"""What a directory of a reproduction holds: ``reproduction.json``, read before anything in it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Final

from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.paper.experiments import Tier

FILE: Final = "reproduction.json"
SCHEMA: Final = 1


@dataclass(frozen=True, slots=True)
class Header:
    """What is reproduced, on what.

    Attributes
    ----------
    tier
        How much is run.
    split, split_digest, protocol
        The data and the rules.
    test, train, calibration
        Trajectories per environment that are used.
    units
        How many units all experiments together have.
    """

    tier: Tier
    split: str
    split_digest: str
    protocol: int
    train: int
    calibration: int
    test: int
    units: int

    @property
    def data(self) -> tuple[str, int]:
        """What records must agree in to stand in one table."""
        return self.split_digest, self.protocol

    def dump(self) -> str:
        """Return the content of the file."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1) + "\n"


def load(directory: Path) -> Header:
    """Read the header of a directory.

    Raises
    ------
    ResultsError
        When there is none, or it cannot be read.
    """
    path = directory / FILE
    try:
        plain = json.loads(path.read_text(encoding="utf-8"))
        if plain.pop("schema") != SCHEMA:
            raise ResultsError(f"{str(path)!r} was written by another version of oodd-eval")
        tier = {f.name: plain["tier"][f.name] for f in fields(Tier)}
        return Header(**plain | {"tier": Tier(**tier)})
    except FileNotFoundError:
        raise ResultsError(
            f"no reproduction in {str(directory)!r}: expected a file {FILE}, written by "
            "oodd-eval reproduce"
        ) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, ResultsError):
            raise
        raise ResultsError(f"{str(path)!r} cannot be read: {error!r}") from None


def check_same_data(directory: Path, header: Header) -> None:
    """Refuse to mix a reproduction with another one that is in the directory.

    Raises
    ------
    UsageError
        When the directory holds one on other data or under other rules.
    """
    if not (directory / FILE).exists():
        return
    other = load(directory)
    if other.data != header.data:
        raise UsageError(
            f"{str(directory)!r} holds a reproduction of tier {other.tier.name} on split "
            f"{other.split} (digest {other.split_digest[:12]}, protocol {other.protocol}), and "
            f"this is tier {header.tier.name} on {header.split} (digest "
            f"{header.split_digest[:12]}, protocol {header.protocol}): name another directory "
            "with --output"
        )

"""Flags: columns with few values."""

from collections.abc import Mapping
from typing import Any, Final

from oodd_logs.kinds import Kind


def _recognise(columns: Mapping[str, Any]) -> dict[str | tuple[str, ...], Any]:
    flags = {name: facts.values for name, facts in columns.items() if facts.flag}
    return {
        name: ", ".join(v if isinstance(v, str) else f"{v:g}" for v in sorted(values, key=str))
        for name, values in flags.items()
    }


KIND: Final = Kind(
    "flag",
    "{names}: few values; a command, a state, or a label by another name",
    recognise=_recognise,
)

"""Roles of columns: why some are no sensors, and in which words it is said.

A role is one of `ROLES`, or the name of a kind of columns (`oodd_logs.kinds`).
"""

import json
import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from oodd_logs.kinds import Kind, kinds
from oodd_logs.selecting import split_unit


class Role(NamedTuple):
    """Words for a role.

    Parameters
    ----------
    reason
        Why a column is no sensor; empty for one that is.
    looks
        What it looks like, in a table: ``{unit}`` and ``{values}`` come from the logs.
    advice
        What to know and to write, where it needs saying: ``{names}``, ``{first}`` and ``{line}``.
    """

    reason: str
    looks: str
    advice: str = ""


ROLES: Final[Mapping[str, Role]] = {
    "times": Role("a time", "time ({unit})"),
    "labels": Role("a label", "label? {values}"),
    "standing": Role(
        "stamps that often stand still",
        "time that stands still",
        "{names}: stamps that often stand still are no times of rows: rows count as equally spaced",
    ),
    "scores": Role(
        "",
        "score of a monitor",
        "{names}: by name what a monitor computed: write scores = [{first}]",
    ),
    "empty": Role("no value in any row", "empty", "{names}: no value in any row; leave out"),
    "text": Role(
        "text", "text: {values}", "{names}: text is no sensor; it may be labels, kinds or task"
    ),
    "constant": Role(
        "one value only",
        "constant",
        '{names}: one value only; leave out, or write constant = "drop"',
    ),
    "setpoints": Role(
        "constant in each recording",
        "",
        "{names}: constant in each recording, different between them: a set point (write task = "
        "{first}) or a label, no sensor",
    ),
    "partial": Role("not in all files", ""),
    "slow": Role("in topics with few rows", ""),
}
"""Roles that are told by more than numbers, in the order in which they are looked for."""

Recognised = Mapping[str, Mapping[tuple[str, ...], Any]]
"""Values of kinds by the names of their columns, by kind."""


def role_of(name: str) -> Role:
    """Return the words of a role, or kind."""
    if name in ROLES:
        return ROLES[name]
    kind = kinds()[name]
    return Role("" if kind.sensor else f"a {name}", "{kind}", kind.words)


def recognise(columns: Mapping[str, Any]) -> Recognised:
    """Return the kinds of columns that they are told to be by their facts; each is of one kind."""
    pairs = [
        (len(names), kind.name, names, value)
        for kind in kinds().values()
        if kind.recognise is not None
        for key, value in kind.recognise(columns).items()
        for names in [(key,) if isinstance(key, str) else tuple(key)]
    ]
    members: dict[str, dict[tuple[str, ...], Any]] = {}
    taken: set[str] = set()
    for _, kind_name, names, value in sorted(pairs, key=lambda pair: -pair[0]):
        if taken.isdisjoint(names):
            members.setdefault(kind_name, {})[names] = value
            taken |= {*names}
    return members


def line_of(kind: Kind, values: Mapping[tuple[str, ...], Any]) -> str:
    """Return the line of a recipe that names columns of a kind; empty where it has no key.

    >>> line_of(Kind("wrap", "", "wraps"), {("enc[ticks]",): 4096.0})
    'wraps = {enc = 4096}'
    >>> line_of(Kind("angle", "", "angles"), {("q 1",): None, ("q2",): "seen"})
    'angles = ["q 1", "q2"]'
    """
    if not kind.key or not values:
        return ""
    if all(isinstance(value, int | float) for value in values.values()):
        keys = [bare_name(name) for (name,) in values]
        keys = [key if re.fullmatch(r"[\w-]+", key, re.ASCII) else toml(key) for key in keys]
        pairs = zip(keys, values.values(), strict=True)
        return f"{kind.key} = {{{', '.join(f'{key} = {value:.12g}' for key, value in pairs)}}}"
    lists = [[*map(bare_name, names)] for names in values]
    return f"{kind.key} = {toml([names[0] if len(names) == 1 else names for names in lists])}"


def bare_name(column: str) -> str:
    """Return the name of a sensor without its prefix and unit, as other keys name it."""
    return split_unit(re.sub(r"^(obs|action):\s*", "", column))[0]


def toml(value: Any) -> str:
    """Return a text, number, truth value or a list of them as TOML, which they share with JSON."""
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)

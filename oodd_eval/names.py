"""Readers of texts that users write: lists of names, numbers, times, ``-k`` expressions."""

import ast
import fnmatch
import json
import operator
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, Final, TypeVar

from oodd_eval.errors import UnknownNameError, UsageError

Predicate = Callable[[str], bool]
Value = TypeVar("Value")
Read = TypeVar("Read")

DETECTOR_NAME: Final = r"[a-z0-9][a-z0-9-]{0,63}"
COLUMN_NAME: Final = r"[\w/][-+\w ./%()\[\]]{0,119}"
"""The name of a column of logs as a detector has it, without its sign."""

SPEC_NAME: Final = DETECTOR_NAME + r"(:[-\w/][-+\w ./%()\[\]]{0,127})?"
"""A detector's name, perhaps with a class or column behind a colon: it goes into tables."""

PARAMETER_NAME: Final = r"[A-Za-z_]\w{0,63}"

_TIMES: Final = {"": 1, "s": 1, "m": 60, "h": 3600}
_AMOUNTS: Final = (
    {"": 1, "b": 1}
    | {f"{prefix}b": 1000**i for i, prefix in enumerate("kmg", start=1)}
    | {f"{prefix}ib": 1024**i for i, prefix in enumerate("kmg", start=1)}
)


def check_known(kind: str, known: Collection[str], *names: str) -> None:
    """Raise `UnknownNameError` for the first name that is not among the known ones."""
    for name in names:
        if name not in known:
            raise UnknownNameError(kind, name, known)


def counted(n: int, noun: str) -> str:
    """Return a number with a noun in singular or plural, whose ending is ``(s)`` or ``(y/ies)``.

    >>> counted(1, "row(s) left out"), counted(3, "episode(s)"), counted(0, "entr(y/ies)")
    ('1 row left out', '3 episodes', '0 entries')
    """
    singular, plural = (r"\1", "") if n == 1 else (r"\2", "s")
    return f"{n} " + re.sub(r"\((\w+)/(\w+)\)", singular, noun).replace("(s)", plural)


def listed(names: Sequence[str], most: int = 4) -> str:
    """Return names in a sentence, of many the first ones and how many more there are.

    >>> listed(["Acrobot"]), listed(["Acrobot", "CartPole"]), listed(list("abcde"))
    ('Acrobot', 'Acrobot and CartPole', 'a, b, c and 2 more')
    """
    if len(names) > most:
        return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def select(kind: str, patterns: str, known: Iterable[str]) -> list[str]:
    """Return the known names that a comma list of names and globs, or ``"all"``, selects, in order.

    A glob without a slash stands for no long name, ``PLUGIN/NAME``.

    >>> select("environment", "hopper,a*", ["acrobot", "ant", "hopper", "a/arm"])
    ['hopper', 'acrobot', 'ant']
    """
    names = list(known)
    selected: dict[str, None] = {}
    for pattern in (p.strip() for p in patterns.split(",")):
        if not pattern:
            continue
        # In a glob the brackets of a name such as "column:pos_innov[0]" are a set of letters.
        globbed = [n for n in names if "/" in pattern or ":" in n or "/" not in n]
        exact = [pattern] if pattern in names else fnmatch.filter(globbed, pattern)
        matches = names if pattern == "all" else exact
        if not matches:
            raise UnknownNameError(kind, pattern, names)
        selected.update(dict.fromkeys(matches))
    if not selected:
        raise UsageError(f"no {kind} was named: expected names separated by commas, or 'all'")
    return list(selected)


def comma_list(names: str | Iterable[str]) -> str:
    """Return names, or a text of names with commas between them, as such a text.

    >>> comma_list("hopper,a*"), comma_list(["hopper", "ant"])
    ('hopper,a*', 'hopper,ant')
    """
    several = [names] if isinstance(names, str) or not isinstance(names, Iterable) else [*names]
    if all(isinstance(name, str) for name in several):
        return ",".join(several)
    raise UsageError(f"{names!r:.80}, expected names, or a text with commas between them")


def natural(text: str) -> int:
    """Return the whole number from 0 on that at most 18 digits stand for; -1 for another text.

    `int` also takes digits of other scripts, signs and underscores, and thousands of digits.

    >>> natural(" 12"), natural("1_000"), natural("-3"), natural("٣")
    (12, -1, -1, -1)
    """
    return int(text) if re.fullmatch(r"\s*[0-9]{1,18}\s*", text) else -1


def is_plain(number: str) -> bool:
    """Tell a number from what `float` takes for one, too: 1_000, and digits of other scripts."""
    return "_" not in number and (number.isascii() or number.strip().isascii())


def whole_numbers(text: str, *, least: int) -> list[int]:
    """Return the numbers of a comma list, each once; `UsageError` when one is below `least`."""
    numbers = list(dict.fromkeys(map(natural, text.split(","))))
    if min(numbers) >= least:
        return numbers
    raise UsageError(f"{text!r}, expected whole numbers of at least {least}, separated by commas")


def whole_number(value: object, *, least: int) -> int:
    """Return a whole number of Python or NumPy; `UsageError` when it is none, or below `least`.

    It has at most 18 digits, as that of a text.
    """
    try:
        number = -1 if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if least <= number < 10**18:
        return number
    raise UsageError(f"{value!r:.80}, expected a whole number of at least {least}")


def each_once(values: object, *, least: int) -> list[int]:
    """Return one or several whole numbers as `whole_number` does; `UsageError` for equal ones.

    >>> each_once(3, least=0), each_once(range(2), least=0)
    ([3], [0, 1])
    """
    try:
        several = list(values)  # type: ignore[call-overload]
    except TypeError:
        several = [values]
    try:
        numbers = [whole_number(value, least=least) for value in several]
    except UsageError:
        numbers = []
    if numbers and len({*numbers}) == len(numbers):
        return numbers
    raise UsageError(f"{values!r:.80}, expected whole numbers of at least {least}, each once")


def read(name: str, reader: Callable[[Value], Read], value: Value) -> Read:
    """Return what a reader makes of the value of an option or argument; name it in `UsageError`."""
    try:
        return reader(value)
    except UsageError as error:
        raise UsageError(f"{name} is {error}") from None


def seconds(text: str) -> float:
    """Return a time such as ``"90"``, ``"90s"``, ``"30m"`` or ``"2h"`` in seconds."""
    return _quantity(text, _TIMES, "a time such as 90s, 30m or 2h")


def memory_bytes(text: str) -> int:
    """Return an amount of memory such as ``"500MB"``, ``"8GB"`` or ``"8GiB"`` in bytes."""
    return int(_quantity(text, _AMOUNTS, "an amount of memory such as 500MB or 8GB"))


def _quantity(text: str, units: dict[str, int], expected: str) -> float:
    match = re.fullmatch(r"\s*([0-9]{1,18}(?:\.[0-9]+)?)\s*([A-Za-z]*)\s*", text)
    if not match or match[2].lower() not in units or float(match[1]) == 0:
        raise UsageError(f"{text!r}, expected {expected}")
    return float(match[1]) * units[match[2].lower()]


def assignment(text: str) -> tuple[str, str]:
    """Return the two sides of ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise UsageError(f"{text!r}, expected NAME=VALUE")
    return name, value


def parameter(text: str) -> tuple[str, Any]:
    """Return a name and a value, which is JSON or else plain text."""
    name, value = assignment(text)
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{name}={value[:40]}...: the value cannot be read: {error}") from None


def expression(text: str | None) -> Predicate:
    """Return the test of cell ids that an expression of ``-k`` describes; an empty one passes all.

    Words are substrings, regardless of case; ``and``, ``or``, ``not`` and round brackets join them.

    >>> selects = expression("hopper and not (iid or drift)")
    >>> selects("mini/hopper/gravity::rf[h=1,seed=0]"), selects("mini/hopper/iid::rf[h=1,seed=0]")
    (True, False)
    """
    if not text:
        return lambda _: True
    words: list[str] = []

    def named(match: re.Match[str]) -> str:
        if match[0] in {"and", "or", "not"}:
            return match[0]
        words.append(match[0].lower())
        return f"_{len(words) - 1}"

    # With a name in place of each word, this is the grammar of Python.
    source = " ".join(re.sub(r"[^\s()]+", named, text).split())
    try:
        return _test(ast.parse(source, mode="eval").body, words)
    except SyntaxError:
        expected = "words joined by and, or, not and round brackets"
        raise UsageError(f"-k {text!r} cannot be read, expected {expected}") from None


def _test(node: ast.expr, words: list[str]) -> Predicate:
    match node:
        case ast.Name(id=name):
            word = words[int(name[1:])]
            return lambda cell: word in cell.lower()
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            inner = _test(operand, words)
            return lambda cell: not inner(cell)
        case ast.BoolOp(op=operator, values=values):
            parts = [_test(value, words) for value in values]
            join = all if isinstance(operator, ast.And) else any
            return lambda cell: join(part(cell) for part in parts)
    raise SyntaxError

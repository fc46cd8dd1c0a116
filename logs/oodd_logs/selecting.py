"""Columns that a recipe names: which column of which topic is a sensor, an action, a label.

A column goes by its name in the file, with and without its unit in brackets, with and without the
prefix ``obs:`` or ``action:``, below its topic where a recording has several.
"""

import dataclasses
import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, product
from typing import Final

from oodd_eval.data.facts import Quantity
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError
from oodd_eval.names import listed
from oodd_logs.kinds.naming import pattern_of
from oodd_logs.readers.cells import nearest_spelling
from oodd_logs.recipe import Recipe
from oodd_logs.recording import Column, Recording, Topic

_PREFIX: Final = re.compile(r"\s*(obs|action)\s*:\s*(?=\S)", re.IGNORECASE)
_UNIT: Final = re.compile(r"(.*?[^\[\]\s])\s*\[\s*([^\[\]]*[^\[\]\s])\s*\]")
_SYMBOL: Final = r"(?:[numkMGµμ]?(?:Nm|Hz|Pa|bar|rad|[msgNAVWJlL])|°[CF]?|degC?|rpm|rev|min|[hKC%])"
_ROUND: Final = re.compile(rf"\s*\(((?:1/)?{_SYMBOL}(?:[ */.·^-]?(?:{_SYMBOL}|\d))*)\)\s*$")


@dataclass(frozen=True, slots=True)
class ChosenColumn:
    """A column that a recipe names.

    Parameters
    ----------
    topic, column
        Where it is, as the file calls both.
    quantity
        Name and unit in the split.
    """

    topic: str
    column: str
    quantity: Quantity


@dataclass(frozen=True, slots=True)
class Selection:
    """The columns of recordings with one layout.

    Parameters
    ----------
    sensors, actions
        In the order of the recipe, then of the file; scores behind the sensors.
    reward
        Rewards, if any.
    times
        Columns whose stamps add up, by topic, with their units.
    labels
        Those of the recipe's label columns that there are, by their text in the recipe.
    unused
        Names that no line of the recipe names.
    """

    sensors: tuple[ChosenColumn, ...]
    actions: tuple[ChosenColumn, ...]
    reward: ChosenColumn | None
    times: dict[str, tuple[ChosenColumn, ...]]
    labels: dict[str, ChosenColumn]
    unused: tuple[str, ...]

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics with sensors, actions or rewards, that of the first sensor first."""
        columns = (*self.sensors, *self.actions, *([self.reward] if self.reward else ()))
        return tuple(dict.fromkeys(column.topic for column in columns))


Layout = tuple[tuple[str, tuple[str, ...], str], ...]
"""Topics of a recording with their columns and their column of seconds."""


def layout_of(recording: Recording) -> Layout:
    """Return what decides which columns a recipe chooses."""
    return tuple((name, topic.names, topic.time) for name, topic in recording.topics.items())


def named_columns(layout: Layout) -> list[str]:
    """Return the columns of a layout as a recipe names them, without their units."""
    return [_aliases(topic, name)[-1] for topic, name in _pairs(layout)]


def _pairs(layout: Layout | None) -> list[tuple[str, str]]:
    return [(topic, name) for topic, names, _ in layout or () for name in names]


def split_unit(text: str) -> tuple[str, str]:
    """Return name and unit of a column; digits in brackets are an index, not a unit.

    >>> split_unit("q1[rad]"), split_unit("q[0]")
    (('q1', 'rad'), ('q[0]', ''))
    """
    match = _UNIT.fullmatch(text.strip())
    if match and not match[2].isdigit():
        return match[1], match[2]
    return text.strip(), ""


def plain_name(text: str) -> str:
    """Return the name of a column without unit, and without what spellings differ in.

    >>> plain_name("Joint\N{NO-BREAK SPACE}1 [rad]"), plain_name("joint1")
    ('joint1', 'joint1')
    """
    letters = unicodedata.normalize("NFKC", split_unit(_in_square(text))[0]).casefold()
    return "".join(c for c in letters if not c.isspace() and unicodedata.category(c) != "Cf")


def plain_unit(text: str) -> str:
    """Return the unit of a column, in round brackets, too, without what spellings differ in.

    >>> plain_unit("speed [m/s]"), plain_unit("speed (m/s)"), plain_unit("speed (raw)")
    ('m/s', 'm/s', '')
    """
    return " ".join(unicodedata.normalize("NFKC", split_unit(_in_square(text))[1]).split())


def _in_square(text: str) -> str:
    return _ROUND.sub(r" [\1]", text)


def respellings(layout: Layout, recipe: Recipe, first: Layout | None) -> dict[tuple[str, str], str]:
    """Return names for columns that are spelled otherwise than in a recipe, or the first recording.

    They differ from these in case, Unicode form, blanks, the brackets of a unit, or in that one of
    the two has no unit.

    Parameters
    ----------
    layout
        Topics of a recording with their columns.
    recipe
        Its keys name columns.
    first
        Those of the first recording, as they were named there.

    Returns
    -------
    dict
        From topic and column to the name that a recipe finds.
    """
    expected, there = {*_pairs(first)}, {*_pairs(layout)}
    spellings: dict[tuple[str, str], list[str]] = defaultdict(list)
    for topic, name in sorted(there - expected):
        spellings[topic, plain_name(_aliases("", name)[-1])].append(name)

    def spelled(topic: str, text: str) -> str:
        """Return the one column that is spelled otherwise than a text; empty for none."""
        columns = spellings[topic, plain_name(text)]
        units = {plain_unit(name) for name in (text, *columns)} - {"", "1"}
        return columns[0] if len(columns) == 1 and len(units) < 2 else ""

    pairs = [(topic, name, spelled(topic, name)) for topic, name in expected - there]
    names = {(topic, old): name for topic, name, old in pairs if old}
    texts = (*_texts_of(recipe), *recipe.sensors, *recipe.actions, recipe.reward, *recipe.time)
    plain = [t.rpartition("=")[2].strip() for t in texts if t and not {*t} & {*"*?"}]
    exact = {text: _matches(layout, text)[0] for text in plain}
    taken = {column for columns in exact.values() for column in columns}
    unfound = (text for text in plain if not exact[text])
    for text, topic in product(unfound, [topic for topic, _, _ in layout]):
        name = text.removeprefix(f"{topic}." if topic else "")
        (bare, unit), old = split_unit(_in_square(name)), spelled(topic, name)
        if old and (topic, old) not in taken:
            squared = _in_square(old)
            new = name if unit else squared.replace(split_unit(squared)[0], bare)
            names.setdefault((topic, old), new)
    return names


def respelled(recording: Recording, names: Mapping[tuple[str, str], str]) -> Recording:
    """Return a recording with other names of columns, by topic and column."""
    topics = {}
    for name, topic in recording.topics.items():
        old = {names.get((name, column), column): column for column in topic.names}
        time = names.get((name, topic.time), topic.time)
        topics[name] = Topic(tuple(old), topic.rows, partial(_read, topic, old), time)
    return dataclasses.replace(recording, topics=topics) if names else recording


def _read(
    topic: Topic, old: Mapping[str, str], columns: Sequence[str], start: int, stop: int
) -> dict[str, Column]:
    cells = topic.read([old[name] for name in columns], start, stop)
    return {name: cells[old[name]] for name in columns}


def find_columns(layout: Layout, text: str) -> list[ChosenColumn]:
    """Return the columns that a text of a recipe names, none where there are none.

    Raises
    ------
    UsageError
        When a renamed column is not exactly one, or the file has another unit.
    """
    new, equals, pattern = text.partition("=")
    pairs, unit = _matches(layout, text)
    name, new_unit = "", ""
    if not pairs and equals:
        (pairs, unit), (name, new_unit) = _matches(layout, pattern), _named_unit(new)
        if len(pairs) > 1:
            raise UsageError(f"{text!r} renames {len(pairs)} columns, expected exactly one")
    columns = [_with_unit(topic, column, unit) for topic, column in pairs]
    for c in columns if name else []:
        quantity = Quantity(name, new_unit or c.quantity.unit)
        return [dataclasses.replace(c, quantity=quantity)]
    return columns


def select_columns(layout: Layout, recipe: Recipe, source: str) -> Selection:
    """Return the columns that a recipe names among those of a recording.

    Parameters
    ----------
    layout
        Topics and their columns.
    recipe
        The recipe.
    source
        What messages call the recording.

    Returns
    -------
    Selection

    Raises
    ------
    UnknownNameError
        When a sensor, an action or the stamps are not there.
    UsageError
        When no sensor is chosen, two have one name, or a score is something else, too.
    """
    rewards_text = (recipe.reward,) if recipe.reward else ()
    texts = {"obs": recipe.sensors, "action": recipe.actions, "reward": rewards_text}
    chosen = {kind: _listed(layout, names, source) for kind, names in texts.items()}
    as_score = partial(dataclasses.replace, role="score")
    columns = _listed(layout, recipe.scores, source)
    scores = [dataclasses.replace(c, quantity=as_score(c.quantity)) for c in columns]
    are_scores = {(c.topic, c.column) for c in scores}
    by_prefix = {} if recipe.sensors else _by_prefix(layout, source, are_scores)
    sensors, actions, rewards = (chosen[kind] or by_prefix.get(kind, []) for kind in texts)
    fields = [column for text in _texts_of(recipe) for column in find_columns(layout, text)]
    labels = {
        text: column for text in recipe.label_columns for column in find_columns(layout, text)[:1]
    }
    used = [*sensors, *actions, *rewards[:1], *labels.values()]
    for c in (c for c in used if (c.topic, c.column) in are_scores):
        both = f"{_aliases(c.topic, c.column)[-1]!r} is a score, and a sensor, action, reward or"
        raise UsageError(f"{source}: {both} label, too: name it in one of these keys")
    sensors, used = [*sensors, *scores], [*used, *scores]
    for kind, columns in (("sensors", sensors), ("actions", actions)):
        names = [column.quantity.name for column in columns]
        if name := next((name for name in names if names.count(name) > 1), ""):
            both = listed(
                [_aliases(c.topic, c.column)[0] for c in columns if c.quantity.name == name]
            )
            problem = f"{source} has two {kind} named {name!r}: name one of {both}, or rename one"
            raise UsageError(f"{problem}, 'new = old'")
    times = _times(layout, dict.fromkeys(column.topic for column in used), recipe.time, source)
    named = {(c.topic, c.column) for c in (*used, *fields, *chain(*times.values()))}
    unused = tuple(_aliases(*column)[-1] for column in _pairs(layout) if column not in named)
    if not recipe.sensors:
        _check_spelling(source, unused)
    reward = rewards[0] if rewards else None
    return Selection(tuple(sensors), tuple(actions), reward, times, labels, unused)


def _texts_of(recipe: Recipe) -> list[str]:
    """Return what names columns, or fields, that say something of a recording or its rows."""
    tables = [recipe.nominal.where, *(table.where for table in recipe.anomalous.values())]
    keys = recipe.outcome, recipe.kinds, recipe.task, *(key for t in tables for key in t)
    return [*recipe.label_columns, *recipe.scores, *filter(None, keys)]


def with_sensors(recipe: Recipe, recording: Recording) -> Recipe:
    """Return a recipe whose sensors, without any or ``obs:`` ones, are what no key names."""
    layout = layout_of(recording)
    matches = [_PREFIX.match(name) for _, name in _pairs(layout)]
    if recipe.sensors or "obs" in {match[1].lower() for match in matches if match}:
        return recipe
    texts = [*recipe.actions, *_texts_of(recipe), *recipe.time, *filter(None, [recipe.reward])]
    named = {(c.topic, c.column) for text in texts for c in find_columns(layout, text)}
    unnamed = (pair for pair in _pairs(layout) if pair not in named)
    sensors = tuple(f"{topic}.{name}" if topic else name for topic, name in unnamed)
    return dataclasses.replace(recipe, sensors=sensors)


def _by_prefix(
    layout: Layout, source: str, scores: Collection[tuple[str, str]]
) -> dict[str, list[ChosenColumn]]:
    """Return the columns ``obs:NAME[UNIT]``, ``action:NAME[UNIT]`` and ``reward``, by kind."""
    by_kind: dict[str, list[ChosenColumn]] = {"obs": [], "action": [], "reward": []}
    for topic, name in (pair for pair in _pairs(layout) if pair not in scores):
        match = _PREFIX.match(name)
        kind = match[1].lower() if match else name.strip().lower()
        if match or kind == "reward":
            label, unit = _named_unit(name[match.end() :] if match else name)
            by_kind[kind].append(ChosenColumn(topic, name, Quantity(label, unit or "1")))
    if not by_kind["obs"]:
        _check_spelling(source, [name for _, name in _pairs(layout)])
        names = ", ".join(named_columns(layout))
        raise UsageError(
            f"{source} has the columns {names or 'none'}: none is called "
            "obs:NAME[UNIT] and is no score, so name the sensors in a recipe (sensors = [...]), "
            "actions, too"
        )
    return by_kind


def _check_spelling(source: str, names: Iterable[str]) -> None:
    for name in names:
        if right := nearest_spelling(name):
            raise UsageError(
                f"{source}: column {name!r} is neither obs:NAME[UNIT] nor action:NAME[UNIT]: "
                f"rename it {right!r}, or name the sensors and actions in a recipe"
            )


def _listed(layout: Layout, texts: Sequence[str], source: str) -> list[ChosenColumn]:
    """Return the columns that texts name, each once."""
    selected: dict[tuple[str, str], ChosenColumn] = {}
    for text in texts:
        columns = find_columns(layout, text)
        if not columns:
            name = split_unit(text.rpartition("=")[2])[0]
            raise UnknownNameError(f"column of {source}", name, named_columns(layout))
        for column in columns:
            selected.setdefault((column.topic, column.column), column)
    return list(selected.values())


def _times(
    layout: Layout, topics: Iterable[str], texts: Sequence[str], source: str
) -> dict[str, tuple[ChosenColumn, ...]]:
    """Return the columns with stamps by topic, as the recipe names them, else as the format."""
    times: dict[str, tuple[ChosenColumn, ...]] = {}
    unmatched = set(texts)
    for topic, names, time in layout:
        columns: list[ChosenColumn] = []
        for text in texts:
            # One name holds for all topics.
            below = f"{topic}.{text}" if topic else text
            matches = (find_columns(((topic, names, time),), name) for name in (text, below))
            for column in next(filter(None, matches), [])[-1:]:
                columns.append(column)
                unmatched.discard(text)
        if texts and len(columns) == len(texts):
            times[topic] = tuple(columns)
        elif time:
            times[topic] = (ChosenColumn(topic, time, Quantity(time, "s")),)
    for text in (text for text in texts if text in unmatched):
        raise UnknownNameError(f"column of {source}", split_unit(text)[0], named_columns(layout))
    if texts and (without := [topic for topic in topics if topic not in times]):
        absent = " and ".join(map(repr, texts))
        raise TrajectoryError(f"{source}: topic {without[0]!r} has no column {absent}, its stamps")
    return {topic: times[topic] for topic in topics if topic in times}


def _named_unit(text: str) -> tuple[str, str]:
    """Return name and unit where brackets hold a unit for certain, digits too."""
    match = _UNIT.fullmatch(text.strip())
    return (match[1], match[2]) if match else (text.strip(), "")


def _aliases(topic: str, column: str) -> list[str]:
    """Return the names that a column goes by, the whole one first, without unit last."""
    prefix = f"{topic}." if topic else ""
    match = _PREFIX.match(column)
    bare = column[match.end() :] if match else column
    name = _named_unit(bare)[0] if match else split_unit(bare)[0]
    return [*dict.fromkeys(prefix + alias.strip() for alias in (column, bare, name))]


def _matches(layout: Layout, text: str) -> tuple[list[tuple[str, str]], str]:
    """Return the columns that a glob without a new name matches, and the unit it names."""
    stripped = text.strip()
    readings = [(stripped, ""), split_unit(stripped)]
    if {*stripped} & {*"*?"}:  # columns with the unit and without it
        readings.reverse()
    for pattern, unit in dict.fromkeys([*readings, _named_unit(stripped)]):
        glob = pattern_of(pattern)
        if pairs := [p for p in _pairs(layout) if any(map(glob.fullmatch, _aliases(*p)))]:
            return pairs, unit
    return [], ""


def _with_unit(topic: str, column: str, unit: str) -> ChosenColumn:
    name = _aliases(topic, column)[-1]
    recorded_unit = (_named_unit if _PREFIX.match(column) else split_unit)(column)[1]
    if unit not in {"", recorded_unit} and recorded_unit not in {"", "1"}:
        problem = f"is in {recorded_unit}, and the recipe says {unit}: values are not converted"
        raise UsageError(f"column {column!r} {problem}")
    return ChosenColumn(topic, column, Quantity(name, unit or recorded_unit or "1"))

"""A column of logs, or of an imported split, as scores of healthy and of labelled episodes."""

import re
import tomllib
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_logs.episodes import EVERY, EpisodeSource, files_of, read_every_episode
from oodd_logs.inspection.draft import draft
from oodd_logs.inspection.logs import inspect_logs, recognised
from oodd_logs.kinds.missing_codes import KEY as MISSING_CODES
from oodd_logs.readers import in_order
from oodd_logs.recipe import Recipe
from oodd_logs.selecting import split_unit

from oodd_eval.data.facts import Quantity
from oodd_eval.data.layout import MANIFEST
from oodd_eval.data.parts import (
    CALIBRATION,
    TRAIN,
    AnomalousSet,
    EnvironmentData,
    LabelledSet,
    TrajectorySet,
)
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_eval.names import counted, listed
from oodd_monitors.calibrating import LabelledScores

Floats = NDArray[np.float64]

_NEVER: Final = 1e11
"""Seconds of a gap that no recording has: none cuts a recording of scores, whose topic is slow."""
_SIGNED: Final = re.compile(r"(-?)(?:\|(?P<a>.+)\||abs\((?P<b>.+)\)|(?P<c>.+))")


class ScoreColumn(NamedTuple):
    """The column that a score is, and its sign.

    Attributes
    ----------
    name
        Of the column.
    sign
        1, or -1 where small values are unusual.
    size
        Whether its absolute value is the score.
    """

    name: str
    sign: int
    size: bool

    @classmethod
    def of(cls, text: str) -> "ScoreColumn":
        """Read NAME, -NAME, |NAME| or abs(NAME), as detectors ``column:`` do.

        >>> ScoreColumn.of("-abs(yaw)")
        ScoreColumn(name='yaw', sign=-1, size=True)
        """
        match = _SIGNED.fullmatch(text.strip())
        if not match:
            raise UsageError(f"{text!r} names no column, expected NAME, -NAME or |NAME|")
        name = match["a"] or match["b"] or match["c"]
        return cls(name, -1 if match[1] else 1, not match["c"])

    def __call__(self, values: Floats, baseline: int) -> Floats:
        """Return the scores of an episode, NaN in the first rows that are a baseline."""
        scores = self.sign * (np.abs(values) if self.size else values)
        scores[:baseline] = np.nan
        return scores


@dataclass(slots=True)
class RecordedScores:
    """Scores of recorded episodes.

    Attributes
    ----------
    unit
        Of the column.
    scores
        Of each healthy episode that may calibrate, in recorded order.
    recordings
        For each of them the recording that it is a window of.
    groups
        For each of them its group; empty without groups.
    healthy
        Scores of further healthy episodes.
    labelled
        Of anomalous and failed episodes.
    notes
        What was read, in sentences.
    """

    unit: str
    scores: list[Floats] = field(default_factory=list)
    recordings: list[Hashable] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)
    healthy: list[Floats] = field(default_factory=list)
    labelled: list[LabelledScores] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_scores(
    logs: str, score: str, *, recipe: Path | None = None, per: str = ""
) -> RecordedScores:
    """Read a column as scores.

    Parameters
    ----------
    logs
        A file, a folder, the directory of a data set, a recipe, or name or path of a split.
    score
        The column, perhaps with a sign.
    recipe
        How the logs are read, whose files are relative to `logs`; by default as ``data inspect``
        has it, each recording whole.
    per
        Field or column with the group of each recording.

    Returns
    -------
    RecordedScores

    Raises
    ------
    UsageError
        When there is no such column, or it holds no numbers.
    """
    path, column = Path(logs), ScoreColumn.of(score)
    if (path / MANIFEST).is_file() or not path.exists():
        return _of_split(load_split(logs), column, per)
    return _of_logs(path, column, recipe, per)


def _of_logs(path: Path, column: ScoreColumn, recipe_file: Path | None, per: str) -> RecordedScores:
    """Read a column of logs."""
    recipe, root, files = _recipe_and_files(path, recipe_file)
    recipe = replace(
        recipe,
        sensors=_texts_of(recipe, column.name),
        scores=(),
        actions=(),
        reward="",
        discrete=0,
        gap=_NEVER,
        roles={},
        columns={k: codes for k, codes in recipe.columns.items() if k == MISSING_CODES},
        task=per or recipe.task,
    )
    try:
        with read_every_episode(recipe, root, files) as source:
            return _of_episodes(source, column, recipe.baseline, per)
    except TrajectoryError as error:
        advice = "A score is a column of numbers: `oodd-eval data inspect` lists them"
        raise UsageError(f"{error}. {advice}") from None


def _texts_of(recipe: Recipe, name: str) -> tuple[str, ...]:
    """Return what a recipe's sensors have to be so that the column of a name is among them."""
    block = re.sub(r"\[\d+\]$", "", name)
    if block in recipe.blocks:
        return recipe.blocks[block]
    texts = (text for text in (*recipe.sensors, *recipe.scores) if "=" in text)
    renamed = (text for text in texts if split_unit(text.partition("=")[0])[0] == name)
    return (next(renamed, name),)


def _recipe_and_files(path: Path, recipe_file: Path | None) -> tuple[Recipe, Path, list[Path]]:
    """Return how logs are read, the folder that files are relative to, and the files."""
    if recipe_file or path.suffix == ".toml":
        recipe = Recipe.load(recipe_file or path)
        roots = dict.fromkeys([path if path.is_dir() else path.parent])
        roots |= {recipe_file.parent: None} if recipe_file else {}
        root, matched = next(
            ((root, files) for root in roots if (files := _files_of(recipe, root))), (path, [])
        )
        if not matched:
            raise UsageError(
                f"no file in {str(root)!r} matches {listed(recipe.globs)} of the recipe: say which "
                "folder they are in, as in calibrate FOLDER --recipe FILE"
            )
        return recipe, root, matched
    logs = inspect_logs(path)
    recipe = Recipe.parse(tomllib.loads(draft(logs)))
    recipe = replace(recipe, window=0, rate=None)
    files = recognised(path, recipe.format)[1]
    root = path if path.is_dir() and files != [path] else path.parent
    copies = {root / name for same in logs.equal for name in same[1:]} | {root / logs.intervals}
    return recipe, root, [file for file in files if file not in copies]


def _files_of(recipe: Recipe, root: Path) -> list[Path]:
    """Return the files of recordings that a recipe lists, in natural order."""
    files = {*files_of(recipe, root)}
    if isinstance(recipe.intervals, str):
        files.discard(root / recipe.intervals)
    return sorted(files, key=lambda file: in_order(file.as_posix()))


def _of_episodes(
    source: EpisodeSource, column: ScoreColumn, baseline: int, per: str
) -> RecordedScores:
    """Return the scores of the episodes of logs."""
    number = _number_of(column.name, source.sensors)
    result, silent = RecordedScores(source.sensors[number].unit), []
    for i, episode in enumerate(source.episodes(EVERY)):
        scores = column(episode.observations[:, number].copy(), baseline)
        if np.isnan(scores).all():
            silent.append(episode.name)
        elif episode.kind or episode.intervals:
            kind = episode.kind or "anomalous"
            result.labelled.append(LabelledScores(scores, episode.intervals, kind))
        else:
            result.scores.append(scores)
            result.recordings.append(i if episode.recording is None else episode.recording)
            result.groups += [episode.task] if per else []
    if per and {*result.groups} <= {""}:
        raise UsageError(f"no healthy log has a field or column {per!r}, which --per names")
    result.notes += _notes(source, result, silent)
    return result


def _number_of(name: str, sensors: Sequence[Quantity]) -> int:
    """Return the number of the column of a name, or of the only one that a glob names."""
    names = [sensor.name for sensor in sensors]
    if name not in names and len(names) > 1:
        raise UsageError(f"{name!r} names {len(names)} columns ({listed(names)}): name one")
    return names.index(name) if name in names else 0


def _notes(source: EpisodeSource, scores: RecordedScores, silent: Sequence[str]) -> Iterator[str]:
    """Yield what was read, and what was left out."""
    if not scores.labelled:
        yield "Nothing says that a log is anomalous: all count as healthy."
    if silent:
        yield f"Left out, as the score has no value there: {listed(silent)}."
    dropped = [e for e in source.ledger if e.fate == "dropped" and e.item in {"file", "recording"}]
    if dropped:
        count, first = sum(entry.count for entry in dropped), dropped[0]
        yield f"Left out: {counted(count, 'log(s)')}, the first as {first.reason}."


def _of_split(split: Split, column: ScoreColumn, per: str) -> RecordedScores:
    """Read a column of a split with one environment."""
    if len(split.environments) > 1:
        names = listed(split.environments, 20)
        raise UsageError(f"{split.name} has several environments, {names}: expected one")
    if per not in {"", "task"}:
        raise UsageError(f"--per {per}: a split keeps no field but the task, so --per task")
    whole = split.environment(split.environments[0])
    data = whole.of_columns([column.name])
    result = RecordedScores(data.sensors[_number_of(column.name, data.sensors)].unit)
    for part, episodes in ((TRAIN, data.train), (CALIBRATION, data.calibration)):
        recordings = data.recordings(part) or [(part, i) for i in range(len(episodes))]
        result.scores += _scores_in(data, column, episodes)
        result.recordings += recordings
        result.groups += episodes.tasks if per else ()
    result.healthy += _scores_in(data, column, data.twins)
    for anomaly in data.anomalies:
        episodes = data.test_set(anomaly)
        for i, scores in enumerate(_scores_in(data, column, episodes)):
            intervals: Sequence[tuple[int, int]] = ()
            if isinstance(episodes, LabelledSet):
                intervals = episodes.intervals[i]
            elif isinstance(episodes, AnomalousSet):
                intervals = [(int(episodes.effects[i]), len(scores))]
            result.labelled.append(LabelledScores(scores, intervals, anomaly))
    result.notes.append(
        f"Healthy: {len(data.train)} training and {len(data.calibration)} calibration episodes, as "
        "nothing is fitted; `run` takes the latter alone."
    )
    return result


def _scores_in(data: EnvironmentData, column: ScoreColumn, episodes: TrajectorySet) -> list[Floats]:
    """Return the scores of the episodes of a part, in the unit of the logs."""
    offset = data.logs.offsets[0] if data.logs and data.logs.offsets else 0.0
    return [
        column(trajectory.observations[:, 0].astype(np.float64) + offset, data.baseline)
        for trajectory in episodes
    ]

"""A column of logs, or of an imported split, as scores of healthy and of labelled episodes."""

import re
import tomllib
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_logs.episodes import EVERY, EpisodeSource, files_of, read_every_episode
from oodd_logs.inspection.draft import draft
from oodd_logs.inspection.logs import inspect_logs, recognised
from oodd_logs.kinds.missing_codes import KEY as MISSING_CODES
from oodd_logs.readers import in_order
from oodd_logs.recipe import Recipe

from oodd_eval.data.facts import Quantity
from oodd_eval.data.layout import MANIFEST
from oodd_eval.data.parts import CALIBRATION, TRAIN, AnomalousSet, TrajectorySet
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError
from oodd_eval.names import counted, listed
from oodd_monitors.calibrating import LabelledScores

Floats = NDArray[np.float64]

_NEVER: Final = 1e11
"""Seconds of a gap that no recording has: none cuts a recording of scores, whose topic is slow."""
_SIGNED: Final = re.compile(r"(-?)(?:\|(?P<a>.+)\||abs\((?P<b>.+)\)|(?P<c>.+))")


class ScoreColumn(NamedTuple):
    """The column that a score is, its sign, and whether its absolute value is taken."""

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
        scores = self.sign * (np.abs(values) if self.size else values) + 0.0  # no -0
        scores[:baseline] = np.nan
        return scores

    def number(self, sensors: Sequence[Quantity]) -> int:
        """Return which of some columns it is; the only one may have another name."""
        names = [sensor.name for sensor in sensors]
        if self.name not in names and len(names) > 1:
            raise UsageError(f"{self.name!r} names {len(names)}, {listed(names)}: expected one")
        return names.index(self.name) if self.name in names else 0


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

    @property
    def arguments(self) -> dict[str, Any]:
        """Those of `calibrate`."""
        names = ("scores", "recordings", "labelled", "healthy", "groups")
        return {name: getattr(self, name) for name in names}


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
        if recipe:
            raise UsageError(f"--recipe is for logs, and {logs!r} is none that exists")
        try:
            split = load_split(logs)
        except UnknownNameError as error:
            raise UsageError(f"{logs!r} is no file or folder of logs, and an {error}") from None
        scores = _of_split(split, column, per)
    else:
        scores = _of_logs(path, column, recipe, per)
    if per and scores.scores and {*scores.groups} <= {""}:
        raise UsageError(f"no healthy log has a field or column {per!r}, which --per names")
    return scores


def _of_logs(path: Path, column: ScoreColumn, recipe_file: Path | None, per: str) -> RecordedScores:
    """Read a column of logs."""
    recipe, root, files = _recipe_and_files(path, recipe_file)
    codes = {key: value for key, value in recipe.columns.items() if key == MISSING_CODES}
    others: dict[str, Any] = {"scores": (), "actions": (), "reward": "", "discrete": 0}
    others |= {"roles": {}, "blocks": {}, "columns": codes, "gap": _NEVER}
    others |= {"task": per} if per else {}
    renaming = re.compile(re.escape(column.name) + r"\s*(\[.*\])?\s*=")
    renamed = tuple(filter(renaming.match, (*recipe.sensors, *recipe.scores)))
    recipe = replace(recipe, sensors=renamed[:1] or (column.name,), **others)
    try:
        with read_every_episode(recipe, root, files) as source:
            return _of_episodes(source, column, recipe.baseline, per)
    except TrajectoryError as error:
        advice = "A score is a column of numbers: `oodd-eval data inspect` lists them"
        raise UsageError(f"{error}. {advice}") from None


def _recipe_and_files(path: Path, recipe_file: Path | None) -> tuple[Recipe, Path, list[Path]]:
    """Return how logs are read, the folder that files are relative to, and the files."""
    if recipe_file or path.suffix == ".toml":
        recipe = Recipe.load(recipe_file or path)
        for root in (path, path.parent, (recipe_file or path).parent):
            files = {*files_of(recipe, root)} - {root / str(recipe.intervals)}
            if recipe_file:
                files = {f for f in files if any(map(path.samefile, (f, *f.parents)))}
            if files:
                return recipe, root, sorted(files, key=lambda file: in_order(file.as_posix()))
        expected = f"{listed(recipe.globs)}: calibrate FOLDER --recipe FILE"
        raise UsageError(f"{str(path)!r} holds no file that the recipe lists, expected {expected}")
    logs = inspect_logs(path)
    recipe = replace(Recipe.parse(tomllib.loads(draft(logs))), window=0, rate=None)
    recordings = recognised(path, recipe.format)[1]
    root = path if path.is_dir() and recordings != [path] else path.parent
    copies = {root / name for same in logs.equal for name in same[1:]} | {root / logs.intervals}
    return recipe, root, [file for file in recordings if file not in copies]


def _of_episodes(source: EpisodeSource, column: ScoreColumn, base: int, per: str) -> RecordedScores:
    """Return the scores of the episodes of logs."""
    number = column.number(source.sensors)
    result, silent = RecordedScores(source.sensors[number].unit), []
    for i, episode in enumerate(source.episodes(EVERY)):
        scores = column(episode.observations[:, number].copy(), base)
        if np.isnan(scores).all():
            silent.append(episode.name)
        elif episode.kind or episode.intervals:
            kind = episode.kind or "anomalous"
            result.labelled.append(LabelledScores(scores, episode.intervals, kind))
        else:
            result.scores.append(scores)
            result.recordings.append(i if episode.recording is None else episode.recording)
            result.groups += [episode.task] if per else []
    result.notes += _notes(source, result, silent)
    return result


def _notes(source: EpisodeSource, scores: RecordedScores, silent: Sequence[str]) -> Iterator[str]:
    """Yield what was read, and what was left out."""
    if not scores.labelled:
        yield "Nothing says that a log is anomalous: all count as healthy."
    elif not scores.scores:
        count = counted(len(scores.labelled), "log(s)")
        yield f"Labels make all {count} anomalous: a recipe (--recipe FILE) names others."
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
    data = split.environment(split.environments[0]).of_columns([column.name])
    result = RecordedScores(data.sensors[column.number(data.sensors)].unit)
    offset = data.logs.offsets[0] if data.logs and data.logs.offsets else 0.0

    def scores_in(episodes: TrajectorySet) -> list[Floats]:
        columns = (x.observations[:, 0].astype(np.float64) + offset for x in episodes)
        return [column(values, data.baseline) for values in columns]

    for part, episodes in ((TRAIN, data.train), (CALIBRATION, data.calibration)):
        result.scores += scores_in(episodes)
        result.recordings += data.recordings(part) or [(part, i) for i in range(len(episodes))]
        result.groups += episodes.tasks if per else ()
    result.healthy += scores_in(data.twins)
    for anomaly in data.anomalies:
        episodes = data.anomalous(anomaly) if data.paired else data.labelled(anomaly)
        intervals: Sequence[Any] = getattr(episodes, "intervals", ())
        if isinstance(episodes, AnomalousSet):
            intervals = [((start, start + 1),) for start in episodes.effects.tolist()]
        pairs = zip(scores_in(episodes), intervals, strict=True)
        result.labelled += [LabelledScores(*pair, anomaly) for pair in pairs]
    n, m = len(data.train), len(data.calibration)
    text = f"Healthy: {n} training and {m} calibration episodes, as nothing is fitted"
    result.notes.append(f"{text}; `run` calibrates with the latter alone.")
    return result

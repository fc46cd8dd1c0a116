"""Logs as a scan reads them: every episode in recorded order, labelled or not."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from oodd_eval.data.facts import Quantity
from oodd_logs.episodes import EVERY, Episode, names_matching, read_every_episode
from oodd_logs.inspection.draft import draft
from oodd_logs.inspection.logs import Inspection, inspect_logs, recognised
from oodd_logs.inspection.meaning import window_of
from oodd_logs.ledger import Ledger
from oodd_logs.recipe import Recipe
from oodd_logs.scanning.outliers import ENOUGH


@dataclass(frozen=True, slots=True, eq=False)
class RecordedLogs:
    """Episodes in recorded order.

    Attributes
    ----------
    episodes
        All of them, with their labels.
    sensors
        Names, units and roles of the columns.
    baseline
        Rows at the start of every episode that are nominal.
    form
        Name of their format.
    ledger
        What was left out, held or changed.
    notes
        Its summary, a line each.
    """

    episodes: list[Episode]
    sensors: list[Quantity]
    baseline: int
    form: str
    ledger: Ledger
    notes: list[str]


def read_logs(
    path: Path,
    recipe: Recipe | None = None,
    form: str = "",
    options: Mapping[str, Any] | None = None,
    window: int | None = None,
    home: Path | None = None,
) -> RecordedLogs:
    """Read all episodes of logs.

    Parameters
    ----------
    path
        A file, a folder, or the directory of a data set; with a recipe, what its files are
        relative to.
    recipe
        By default a first one, as ``data inspect`` writes it.
    form, options
        Format of the files and options of its reader, without a recipe; by default it is
        recognised.
    window
        Rows to which longer recordings are cut, in place of the recipe's. Without a recipe, 20
        recordings and more are left whole, and fewer are cut as ``data inspect`` advises.
    home
        Folder of the recipe. Its files are relative to the first of `path`, the folder that this is
        in, and `home`, in which it lists any.

    Returns
    -------
    RecordedLogs
    """
    reader, files, others = recognised(path, form or (recipe.format if recipe else ""))
    root = path if path.is_dir() and files != [path] else path.parent
    logs: Inspection | None = None
    if recipe is None:
        logs = inspect_logs(path, reader.name, options or {})
        recipe = Recipe.parse(tomllib.loads(draft(logs)))
        if window is None:
            window = 0 if len(logs.recordings) >= ENOUGH else window_of(logs)
    if isinstance(recipe.intervals, str):
        files = [file for file in files if file != root / recipe.intervals]
    if window is not None:
        recipe = replace(recipe, window=window, nominal=replace(recipe.nominal, window=None))
    folders = () if home is None else (root, path.parent, home)
    globs = recipe.globs
    root = next((f for f in folders if any(names_matching(glob, f) for glob in globs)), root)
    with read_every_episode(recipe, root, files) as source:
        ledger = logs.ledger if logs else Ledger()
        for ending, count in others.items():
            ledger.add(
                "file", "dropped", f"of another format, {ending or 'no ending'}", count=count
            )
        ledger.complete(source.ledger)
        source.ledger = ledger
        return RecordedLogs(
            list(source.episodes(EVERY)),
            [*source.sensors],
            recipe.baseline,
            reader.name,
            ledger,
            source.summary,
        )

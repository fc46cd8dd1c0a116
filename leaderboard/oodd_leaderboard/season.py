"""A season: every entry in every environment of a fresh split, with the same seeds, in sandboxes.

The directory is that of `oodd_leaderboard.season_files`. What is done is kept at once, so that a
season goes on where it was ended, at any moment. What goes wrong with an entry is the reason of
its row; the others go on.
"""

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from oodd_eval._version import __version__
from oodd_eval.data.facts import PROTOCOL, SplitDefinition
from oodd_eval.data.split import Split, load_split, split_places
from oodd_eval.errors import MissingExtraError, PluginError, UnknownNameError, UsageError
from oodd_eval.plugins.discovery import Plugins, printable
from oodd_eval.plugins.installed import normalized
from oodd_eval.plugins.parameters import resolve_parameters
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record, Status, gather
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import Plan, Unit, make_plan
from oodd_eval.scoring.runner import run
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.install import beside, install
from oodd_leaderboard.sandbox.describe import discover_entry
from oodd_leaderboard.sandbox.launcher import make_sandbox
from oodd_leaderboard.season_files import (
    PACKAGES,
    ROWS,
    SEASON,
    SPLIT,
    WORK,
    Installed,
    Season,
    SeasonSplit,
    read_season,
    row_path,
    write_row,
    write_season,
)

SEEDS: Final = (0, 1, 2)


def begin(
    directory: Path,
    definition: SplitDefinition,
    bits: int,
    *,
    trial: bool,
    entries: Sequence[Entry],
) -> Season:
    """Begin a season in a directory, or go on with the one that is there; it is written.

    Of another row than it had, what was done is removed. `UsageError`: the directory has a season
    of other bits, sizes, environments or versions, or one that is whole and has other entries.
    """
    recipe: dict[str, Any] = json.loads(json.dumps(definition.recipe))
    rows = {entry.name: entry for entry in entries}
    environments = list(definition.environments)
    conditions = {e: [*definition.of(e).strengths] for e in environments}
    season = Season(
        name=directory.resolve().name,
        bits=f"{bits:032x}",
        protocol=PROTOCOL,
        oodd_eval=__version__,
        split=SeasonSplit(definition.name, "", recipe),
        seeds=[*SEEDS],
        environments=environments,
        conditions=conditions,
        trial=trial,
        entries=rows,
    )
    if (directory / SEASON).is_file():
        earlier = read_season(directory)
        if not entries:  # only its split is recorded again
            rows = dict(earlier.entries)
            season = replace(season, entries=rows)
        _check_same(earlier, season, directory)
        for name, entry in earlier.entries.items():
            if rows.get(name) != entry:
                _forget(directory, name)
        installed = {
            n: held for n, held in earlier.installed.items() if earlier.entries[n] == rows.get(n)
        }
        season = replace(earlier, entries=rows, installed=installed)
    write_season(season, directory)
    return season


def _check_same(earlier: Season, season: Season, directory: Path) -> None:
    facts = {
        "bits": (earlier.bits, season.bits),
        "protocol": (earlier.protocol, season.protocol),
        **{
            name: (earlier.split.definition.get(name), season.split.definition.get(name))
            for name in season.split.definition
        },
    }
    if not earlier.date:
        facts["version of oodd-eval"] = earlier.oodd_eval, season.oodd_eval
    for name, (there, here) in facts.items():
        if there != here:
            raise UsageError(
                f"{str(directory)!r} has a season with {name} {there}, expected {here}: go on with "
                "the command that began it, or name another directory with --output"
            )
    if earlier.date and earlier.entries != season.entries:
        names = sorted({*earlier.entries} ^ {*season.entries}) or [
            name for name, entry in earlier.entries.items() if entry != season.entries[name]
        ]
        raise UsageError(
            f"the season in {str(directory)!r} was whole on {earlier.date}, and its bits are no "
            f"secret any more: {', '.join(names)} can be in the next one"
        )


def _forget(directory: Path, name: str) -> None:
    """Remove what was done for a row."""
    row_path(directory, name).unlink(missing_ok=True)
    for part in (PACKAGES, WORK):
        shutil.rmtree(directory / part / name, ignore_errors=True)


def noted_split(season: Season, directory: Path) -> Season:
    """Return the season with the digest of the split that was recorded; it is written."""
    digest = load_split(directory / SPLIT).digest
    if season.split.digest not in ("", digest):
        raise UsageError(
            f"the split of the season in {str(directory)!r} has the digest {digest}, expected "
            f"{season.split.digest}: this machine's simulators or libraries record other episodes"
        )
    season = replace(season, split=replace(season.split, digest=digest))
    write_season(season, directory)
    return season


def end(season: Season, directory: Path) -> Season:
    """Return a season of which every row is there, with the day of its end; it is written."""
    season = replace(season, date=season.date or datetime.now(UTC).date().isoformat())
    write_season(season, directory)
    return season


def check_entries(entries: Sequence[Entry], directory: Path, plugins: Plugins) -> None:
    """Raise `UsageError` for what can be told of entries before anything is run or installed.

    These are wheels that are not there, rows that oodd-eval does not ship, and parameters of
    shipped ones that do not exist.
    """
    for entry in entries:
        if entry.wheel and not (path := beside(entry, directory) / entry.wheel).is_file():
            raise UsageError(
                f"entry {entry.name!r} has the wheel {entry.wheel}, expected it beside the entry: "
                f"no such file as {str(path)!r}"
            )
        if entry.shipped:
            with suppress(PluginError, MissingExtraError):  # a reason of the row
                _check_shipped(entry, plugins)


def _check_shipped(entry: Entry, plugins: Plugins) -> None:
    try:
        offer = plugins.offer(entry.detector)
    except UnknownNameError as error:
        raise UsageError(
            f"entry {entry.name!r}: {error}; a row that oodd-eval does not ship needs wheel or "
            "requirement"
        ) from None
    if offer.distribution != entry.distribution:
        raise UsageError(
            f"entry {entry.name!r} names the detector {entry.detector!r} of {offer.distribution}, "
            "expected a row that oodd-eval ships, or what is to be installed: a requirement or a "
            "wheel"
        )
    declared, others = offer.spec.parameters, offer.spec.other_parameters
    resolve_parameters(entry.detector, declared, entry.parameters, others=others)


@dataclass(slots=True)
class SeasonRunner:
    """Runs the rows of a season whose split is recorded.

    Parameters
    ----------
    directory
        The season's.
    season
        As it is written there.
    entries
        Directory of the entries, beside which their wheels are.
    shipped
        The plug-ins that oodd-eval ships.
    settings
        Of every row; launchers are made for each.
    """

    directory: Path
    season: Season
    entries: Path
    shipped: Plugins
    settings: RunSettings
    split: Split = field(init=False)

    def __post_init__(self) -> None:
        self.split = load_split(self.directory / SPLIT)

    def run(self, entry: Entry, observers: Sequence[object] = ()) -> list[Record] | None:
        """Run a row and write its records; None where it was interrupted.

        `observers` hear of its progress. `SplitError`, `OutputError`: the season cannot go on.
        """
        try:
            packages = () if entry.shipped else (self._installed(entry),)
        except PluginError as error:
            return self._kept(entry, self._failed(entry, "unavailable", str(error)))
        launcher = make_sandbox(self._hidden(), packages)
        try:
            plugins = self.shipped
            if packages:
                plugins = discover_entry(packages[0], launcher, self.settings.limits.memory)
            plan = self._plan(entry, plugins)
        except (PluginError, MissingExtraError, UsageError) as error:
            return self._kept(entry, self._failed(entry, "error", str(error)))
        settings = replace(self.settings, launcher=launcher, streamed=True)
        results = ResultsDirectory(self.directory / WORK / entry.name)
        outcome = run(plan, self.split, plugins, settings, results, observers)
        if outcome.interrupted or outcome.left:
            return None
        return self._kept(entry, outcome.records)

    def _kept(self, entry: Entry, records: Sequence[Record]) -> list[Record]:
        """Write the records of a row, which has the name of its entry."""
        # What it is trained on is declared twice, and what is not ranked counts.
        declared: dict[str, Any] = {}
        if entry.training != "nominal":
            declared["training"] = entry.training
        named = [replace(record, detector=entry.name, **declared) for record in records]
        write_row(self.directory, entry.name, named)
        return named

    def _plan(self, entry: Entry, plugins: Plugins) -> Plan:
        try:
            offer = plugins.offer(entry.detector)
        except UnknownNameError:
            if not plugins.broken:
                raise
            raise PluginError(plugins.broken[0].reason) from None
        if normalized(offer.distribution) != entry.distribution:
            raise PluginError(f"it is {offer.distribution} that offers {entry.detector!r}")
        spec = offer.spec
        return make_plan(
            plugins,
            split=self.split,
            detectors=[spec.name],
            environments=self.season.environments,
            horizons=[entry.horizon],
            seeds=self.season.seeds[:1] if spec.deterministic else self.season.seeds,
            parameters=dict(entry.parameters),
        )

    def _hidden(self) -> list[str]:
        """Return what no worker may see: bits, split and results."""
        parts = (SEASON, SPLIT, WORK, ROWS)
        return [
            *map(str, split_places(self.split)),
            *(str(self.directory / part) for part in parts),
        ]

    def _installed(self, entry: Entry) -> Path:
        """Return the directory that a stranger's entry is installed in, once it is."""
        target = (self.directory / PACKAGES / entry.name).absolute()
        if entry.name not in self.season.installed or not target.is_dir():
            wheels = [Installed(**wheel) for wheel in install(entry, self.entries, target)]
            self.season = replace(
                self.season, installed={**self.season.installed, entry.name: wheels}
            )
            write_season(self.season, self.directory)
        return target

    def _failed(self, entry: Entry, status: Status, reason: str) -> list[Record]:
        """Return the records of a row of which no cell could be tried."""
        parameters = dict(entry.parameters)
        units = tuple(
            Unit(
                environment,
                Setting.of(entry.name, entry.horizon, parameters),
                seed,
                self.split.conditions(environment),
                parameters,
                parameters,
                plugin=entry.detector,
                distribution=entry.distribution,
                version="unknown",
            )
            for environment in self.season.environments
            for seed in self.season.seeds
        )
        strengths = {e: self.split.strengths(e) for e in self.season.environments}
        plan = Plan(self.split.name, self.split.digest, units, self.split.groups, None, strengths)
        outcome: dict[str, Any] = {
            "status": status,
            "reason": printable(reason),
            "provenance": gather(self.settings.command),
        }
        return [plan.blank(u, condition, **outcome) for u in units for condition in u.conditions]

"""Frozen splits: find one by its name or path, verify it, open an environment."""

import contextlib
import functools
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from oodd_eval.data import layout
from oodd_eval.data.condition import NOMINAL, Condition, in_suite_order
from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    LONG_NAMES,
    SPLITS,
    Group,
    Role,
    in_order,
    short_name,
)
from oodd_eval.data.layout import MANIFEST, GroupCheck
from oodd_eval.data.parts import NAMES, TRAIN, TWINS, EnvironmentData, check_twins, conditions_in
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import (
    DigestError,
    OutputError,
    SplitError,
    SplitNotFoundError,
    UnknownNameError,
    UsageError,
)
from oodd_eval.names import check_known, select

SHIPPED = Path(__file__).with_name("shipped")  # splits of the package: ``mini``
_KEPT: Final = 2**26  # bytes of a dataset of the test parts that is read at once


def split_places(split: "Split") -> tuple[str, ...]:
    """Return the directories that hold a split, or others that are at hand."""
    shipped = [path for path in SHIPPED.iterdir() if path.is_dir()]
    return tuple(map(str, (*shipped, *_homes()[1:], split.path)))


def data_home() -> Path:
    """Return ``$OODD_EVAL_DATA``, or ``oodd-eval/splits`` in the user's data directory.

    Returns
    -------
    Path
        The directory, which need not exist.

    Raises
    ------
    OutputError
        When there is no home directory: no ``HOME``, and no entry of the user in passwd.
    """
    if os.environ.get("OODD_EVAL_DATA"):
        return Path(os.environ["OODD_EVAL_DATA"])
    try:
        base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    except RuntimeError:
        raise OutputError(
            "splits are kept in the home directory, and there is none (no HOME, and no entry of "
            f"user {os.getuid()} in passwd): set OODD_EVAL_DATA to a directory for them"
        ) from None
    return Path(base) / "oodd-eval" / "splits"


def _homes() -> list[Path]:
    """Return the directories that may hold splits, the shipped ones first."""
    homes = [SHIPPED]
    with contextlib.suppress(OutputError):
        homes.append(data_home())
    return homes


def split_directories() -> dict[str, Path]:
    """Return the directories of splits by name: shipped ones, then those in `data_home`."""
    directories: dict[str, Path] = {}
    for home in _homes():
        for manifest in sorted(home.glob(f"*/{MANIFEST}")):
            directories.setdefault(manifest.parent.name, manifest.parent)
    return directories


def _readable_splits() -> Iterator[tuple[str, "Split"]]:
    """Yield the splits of `split_directories` by name, but for those that cannot be read."""
    for name, directory in split_directories().items():
        with contextlib.suppress(SplitError):
            _ = Split(directory).manifest
            yield name, Split(directory)


def imported_environments() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield environments of logs in the splits of `split_directories`.

    Yields
    ------
    tuple
        Name of the environment, name of the split, and the environment's entry in its manifest.
        Splits that cannot be read are passed over.
    """
    for name, split in _readable_splits():
        for environment, entry in split.manifest["environments"].items():
            if "logs" in entry:
                yield environment, name, entry


def load_split(name: str | Path) -> "Split":
    """Open a split by its directory or its name; only its manifest is read.

    Parameters
    ----------
    name
        Such as ``"mini"`` or ``"path/to/mine"``: a directory with a manifest is taken first, then
        shipped splits, then built or fetched ones.

    Returns
    -------
    Split
        Its files are opened when an environment is.

    Raises
    ------
    UnknownNameError, SplitNotFoundError
        For a name of no split, or of a published one that is not on this machine.
    """
    path = Path(name)
    if os.path.isfile(path / MANIFEST):  # noqa: PTH113  of an unreadable directory it is False
        return Split(path)
    if isinstance(name, Path) or os.sep in name:
        raise SplitNotFoundError(f"{name} is no split: it has no {MANIFEST}")
    directories = split_directories()
    if name in directories:
        return Split(directories[name])
    if name in SPLITS:
        raise SplitNotFoundError(
            f"split {name!r} is not on this machine: build it with "
            f"`oodd-eval data build {name}`, or fetch a copy with `oodd-eval data fetch`"
        )
    raise UnknownNameError("split", name, {*directories, *SPLITS})


@dataclass(frozen=True, slots=True)
class Split:
    """A frozen split: a directory with a manifest and one file per environment.

    Parameters
    ----------
    path
        The directory.
    """

    path: Path

    @property
    def manifest(self) -> dict[str, Any]:
        """The manifest, read and checked once per path and modification time."""
        file = self.path / MANIFEST
        stamp = file.stat().st_mtime_ns if file.exists() else 0
        return _manifest(self.path, stamp)

    @property
    def name(self) -> str:
        """The split's name; with the start of its digest when it is not the published one."""
        name = str(self.manifest["name"])
        unambiguous = name not in SPLITS or published_digests().get(name) == self.digest
        return name if unambiguous else f"{name}@{self.digest[:8]}"

    @property
    def digest(self) -> str:
        """SHA-256 over the content of all environments and the recipe."""
        return str(self.manifest["digest"])

    @property
    def environments(self) -> tuple[str, ...]:
        """Names of the environments: the benchmark's in its order, then others in theirs."""
        return tuple(in_order(self.manifest["environments"], ENVIRONMENTS))

    @property
    def environment_names(self) -> tuple[str, ...]:
        """Names of the environments: short ones, then those with their plug-in, ``PLUGIN/NAME``."""
        return (*self.environments, *map(self.long_name, self.environments))

    def long_name(self, environment: str, anomaly: str = "") -> str:
        """Return the long name of an environment, or of an anomaly in it.

        Parameters
        ----------
        environment
            One of `environments`.
        anomaly
            Name of a kind or condition.

        Returns
        -------
        str
            ``PLUGIN/NAME``; the name alone where it is the benchmark's, or the split does not say
            whose it is.
        """
        entry, kind = self.manifest["environments"][environment], anomaly.partition("@")[0]
        plugin = entry.get("plugins", {}).get(kind, "")
        named = self.manifest["definition"].get("environments", ())
        if environment in named and kind not in ANOMALIES:  # older ones lack what is known of them
            plugin = plugin or LONG_NAMES.get(environment, "").rpartition("/")[0]
        return f"{plugin}/{anomaly or environment}".lstrip("/")

    def conditions(self, environment: str) -> tuple[Condition, ...]:
        """Return the conditions of an environment: anomalies, each at its strengths.

        Parameters
        ----------
        environment
            One of `environments`.

        Returns
        -------
        tuple of Condition
            In the benchmark's order; `NOMINAL` alone where there are nominal test episodes only.
        """
        groups = self.manifest["environments"][environment]["groups"]
        return conditions_in(groups) or ((NOMINAL,) if groups[TWINS]["trajectories"] else ())

    def strengths(self, environment: str) -> dict[Condition, float]:
        """Return the strengths of an environment's conditions as numbers, as far as it has any.

        Parameters
        ----------
        environment
            One of `environments`.

        Returns
        -------
        dict
            Numbers by condition, in the unit of the kind of anomaly; empty for a split with the
            values of the paper's Table 1.
        """
        entry, definition = self.manifest["environments"][environment], self.manifest["definition"]
        numbers = entry.get("strengths", definition.get("strengths", {}))
        conditions = {str(condition): condition for condition in self.conditions(environment)}
        return {conditions[name]: float(n) for name, n in numbers.items() if name in conditions}

    @property
    def units(self) -> dict[str, str]:
        """Units of strengths by kind of anomaly, where the manifest has one for each."""
        units: dict[str, set[str]] = {}
        for entry in self.manifest["environments"].values():
            for kind, unit in entry.get("units", {}).items():
                units.setdefault(kind, set()).add(unit)
        return {kind: several.pop() for kind, several in units.items() if len(several) == 1}

    @property
    def anomalies(self) -> tuple[str, ...]:
        """Names by which anomalies of any environment can be chosen: kinds, and conditions."""
        return self._names(*self.environments)

    @property
    def groups(self) -> dict[str, Group]:
        """Groups of all anomalies, by kind."""
        groups: dict[str, Group] = {}
        for entry in self.manifest["environments"].values():
            groups |= layout.groups_of(entry)
        return groups

    def select_environments(self, names: str) -> list[str]:
        """Return the environments that a comma list of names and globs, or ``"all"``, selects.

        Parameters
        ----------
        names
            Text as on the command line, of short and long names.

        Returns
        -------
        list of str
            Short names.

        Raises
        ------
        UsageError
            When one is unknown; where another split has it, built or not, that is named.
        """
        try:
            selected = select("environment", names, self.environment_names)
        except UnknownNameError as error:
            built = [n for n, split in _readable_splits() if error.name in split.environment_names]
            short = {long: name for name, long in LONG_NAMES.items()}.get(error.name, error.name)
            if not (holders := built or [n for n, s in SPLITS.items() if short in s.environments]):
                raise
            build = "" if built else f" after `oodd-eval data build {holders[0]}`"
            raise UsageError(
                f"split {self.name} has no environment {error.name!r}: it is in "
                f"{' and '.join(holders)}, pass --split {holders[0]}{build}"
            ) from None
        return list(dict.fromkeys(map(short_name, selected)))

    def select(self, environments: str, anomalies: str) -> tuple[list[str], list[str]]:
        """Return the names that comma lists, globs or ``"all"`` select.

        Parameters
        ----------
        environments, anomalies
            Texts as on the command line.

        Returns
        -------
        tuple
            Names of environments, and of anomalies that any of these has.

        Raises
        ------
        UsageError
            When something is unknown, or the environments have nominal episodes only.
        """
        selected = self.select_environments(environments)
        if not (anomaly_names := self._names(*selected)):
            raise UsageError(
                f"split {self.name} has no anomalous episodes of {', '.join(selected)}, expected "
                "some to evaluate detectors on: import them, or fit a watchdog on what there is"
            )
        long = [self.long_name(e, name) for e in selected for name in self._names(e)]
        kinds = select("anomaly", anomalies, [*anomaly_names, *long])
        return selected, list(dict.fromkeys(map(short_name, kinds)))

    def _names(self, *environments: str) -> tuple[str, ...]:
        conditions = in_suite_order(c for e in environments for c in self.conditions(e))
        return tuple(dict.fromkeys((*(c.anomaly for c in conditions), *map(str, conditions))))

    def baseline(self, environment: str) -> int:
        """Return the number of baseline rows of an environment's episodes.

        Parameters
        ----------
        environment
            One of `environments`.

        Returns
        -------
        int
            0 where none are declared.
        """
        facts = layout.log_facts(self.manifest["environments"][environment])
        return 0 if facts is None else facts.baseline

    def roles(self, environment: str) -> tuple[Role, ...]:
        """Return the roles of an environment's sensors, see `Quantity`.

        Parameters
        ----------
        environment
            One of `environments`.

        Returns
        -------
        tuple of str
            One a sensor; empty where all are just measured.
        """
        roles = layout.roles_in(environment, self.manifest["environments"][environment])
        of_sensors = tuple(role for role in roles if role != "score")
        return of_sensors if {*of_sensors} - {"measured"} else ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of all environments, each once: sensors and recorded scores."""
        entries = self.manifest["environments"].values()
        return tuple(dict.fromkeys(row["name"] for entry in entries for row in entry["sensors"]))

    def train_digest(self, environment: str, part: str = TRAIN) -> str:
        """Return the digest of an environment's training part: what a fit depends on.

        Parameters
        ----------
        environment
            One of `environments`.
        part
            Another part that it depends on.

        Returns
        -------
        str
            SHA-256, in hexadecimal digits.
        """
        return str(self.manifest["environments"][environment]["groups"][part]["sha256"])

    def environment(self, name: str) -> EnvironmentData:
        """Open one environment after verifying every group's digest.

        Parameters
        ----------
        name
            One of `environments`.

        Returns
        -------
        EnvironmentData
            Its file is open until it is closed.

        Raises
        ------
        UnknownNameError
            When the split has no such environment.
        SplitNotFoundError, SplitError, DigestError
            When the file is missing, damaged, or not what the manifest names.
        """
        check_known(f"environment of split {self.name}", self.environments, name)
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(contextlib.closing(self._open(name)))
            parts = self._parts(name, file)
            bad = next((check for check in self._checks(name, file, parts) if not check.ok), None)
            if bad is not None:
                raise DigestError(
                    f"{bad.file}, group {bad.group}: content does not match the manifest: expected "
                    f"{bad.expected}, found {bad.actual}; the file was changed or damaged, build "
                    "or fetch it again"
                )
            stack.pop_all()
        entry = self.manifest["environments"][name]
        digest = layout.environment_digest(entry)
        discrete, logs = layout.discrete_actions(name, entry), layout.log_facts(entry)
        return EnvironmentData(
            name,
            file,
            parts,
            digest,
            discrete=discrete,
            logs=logs,
            roles=layout.roles_in(name, entry),
            recordings=layout.recordings_of(entry),
            ledger=entry.get("ledger", ()),
        )

    @contextlib.contextmanager
    def opened(self) -> Iterator[Callable[[str], EnvironmentData]]:
        """Open environments, each once; all are closed when the block is left.

        Yields
        ------
        function
            Returns the `EnvironmentData` of a name.
        """
        with contextlib.ExitStack() as stack:
            yield functools.cache(
                lambda name: stack.enter_context(contextlib.closing(self.environment(name)))
            )

    def verify(self) -> Iterator[GroupCheck]:
        """Compare every group with the manifest; `SplitError` when a file cannot be read.

        Yields
        ------
        GroupCheck
            Of each group of each file, the expected and the actual digest.

        Raises
        ------
        SplitError
            When a file cannot be read.
        """
        for name in self.environments:
            with contextlib.closing(self._open(name)) as file:
                yield from self._checks(name, file, self._parts(name, file))

    def _open(self, name: str) -> StoredFile:
        path = self.path / str(self.manifest["environments"][name]["file"])
        if path.parent != self.path:
            raise SplitError(f"the manifest names a file outside of the split: {path.name}")
        # Installers may link the files of a package.
        if path.is_symlink() and self.path.parent != SHIPPED:
            raise SplitError(f"{path} is a link to another file, expected the file: copy it there")
        if not path.is_file():
            raise SplitNotFoundError(
                f"{path} is missing, or is no plain file: build or fetch the split again"
            )
        return StoredFile(path)

    def _parts(self, name: str, file: StoredFile) -> dict[str, dict[str, Any]]:
        """Read what is small, look at the sizes of what is not; `SplitError` for other sizes."""
        entry = self.manifest["environments"][name]
        expected = {*entry["groups"], NAMES}
        held = {*file.groups()} - {"test"} | {f"test/{test}" for test in file.groups("test")}
        if more := held - expected:
            raise SplitError(
                f"{file.name} holds the groups {sorted(more)}, expected none but {sorted(expected)}"
            )
        parts = {}
        for group in (*entry["groups"], NAMES):
            parts[group] = part = file.part(group)
            if group == NAMES:
                layout.check_names(file.name, parts)
                break
            layout.check_layout(file.name, group, part, paired=layout.is_paired(entry))
            sizes, named = (len(part["seeds"]), len(part["actions"])), entry["groups"][group]
            if sizes != (named["trajectories"], named["transitions"]):
                raise SplitError(
                    f"{file.name}, {group} has {sizes[0]} trajectories with {sizes[1]} "
                    f"transitions, expected {named['trajectories']} with {named['transitions']}"
                )
        return parts

    def _checks(
        self, name: str, file: StoredFile, parts: Mapping[str, Mapping[str, Any]]
    ) -> Iterator[GroupCheck]:
        entry = self.manifest["environments"][name]
        recorded = "seed_base" in self.manifest["definition"]
        twins = _read_small(parts[TWINS])
        for group, part in parts.items():
            expected = entry["groups"][group]["sha256"] if group != NAMES else None
            rows = _read_small(part) if "onsets" in part else twins if group == TWINS else part
            digest = layout.content_digest(rows)
            check = GroupCheck(file.name, group, expected or layout.names_digest(entry), digest)
            yield check
            if "onsets" in part and check.ok:
                check_twins(f"{file.name}, group {group}", rows, twins, recorded=recorded)


def _read_small(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return a part whose datasets are arrays, to be digested and compared, unless too large."""
    return {name: rows[:] if rows.nbytes <= _KEPT else rows for name, rows in part.items()}


@functools.lru_cache(maxsize=32)
def _manifest(path: Path, _stamp: int) -> dict[str, Any]:
    return layout.read_manifest(path)


@functools.cache
def published_digests() -> dict[str, str]:
    """Return the digests of the published splits by name."""
    digests: dict[str, str] = json.loads((SHIPPED / "published.json").read_text(encoding="utf-8"))
    return digests

"""``oodd-eval data``: build, verify, fetch, export and describe splits."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from oodd_eval.cli.terminal import make_console
from oodd_eval.data.facts import ENVIRONMENTS, SPLITS, SplitDefinition
from oodd_eval.data.split import data_home, load_split
from oodd_eval.errors import UsageError
from oodd_eval.names import select

SEED_BASES: Final = range(4, 900)
"""Free bases: published splits have those below, policies are trained and evaluated above."""


def build(options: argparse.Namespace) -> int:
    """Carry out ``data build``; what an earlier call has recorded is kept."""
    definition = _definition(options)
    environments = select("environment", options.env, ENVIRONMENTS)
    if options.jobs is not None and options.jobs < 1:
        raise UsageError(f"--jobs is {options.jobs}, expected at least 1")
    directory = Path(options.output) if options.output else data_home() / definition.name
    console = make_console()

    def progress(done: int, total: int, what: str) -> None:
        if options.verbosity >= 0:
            console.print(f"{done}/{total}  {what}")

    from oodd_eval.data.simulate.build import build_split  # noqa: PLC0415  an extra

    build_split(
        definition, directory, environments=environments, jobs=options.jobs, progress=progress
    )
    split = load_split(directory)
    console.print(f"split {split.name}, digest {split.digest}, in {directory}")
    return 0


def _definition(options: argparse.Namespace) -> SplitDefinition:
    sizes = {"train": options.train, "calibration": options.calibration, "test": options.test,
             "seed-base": options.seed_base}  # fmt: skip
    if options.name in SPLITS:
        given = [n for n, v in {**sizes, "cap": options.cap}.items() if v is not None]
        if given:
            raise UsageError(
                f"split {options.name!r} is published: --{given[0]} would make another; give that "
                "a name of its own"
            )
        return SPLITS[options.name]
    missing = [f"--{name}" for name, value in sizes.items() if value is None]
    if missing:
        raise UsageError(
            f"split {options.name!r} is not a published one ({', '.join(SPLITS)}): to define it, "
            f"{', '.join(missing)} must be given"
        )
    if options.seed_base not in SEED_BASES:
        raise UsageError(
            f"--seed-base is {options.seed_base}, expected {SEED_BASES.start} to "
            f"{SEED_BASES.stop - 1}: other bases are those of published splits and policies"
        )
    if not options.name.isprintable() or set(options.name) & set("/@: "):
        raise UsageError(f"{options.name!r} cannot be a split's name: it holds one of '/@: '")
    return SplitDefinition(
        options.name,
        options.train,
        options.calibration,
        options.test,
        options.cap,
        options.seed_base,
    )


def verify(options: argparse.Namespace) -> int:
    """Carry out ``data verify``; 1 when a group's content is not what the manifest names."""
    console = make_console()
    split = load_split(_place(options.name))
    checks = list(split.verify())
    for check in checks:
        if not check.ok:
            console.print(
                f"{check.file}, {check.group}: expected {check.expected}, found {check.found}"
            )
        elif options.verbosity > 0:
            console.print(f"{check.file}, {check.group}: {check.found}")
    wrong = sum(not check.ok for check in checks)
    console.print(
        f"split {split.name}, digest {split.digest}: {len(checks) - wrong} of {len(checks)} groups "
        "as they should be"
    )
    return int(wrong > 0)


def fetch(options: argparse.Namespace) -> int:
    """Carry out ``data fetch``; what an earlier call has brought is kept."""
    from oodd_eval.data.fetch import fetch as bring  # noqa: PLC0415  reads archives and the web

    console = make_console()

    def progress(file: str) -> None:
        if options.verbosity >= 0:
            console.print(f"{file}  verified")

    output = Path(options.output) if options.output else None
    found = bring(options.place, output=output, digest=options.digest, progress=progress)
    split, there = found.split, " already" if found.already else ""
    console.print(f"split {split.name}, digest {split.digest}, is{there} in {split.path}")
    return 0


def export(options: argparse.Namespace) -> int:
    """Carry out ``data export``."""
    from oodd_eval.data import export as minari  # noqa: PLC0415  writes HDF5

    console = make_console()
    split = load_split(_place(options.name))
    written = minari.export(
        split,
        Path(options.output),
        environments=select("environment", options.env, split.environments),
        progress=lambda name: console.print(name) if options.verbosity >= 0 else None,
    )
    console.print(
        f"{len(written)} datasets in {options.output}: Minari finds them with "
        f"MINARI_DATASETS_PATH={options.output}"
    )
    return 0


def info(options: argparse.Namespace) -> int:
    """Carry out ``data info``."""
    from oodd_eval.results.tables.split_info import describe  # noqa: PLC0415  reads all returns

    make_console().print(describe(load_split(_place(options.name))))
    return 0


def _place(name: str) -> str | Path:
    """Take a text as a path when it is a directory and no name."""
    return Path(name) if "/" in name or (Path(name) / "manifest.json").is_file() else name

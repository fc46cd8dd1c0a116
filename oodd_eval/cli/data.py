"""``oodd-eval data``: build, import, verify, fetch and export splits, and describe them."""

import argparse
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path

from oodd_eval.cli import Parser, at_least, value
from oodd_eval.cli.terminal import know_own, make_console
from oodd_eval.data.export import export as export_split
from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    OWN_SEED_BASES,
    SPLITS,
    Quantity,
    SplitDefinition,
    join_condition,
)
from oodd_eval.data.fetch import fetch as fetch_split
from oodd_eval.data.importing import import_data
from oodd_eval.data.info import describe
from oodd_eval.data.logs import FORMATS, quantity
from oodd_eval.data.own import EnvironmentSpec
from oodd_eval.data.split import data_home, load_split
from oodd_eval.errors import UsageError
from oodd_eval.names import assignment, select


def define(parser: Parser) -> None:
    """Add the actions and their options."""
    # fmt: off
    action = parser.nested("action")
    split = "name or path of a split"
    place = "directory of the split (default: where splits are found)"
    add = action("build", "record a split (needs the extra sim)").options(
        build,
        "data build standard --jobs 2",
        "data build dev --train 120 --calibration 40 --test 20 --cap 500 --seed-base 41",
        "data build dev-ladder --base dev --suite ladder",
        "data build mine --env cartpole --train 40 --calibration 40 --test 10 --seed-base 42 "
        "--strength iid=0.1,0.3",
        plugins=True,
    )
    add("name", help="a published split, or a new name with sizes and a seed base of its own")
    add("--train", type=int, metavar="N", help="training trajectories per environment")
    add("--calibration", type=int, metavar="N", help="calibration trajectories per environment")
    add("--test", type=int, metavar="N", help="test seeds per environment")
    add("--cap", type=int, metavar="T", help="longest episode (default: the simulator's)")
    add("--seed-base", type=int, metavar="K", help="base of the seeds, apart from published ones")
    add("--noise", type=float, metavar="SHARE",
        help="noise of all sensors in nominal operation, in shares of their spread")
    add("--base", metavar="SPLIT", help="take training and calibration part, and test seeds")
    add("--suite", choices=["ladder", "paper"], help="strengths of anomalies; needs --base")
    add("--strength", action="append", default=[], metavar="ANOMALY=NUMBER,...",
        type=value(_strengths), help="strengths of an anomaly, in place of the paper's values")
    add("--env", default="all", metavar="NAMES",
        help="environments, also of plug-ins (default: all of the benchmark)")
    add("--jobs", type=at_least(1), metavar="N", help="worker processes (default: one per core)")
    add("--output", type=Path, metavar="DIR", help=place)
    add = action("import", "import logs of your own as an environment of a split").options(
        import_logs,
        "data import plant --env pump --format csv --train logs/a --calibration logs/b",
    )
    add("name", help="of a split of your own; one that was imported gets a further environment")
    add("--env", required=True, metavar="NAME", help="name of the environment")
    add("--format", required=True, choices=[*FORMATS], help="of the files")
    add("--train", required=True, type=Path, metavar="PLACE", help="nominal episodes to fit on")
    add("--calibration", required=True, type=Path, metavar="PLACE",
        help="nominal episodes for the thresholds of alarms")
    add("--test", type=Path, metavar="DIR",
        help="the place 'nominal' of twins, and one for each anomaly, named as the anomaly")
    add("--sensors", type=value(_quantities), default=(), metavar="NAME[UNIT],...",
        help="names of the sensors, if the files do not name them")
    add("--actions", type=value(_quantities), default=(), metavar="NAME[UNIT],...",
        help="names of the actions")
    add("--discrete", type=at_least(1), default=0, metavar="N",
        help="actions are whole numbers from 0 to N - 1")
    add("--group", action="append", default=[], metavar="ANOMALY=sensor|dynamics",
        type=value(assignment), help="group of an anomaly of your own (default: dynamics)")
    add("--output", type=Path, metavar="DIR", help=place)
    action("verify", "compare a split with its digests").options(
        verify, "data verify mini"
    )("name", help=split)
    add = action("fetch", "verify a copy of a split and install it").options(
        fetch, "data fetch standard.tar.gz"
    )
    add("place", metavar="FILE|DIR|URL", help="a split's directory, or a tar or zip archive of it")
    add("--digest", metavar="SHA256", help="the split's digest; another one is refused")
    add("--output", type=Path, metavar="DIR", help=place)
    _define_calibrate(action)
    add = action("export", "write a split in another project's format").options(
        export, "data export mini --format minari --output datasets"
    )
    add("name", help=split)
    add("--format", required=True, choices=["minari"], help="minari: one dataset a part")
    add("--output", required=True, type=Path, metavar="DIR", help="root of the datasets")
    add("--env", default="all", metavar="NAMES", help="environments (default: all)")
    add = action("page", "write the pages on environments and anomalies (extra sim)").options(
        page, "data page docs"
    )
    add("directory", type=Path, metavar="DIR", help="directory of the documents")
    add("--env", default="all", metavar="NAMES", help="environments to draw (default: all)")
    action("info", "describe a split").options(info, "data info mini")("name", help=split)
    # fmt: on


def _define_calibrate(action: Callable[[str, str], Parser]) -> None:
    # fmt: off
    add = action("calibrate", "find the strengths of the ladder (extra sim)").options(
        calibrate, "data calibrate --env cartpole --output ladder.json"
    )
    add("--env", default="all", metavar="NAMES", help="environments (default: all)")
    add("--anomaly", default="all", metavar="NAMES", help="kinds of anomalies (default: all)")
    add("--whole", action="store_true",
        help="measure robots on whole episodes, and only the rung of the paper's Table 2 "
        "(default: episodes of at most 300 steps, all rungs)")
    add("--output", required=True, type=Path, metavar="FILE", help="strengths, as JSON")
    add("--work", type=Path, metavar="FILE", help="measured returns (default: OUTPUT.work)")
    add("--jobs", type=at_least(1), metavar="N", help="worker processes (default: one per core)")
    # fmt: on


def build(options: argparse.Namespace) -> int:
    """Carry out ``data build``; what an earlier call has recorded is kept."""
    environments = list(ENVIRONMENTS)
    if options.env != "all" or options.strength:
        own = [s.name for s in know_own(options) if isinstance(s, EnvironmentSpec)]
        if options.env != "all":
            environments = select("environment", options.env, [*ENVIRONMENTS, *own])
    record_split(_definition(options), options, environments, options.output)
    return 0


def record_split(
    definition: SplitDefinition,
    options: argparse.Namespace,
    environments: Sequence[str] = tuple(ENVIRONMENTS),
    output: Path | None = None,
) -> None:
    """Record a split, by default of all environments and where splits are found."""
    # Other actions need no simulators.
    from oodd_recording.build import build_split

    directory = output or data_home() / definition.name
    notes = make_console(quiet=options.verbosity < 0)
    build_split(
        definition,
        directory,
        environments=environments,
        jobs=options.jobs,
        progress=lambda n, total, what: notes.print(f"{n}/{total}  {what}"),
    )
    split = load_split(directory)
    make_console().print(f"split {split.name}, digest {split.digest}, in {directory}")


def _definition(options: argparse.Namespace) -> SplitDefinition:
    """Return the definition of a published split, or of one with sizes of its own."""
    name, cap = options.name, options.cap
    sizes = {
        "train": options.train,
        "calibration": options.calibration,
        "test": options.test,
        "seed-base": options.seed_base,
    }
    others, strengths = {"cap": cap, "noise": options.noise}, dict(chain(*options.strength))
    given = [n for n, size in {**sizes, **others}.items() if size is not None]
    if name in SPLITS:
        given += [n for n in ("base", "suite", "strength") if getattr(options, n)]
        if given:
            other = f"--{given[0]} would make another; give that a name of its own"
            raise UsageError(f"split {name!r} is published: {other}")
        return SPLITS[name]
    if not name.isprintable() or set(name) & set("/@: "):
        raise UsageError(f"{name!r} cannot be a split's name: it holds one of '/@: '")
    if options.base:
        if given or bool(options.suite) == bool(strengths):
            raise UsageError(
                f"--base {options.base} gives split {name!r} its sizes and seeds: expected "
                "--suite ladder, --suite paper or --strength, and none of "
                f"--{', --'.join([*sizes, *others])}"
            )
        taken = load_split(options.base).manifest["definition"]
        if "seed_base" not in taken:
            raise UsageError(f"--base {options.base} was imported: expected a recorded split")
        own = {"suite": options.suite or "table1", "strengths": strengths}
        return SplitDefinition(**{**taken, "name": name, "base": options.base, **own})
    if options.suite:
        raise UsageError(f"--suite {options.suite} needs --base, a split to take training from")
    if missing := [f"--{n}" for n, size in sizes.items() if size is None]:
        known, todo = ", ".join(SPLITS), f"to define it, {', '.join(missing)} must be given"
        raise UsageError(f"split {name!r} is not a published one ({known}): {todo}")
    train, calibration, test, seed_base = sizes.values()
    if seed_base not in OWN_SEED_BASES:
        raise UsageError(
            f"--seed-base is {seed_base}, expected {OWN_SEED_BASES.start} to "
            f"{OWN_SEED_BASES.stop - 1}: other bases are those of published splits and policies"
        )
    return SplitDefinition(
        name,
        train,
        calibration,
        test,
        cap,
        seed_base,
        noise=options.noise or 0.0,
        strengths=strengths,
    )


def _strengths(text: str) -> list[tuple[str, float]]:
    """Return conditions with their strengths from ``ANOMALY=NUMBER,...``."""
    kind, numbers = assignment(text)
    try:
        found = [float(number) for number in numbers.split(",")]
    except ValueError:
        raise UsageError(f"{text!r}, expected ANOMALY=NUMBER,...") from None
    if len(found) == 1:
        return [(kind, found[0])]
    return [(join_condition(kind, f"{strength:g}"), strength) for strength in found]


def import_logs(options: argparse.Namespace) -> int:
    """Carry out ``data import``."""
    notes = make_console(quiet=options.verbosity < 0)
    split = import_data(
        options.name,
        options.env,
        form=options.format,
        train=options.train,
        calibration=options.calibration,
        test=options.test,
        sensors=options.sensors,
        actions=options.actions,
        discrete=options.discrete,
        groups=dict(options.group),
        output=options.output,
        progress=lambda part: notes.print(f"{options.env} {part}"),
    )
    make_console().print(f"split {split.name}, digest {split.digest}, in {split.path}")
    return 0


def _quantities(text: str) -> tuple[Quantity, ...]:
    return tuple(map(quantity, text.split(",")))


def verify(options: argparse.Namespace) -> int:
    """Carry out ``data verify``; 1 when a group's content is not what the manifest names."""
    console = make_console()
    split = load_split(options.name)
    checks = list(split.verify())
    for check in checks:
        if options.verbosity > 0 or not check.ok:
            expected = "" if check.ok else f"expected {check.expected}, found "
            console.print(f"{check.file}, {check.group}: {expected}{check.actual}")
    good = f"{sum(check.ok for check in checks)} of {len(checks)} groups as they should be"
    console.print(f"split {split.name}, digest {split.digest}: {good}")
    return int(not all(check.ok for check in checks))


def calibrate(options: argparse.Namespace) -> int:
    """Carry out ``data calibrate``; returns that an earlier call has measured are kept."""
    from oodd_recording.calibrate import calibrate as find_strengths

    notes = make_console(quiet=options.verbosity < 0)
    work = options.work or options.output.with_name(options.output.name + ".work")
    found = find_strengths(
        options.output,
        work,
        environments=select("environment", options.env, ENVIRONMENTS),
        kinds=select("anomaly", options.anomaly, ANOMALIES),
        whole=options.whole,
        jobs=options.jobs,
        progress=notes.print,
    )
    count = sum(map(len, found.values()))
    make_console().print(
        f"strengths of {count} kinds in {len(found)} environments: {options.output}"
    )
    return 0


def fetch(options: argparse.Namespace) -> int:
    """Carry out ``data fetch``; what an earlier call has brought is kept."""
    notes = make_console(quiet=options.verbosity < 0)
    found = fetch_split(
        options.place,
        output=options.output,
        digest=options.digest,
        progress=lambda file: notes.print(f"{file}  verified"),
    )
    split, there = found.split, " already" if found.already else ""
    make_console().print(f"split {split.name}, digest {split.digest}, is{there} in {split.path}")
    return 0


def export(options: argparse.Namespace) -> int:
    """Carry out ``data export``."""
    split = load_split(options.name)
    environments = select("environment", options.env, split.environments)
    notes = make_console(quiet=options.verbosity < 0)
    written = export_split(split, options.output, environments=environments, progress=notes.print)
    told = f"Minari finds them with MINARI_DATASETS_PATH={options.output}"
    make_console().print(f"{len(written)} datasets in {options.output}: {told}")
    return 0


def info(options: argparse.Namespace) -> int:
    """Carry out ``data info``."""
    make_console().print(describe(load_split(options.name)))
    return 0


def page(options: argparse.Namespace) -> int:
    """Carry out ``data page``; the overview names all environments."""
    from oodd_recording.page import NAME, write_pages

    notes = make_console(quiet=options.verbosity < 0)
    environments = select("environment", options.env, ENVIRONMENTS)
    write_pages(options.directory, environments=environments, progress=notes.print)
    make_console().print(f"pages: {options.directory / NAME}.md and {len(environments)} more")
    return 0

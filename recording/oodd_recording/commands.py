"""Commands of oodd-eval that record: ``data build`` and ``calibrate``, ``policies``.

The evaluator knows them by name only (`oodd_eval.cli.main`).
"""

import time
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Final

import click

from oodd_eval.cli import (
    COUNT,
    DIRECTORY,
    FILE,
    Converted,
    Name,
    Names,
    Options,
    command,
    jobs_option,
    say,
)
from oodd_eval.cli.check import STYLES
from oodd_eval.cli.terminal import make_console, register_custom
from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import ANOMALIES, CUSTOM_SEED_BASES, ENVIRONMENTS, SPLITS, SplitDefinition
from oodd_eval.data.registry import AnomalySpec, EnvironmentSpec
from oodd_eval.data.split import data_home, load_split
from oodd_eval.errors import UsageError
from oodd_eval.names import Predicate, assignment, select
from oodd_eval.plugins.conformance import CheckReport, Result
from oodd_recording.build import build_split
from oodd_recording.calibrate import calibrate as find_strengths
from oodd_recording.checks import custom_checks
from oodd_recording.policies import load_policy
from oodd_recording.record import evaluate_policy
from oodd_recording.train.train import train_policy

_SIZE: Final = click.types.IntParamType()
_environment_argument: Final = click.argument("environment", type=Name("envs"))


def _strengths(text: str) -> list[tuple[str, float]]:
    """Return conditions with their strengths from ``ANOMALY=NUMBER,...``."""
    kind, numbers = assignment(text)
    try:
        strengths = [float(number) for number in numbers.split(",")]
    except ValueError:
        raise UsageError(f"{text!r}, expected ANOMALY=NUMBER,...") from None
    if len(strengths) == 1:
        return [(kind, strengths[0])]
    return [(str(Condition(kind, f"{strength:g}")), strength) for strength in strengths]


@command(
    "data build standard --jobs 2",
    "data build dev --train 120 --calibration 40 --test 20 --cap 500 --seed-base 41",
    "data build dev-ladder --base dev --suite ladder",
    "data build mine --env cartpole --train 40 --calibration 40 --test 10 --seed-base 42 "
    "--strength iid=0.1,0.3",
    plugins=True,
)
@click.argument(
    "name", help="a published split, or a new name with sizes and a seed base of its own"
)
@click.option("--train", type=_SIZE, help="training trajectories per environment")
@click.option("--calibration", type=_SIZE, help="calibration trajectories per environment")
@click.option("--test", type=_SIZE, help="test seeds per environment")
@click.option("--cap", type=_SIZE, help="longest episode (default: the simulator's)")
@click.option("--seed-base", type=_SIZE, help="base of the seeds, apart from published ones")
@click.option(
    "--noise",
    type=float,
    metavar="SHARE",
    help="noise of all sensors in nominal operation, in shares of their spread",
)
@click.option(
    "--base", type=Name("splits"), help="take training and calibration part, and test seeds"
)
@click.option(
    "--suite", type=click.Choice(["ladder", "paper"]), help="strengths of anomalies; needs --base"
)
@click.option(
    "--strength",
    multiple=True,
    type=Converted(_strengths, "ANOMALY=NUMBER,..."),
    help="strengths of an anomaly, in place of the paper's values",
)
@click.option(
    "--env",
    default="all",
    type=Names("envs"),
    help="environments, also of plug-ins (default: all of the benchmark)",
)
@jobs_option
@click.option(
    "--output", type=DIRECTORY, help="directory of the split (default: where splits are found)"
)
def build(options: Options) -> int:
    """Record a split, which needs the extra sim; what an earlier call has recorded is kept."""
    environments = list(ENVIRONMENTS)
    if options.env != "all" or options.strength:
        custom = [s.name for s in register_custom(options) if isinstance(s, EnvironmentSpec)]
        if options.env != "all":
            environments = select("environment", options.env, [*ENVIRONMENTS, *custom])
    record_split(_definition(options), options, environments, options.output)
    return 0


def record_split(
    definition: SplitDefinition,
    options: Options,
    environments: Sequence[str] = tuple(ENVIRONMENTS),
    output: Path | None = None,
    *,
    bits: int | None = None,
) -> None:
    """Record a split, by default of all environments and where splits are found.

    See `build_split` for the `bits`.
    """
    directory = output or data_home() / definition.name
    notes = make_console(quiet=options.verbosity < 0)
    build_split(
        definition,
        directory,
        environments=environments,
        bits=bits,
        jobs=options.jobs,
        progress=lambda n, total, what: notes.print(f"{n}/{total}  {what}"),
    )
    split = load_split(directory)
    make_console().print(f"split {split.name}, digest {split.digest}, in {directory}")


def _definition(options: Options) -> SplitDefinition:
    """Return the definition of a published split, or of one with sizes of its own."""
    name, cap = options.name, options.cap
    sizes = {
        "train": options.train,
        "calibration": options.calibration,
        "test": options.test,
        "seed-base": options.seed_base,
    }
    others, strengths = {"cap": cap, "noise": options.noise}, dict(chain(*options.strength))
    set_options = [n for n, size in {**sizes, **others}.items() if size is not None]
    if name in SPLITS:
        set_options += [n for n in ("base", "suite", "strength") if getattr(options, n)]
        if set_options:
            other = f"--{set_options[0]} would make another; give that a name of its own"
            raise UsageError(f"split {name!r} is published: {other}")
        return SPLITS[name]
    if not name.isprintable() or set(name) & set("/@: "):
        raise UsageError(f"{name!r} cannot be a split's name: it holds one of '/@: '")
    if options.base:
        if set_options or bool(options.suite) == bool(strengths):
            raise UsageError(
                f"--base {options.base} gives split {name!r} its sizes and seeds: expected "
                "--suite ladder, --suite paper or --strength, and none of "
                f"--{', --'.join([*sizes, *others])}"
            )
        taken = load_split(options.base).manifest["definition"]
        if "seed_base" not in taken:
            raise UsageError(f"--base {options.base} was imported: expected a recorded split")
        changed = {"suite": options.suite or "table1", "strengths": strengths}
        return SplitDefinition(**{**taken, "name": name, "base": options.base, **changed})
    if options.suite:
        raise UsageError(f"--suite {options.suite} needs --base, a split to take training from")
    if missing := [f"--{n}" for n, size in sizes.items() if size is None]:
        known, todo = ", ".join(SPLITS), f"to define it, {', '.join(missing)} must be given"
        raise UsageError(f"split {name!r} is not a published one ({known}): {todo}")
    train, calibration, test, seed_base = sizes.values()
    if seed_base not in CUSTOM_SEED_BASES:
        raise UsageError(
            f"--seed-base is {seed_base}, expected {CUSTOM_SEED_BASES.start} to "
            f"{CUSTOM_SEED_BASES.stop - 1}: other bases are those of published splits and policies"
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


@command("data calibrate --env cartpole --output ladder.json")
@click.option("--env", default="all", type=Names("envs"), help="environments")
@click.option("--anomaly", default="all", type=Names("anomalies"), help="kinds of anomalies")
@click.option(
    "--whole",
    is_flag=True,
    help="measure robots on whole episodes, and only the rung of the paper's Table 2 (default: "
    "episodes of at most 300 steps, all rungs)",
)
@click.option("--output", required=True, type=FILE, help="strengths, as JSON")
@click.option("--work", type=FILE, help="measured returns (default: OUTPUT.work)")
@jobs_option
def calibrate(options: Options) -> int:
    """Find the strengths of the ladder; returns that an earlier call has measured are kept."""
    notes = make_console(quiet=options.verbosity < 0)
    work = options.work or options.output.with_name(options.output.name + ".work")
    strengths = find_strengths(
        options.output,
        work,
        environments=select("environment", options.env, ENVIRONMENTS),
        kinds=select("anomaly", options.anomaly, ANOMALIES),
        whole=options.whole,
        jobs=options.jobs,
        progress=notes.print,
    )
    count = sum(map(len, strengths.values()))
    make_console().print(
        f"strengths of {count} kinds in {len(strengths)} environments: {options.output}"
    )
    return 0


@command("policies train hopper --steps 200000", plugins=True)
@_environment_argument
@click.option("--output", default="policies", type=DIRECTORY, help="checkpoint and best policy")
@click.option("--steps", type=_SIZE, help="environment steps in all")
@click.option("--seed", type=int, default=1, help="seed of the training")
def train(options: Options) -> int:
    """Train a policy, going on from a checkpoint if there is one."""
    _must_know(options)
    tell = make_console(quiet=options.verbosity < 0).print
    best = train_policy(
        options.environment,
        out=options.output,
        steps=options.steps,
        seed=options.seed,
        progress=tell,
    )
    make_console().print(f"best policy in {best}")
    return 0


@command("policies evaluate hopper --episodes 20", plugins=True)
@_environment_argument
@click.option("--policy", type=FILE, help="policy file (default: the frozen one)")
@click.option("--episodes", type=COUNT, default=100, help="fresh episodes")
@click.option(
    "--noise",
    type=float,
    default=0.0,
    metavar="SHARE",
    help="noise of all sensors, in shares of their spread",
)
def evaluate(options: Options) -> int:
    """Print the mean return of a policy over fresh nominal episodes."""
    name = options.environment
    _must_know(options)
    returns = evaluate_policy(
        name, load_policy(name, options.policy), episodes=options.episodes, noise=options.noise
    )
    paper = f" (paper: {ENVIRONMENTS[name].paper_return})" if name in ENVIRONMENTS else ""
    mean = f"{returns.mean():.1f} ± {returns.std():.1f}"
    make_console().print(f"{name}: return {mean} over {options.episodes} episodes{paper}")
    return 0


def _must_know(options: Options) -> None:
    """Ask plug-ins for an environment that the benchmark does not have."""
    if options.environment not in ENVIRONMENTS:
        register_custom(options)


def check_custom(options: Options, selects: Predicate) -> int:
    """Check an environment or an anomaly of a plug-in; 1 when a check failed, 5 when none ran."""
    specs = {spec.name: spec for spec in register_custom(options)}
    spec, environment = specs[options.name], options.name
    if isinstance(spec, AnomalySpec):
        others = (s.name for s in specs.values() if isinstance(s, EnvironmentSpec))
        environment = options.env or next(iter([*spec.environments, *others, "cartpole"]))
    console, results = make_console(), []
    console.print(f"{spec.name} in {environment}" if spec.name != environment else spec.name)
    for name, check in custom_checks(spec, environment):
        if selects(name):
            start = time.perf_counter()
            problem = check()
            seconds = time.perf_counter() - start
            results.append(Result(name, "failed" if problem else "passed", problem, seconds))
            if options.verbosity >= 0 or problem:
                console.print(results[-1].line(13), style=STYLES[results[-1].status])
    report = CheckReport(results)
    if not results:
        return say(f"no check matches -k {options.expression!r}", 5)
    console.print(report.summary(), style="green" if report.ok else "bold red")
    return 0 if report.ok else 1

"""Commands of oodd-eval that record: ``data build``, ``calibrate`` and ``page``, ``policies``.

The evaluator knows them by name only (`oodd_eval.cli.main`).
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import click
from oodd_checks.commands.check import STYLES
from oodd_checks.conformance import CheckReport, Result

from oodd_eval.cli import (
    COUNT,
    FILE,
    OUTPUT_DIRECTORY,
    OUTPUT_FILE,
    Converted,
    Name,
    Names,
    Options,
    command,
    jobs_option,
    refuse,
    say,
)
from oodd_eval.cli.console import make_console
from oodd_eval.cli.plugins import discovered
from oodd_eval.cli.progress import pace_shown
from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import (
    CUSTOM_SEED_BASES,
    ENVIRONMENTS,
    LONG_NAMES,
    SPLITS,
    SplitDefinition,
    short_name,
)
from oodd_eval.data.files import temporary_directory
from oodd_eval.data.offers import OfferedSpecs
from oodd_eval.data.registry import (
    AnomalySpec,
    EnvironmentSpec,
    Spec,
    environment_spec,
    long_name,
    registered,
)
from oodd_eval.data.split import data_home, load_split
from oodd_eval.errors import UsageError
from oodd_eval.names import Predicate, assignment, check_known, counted, select
from oodd_recording.build import build_split
from oodd_recording.calibrate import calibrate as find_strengths
from oodd_recording.checks import custom_checks
from oodd_recording.closed_loop import evaluate_policy
from oodd_recording.page import Page, write_page
from oodd_recording.policies import load_policy
from oodd_recording.registered import kinds_of
from oodd_recording.train.train import train_policy

TRIED: Final = 5  # episodes in which an imported policy is tried
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
    "data build other --env cartpole --policy cartpole.npz --train 40 --calibration 40 --test 10 "
    "--seed-base 43",
    further={"Other": "--noise --suite --policy -p"},
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
@click.option("--suite", type=click.Choice(["ladder", "paper"]), help="strengths of anomalies")
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
@click.option("--policy", type=FILE, help="policy file of the one --env (default: its own)")
@jobs_option
@click.option(
    "--output",
    type=OUTPUT_DIRECTORY,
    help="directory of the split (default: where splits are found)",
)
def build(options: Options) -> int:
    """Record a split, which needs the extra sim; what an earlier call has recorded is kept."""
    definition = _definition(options)
    environments = list(definition.environments or ENVIRONMENTS)
    if options.env != "all" or options.strength or definition.environments:
        offered = discovered(options).custom_specs
        if options.env != "all":
            environments = offered.select_environments(options.env)
        # What a published definition names is the project's, whatever else is installed.
        long = LONG_NAMES if definition.environments else {}
        environments = [long.get(name, name) for name in environments]
        kinds = [Condition.parse(name).anomaly for name in definition.strengths]
        environments = offered.register(environments, kinds)
        strengths = {short_name(name): number for name, number in definition.strengths.items()}
        definition = replace(definition, strengths=strengths)
    if options.policy and len(environments) != 1:
        raise UsageError(f"--policy is for one --env, got {', '.join(environments)}")
    policies = dict.fromkeys(environments, options.policy) if options.policy else {}
    record_split(definition, options, environments, options.output, policies=policies)
    return 0


def record_split(
    definition: SplitDefinition,
    options: Options,
    environments: Sequence[str] = tuple(ENVIRONMENTS),
    output: Path | None = None,
    *,
    policies: Mapping[str, Path] | None = None,
) -> None:
    """Record a split, by default of all environments and where splits are found.

    `policies` are files of others, as `build_split` takes them.
    """
    directory = output or data_home() / definition.name
    notes = make_console(quiet=options.verbosity < 0)
    build_split(
        definition,
        directory,
        environments=environments,
        policies=policies,
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
    if missing := [f"--{n}" for n, size in sizes.items() if size is None]:
        known, todo = ", ".join(SPLITS), f"to define it, {', '.join(missing)} must be given"
        todo += ", or --base with a split that has them" if options.suite else ""
        raise UsageError(f"split {name!r} is not a published one ({known}): {todo}")
    train, calibration, test, seed_base = sizes.values()
    if seed_base not in CUSTOM_SEED_BASES:
        raise UsageError(
            f"--seed-base is {seed_base}, expected {CUSTOM_SEED_BASES.start} to "
            f"{CUSTOM_SEED_BASES.stop - 1}: other bases are those of published splits and policies"
        )
    more: dict[str, Any] = {"noise": options.noise or 0.0, "strengths": strengths}
    sizes_of_split = train, calibration, test, cap, seed_base
    return SplitDefinition(name, *sizes_of_split, suite=options.suite or "table1", **more)


@command("data calibrate --env cartpole --output ladder.json", plugins=True)
@click.option("--env", default="all", type=Names("envs"), help="environments")
@click.option("--anomaly", default="all", type=Names("anomalies"), help="kinds of anomalies")
@click.option(
    "--whole",
    is_flag=True,
    help="measure robots on whole episodes, and only the rung of the paper's Table 2 (default: "
    "episodes of at most 300 steps, all rungs)",
)
@click.option("--output", required=True, type=OUTPUT_FILE, help="strengths, as JSON")
@click.option("--work", type=OUTPUT_FILE, help="measured returns (default: OUTPUT.work)")
@jobs_option
def calibrate(options: Options) -> int:
    """Find the strengths of a ladder; what an earlier call has measured is kept.

    With --env, also in environments of plug-ins, and of kinds of theirs.
    """
    environments, kinds = list(ENVIRONMENTS), options.anomaly.split(",")
    if options.env != "all":
        offered = discovered(options).custom_specs
        environments = offered.select_environments(options.env)
        environments = offered.register(environments, [] if kinds == ["all"] else kinds)
    kind_names = [spec.name for spec in registered() if isinstance(spec, AnomalySpec)]
    work = options.work or options.output.with_name(options.output.name + ".work")
    selected = select("anomaly", ",".join(map(short_name, kinds)), kind_names)
    with pace_shown("evaluations", quiet=options.verbosity < 0) as progress:
        strengths = find_strengths(
            options.output,
            work,
            environments=environments,
            kinds=selected,
            whole=options.whole,
            jobs=options.jobs,
            progress=progress,
        )
    kinds_measured = counted(sum(map(len, strengths.values())), "kind(s)")
    of = counted(len(strengths), "environment(s)")
    make_console().print(f"strengths of {kinds_measured} in {of}: {options.output}")
    return 0


@command(
    "data page hopper --output pages", "data page cartpole --anomaly iid,gravity", plugins=True
)
@_environment_argument
@click.option(
    "--anomaly",
    type=Names("anomalies"),
    help="kinds of anomalies (default: those of the environment's ladder, and those of plug-ins "
    "that can be recorded in it)",
)
@click.option("--output", default="pages", type=OUTPUT_DIRECTORY, help="directory of the page")
def page(options: Options) -> int:
    """Write a page on an environment, as Markdown with pictures.

    It has what the plug-in says of the environment, sensors, actions, kinds of anomalies with their
    strengths, a frame or drawing, and for each kind an episode beside its twin.
    """
    kinds = options.anomaly.split(",") if options.anomaly else []
    environment = _meant(options, kinds)
    if kinds:
        kinds = select("anomaly", ",".join(map(short_name, kinds)), kinds_of(environment))
    notes = make_console(quiet=options.verbosity < 0)
    path = write_page(Page(environment, kinds), options.output, notes.print)
    make_console().print(f"page of {environment}: {path}")
    return 0


@command("policies train hopper --steps 200000", plugins=True)
@_environment_argument
@click.option(
    "--output", default="policies", type=OUTPUT_DIRECTORY, help="checkpoint and best policy"
)
@click.option("--steps", type=_SIZE, help="environment steps in all")
@click.option("--seed", type=int, default=1, help="seed of the training")
def train(options: Options) -> int:
    """Train a policy, going on from a checkpoint if there is one."""
    environment = _meant(options)
    tell = make_console(quiet=options.verbosity < 0).print
    best = train_policy(
        environment, out=options.output, steps=options.steps, seed=options.seed, progress=tell
    )
    make_console().print(f"best policy in {best}")
    return 0


@command("policies import actor.onnx --env hopper --output hopper.npz", plugins=True)
@click.argument("path", type=FILE, metavar="FILE.onnx")
@click.option("--env", required=True, type=Name("envs"), help="environment in which it acts")
@click.option("--output", required=True, type=OUTPUT_FILE, help="policy file, .npz or .onnx")
@click.option("--tensor", default="", help="the graph's output with actions (default: the first)")
def import_policy(options: Options) -> int:
    """Take a policy over from an ONNX file, and try it in its environment.

    Layers in a row become arrays of the project's own format, which needs no further package. Any
    other graph without memory is kept as it is, and runs in onnxruntime.
    """
    from oodd_recording.onnx_files import layers_of, write_policy  # noqa: PLC0415  of an extra

    options.environment = options.env
    environment = _meant(options)
    arrays = layers_of(options.path, options.tensor)
    suffix = ".onnx" if arrays is None else ".npz"
    if options.output.suffix != suffix:
        what = "more than layers in a row" if arrays is None else "layers in a row"
        raise UsageError(
            f"{options.path.name} is {what}: expected an --output that ends in {suffix}"
        )
    with temporary_directory() as directory:  # a policy that cannot act is not written
        partial = directory / options.output.name
        write_policy(options.path, options.tensor, arrays, partial)
        returns = evaluate_policy(environment, load_policy(environment, partial), episodes=TRIED)
    write_policy(options.path, options.tensor, arrays, options.output)
    policy = load_policy(environment, options.output)
    steps = "onnxruntime" if arrays is None else counted(len(arrays["steps"]), "operation(s)")
    make_console().print(
        f"policy in {options.output}, {steps}, digest {policy.digest[:12]}: mean return "
        f"{returns.mean():.1f} in {TRIED} episodes of {environment}"
    )
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
    name = _meant(options)
    returns = evaluate_policy(
        name, load_policy(name, options.policy), episodes=options.episodes, noise=options.noise
    )
    paper = f" (paper: {ENVIRONMENTS[name].paper_return})" if name in ENVIRONMENTS else ""
    mean = f"{returns.mean():.1f} ± {returns.std():.1f}"
    make_console().print(
        f"{name}: return {mean} over {counted(options.episodes, 'episode(s)')}{paper}"
    )
    return 0


def _meant(options: Options, kinds: Sequence[str] = ()) -> str:
    """Register what the name of an environment means, and those of kinds; return its short name."""
    name: str = options.environment
    if name not in ENVIRONMENTS:
        discovered(options).custom_specs.register([name], kinds)
    return short_name(name)


def check_custom(options: Options, selects: Predicate, spec: Spec, offered: OfferedSpecs) -> int:
    """Check an environment or an anomaly of a plug-in; 1 when a check failed, 5 when none ran."""
    name, environment, beside = long_name(spec), options.env, spec.plugin
    if isinstance(spec, EnvironmentSpec):
        refuse(options, ["env"], f"is for anomalies, and {name} is an environment")
        environment = name
    elif not environment:
        environments = [s for s in offered.specs if isinstance(s, EnvironmentSpec)]
        of_plugin = [s.name for s in environments if s.plugin == beside]
        environment = [*spec.environments, *of_plugin, "cartpole"][0]
    kinds = [name] if isinstance(spec, AnomalySpec) else []
    (environment,) = offered.register([environment], kinds, "" if options.env else beside)
    if kinds:
        check_known(f"anomaly that {environment} can have", kinds_of(environment), spec.name)
        name = f"{name} in {long_name(environment_spec(environment))}"
    console, results = make_console(), []
    console.print(name)
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

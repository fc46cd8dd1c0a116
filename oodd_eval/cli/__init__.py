"""The command line: a module per command, and here the classes and options that they share."""

import contextlib
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from inspect import getdoc
from itertools import chain
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, Final, TypeAlias

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from oodd_eval.errors import OoddError, UnknownNameError, UsageError
from oodd_eval.metrics.catalogue import LEVELS
from oodd_eval.names import memory_bytes, parameter, read, seconds, whole_numbers

PARAM: Final = "a parameter, of one detector as DETECTOR.K=V; V is JSON or text"

NAMES: Final = "names separated by commas, globs, or 'all'"

Options: TypeAlias = SimpleNamespace
"""The values of a command's options and arguments.

``invocation`` is the whole command line, ``passed`` has the options that are in it by their names.
"""

Commands: TypeAlias = Mapping[str, tuple[str, "str | Commands"]]
"""A summary for each name, with ``module:attribute`` of a command, or the commands of a group."""

Items: TypeAlias = list[CompletionItem[str]]
Handler: TypeAlias = Callable[[Options], int]
Decorator: TypeAlias = Callable[[Handler], Handler]


def load(target: str) -> Any:
    """Import ``module:attribute``: what belongs to other packages is known by name only."""
    module, _, attribute = target.partition(":")
    return getattr(import_module(module), attribute)


class Command(click.Command):
    """A command that hands its options to a function, and shows examples in its help.

    Parameters
    ----------
    handler
        The function, which returns the exit code; its docstring is the help.
    params
        Options and arguments.
    examples
        Arguments of oodd-eval that the help shows.
    further
        Options that ``--help`` leaves out, by the headings that ``--help-all`` has them under.
    """

    def __init__(
        self,
        handler: Handler,
        params: list[click.Parameter],
        examples: Sequence[str],
        further: Mapping[str, str],
    ) -> None:
        settings = {"show_default": True}
        self.further = {name: head for head, names in further.items() for name in names.split()}
        text = f"Show {len(self.further)} more options and exit."
        self._help_all = click.Option(["--help-all"], is_flag=True, expose_value=False, help=text)
        super().__init__(None, settings, params=params, help=getdoc(handler))
        self.handler, self.examples = handler, examples

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return options and arguments, with those that print a help text."""
        *params, help_option = super().get_params(ctx)
        return [*params, *[self._help_all][: len(self.further)], help_option]

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments; ``--help-all`` prints the help with the further options."""
        if self.further and "--help-all" in args:
            args, ctx.meta[ALL] = ["--help"], True
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> int:
        """Run the command and return its exit code; an output that is an input is refused."""
        self._check_outputs(ctx)
        passed = {
            p.name: p.opts[0]
            for p in self.params
            if p.name and ctx.get_parameter_source(p.name) is ParameterSource.COMMANDLINE
        }
        return self.handler(Options(**ctx.params, invocation=ctx.obj, passed=passed))

    def _check_outputs(self, ctx: click.Context) -> None:
        """Raise `UsageError` for an output that would overwrite an input, or another output."""
        values = [(p, ctx.params[p.name]) for p in self.params if p.name and ctx.params[p.name]]
        outputs = [(p.opts[0], path) for p, path in values if is_output(p)]
        if not outputs:
            return
        inputs = [path for p, value in values if not is_output(p) for path in _paths(p, value)]
        refuse_inputs = load("oodd_eval.data.files:refuse_inputs")
        for i, (option, path) in enumerate(outputs):
            refuse_inputs(path, inputs, option)
            if path in (taken for _, taken in outputs[:i]):
                raise UsageError(f"two outputs are {str(path)!r}: {option} would replace the first")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options; the further ones where the context asks for all."""
        further = dict.fromkeys(self.further.values()) if ctx.meta.get(ALL) else ()
        options = [p for p in self.get_params(ctx) if isinstance(p, click.Option)]
        for heading in ("Options", *further):
            under = (p for p in options if self.further.get(p.opts[0], "Options") == heading)
            if records := [r for p in under if (r := p.get_help_record(ctx))]:
                with formatter.section(heading):
                    formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples."""
        del ctx
        write_section(formatter, "Examples", [f"oodd-eval {line}" for line in self.examples])


ALL: Final = "oodd_eval.all"
"""Key of `click.Context.meta`: whether a help text has all options."""


def write_section(formatter: click.HelpFormatter, heading: str, lines: Iterable[str]) -> None:
    """Write lines into a help text as they are, below a heading."""
    with formatter.section(heading):
        for line in lines:
            formatter.write(f"  {line}\n")


def command(
    *examples: str,
    plugins: bool = False,
    further: Mapping[str, str] = MappingProxyType({}),
    kind: type[Command] = Command,
) -> Callable[[Handler], Command]:
    """Return a decorator that makes a command of a function with click's options.

    Parameters
    ----------
    examples, further
        As in `Command`.
    plugins
        Whether the command loads plug-ins, and so has the option ``-p``.
    kind
        The class of the command.
    """

    def decorate(handler: Handler) -> Command:
        params = [*reversed(getattr(handler, "__click_params__", []))]
        options = _PLUGIN_OPTION if plugins else ()
        return kind(handler, [*params, *options, *_VERBOSITY], examples, further)

    return decorate


def _left_out(text: str) -> str:
    if not text.startswith("no:"):
        raise UsageError(f"{text!r}, expected no:NAME, which leaves a plug-in out")
    return text.removeprefix("no:")


class Group(click.Group):
    """Commands that are imported when they are named: help and completion need no import.

    Parameters
    ----------
    help_text
        What the group is for.
    sections
        Commands by the headings of the help.
    """

    def __init__(self, help_text: str, sections: Mapping[str, Commands]) -> None:
        super().__init__(help=help_text, no_args_is_help=False, subcommand_metavar="COMMAND ...")
        self.sections = sections
        self.entries = {name: row for rows in sections.values() for name, row in rows.items()}

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments; without any, print the help, as git, docker and gh do."""
        return super().parse_args(ctx, args or ["--help"])

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands."""
        del ctx
        return list(self.entries)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        """Import a command; raise `UnknownNameError`, with a suggestion, if there is none."""
        if cmd_name not in self.entries:
            kind = f"command of {ctx.info_name}" if ctx.parent else "command"
            raise UnknownNameError(kind, cmd_name, self.entries)
        summary, target = self.entries[cmd_name]
        if isinstance(target, Mapping):
            return Group(f"{summary[0].upper()}{summary[1:]}.", {"Commands": target})
        loaded: Command = load(target)
        return loaded

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands below their headings."""
        del ctx
        width = max(map(len, self.entries))
        for heading, commands in self.sections.items():
            with formatter.section(heading):
                rows = [(name.ljust(width), row[0]) for name, row in commands.items()]
                formatter.write_dl(rows)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> Items:
        """Complete names of commands without importing them, and options."""
        rows = [(name, row[0]) for name, row in self.entries.items() if name.startswith(incomplete)]
        names = [CompletionItem(name, help=summary) for name, summary in rows]
        return names + click.Command.shell_complete(self, ctx, incomplete)


class Converted(click.ParamType[Any]):
    """The type of an option whose text a function reads.

    The message of the function's `UsageError` follows the name of the option.

    Parameters
    ----------
    function
        Returns what a text stands for.
    metavar
        What the help shows in place of the text.
    """

    def __init__(self, function: Callable[[str], Any], metavar: str) -> None:
        self.name, self._function = metavar, function

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return what the text stands for."""
        del ctx
        option = param.opts[0] if param else "the value"
        return read(option, self._function, value) if isinstance(value, str) else value


class Names(click.ParamType[str]):
    """The type of an option with names separated by commas, of which shells complete the last.

    Parameters
    ----------
    kinds
        Kinds of names that the option takes, as ``oodd-eval list`` knows them.
    """

    name = "names"

    def __init__(self, *kinds: str) -> None:
        self.kinds = kinds

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
        """Return the list with each name that begins like its last one."""
        del ctx, param
        before, comma, last = incomplete.rpartition(",")
        names = chain.from_iterable(map(_names, self.kinds))
        return [CompletionItem(before + comma + name) for name in names if name.startswith(last)]


class Name(Names):
    """The type of an option with one name."""

    name = "name"


def _names(kind: str) -> Iterable[str]:
    """Return the names of a kind, of plug-ins too."""
    if kind == "metrics":
        return [*load("oodd_eval.metrics.catalogue:NAMES")]
    # Forms such as (pyod:NAME) are listed, too.
    rows = load("oodd_eval.cli.listing:rows")(kind, load("oodd_eval.plugins.discovery:discover")())
    return [name for name, *_ in rows if name[0].isalnum()]


def plain_path(text: str) -> Path:
    """Return a path to read or write at; `UsageError` for a pipe, a device and the like."""
    path = Path(text)
    try:
        kind = path.stat().st_mode
    except (OSError, ValueError):  # the command says what is missing
        return path
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise UsageError(f"{text!r}, expected a file or directory, not a pipe or a device")
    return path


class _PathType(Converted):
    """The type of a path, which shells complete as they do files; if `written`, of an output.

    Of a `partly_read` folder the command itself says which files no output may overwrite.
    """

    def __init__(self, metavar: str, *, written: bool = False, partly_read: bool = False) -> None:
        super().__init__(plain_path, metavar)
        self.written, self.partly_read = written, partly_read

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> Items:
        return click.Path().shell_complete(ctx, param, incomplete)


def is_output(parameter: click.Parameter) -> bool:
    """Tell whether a command writes at the path that an option or argument names."""
    return isinstance(parameter.type, _PathType) and parameter.type.written


def _paths(parameter: click.Parameter, value: Any) -> Iterator[Path]:
    """Yield the paths that a command reads by an option or argument."""
    kind = parameter.type
    if isinstance(kind, _PathType) and kind.partly_read:
        return
    if isinstance(kind, _PathType | click.Path):
        yield from map(Path, value if isinstance(value, tuple) else (value,))
    elif isinstance(kind, Names) and "splits" in kind.kinds:
        with contextlib.suppress(OoddError):  # no split: the command says so
            yield load("oodd_eval.data.split:load_split")(value).path


DIRECTORY: Final = _PathType("DIR")
FILE: Final = _PathType("FILE")
LOGS: Final = _PathType("FILE", partly_read=True)
OUTPUT_DIRECTORY: Final = _PathType("DIR", written=True)
OUTPUT_FILE: Final = _PathType("FILE", written=True)
COUNT: Final = click.IntRange(min=1)
COUNT.name = "N"
HORIZONS: Final = Converted(partial(whole_numbers, least=1), "N,...")
SEEDS: Final = Converted(partial(whole_numbers, least=0), "N,...")
TIME: Final = Converted(seconds, "TIME")
MEMORY: Final = Converted(memory_bytes, "SIZE")
PARAMETER: Final = Converted(parameter, "K=V")

_PLUGIN_OPTION: Final = (
    click.Option(
        ["-p", "disabled"],
        multiple=True,
        metavar="no:NAME",
        type=Converted(_left_out, "NAME"),
        help="leave a plug-in out (see also OODD_EVAL_PLUGINS)",
    ),
)

_VERBOSITY: Final = tuple(
    click.Option(
        [flag, "verbosity"], flag_value=value, type=int, default=0, show_default=False, help=text
    )
    for flag, value, text in (
        ("-q", -1, "print less"),
        ("-v", 1, "print more, and tracebacks of errors"),
    )
)


def together(*options: Decorator) -> Decorator:
    """Return one decorator for several options."""

    def decorate(handler: Handler) -> Handler:
        for option in reversed(options):
            handler = option(handler)
        return handler

    return decorate


expression_option: Final = click.option(
    "-k", "expression", metavar="EXPR", help="only cells whose id matches: 'hopper and not iid'"
)

row_metrics_option: Final = click.option(
    "--row-metrics", is_flag=True, help="without twins: add rows' F1, alarm rates and VUS-PR"
)

alarm_options: Final = together(
    click.option(
        "--level",
        type=click.Choice([suffix[3:-3] for suffix in LEVELS]),
        callback=lambda _ctx, _parameter, percent: f"at_{percent}pct" if percent else "",
        help="guaranteed alarms at most in this percentage of nominal episodes (default: 5)",
    ),
    click.option("--paper", is_flag=True, help="print what the paper's alarm does, too"),
)

detector_options: Final = together(
    click.option("--param", multiple=True, type=PARAMETER, help=PARAM),
    click.option("--horizon", default="1", type=HORIZONS, help="prediction horizons"),
)


jobs_option: Final = click.option(
    "--jobs", type=COUNT, help="processes at a time (default: one per core)"
)


def limit_options(process: str, timeout: str) -> Decorator:
    """Return the options that limit the time and the memory of a process."""
    return together(
        click.option("--timeout", default=timeout, type=TIME, help=f"wall-clock time of {process}"),
        click.option("--memory", default="8GB", type=MEMORY, help=f"resident memory of {process}"),
    )


def fit_options(timeout: str) -> Decorator:
    """Return the options that say where fits run and within which limits."""
    choice = click.Choice(["auto", "cpu", "cuda"])
    device = click.option("--device", type=choice, help="where networks of detectors compute")
    return together(jobs_option, device, limit_options("a fit with its scores", timeout))


def refuse(options: Options, names: Iterable[str], why: str) -> None:
    """Raise `UsageError` for the first of some options that was passed: it would do nothing."""
    for option in (options.passed[name] for name in names if name in options.passed):
        raise UsageError(f"{option} {why}")


def say_notes(notes: Iterable[str]) -> None:
    """Say each of some notes once."""
    for note in dict.fromkeys(notes):
        say(note)


def say(message: str, code: int = 0) -> int:
    """Print a message of the program itself on standard error and return an exit code."""
    print(f"oodd-eval: {message}", file=sys.stderr)
    return code

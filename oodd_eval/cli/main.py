"""The entry point: read the command line, carry it out, and return its exit code."""

import contextlib
import errno
import os
import shlex
import signal
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NoReturn

import click
from click.shell_completion import shell_complete

from oodd_eval._version import __version__
from oodd_eval.cli import Commands, Group, Options, command, say, write_section
from oodd_eval.cli.streams import open_streams, plain_streams
from oodd_eval.errors import OoddError

FIRST_STEPS: Final = (
    "run --detector mewma --env hopper  evaluate a detector, in seconds",
    "list detectors                     list what else can be run",
    "leaderboard show                   print the board",
    "scan LOGS                          find odd episodes in your logs",
    "calibrate LOGS --score COLUMN      find your monitor's threshold",
    "new NAME                           write a detector of your own",
)

EXIT_CODES: Final = (
    "0  ok",
    "1  a cell, check or comparison failed, or a plug-in is broken",
    "2  interrupted (Ctrl-C, TERM, HUP, USR1, USR2, XCPU), or output pipe closed",
    "3  internal error",
    "4  cannot be carried out: unknown name, missing data, refused by the system",
    "5  nothing was selected or compared",
)

_LOGS, _BOARD = "oodd_logs.commands", "oodd_leaderboard.commands"
_RECORDING, _ACTS = "oodd_recording.commands", "oodd_interventions.commands"
_SCORES: Final = "oodd_monitors.commands.calibrate_score"

DATA: Final[Commands] = {
    "inspect": ("look at logs, write a first recipe", f"{_LOGS}.inspect_logs:inspect"),
    "import": ("import logs as an environment", f"{_LOGS}.imports:import_logs"),
    "info": ("describe a split", "oodd_eval.cli.data:info"),
    "verify": ("compare a split with its digests", "oodd_eval.cli.data:verify"),
    "fetch": ("verify a copy of a split and install it", "oodd_eval.cli.data:fetch"),
    "export": ("write a split in another project's format", f"{_LOGS}.exports:export"),
    "build": ("record a split (extra sim)", f"{_RECORDING}:build"),
    "calibrate": ("find the ladder's strengths (extra sim)", f"{_RECORDING}:calibrate"),
    "page": ("write the page of an environment (extra sim)", f"{_RECORDING}:page"),
}

LEADERBOARD: Final[Commands] = {
    "show": ("print the last season's board", f"{_BOARD}.published_board:show"),
    "place": ("show where a run would stand on it", f"{_BOARD}.published_board:place_run"),
    "submit": ("write an entry from a run", f"{_BOARD}.entries:submit"),
    "season": ("run every entry on a fresh split (extra sim)", f"{_BOARD}.season:season"),
    "build": ("render page, tables and site", f"{_BOARD}.entries:build"),
}

POLICIES: Final[Commands] = {
    "train": ("train a policy (extra train)", f"{_RECORDING}:train"),
    "import": ("take a policy over from ONNX (extra onnx)", f"{_RECORDING}:import_policy"),
    "evaluate": ("mean return of a policy (extra sim)", f"{_RECORDING}:evaluate"),
}

COMMANDS: Final[Mapping[str, Commands]] = {
    "Evaluate detectors": {
        "run": ("fit and score every selected cell", "oodd_eval.cli.run:run"),
        "show": ("print the tables of earlier results", "oodd_eval.cli.show:show"),
        "compare": ("compare rows, or results with a reference", "oodd_eval.cli.compare:compare"),
        "forget": ("remove cells from a results directory", "oodd_eval.cli.forget:forget"),
        "intervene": ("tell what acting at an alarm saves (extra sim)", f"{_ACTS}:intervene"),
        "reproduce": ("compute the paper's tables and claims", "oodd_paper.command:reproduce"),
    },
    "Use logs of your own": {
        "scan": ("find odd episodes in recorded logs", f"{_LOGS}.scan_logs:scan"),
        "calibrate": ("find the threshold of a recorded score", f"{_SCORES}:calibrate_score"),
        "data": ("inspect and import logs, record and fetch splits", DATA),
    },
    "Look up": {
        "list": ("list what there is, one line each", "oodd_eval.cli.listing:list_names"),
        "info": ("describe a detector, environment, split, ...", "oodd_eval.cli.info:info"),
        "leaderboard": ("show the board, enter it, run a season", LEADERBOARD),
    },
    "Add your own": {
        "new": ("write a ready plug-in project", "oodd_checks.commands.new:new"),
        "check": ("check that a detector honours the contract", "oodd_checks.commands.check:check"),
        "policies": ("train and evaluate nominal policies", POLICIES),
        "completion": ("print a script for a shell's completion", "oodd_eval.cli.main:completion"),
    },
}


class _Program(Group):
    """The command line as a whole; its help begins with first steps and ends with exit codes."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        steps = [f"oodd-eval {step}" for step in FIRST_STEPS]
        write_section(formatter, "First steps", steps)
        super().format_options(ctx, formatter)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        del ctx
        write_section(formatter, "Exit codes", EXIT_CODES)


PROGRAM: Final = click.version_option(__version__, message="oodd-eval %(version)s")(
    _Program("Evaluate detectors of out-of-distribution dynamics on frozen trajectories.", COMMANDS)
)

INTERRUPTS: Final = (signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
"""Signals that end a command as Ctrl-C does: batch systems send them before they kill."""

COMPLETION: Final = "_OODD_EVAL_COMPLETE"  # the variable in which shells ask for completions


@command("completion bash", "completion fish")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(options: Options) -> int:
    """Print what makes a shell complete commands, options and names of oodd-eval.

    For bash, put `eval "$(oodd-eval completion bash)"` into ~/.bashrc; for zsh, the same with zsh
    into ~/.zshrc, after compinit; for fish, write the output to
    ~/.config/fish/completions/oodd-eval.fish.
    """
    return shell_complete(PROGRAM, {}, "oodd-eval", COMPLETION, f"{options.shell}_source")


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code; by default end this process with it."""
    # Pydantic would look for plug-ins of its own, and fail at broken metadata of any distribution.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    if arguments is not None:
        with plain_streams():
            return _exit_code(list(arguments))
    for number in INTERRUPTS:
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup has it ignored
            signal.signal(number, _interrupt)
    _leave_unreadable_directory()
    if open_streams():
        say("standard output is closed, so that nothing is printed there")
    with plain_streams():
        if question := os.environ.get(COMPLETION):
            with contextlib.suppress(OoddError):  # of a broken split, say: then there are no names
                shell_complete(PROGRAM, {}, "oodd-eval", COMPLETION, question)
            return 0
        code = _exit_code(sys.argv[1:])
    # Threads and exit handlers of plug-ins, which might never end, have no say.
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(code)


def _interrupt(number: int, frame: object) -> NoReturn:
    """Interrupt the command; the kernel repeats XCPU every second, which is to hold nothing up."""
    del frame
    if number not in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt(signal.Signals(number).name)


def _leave_unreadable_directory() -> None:
    """Import nothing from a working directory whose path cannot be found out."""
    try:
        Path.cwd()
    except OSError:
        sys.path[:] = [entry for entry in sys.path if entry]


def _refusal(error: Exception) -> str:
    """Return why a command is not carried out; empty for an error of this program."""
    if isinstance(error, OoddError):
        return str(error)
    if isinstance(error, OSError):
        paths = (str(path) for path in (error.filename, error.filename2) if path is not None)
        reason = error.strerror or str(error) or type(error).__name__
        advice = ": raise the limit (ulimit -n)" if error.errno == errno.EMFILE else ""
        return f"{' and '.join(map(repr, paths)) or 'a call of the system'}: {reason}{advice}"
    if isinstance(error, MemoryError) or "start new thread" in str(error):
        return "memory or threads do not suffice: raise ulimit -v and -u, or use fewer --jobs"
    return ""


def _exit_code(arguments: list[str]) -> int:
    """Carry out a command line, and print why it failed."""
    invocation = shlex.join(["oodd-eval", *arguments])
    try:
        # Group.main is not called, as it has exit codes of its own.
        with PROGRAM.make_context("oodd-eval", arguments, obj=invocation) as context:
            code: int = PROGRAM.invoke(context)
        sys.stdout.flush()
    except click.exceptions.Exit as ended:  # --help and --version
        return ended.exit_code
    except SystemExit as error:
        return say(f"something called sys.exit({error.code!r}), so that not all was done", 3)
    except KeyboardInterrupt as interrupt:
        return say(" by ".join(("interrupted", *map(str, interrupt.args))), 2)
    except BrokenPipeError:
        # Nothing more can be written to the closed pipe, not even when Python exits.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 2
    except click.UsageError as error:
        advice = f" (see {error.ctx.command_path} --help)" if error.ctx else ""
        return say(f"{error.format_message().removesuffix('.')}{advice}", 4)
    except Exception as error:  # noqa: BLE001  the outermost: everything unforeseen ends here
        reason = _refusal(error)
        if "-v" in arguments or not reason:
            traceback.print_exc()
        internal = "internal error, please report it with the lines above"
        return say(reason or internal, 4 if reason else 3)
    return code

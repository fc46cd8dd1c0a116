"""The entry point: read the command line, carry it out, and return its exit code."""

import argparse
import contextlib
import os
import shlex
import signal
import sys
import traceback
from collections.abc import Container, Sequence
from importlib import import_module
from typing import Final

from oodd_eval._version import __version__
from oodd_eval.cli import Parser, say
from oodd_eval.errors import OoddError

EXIT_CODES: Final = """exit codes:
  0  ok
  1  a cell, check or comparison failed, or a plug-in is broken
  2  interrupted (Ctrl-C, TERM, HUP), or output pipe closed
  3  internal error
  4  the request cannot be carried out: unknown name, missing data, no place to write
  5  nothing was selected or compared"""

COMMANDS: Final = (
    ("run", "run", "fit and score every selected cell"),
    ("list", "listing", "list what there is, one line each"),
    ("show", "show", "print the tables of earlier results from stored scores"),
    ("check", "check", "check that a detector honours the contract"),
    ("compare", "compare", "compare rows of some results, or results with a reference"),
    ("info", "info", "describe a detector, an environment or an anomaly"),
    ("forget", "forget", "remove cells from a results directory"),
    ("leaderboard", "leaderboard", "submit, verify and show entries of the board"),
    ("data", "data", "build, import, verify, fetch and export splits"),
    ("policies", "policies", "train and evaluate nominal policies"),
    (
        "reproduce",
        "reproduce",
        "regenerate the paper's tables, figures and claims; resumes where it was",
    ),
    ("new", "new", "write a ready plug-in project"),
)


def build_parser(named: Container[str] | None = None) -> Parser:
    """Return the parser of the command line: with the options of all commands, or of some."""
    parser = Parser(
        prog="oodd-eval",
        description="Evaluate detectors of out-of-distribution dynamics on frozen trajectories.",
        epilog=EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"oodd-eval {__version__}")
    add_command = parser.nested("command")
    for name, module, summary in COMMANDS:
        command = add_command(name, summary)
        if named is None or name in named:
            import_module(f"oodd_eval.cli.{module}").define(command)
    return parser


def _parse(given: Sequence[str]) -> argparse.Namespace:
    parser = build_parser(given[:1])
    parsed = parser.parse_args(given)
    if getattr(parsed, "config", None):
        # The command line comes last, so that it wins.
        parsed = parser.parse_args([given[0], *parsed.options_of(parsed.config), *given[1:]])
    parsed.invocation = shlex.join(["oodd-eval", *given])
    return parsed


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code; by default end this process with it."""
    if arguments is not None:
        return _carried_out(list(arguments))
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup has it ignored
            signal.signal(number, signal.default_int_handler)
    code = _carried_out(sys.argv[1:])
    # Threads and exit handlers of plug-ins, which might never end, have no say.
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(code)


def _carried_out(given: list[str]) -> int:
    options = None
    try:
        if not given:
            build_parser(given).print_help()
            return 0
        options = _parse(given)
        code: int = options.handler(options)
        sys.stdout.flush()
    except SystemExit as error:
        if options is None:  # argparse's --help and --version
            return error.code if isinstance(error.code, int) else 0
        return say(f"something called sys.exit({error.code!r}), so that not all was done", 3)
    except KeyboardInterrupt:
        return say("interrupted", 2)
    except BrokenPipeError:
        # Nothing more can be written to the closed pipe, not even when Python exits.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 2
    except OoddError as error:
        if "-v" in given:
            traceback.print_exc()
        return say(str(error), 4)
    except Exception:  # noqa: BLE001  the outermost: everything unforeseen ends here
        traceback.print_exc()
        return say("internal error, please report it with the lines above", 3)
    return code

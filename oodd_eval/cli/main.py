"""The command line: what can be asked, and which exit code is the answer.

Handlers live in `oodd_eval.cli` and are imported when called, so that help is quick.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from types import ModuleType
from typing import Final

from oodd_eval._version import __version__
from oodd_eval.cli.options import (
    Parser,
    check,
    choices,
    compare,
    data,
    leaderboard,
    new,
    policies,
    reproduce,
    running,
)
from oodd_eval.errors import OoddError, UnknownNameError

EXIT_CODES: Final = """exit codes:
  0  ok
  1  a cell, check or comparison failed, or a plug-in is broken
  2  interrupted, or nobody reads the output any more
  3  internal error
  4  the request cannot be carried out: unknown name, missing data, no place to write
  5  nothing was selected or compared"""

FAMILIES: Final = (running, check, compare, leaderboard, data, policies, reproduce, new)
"""Modules of options, in the order of the help."""


def build_parser() -> Parser:
    """Return the parser of the whole command line."""
    parser = Parser(
        prog="oodd-eval",
        description="Evaluate detectors of out-of-distribution dynamics on frozen trajectories.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"oodd-eval {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for family in FAMILIES:
        family.add(commands)
    return parser


def _check_command(parser: Parser, arguments: Sequence[str]) -> None:
    """Name the nearest command for an unknown one, which argparse does not."""
    what = "command"
    for argument in arguments:
        known = choices(parser)
        if not known or argument.startswith("-"):
            return
        if argument not in known:
            raise UnknownNameError(what, argument, known)
        what, parser = f"action of {argument}", known[argument]


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code.

    Parameters
    ----------
    arguments
        Without the program's name; None means those of this process.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        parser = build_parser()
        _check_command(parser, given)
        parsed = parser.parse_args(given)
        if getattr(parsed, "config", None):
            options = _module("config").options_of(parsed.config)
            parsed = build_parser().parse_args(["run", *options, *given[1:]])
        module, _, function = parsed.handler.partition(":")
        handler: Callable[[argparse.Namespace], int] = getattr(_module(module), function)
        code = handler(parsed)
        sys.stdout.flush()
    except SystemExit as error:  # argparse's --help and --version
        return error.code if isinstance(error.code, int) else 0
    except KeyboardInterrupt:
        return _say("interrupted", 2)
    except BrokenPipeError:
        # Whoever read the output has seen enough; nothing more can be written, not even at exit.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 2
    except OoddError as error:
        if "-v" in given:
            traceback.print_exc()
        return _say(str(error), 4)
    except Exception:  # noqa: BLE001  the outermost: everything unforeseen ends here
        traceback.print_exc()
        return _say("internal error, please report it with the lines above", 3)
    return code


def _module(name: str) -> ModuleType:
    room = "leaderboard.build" if name == "leaderboard_build" else f"cli.{name}"
    return import_module(f"oodd_eval.{room}")


def _say(message: str, code: int) -> int:
    print(f"oodd-eval: {message}", file=sys.stderr)  # noqa: T201  the program's voice
    return code

"""The command line: a module per command, and here the parser and the options that they share."""

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final, NoReturn, TypeVar

from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.names import memory_bytes, parameter, seconds, whole_numbers

NAMES: Final = "names separated by commas, globs, or 'all'"
EXPRESSION: Final = "only cells whose id matches, such as 'hopper and not (iid or drift)'"

Add = Callable[..., argparse.Action]
T = TypeVar("T")


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are exceptions, with a suggestion."""

    def __init__(self, **settings: Any) -> None:
        plain = {"formatter_class": argparse.RawDescriptionHelpFormatter, **settings}
        super().__init__(allow_abbrev=False, **plain)
        self.choices: dict[str, Parser] = {}
        self.examples: tuple[str, ...] = ()

    def nested(self, kind: str) -> Callable[[str, str], "Parser"]:
        """Return a function that adds a command or an action: its name and summary."""
        nested = self.add_subparsers(dest=kind, metavar=kind.upper(), required=True)
        self.choices = nested.choices
        return lambda name, summary: nested.add_parser(name, help=summary, description=summary)

    def format_help(self) -> str:
        """Return the help, with examples below it: a command's own, or those of its actions."""
        examples = self.examples or [e for p in self.choices.values() for e in p.examples[:1]]
        if examples and not self.epilog:
            lines = "".join(f"\n  oodd-eval {line}" for line in examples)
            self.epilog = f"examples:{lines}"
        return super().format_help()

    def options(
        self, handler: Callable[[argparse.Namespace], int], *examples: str, plugins: bool = False
    ) -> Add:
        """Add the options that all commands have; return the method that adds further ones.

        `examples` are arguments of oodd-eval that the help shows.
        """
        self.examples = examples

        def left_out(text: str) -> str:
            if not text.startswith("no:"):
                raise UsageError(f"{text!r}, expected no:NAME, which leaves a plug-in out")
            return text.removeprefix("no:")

        self.set_defaults(handler=handler)
        add = partial(self.add_mutually_exclusive_group().add_argument, dest="verbosity", default=0)
        add("-q", action="store_const", const=-1, help="print less")
        add("-v", action="store_const", const=1, help="print more, and tracebacks of errors")
        if plugins:
            self.add_argument(
                "-p",
                dest="disabled",
                action="append",
                default=[],
                metavar="no:NAME",
                type=value(left_out),
                help="leave a plug-in out (see also OODD_EVAL_PLUGINS)",
            )
        return self.add_argument

    def error(self, message: str) -> NoReturn:
        """Raise `UsageError` instead of ending the process."""
        if wrong := re.match(r"argument (-\S+): is (.*)", message, re.DOTALL):
            raise UsageError(f"{wrong[1]} is {wrong[2]}")
        if wrong := re.match(r"argument (COMMAND|ACTION): invalid choice: '(.*?)'", message):
            kind = "command" if wrong[1] == "COMMAND" else f"action of {self.prog.split()[-1]}"
            raise UnknownNameError(kind, wrong[2], self.choices)
        if unknown := re.match(r"unrecognized arguments: (\S+)", message):
            option = unknown[1].partition("=")[0]
            close = difflib.get_close_matches(option, self._option_string_actions, n=1)
            message += f": did you mean {close[0]}?" if close else ""
        raise UsageError(f"{message} (see {self.prog} --help)")

    def parse_known_args(  # type: ignore[override]  # the overloads of argparse say the same
        self, *given: Any
    ) -> tuple[argparse.Namespace, list[str]]:
        """Refuse unknown options where they stand, so that the suggestion is the command's."""
        parsed, rest = super().parse_known_args(*given)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return parsed, rest


def value(convert: Callable[[str], T]) -> Callable[[str], T]:
    """Return a converter for argparse that reports the message of a `UsageError`."""

    def converted(text: str) -> T:
        try:
            return convert(text)
        except UsageError as error:
            raise argparse.ArgumentTypeError(f"is {error}") from None

    return converted


def at_least(least: int) -> Callable[[str], int]:
    """Return a converter for whole numbers that are not below a bound."""

    def convert(text: str) -> int:
        if not re.fullmatch(r"-?\d+", text) or int(text) < least:
            raise UsageError(f"{text!r}, expected a whole number of at least {least}")
        return int(text)

    return value(convert)


def add_detector(add: Add) -> None:
    """Add the options that say how detectors are made."""
    add(
        "--param",
        action="append",
        default=[],
        metavar="K=V",
        type=value(parameter),
        help="a parameter of the detector, V in JSON or plain text",
    )
    add(
        "--horizon",
        default="1",
        metavar="N,...",
        type=value(partial(whole_numbers, least=1)),
        help="prediction horizons (default: 1)",
    )


def add_limits(add: Add, what: str, timeout: str) -> None:
    """Add the options that limit a process."""
    add(
        "--timeout",
        default=timeout,
        type=value(seconds),
        metavar="TIME",
        help=f"wall-clock time of {what} (default: {timeout})",
    )
    add(
        "--memory",
        default="8GB",
        type=value(memory_bytes),
        help=f"resident memory of {what} (default: 8GB)",
    )


def add_resources(add: Add, *, timeout: str) -> None:
    """Add the options that say where fits are carried out and within which limits."""
    add("--jobs", type=at_least(1), metavar="N", help="fits at a time (default: one per core)")
    add(
        "--device",
        choices=("auto", "cpu", "cuda"),
        metavar="auto|cpu|cuda",
        help="where networks compute: the parameter device of detectors that have it",
    )
    add_limits(add, "a fit with its scores", timeout)


def say_notes(notes: Iterable[str]) -> None:
    """Say each of some notes once."""
    for note in dict.fromkeys(notes):
        say(note)


def say(message: str, code: int = 0) -> int:
    """Print a message of the program itself on standard error and return an exit code."""
    print(f"oodd-eval: {message}", file=sys.stderr)
    return code

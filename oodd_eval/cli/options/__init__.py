"""What can be asked on the command line: one module per family of commands, each with `add`.

Handlers live in `oodd_eval.cli` and are imported when called, so that help is quick.
"""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Sequence
from typing import NoReturn

from oodd_eval.errors import UsageError

NAMES = "names separated by commas, globs, or 'all'"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are exceptions, with a suggestion."""

    def error(self, message: str) -> NoReturn:
        """Raise `UsageError` instead of ending the process."""
        unknown = re.match(r"unrecognized arguments: (\S+)", message)
        if unknown:
            option = unknown[1].partition("=")[0]
            close = difflib.get_close_matches(option, self._option_string_actions, n=1)
            message += f": did you mean {close[0]}?" if close else ""
        raise UsageError(f"{message} (see {self.prog} --help)")

    def parse_known_args(  # type: ignore[override]  # the overloads of argparse say the same
        self,
        args: Sequence[str] | None = None,
        namespace: argparse.Namespace | None = None,
    ) -> tuple[argparse.Namespace, list[str]]:
        """Refuse unknown options where they stand, so that the suggestion is the command's."""
        parsed, rest = super().parse_known_args(args, namespace)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return parsed, rest


Commands = argparse._SubParsersAction  # noqa: SLF001  argparse has no public name for it


def command(
    commands: Commands[Parser], name: str, handler: str, summary: str, *, plugins: bool = False
) -> Parser:
    """Add a command that is carried out by ``module:function`` of `oodd_eval.cli`."""
    parser = commands.add_parser(name, help=summary, description=summary, allow_abbrev=False)
    parser.set_defaults(handler=handler)
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("-q", dest="verbosity", action="store_const", const=-1, default=0,
                        help="print less")  # fmt: skip
    amount.add_argument("-v", dest="verbosity", action="store_const", const=1,
                        help="print more, and tracebacks of errors")  # fmt: skip
    if plugins:
        parser.add_argument("-p", dest="plugins", action="append", default=[], metavar="no:NAME",
                            help="leave a plug-in out (see also OODD_EVAL_PLUGINS)")  # fmt: skip
    return parser


def choices(parser: argparse.ArgumentParser) -> dict[str, Parser]:
    """Return the parsers of a parser's commands or actions by name; none if it has none."""
    for action in parser._actions:  # noqa: SLF001  argparse has no public way to ask
        if isinstance(action, Commands):
            return dict(action.choices)
    return {}

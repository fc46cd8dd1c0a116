"""The command line: what can be asked, and which exit code is the answer.

Handlers live in `oodd_eval.commands` and are imported when called, so that help is quick.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from types import ModuleType
from typing import Final, NoReturn

from oodd_eval._version import __version__
from oodd_eval.errors import OoddError, UnknownNameError, UsageError

EXIT_CODES: Final = """exit codes:
  0  ok
  1  a cell or check failed, or a plug-in is broken
  2  interrupted, or nobody reads the output any more
  3  internal error
  4  the request cannot be carried out: unknown name, missing data, no place to write
  5  nothing was selected"""

DEFAULT_OUTPUT: Final = "oodd-results"


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


def build_parser() -> argparse.ArgumentParser:
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
    _add_run(commands)
    _add_list(commands)
    _add_show(commands)
    _add_data(commands)
    _add_policies(commands)
    return parser


_Commands = argparse._SubParsersAction  # noqa: SLF001  argparse has no public name for it


def _command(
    commands: _Commands[Parser], name: str, handler: str, summary: str, *, plugins: bool = False
) -> Parser:
    """Add a command that is carried out by ``module:function`` of `oodd_eval.commands`."""
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


def _add_run(commands: _Commands[Parser]) -> None:
    run = _command(commands, "run", "run:run", "fit and score every selected cell", plugins=True)
    add = run.add_argument
    names = "names separated by commas, globs, or 'all'"
    add("--detector", metavar="NAMES", help=f"{names} (required)")
    add("--env", metavar="NAMES", help=f"{names} (required)")
    add("--anomaly", default="all", metavar="NAMES", help=f"{names} (default: all)")
    add("--split", default="mini", help="name or path of a split (default: mini)")
    add("--horizon", default="1", metavar="N,...", help="prediction horizons (default: 1)")
    add("--seed", default="0", metavar="N,...", help="seeds of the detectors (default: 0)")
    add("--param", action="append", default=[], metavar="K=V",
        help="a parameter of the selected detectors, V in JSON or plain text")  # fmt: skip
    add("-k", dest="expression", metavar="EXPR",
        help="only cells whose id matches, such as 'hopper and not (iid or drift)'")  # fmt: skip
    add("--collect-only", action="store_true", help="print the selected cells and do nothing")
    add("-x", dest="stop", action="store_true", help="stop at the first failure")
    add("--limit", type=int, metavar="N", help="use the first N trajectories of each part")
    add("--jobs", type=int, metavar="N", help="fits at a time (default: one per core)")
    add("--timeout", default="30m", help="wall-clock time of a fit with its scores (default: 30m)")
    add("--memory", default="8GB", help="resident memory of a fit (default: 8GB)")
    add("--fresh", action="store_true", help="fit again what the results directory has already")
    add("--intervals", action="store_true", help="print 95 %% intervals in the tables")
    add("--config", metavar="FILE", help="TOML file with these options by their long names")
    add("--output", default=DEFAULT_OUTPUT, metavar="DIR",
        help=f"results directory (default: {DEFAULT_OUTPUT})")  # fmt: skip


def _add_list(commands: _Commands[Parser]) -> None:
    what = _command(commands, "list", "listing:run", "list what there is, one line each",
                    plugins=True)  # fmt: skip
    what.add_argument("what", metavar="detectors|envs|anomalies|splits|metrics")


def _add_show(commands: _Commands[Parser]) -> None:
    show = _command(
        commands, "show", "show:run", "print the tables of earlier results from stored scores"
    )
    add = show.add_argument
    add("directory", metavar="DIR", help="results directory")
    add("--split", metavar="NAME", help="where the split is, if not at its usual place")
    add("--stored", action="store_true", help="print stored metrics without recomputing them")
    add("--intervals", action="store_true", help="print 95 %% intervals")
    add("--detector", metavar="NAME", help="print the table by anomaly of one detector")
    add("--metric", default="auc_matched", help="metric of that table (default: auc_matched)")
    add("--markdown", action="store_true", help="print Markdown, everything in it")


def _add_data(commands: _Commands[Parser]) -> None:
    data = commands.add_parser("data", help="build, verify and describe splits")
    actions = data.add_subparsers(dest="action", metavar="ACTION", required=True)
    build = _command(actions, "build", "data:build", "record a split (needs the extra sim)")
    add = build.add_argument
    add("name", help="a published split, or a new name with sizes and a seed base of its own")
    add("--train", type=int, metavar="N", help="training trajectories per environment")
    add("--calibration", type=int, metavar="N", help="calibration trajectories per environment")
    add("--test", type=int, metavar="N", help="test seeds per environment")
    add("--cap", type=int, metavar="T", help="longest episode (default: the simulator's)")
    add("--seed-base", type=int, metavar="K", help="base of the seeds, apart from published ones")
    add("--env", default="all", metavar="NAMES", help="environments (default: all)")
    add("--jobs", type=int, metavar="N", help="worker processes (default: one per core)")
    add("--output", metavar="DIR", help="directory of the split (default: where splits are found)")
    verify = _command(actions, "verify", "data:verify", "compare a split with its digests")
    verify.add_argument("name", help="name or path of a split")
    info = _command(actions, "info", "data:info", "describe a split")
    info.add_argument("name", help="name or path of a split")


def _add_policies(commands: _Commands[Parser]) -> None:
    policies = commands.add_parser("policies", help="train and evaluate nominal policies")
    actions = policies.add_subparsers(dest="action", metavar="ACTION", required=True)
    train = _command(actions, "train", "policies:train", "train a policy (needs the extra train)")
    add = train.add_argument
    add("environment", metavar="ENV")
    add("--output", default="policies", metavar="DIR", help="checkpoint and best policy")
    add("--steps", type=int, metavar="N", help="environment steps in all")
    add("--seed", type=int, default=1, metavar="N")
    evaluate = _command(actions, "evaluate", "policies:evaluate", "mean return of a policy")
    add = evaluate.add_argument
    add("environment", metavar="ENV")
    add("--policy", metavar="FILE", help="policy file (default: the frozen one)")
    add("--episodes", type=int, default=100, metavar="N", help="fresh episodes (default: 100)")


_ACTIONS: Final = {
    "run": (), "list": (), "show": (),
    "data": ("build", "verify", "info"), "policies": ("train", "evaluate"),
}  # fmt: skip


def _check_command(arguments: Sequence[str]) -> None:
    """Name the nearest command for an unknown one, which argparse does not."""
    if not arguments or arguments[0].startswith("-"):
        return
    if arguments[0] not in _ACTIONS:
        raise UnknownNameError("command", arguments[0], _ACTIONS)
    actions = _ACTIONS[arguments[0]]
    action = arguments[1] if arguments[1:] else "-"
    if actions and not action.startswith("-") and action not in actions:
        raise UnknownNameError(f"action of {arguments[0]}", action, actions)


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code.

    Parameters
    ----------
    arguments
        Without the program's name; None means those of this process.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _check_command(given)
        parsed = build_parser().parse_args(given)
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
    return import_module(f"oodd_eval.commands.{name}")


def _say(message: str, code: int) -> int:
    print(f"oodd-eval: {message}", file=sys.stderr)  # noqa: T201  the program's voice
    return code

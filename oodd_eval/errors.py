"""The errors that oodd-eval raises on purpose, in one tree; each is also a built-in exception.

A message says what went wrong, in which object, what was expected, what was found and what to do.
"""

import difflib
from collections.abc import Iterable


class OoddError(Exception):
    """Base of all errors raised on purpose by oodd-eval."""


class UsageError(OoddError, ValueError):
    """The request itself is wrong: an unknown name, a bad value, nothing selected."""


def near(name: object, known: Iterable[str]) -> list[str]:
    """Return the known names that a wrong one may stand for.

    Parameters
    ----------
    name
        The wrong name.
    known
        The names that exist.

    Returns
    -------
    list of str
        At most five, the most alike first.

    Examples
    --------
    >>> near("hoper", ["ant", "hopper"]), near("nonsense", ["components"])
    (['hopper'], [])
    """
    return difflib.get_close_matches(str(name), dict.fromkeys(known), n=5, cutoff=0.57)


_LISTED = 60  # known names in a message: logs may have thousands of columns
_FEW = 20  # of which a message has all, beside a name that may be meant


class UnknownNameError(UsageError, LookupError):
    """A name that is not among the known ones.

    Parameters
    ----------
    kind
        Kind of the named thing, in the singular: ``"detector"``, ``"environment"``.
    name
        The unknown name.
    known
        The names that exist.

    Examples
    --------
    >>> print(UnknownNameError("environment", "hoper", ["ant", "hopper"]))
    unknown environment 'hoper': did you mean 'hopper'? Known: ant, hopper
    """

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        names = sorted({*known})
        further = len(names) - _LISTED
        more = f" and {further} more" if further > 0 else ""
        hints = [f"did you mean {close!r}?" for close in near(name, names)[:1]]
        if not hints or len(names) <= _FEW:
            hints.append(f"Known: {', '.join(names[:_LISTED]) or 'none'}{more}")
        super().__init__(f"unknown {kind} {name!r}: {' '.join(hints)}")
        self.kind, self.name, self.known = kind, name, names


class TrajectoryError(OoddError, ValueError):
    """Arrays that do not form a trajectory."""


class SplitError(OoddError, ValueError):
    """A split that is damaged, or does not have the layout of a split."""


class SplitNotFoundError(SplitError, FileNotFoundError):
    """A split, or one of its environments, that is not on this machine."""


class DigestError(SplitError):
    """The digest of a split's content differs from its manifest."""


class ContractError(OoddError, ValueError):
    """A detector that broke the contract of `oodd_eval.plugins.contract`."""


class NotFittedError(OoddError, RuntimeError):
    """`score` was called before `fit`."""


class FittedStateError(OoddError, ValueError):
    """Files that do not hold a fitted detector, or hold another one."""


class PluginError(OoddError, ImportError):
    """A plug-in that cannot be loaded, or two that offer the same name."""


class PromiseWarning(UserWarning):
    """Something puts a promise on false alarms in doubt."""


class PrecisionWarning(UserWarning):
    """Readings lose what they tell when they are rounded to float32."""


class MissingExtraError(OoddError, ModuleNotFoundError):
    """An optional dependency that the requested work needs."""


class PolicyError(OoddError, ValueError):
    """A policy file that cannot be used."""


class SimulationError(OoddError, RuntimeError):
    """A trajectory that cannot be recorded as the protocol asks."""


class ResultsError(OoddError, ValueError):
    """A results directory or record that cannot be read."""


class ExecutorError(OoddError, RuntimeError):
    """An executor that cannot be reached or used."""


class OutputError(OoddError, OSError):
    """A file or directory that cannot be written."""

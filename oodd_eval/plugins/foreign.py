"""Objects of other libraries that are handed over as detectors: which name makes a detector."""

import inspect

from oodd_eval.errors import OoddError, UsageError
from oodd_eval.plugins.discovery import discover

_MODEL = ("fit", "predict", "forward", "learn_one")  # methods of a model, not of a function


def refuse_foreign(detector: object) -> None:
    """Raise `UsageError` for another library's object or class, with the name to hand over."""
    model = detector if isinstance(detector, type) else type(detector)
    library, *modules = model.__module__.split(".")
    name, advice = model.__name__, "hand over a class with these two methods around it"
    named = library in ("sklearn", "pyod", "river")
    if not named and (_takes_episodes(model) or not any(hasattr(model, m) for m in _MODEL)):
        return
    names = [f"{library}:{name}"] if named else []
    if library not in ("pyod", "river") and hasattr(model, "predict"):
        names.append(".".join([f"forecast:{library}", *(m for m in modules if m[0] != "_"), name]))
    if offered := next(filter(_is_offered, names), ""):
        advice = f"hand over the name {offered!r}, with its parameters beside it"
    raise UsageError(
        f"{model.__module__}.{name} does not have fit(nominal) and score(trajectory) of episodes: "
        f"{advice} (docs/adapters.md)"
    )


def _takes_episodes(model: type) -> bool:
    """Tell whether a class has `score`, and a `fit` that needs no more than one argument."""
    try:
        inspect.signature(model.fit).bind(None, None)  # type: ignore[attr-defined]
    except (TypeError, AttributeError):
        return False
    except ValueError:  # of some compiled functions
        pass
    return callable(getattr(model, "score", None))


def _is_offered(name: str) -> bool:
    """Tell whether the adapters make a detector of a name."""
    try:
        return bool(discover(only=["adapters"]).offer(name))
    except OoddError:
        return False

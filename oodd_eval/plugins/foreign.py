"""Objects of other libraries that are handed over as detectors: which name makes a detector."""

import contextlib

from oodd_eval.errors import OoddError, UsageError
from oodd_eval.plugins.discovery import discover

_MODEL = ("fit", "predict", "forward", "learn_one")  # methods of a model, not of a function


def refuse_foreign(detector: object) -> None:
    """Raise `UsageError` for another library's object or class, with the name to hand over."""
    model = detector if isinstance(detector, type) else type(detector)
    library, *modules = model.__module__.split(".")
    # Those of scikit-learn may have fit and score, of other things.
    named = library in ("sklearn", "pyod", "river")
    if not named and (hasattr(model, "score") or not any(hasattr(model, m) for m in _MODEL)):
        return
    name, advice = model.__name__, "hand over a class with these two methods around it"
    names = [f"{library}:{name}"] if named else []
    if library not in ("pyod", "river") and hasattr(model, "predict"):
        names.append(".".join([f"forecast:{library}", *(m for m in modules if m[0] != "_"), name]))
    for text in reversed(names):
        with contextlib.suppress(OoddError):
            discover(only=["adapters"]).offer(text)
            advice = f"hand over the name {text!r}, with its parameters beside it"
    raise UsageError(
        f"{model.__module__}.{name} does not have fit(nominal) and score(trajectory) of episodes: "
        f"{advice} (docs/adapters.md)"
    )

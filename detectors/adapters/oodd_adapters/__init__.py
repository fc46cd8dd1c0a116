"""Detectors made of other libraries' classes: the plug-in `adapters`.

``pyod:IForest``, ``sklearn:IsolationForest`` and ``river:HalfSpaceTrees`` are outlier detectors on
windows of observations, ``forecast:sklearn.linear_model.Ridge`` a forecaster whose prediction error
is the score.
"""

from oodd_eval import DetectorSpec, hookimpl


@hookimpl
def oodd_detector_from_spec(spec: str) -> DetectorSpec | None:
    """pyod:CLASS, sklearn:CLASS, river:CLASS, forecast:MODULE.CLASS: other libraries' classes.

    Raises
    ------
    UsageError
        When the name leads to no class, or to one that cannot be used.
    """
    kind, _, name = spec.partition(":")
    if kind not in ("pyod", "sklearn", "river", "forecast"):
        return None
    from oodd_adapters import specs  # noqa: PLC0415  keeps the listing quick

    makers = {
        "pyod": specs.pyod,
        "sklearn": specs.sklearn,
        "river": specs.river,
        "forecast": specs.forecast,
    }
    return makers[kind](name)

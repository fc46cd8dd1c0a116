"""Parameters of the rivals, a class for each detector."""

from dataclasses import dataclass

from oodd_eval.plugins.parameters import parameter


@dataclass(frozen=True, slots=True)
class PcaParameters:
    """Parameters of `pca`."""

    window: int = parameter(20, low=1, help="latest observations that a judgement looks at, W")
    rows: str = parameter(
        "stacked",
        choices=("stacked", "averaged"),
        help="what becomes of the observations of a window: all of them in a row, or their mean",
    )
    share: float = parameter(
        0.99, above=0, high=1, help="share of the variance that the kept components explain"
    )
    quantile: float = parameter(
        0.99, above=0, high=1, help="quantile of nominal values in whose units T2 and Q are added"
    )


@dataclass(frozen=True, slots=True)
class KnnParameters:
    """Parameters of `knn`."""

    window: int = parameter(10, low=1, help="latest observations that a judgement looks at, W")
    neighbours: int = parameter(2, low=1, help="nearest nominal windows, k")
    most: int = parameter(2000, low=1, help="nominal windows that are kept at most")


@dataclass(frozen=True, slots=True)
class DeedeeParameters:
    """Parameters of `deedee`."""

    weight: float = parameter(
        0.1, low=0, high=1, help="weight of the newest row in running means; 0: all rows alike"
    )
    bandwidth: float = parameter(
        0.001, above=0, help="of the kernel, in median squared distances of training rows"
    )
    summary: int = parameter(2000, low=1, help="training rows that stand for training")


@dataclass(frozen=True, slots=True)
class RndParameters:
    """Parameters of `rnd`."""

    window: int = parameter(2, low=1, help="latest observations that the networks see, W")
    limit: float = parameter(10.0, above=0, help="standardized sensors are clipped at this")
    width: int = parameter(128, low=1, help="units of each hidden layer")
    outputs: int = parameter(16, low=1, help="outputs of both networks")
    updates: int = parameter(3000, low=1, help="gradient steps")
    batch: int = parameter(256, low=1, help="rows of an update")
    rate: float = parameter(3e-3, above=0, help="learning rate at the start")


@dataclass(frozen=True, slots=True)
class PaanoParameters:
    """Parameters of `paano`."""

    window: int = parameter(8, low=2, help="observations of a patch, W")
    normalize: str = parameter(
        "training",
        choices=("training", "patch"),
        help="whose mean and spread are taken away: training's alone, or each patch's as well",
    )
    width: int = parameter(64, low=1, help="units of each layer, and numbers of an embedding")
    updates: int = parameter(200, low=1, help="gradient steps")
    batch: int = parameter(256, low=2, help="patches of an update")
    rate: float = parameter(1e-3, above=0, help="learning rate at the start")
    share: float = parameter(0.3, above=0, high=1, help="share of nominal patches in the bank")
    least: int = parameter(500, low=1, help="patches in the bank at least, where there are as many")
    neighbours: int = parameter(1, low=1, help="nearest patches, k")
    lengths: str = parameter(
        "kept",
        choices=("kept", "one"),
        help="whether embeddings are compared as they are, or by their directions alone",
    )


@dataclass(frozen=True, slots=True)
class ArcadeParameters:
    """Parameters of `arcade-a`."""

    lags: int = parameter(12, low=6, help="latest rows and commands of the forecast")
    rank: int = parameter(4, low=0, help="directions in which a sensor's head differs by episode")

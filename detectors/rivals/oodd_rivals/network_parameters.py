"""Parameters of the rivals that train networks, a class for each; torch is not imported."""

from dataclasses import dataclass

from oodd_eval.plugins.parameters import parameter


@dataclass(frozen=True, slots=True)
class RaptParameters:
    """Parameters of `rpt-a`."""

    updates: int = parameter(1000, low=1, help="gradient steps")
    batch: int = parameter(32, low=1, help="pieces of episodes in a batch")
    chunk: int = parameter(20, low=1, help="steps of a piece, through which gradients flow")
    units: int = parameter(128, low=1, help="units of every layer")
    statistic: str = parameter(
        "mean", choices=("mean", "largest"), help="what is made of the sensors' deviations"
    )


@dataclass(frozen=True, slots=True)
class LstmParameters:
    """Parameters of `lstm`."""

    updates: int = parameter(2000, low=1, help="gradient steps")
    batch: int = parameter(32, low=1, help="pieces of episodes in a batch")
    chunk: int = parameter(20, low=1, help="steps of a piece, through which gradients flow")
    units: int = parameter(64, low=1, help="units of each of the two layers")
    steps: int = parameter(3, low=1, help="rows that are forecast at once, l")


@dataclass(frozen=True, slots=True)
class MixtureParameters:
    """Parameters of `dagmm`."""

    updates: int = parameter(2000, low=1, help="gradient steps")
    batch: int = parameter(1024, low=2, help="windows of an update")
    window: int = parameter(5, low=1, help="latest observations that a judgement looks at, W")
    code: int = parameter(4, low=1, help="numbers that the encoder makes of a window")
    components: int = parameter(4, low=1, help="normal laws in the mixture")


@dataclass(frozen=True)
class FlowParameters:
    """Parameters of `logpzo`."""

    updates: int = parameter(6000, low=1, help="gradient steps")
    batch: int = parameter(512, low=1, help="rows of an update")
    units: int = parameter(128, low=1, help="units of each of the three hidden layers")
    steps: int = parameter(1, low=1, help="Euler steps from a row to its latent")


@dataclass(frozen=True)
class TransitionFlowParameters(FlowParameters):
    """Parameters of `logpzo-a`."""

    steps: int = parameter(8, low=1, help="Euler steps from a transition to its latent")
    conditional: bool = parameter(
        True,
        help="whether the flow carries the newest observation alone, by a velocity that knows the "
        "observation and action before it, instead of whole transitions",
    )


@dataclass(frozen=True, slots=True)
class WorldModelParameters:
    """Parameters of `wm-kl-a`."""

    updates: int = parameter(2000, low=1, help="gradient steps")
    batch: int = parameter(32, low=1, help="pieces of episodes in a batch")
    chunk: int = parameter(16, low=1, help="steps of a piece, through which gradients flow")
    units: int = parameter(128, low=1, help="units of the memory and of every hidden layer")
    noise: float = parameter(
        0.1,
        above=0,
        help="standard deviation with which latents are decoded, in errors of a linear forecast",
    )
    statistic: str = parameter(
        "surprise",
        choices=("surprise", "bound"),
        help="divergence from the prior, or how far it exceeds that from a memoryless posterior",
    )

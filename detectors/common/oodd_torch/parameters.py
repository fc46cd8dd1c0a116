"""Parameters that all detectors of trained networks share."""

from dataclasses import dataclass

from oodd_eval.plugins.parameters import parameter


@dataclass(frozen=True)
class NetworkParameters:
    """Parameters of every detector of this family; subclasses add their own."""

    members: int = parameter(5, low=1, help="networks in the ensemble, e")
    updates: int = parameter(2500, low=1, help="gradient steps of each member")
    batch: int = parameter(32, low=1, help="pieces of episodes in a batch")
    chunk: int = parameter(10, low=1, help="steps of a piece, through which gradients flow")
    scheduled_sampling: float = parameter(
        0.5,
        low=0,
        high=1,
        help="probability at the end of training that an input is the network's own sample; "
        "without effect at horizon 1",
    )
    trunk: str = parameter(
        "shared",
        choices=("shared", "per-feature"),
        help="one network with a head per sensor, or a network per sensor, D times as dear",
    )
    device: str = parameter(
        "cpu",
        choices=("auto", "cpu", "cuda"),
        decides="nothing",
        help="where torch computes; auto: cuda where there is one",
    )

"""Rivals: detectors of other fields and of recent papers, each written from its source.

They are here so that the board says whether what their authors report holds on these data.
"""

from functools import partial
from importlib import import_module
from typing import Any

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import checked
from oodd_rivals.network_parameters import (
    FlowParameters,
    LstmParameters,
    MixtureParameters,
    RaptParameters,
    TransitionFlowParameters,
    WorldModelParameters,
)
from oodd_rivals.parameters import (
    ArcadeParameters,
    DeedeeParameters,
    KnnParameters,
    PaanoParameters,
    PcaParameters,
    RndParameters,
)


def make_rival(
    name: str, detector: str, parameters: type, *, seed: int = 0, horizon: int = 1, **values: Any
) -> Detector:
    """Return an unfitted detector of this package.

    Parameters
    ----------
    name
        Name of the row, for messages.
    detector
        Module of this package and class in it: ``"pca:PcaDetector"``. It is imported now, so that
        listing detectors needs neither numpy nor torch.
    parameters
        The class's parameters, a dataclass.
    seed, horizon
        From the harness.
    values
        Parameters that are set.
    """
    module, _, class_name = detector.partition(":")
    make = getattr(import_module(f"{__name__}.{module}"), class_name)
    settings: object = checked(parameters, name, values)
    rival: Detector = make(name, settings, seed=seed, horizon=horizon)
    return rival


def _spec(*, name: str, detector: str, parameters: type, **fields: Any) -> DetectorSpec:
    factory = partial(make_rival, name, detector, parameters)
    return DetectorSpec(name=name, factory=factory, parameters=parameters, **fields)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer all rivals."""
    return [
        _spec(
            name="pca",
            detector="pca:PcaDetector",
            parameters=PcaParameters,
            summary="principal components of the latest rows: T2 and Q in one statistic",
            reference="MacGregor & Kourti (1995); Jackson & Mudholkar (1979)",
            deterministic=True,
            horizon_decides_fit=False,
        ),
        _spec(
            name="knn",
            detector="knn:KnnDetector",
            parameters=KnnParameters,
            summary="distance of the latest rows to the nearest nominal ones",
            reference="Ramaswamy, Rastogi & Shim (2000)",
            deterministic=True,
            horizon_decides_fit=False,
        ),
        _spec(
            name="deedee",
            detector="deedee:DeedeeDetector",
            parameters=DeedeeParameters,
            summary="mean of the rows so far and their similarity to training",
            reference="Aljaafari, Kanade, Torr & Schroeder de Witt (2025), DEEDEE",
            deterministic=True,
            horizon_decides_fit=False,
            alarm="score",
        ),
        _spec(
            name="rnd",
            detector="rnd:RndDetector",
            parameters=RndParameters,
            summary="error of a network that was taught a random one's outputs",
            reference="Burda et al. (2018), RND; Roemer et al. (2025), FIPER",
            horizon_decides_fit=False,
            requires=("torch",),
            extra="oodd-eval[reference]",
        ),
        _spec(
            name="paano",
            detector="paano:PaanoDetector",
            parameters=PaanoParameters,
            summary="distance of a patch of rows to nominal ones, as embedded by a network",
            reference="Park & Kang (2026), PaAno",
            horizon_decides_fit=False,
            requires=("torch", "sklearn"),
            extra="oodd-eval[reference]",
            seconds=20,
        ),
        _spec(
            name="arcade-a",
            detector="arcade:Arcade",
            parameters=ArcadeParameters,
            summary="linear forecast whose heads learn the episode, and evidence that they changed",
            reference="Yadav, Das, Song, Kaski & Pan (2025), ARCADE",
            inputs="observations+actions",
            deterministic=True,
            alarm="score",
        ),
        *_networks(),
    ]


def _networks() -> list[DetectorSpec]:
    """Return the rivals that train networks."""
    flow = "Xu et al. (2025), FAIL-Detect, logpZO"
    torch: dict[str, Any] = {"requires": ("torch",), "extra": "oodd-eval[reference]", "seconds": 30}
    return [
        _spec(
            name="rpt-a",
            detector="rapt:RecurrentForecast",
            parameters=RaptParameters,
            summary="recurrent Gaussian forecast, deviations calibrated sensor by sensor",
            reference="Munn et al. (2026), RAPT",
            inputs="observations+actions",
            **torch,
        ),
        _spec(
            name="logpzo",
            detector="flow:of_rows",
            parameters=FlowParameters,
            summary="norm of the latent to which a learned flow carries an observation",
            reference=flow,
            horizon_decides_fit=False,
            **torch,
        ),
        _spec(
            name="logpzo-a",
            detector="flow:of_transitions",
            parameters=TransitionFlowParameters,
            summary="norm of the latent to which a learned flow carries a transition",
            reference=flow,
            inputs="observations+actions",
            **torch,
        ),
        _spec(
            name="wm-kl-a",
            detector="world_model:WorldModel",
            parameters=WorldModelParameters,
            summary="divergence of a world model's belief after an observation from that before",
            reference="Zollicoffer et al. (2025), novelty detection with world models",
            inputs="observations+actions",
            horizon_decides_fit=False,
            **torch | {"seconds": 90},
        ),
        _spec(
            name="lstm",
            detector="stacked_lstm:StackedLstm",
            parameters=LstmParameters,
            summary="errors of a stacked LSTM's forecasts, as a multivariate normal law",
            reference="Malhotra, Vig, Shroff & Agarwal (2015), LSTM-AD",
            **torch,
        ),
        _spec(
            name="dagmm",
            detector="mixture:DeepMixture",
            parameters=MixtureParameters,
            summary="energy of a window's code and reconstruction in a mixture of normal laws",
            reference="Zong et al. (2018), DAGMM",
            horizon_decides_fit=False,
            **torch,
        ),
    ]

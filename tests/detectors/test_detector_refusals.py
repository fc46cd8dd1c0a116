"""What all detectors of windows refuse, each with an error that names it."""

import numpy as np
import pytest
from oodd_mewma import make_mewma, make_mewma_a
from oodd_npn import npn
from oodd_pe import make_pe
from oodd_riqn import riqn

from oodd_eval import Trajectory
from oodd_eval.errors import TrajectoryError, UsageError

pytest.importorskip("sklearn")
from oodd_rf import make_rf

RNG = np.random.default_rng(0)
NOMINAL = [Trajectory(RNG.normal(size=(30, 3)), RNG.normal(size=(29, 1))) for _ in range(4)]
NARROW = Trajectory(np.zeros((9, 2)), np.zeros((8, 1)))
FACTORIES = {"mewma": make_mewma, "pe": lambda **p: make_pe("pe", **p), "rf": make_rf, "npn": npn,
             "riqn": riqn}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [
        ("mewma", "horizon", 0), ("mewma", "order", True), ("mewma", "clip", float("nan")),
        ("mewma", "weights", []), ("mewma", "weights", [0.1, 2]), ("mewma", "ridge", "small"),
        ("pe", "members", 0), ("pe", "memories", [2]), ("pe", "device", "tpu"),
        ("rf", "trees", 1.5), ("rf", "rows", "many"), ("rf", "seed", -1), ("riqn", "samples", 1.5),
        ("riqn", "updates", True), ("npn", "horizon", 1.0),
    ],
)  # fmt: skip
def test_wrong_parameters_are_named(name, parameter, value):
    with pytest.raises(UsageError, match=rf"parameter '{parameter}' of {name} is .*, expected"):
        FACTORIES[name](**{parameter: value})


@pytest.mark.parametrize("name", ["mewma", "pe", "rf"])
@pytest.mark.parametrize("nominal", [[], [x[:1] for x in NOMINAL], [NOMINAL[0], NARROW]])
def test_unusable_training_data_are_refused(name, nominal):
    with pytest.raises(TrajectoryError):
        FACTORIES[name]().fit(nominal)


def test_another_width_is_refused_where_it_matters():
    chart, chart_a = make_mewma().fit(NOMINAL), make_mewma_a().fit(NOMINAL)
    x = NOMINAL[0]
    np.testing.assert_array_equal(chart.score(x.without_actions()), chart.score(x))
    with pytest.raises(TrajectoryError, match=r"fitted on .*\(3, 1\) .* trajectory of \(3, 0\)"):
        chart_a.score(x.without_actions())
    with pytest.raises(TrajectoryError, match=r"fitted on .*\(3, 0\) .* trajectory of \(2, 0\)"):
        chart.score(NARROW)

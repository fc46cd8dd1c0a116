"""Split reduced is a part of split standard: the same seeds give the same episodes."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("gymnasium")
from oodd_recording.build import build_split

from oodd_eval.data.facts import SPLITS, SplitDefinition
from oodd_eval.data.split import load_split

pytestmark = pytest.mark.slow

WHOLE = SplitDefinition("whole", 4, 3, 3, 80, 951)
PART = replace(WHOLE, name="part", train=4, calibration=2, test=1)
ENVIRONMENTS = ["acrobot", "cartpole"]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    place = tmp_path_factory.mktemp("splits")
    return {
        split.name: load_split(build_split(split, place / split.name, jobs=1,
                                           environments=ENVIRONMENTS))
        for split in (WHOLE, PART)
    }  # fmt: skip


def parts(split, environment):
    data = split.environment(environment)
    anomalous = {f"test/{a}": data.anomalous(a) for a in data.anomalies}
    return {"train": data.train, "calibration": data.calibration, "twins": data.twins, **anomalous}


def test_reduced_differs_from_standard_in_sizes_alone():
    reduced, standard = SPLITS["reduced"], SPLITS["standard"]
    sizes = {"train": 500, "calibration": 200, "test": 50}
    assert replace(reduced, name="standard", **sizes) == standard
    assert (reduced.train, reduced.calibration, reduced.test) == (500, 50, 20)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_a_smaller_split_holds_the_first_trajectories_of_each_part(built, environment):
    whole, part = (parts(built[name], environment) for name in ("whole", "part"))
    assert list(whole) == list(part)
    assert len(part) == 3 + 8
    for name, few in part.items():
        many = whole[name]
        n = {"train": PART.train, "calibration": PART.calibration}.get(name, PART.test)
        assert len(few) == n
        assert len(many) >= n
        assert few.seeds.tolist() == many.seeds.tolist()[:n], name
        assert few.returns.tolist() == many.returns.tolist()[:n], name
        for i in range(n):
            assert np.array_equal(few[i].observations, many[i].observations), (name, i)
            assert np.array_equal(few[i].actions, many[i].actions), (name, i)
            assert np.array_equal(few.rewards(i), many.rewards(i)), (name, i)
        if name.startswith("test/"):
            assert few.onsets.tolist() == many.onsets.tolist()[:n]
            assert few.effects.tolist() == many.effects.tolist()[:n]


def test_sizes_alone_make_another_digest(built):
    assert built["whole"].digest != built["part"].digest

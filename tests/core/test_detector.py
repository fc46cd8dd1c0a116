"""The score contract, and the messages of those who break it."""

import functools
import sys
import threading
import types

import numpy as np
import pytest

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, OoddError, UnknownNameError, UsageError
from oodd_eval.plugins.contract import accepted, check_scores, copied, float_scores

EPISODE = Trajectory(np.zeros((6, 2)), np.zeros((5, 1)))


def check(scores, horizon=1, warm_up=0):
    return check_scores(
        scores, EPISODE, horizon=horizon, warm_up=warm_up, detector="rf", where="hopper/test[7]"
    )


@pytest.mark.parametrize(
    "scores",
    [
        [0, 1, 0, 1, 1, 0],
        (0.0, 1.0, 0.0, 1.0, 1.0, 0.0),
        [np.float32(0), True, 0, 1.0, np.int8(1), False],
        *(np.array([0, 1, 0, 1, 1, 0], dtype) for dtype in ("f2", "f4", ">f8", "i1", "u8", "?")),
        np.array([0, 1, 0, 1, 1, 0], np.longdouble),
    ],
    ids=repr,
)
def test_scores_of_any_real_type_become_float64(scores):
    checked = check(scores)
    assert (type(checked), checked.dtype.str) == (np.ndarray, np.dtype("f8").str)
    assert checked.tolist() == [0.0, 1.0, 0.0, 1.0, 1.0, 0.0]


class Seeded:
    def __init__(self, seed):
        self.seed = seed


class Any:
    def __init__(self, **arguments):
        self.arguments = arguments


def test_factories_get_what_they_take():
    def both(*, horizon, seed, power=1):
        return horizon, seed

    assert accepted(Seeded, seed=3, horizon=2) == {"seed": 3}
    assert accepted(object, seed=3, horizon=2) == {}
    assert accepted(lambda *rows: rows, seed=3, horizon=2) == {}
    assert accepted(both, seed=3, horizon=2) == {"seed": 3, "horizon": 2}
    assert accepted(functools.partial(both, seed=1), horizon=2) == {"horizon": 2}
    for unknown in (Any, lambda **_: 0):
        assert accepted(unknown, seed=3, horizon=2) == {"seed": 3, "horizon": 2}


class Locked:
    def __init__(self, *parts):
        self.name, self.parts = "x", {"parts": parts}

    def fit(self, nominal): ...

    def score(self, x):
        return [0.0] * len(x)


def test_what_cannot_be_copied_is_named(tmp_path):
    with (tmp_path / "log").open("w") as file:
        for part, kind in ((threading.Lock(), "_thread.lock"), (file, "TextIOWrapper")):
            with pytest.raises(
                UsageError, match=rf"Locked .* its attribute 'parts' .*{kind}.*: pa"
            ):
                copied(Locked(part))
    detector = Locked([1.0])
    twin = copied(detector)
    twin.parts["parts"][0].append(2.0)
    assert detector.parts == {"parts": ([1.0],)}


@pytest.mark.parametrize("undefined", [0, 1, 3])
def test_nan_is_allowed_in_the_leading_block(undefined):
    scores = np.zeros(6)
    scores[:undefined] = np.nan
    assert check(scores, warm_up=3) is scores
    others = check(scores.tolist(), warm_up=3), check(scores.astype("f4"), warm_up=3)
    assert all(np.array_equal(other, scores, equal_nan=True) for other in others)
    with pytest.raises(ContractError, match="in one leading block only"):
        check(np.array([0, np.nan, 0, 0, 0, 0]), horizon=3)


def test_a_trajectory_shorter_than_the_block_may_be_undefined_throughout():
    assert np.isnan(check(np.full(6, np.nan), horizon=10)).all()


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        (np.zeros(5), r"'rf' returned 5 scores for hopper/test\[7\], expected 6 \(one per obs"),
        (np.zeros((6, 1)), r"shape \(6, 1\) .* expected \(6,\)"),
        ([[0.0], [0.0, 1.0]], r"list that is no array .* expected real numbers"),
        (["0"] * 6, "'rf' returned list of <U1 for hopper/test.7., expected real numbers"),
        ([0.0] * 5 + [None], "returned list of object"),
        (np.zeros(6, complex), "returned ndarray of complex128 .* expected real numbers"),
        (np.zeros(6, "datetime64[s]"), "returned ndarray of datetime64"),
        ("000000", "returned str for"),
        (np.ma.masked_less(np.arange(6.0), 2), "returned a masked array for hopper.* expected NaN"),
        (None, "returned NoneType for"),
        ((0.0 for _ in range(6)), "returned generator for"),
        ([0.0] * 5, "returned 5 scores"),
        (np.array([0, 0, np.inf, 0, 0, 0], np.float16), "inf at t = 2"),
        (np.array([0, 0, np.nan, 0, 0, 0]), "nan at t = 2"),
        (np.array([np.inf, 0, 0, 0, 0, 0]), "inf at t = 0"),
        (np.array([0, 0, 0, 0, 0, -np.inf]), "-inf at t = 5"),
    ],
)
def test_broken_scores_are_named(scores, message):
    with pytest.raises(ContractError, match=message):
        check(scores)


@pytest.mark.parametrize("warm_up", [-1, 21, 1.0, True])
def test_warm_up_is_an_int_of_at_most_twenty(warm_up):
    with pytest.raises(ContractError, match="between 0 and 20"):
        check(np.zeros(6), warm_up=warm_up)


def test_every_error_is_also_a_builtin():
    def subclasses(kind):
        for child in kind.__subclasses__():
            yield child
            yield from subclasses(child)

    own = set(subclasses(OoddError))
    assert len(own) >= 10
    for kind in own:
        assert any(base.__module__ == "builtins" and base is not Exception
                   for base in kind.__mro__[1:-3]), kind  # fmt: skip


def test_an_unknown_name_comes_with_the_nearest_and_with_some_of_the_others():
    message = str(UnknownNameError("environment", "hoper", ["ant", "hopper"]))
    assert message == "unknown environment 'hoper': did you mean 'hopper'? Known: ant, hopper"
    many = [f"topic.{i}" for i in range(1000)]
    message = str(UnknownNameError("column", "zzz", many))
    assert ("did you mean" in message, "and 940 more" in message) == (False, True)
    near = UnknownNameError("column", "topik.7", many)
    assert str(near) == "unknown column 'topik.7': did you mean 'topic.7'?"


def test_scores_are_read_while_another_thread_imports_masked_arrays(monkeypatch):
    monkeypatch.setitem(sys.modules, "numpy.ma", types.ModuleType("numpy.ma"))
    assert float_scores(np.arange(3)).tolist() == [0.0, 1.0, 2.0]

"""States that a detector of anybody's may return: each is packed, or a `ContractError`."""

import itertools
import json
import time
from collections import OrderedDict

import numpy as np
import pytest

from oodd_eval.errors import ContractError
from oodd_eval.plugins.state import MOST_ARRAYS, MOST_BYTES, pack, read_state, write_state


def nested(depth, make):
    value = make(None)
    for _ in range(depth):
        value = make(value)
    return value


def circle():
    value = []
    value.append(value)
    return value


class Raises(dict):
    def items(self):
        raise SystemError("no")

    keys = __iter__ = items


class EndlessDictionary(dict):
    def items(self):
        return ((str(k), k) for k in itertools.count())


class Named:
    def __init__(self, value):
        self.value = value

    def __reduce__(self):
        raise SystemError("no")

    __repr__ = __reduce__


HOSTILE = {
    "a list": lambda: [("a", 1)],
    "objects": lambda: {"a": np.array([Named(1)], object)},
    "texts": lambda: {"a": np.array(["a"])},
    "structured": lambda: {"a": np.zeros(2, [("x", "f8")])},
    "long floats": lambda: {"a": np.zeros(2, np.longdouble)},
    "other byte order": lambda: {"a": np.zeros(2, np.dtype("f8").newbyteorder())},
    "masked": lambda: {"a": np.ma.masked_array([1.0, 2.0], [True, False])},
    "too many bytes": lambda: {"a": np.zeros(MOST_BYTES // 8 + 1)},
    "too many bytes together": lambda: {str(k): np.zeros(MOST_BYTES // 24) for k in range(4)},
    "an endless view": lambda: {"a": np.broadcast_to(np.zeros(1), 10**15)},
    "too many arrays": lambda: {str(k): np.zeros(1) for k in range(MOST_ARRAYS + 1)},
    "a million values": lambda: dict.fromkeys(map(str, range(10**6)), 1),
    "too much text": lambda: {"a": "x" * 2**20},
    "deep lists": lambda: {"a": nested(100_000, lambda v: [v])},
    "deep objects": lambda: {"a": nested(100_000, lambda v: {"a": v})},
    "a circle": lambda: {"a": circle()},
    "not a number": lambda: {"a": float("nan")},
    "infinity in a list": lambda: {"a": [1.0, float("inf")]},
    "huge integers": lambda: {"a": 10**5000},
    "sets": lambda: {"a": {1, 2}},
    "a number as name": lambda: {1: np.zeros(2)},
    "a number as inner name": lambda: {"a": {1: 2}},
    "an empty name": lambda: {"": np.zeros(2)},
    "a long name": lambda: {"a" * 201: np.zeros(2)},
    "a taken name": lambda: {"_json": np.zeros(2)},
    "half a character as name": lambda: {"\ud800": np.zeros(2)},
    "a zero as name": lambda: {"a\0b": np.zeros(2)},
    "an ending as name": lambda: {"a.npy": np.zeros(2)},
    "items that raise": Raises,
    "items without end": EndlessDictionary,
}


@pytest.mark.parametrize("make", HOSTILE.values(), ids=HOSTILE)
def test_a_state_that_is_none_is_a_contract_error(make):
    state, start = make(), time.monotonic()
    with pytest.raises(ContractError, match=r"state\(\) of mine: .*expected a mapping"):
        pack(state, "mine")
    assert time.monotonic() - start < 5


ODD = {
    "nothing": {},
    "views": {"a": np.arange(20.0)[::3], "b": np.arange(12).reshape(3, 4).T[1:]},
    "scalars": {"a": np.float32(0.1), "b": np.int64(-(2**63)), "c": np.bool_(1)},
    "no dimension": {"a": np.array(5.0), "b": np.zeros((0, 3))},
    "not finite": {"a": np.array([np.nan, np.inf, -0.0])},
    "column by column": {"a": np.asfortranarray(np.arange(6.0).reshape(2, 3))},
    "names": {"file": np.zeros(1), "arr_0": np.ones(1), "../up": np.zeros(2), "µ/s": np.ones(2)},
    "values": {"a": [1, 2.5, "x", None, True, {"b": ("c", [])}], "kind": "\ud800", "b": 2**70},
    "classes": {"a": OrderedDict(b=1), "c": np.float64(0.1)},
    "both": {"_json": 1, "a": np.zeros(3, np.float16)},
}


@pytest.mark.parametrize("state", ODD.values(), ids=ODD)
def test_an_odd_state_comes_back_from_a_file_as_it_was(state, tmp_path):
    packed = pack(state)
    write_state(tmp_path / "fit.npz", packed)
    back = read_state(tmp_path / "fit.npz").state()
    assert back.keys() == state.keys()
    for name, value in state.items():
        if isinstance(value, np.ndarray | np.generic):
            array = np.asarray(value)
            assert (back[name].dtype, back[name].shape) == (array.dtype, array.shape)
            assert back[name].tobytes() == array.tobytes()
            assert back[name].flags.f_contiguous or not array.flags.f_contiguous
        else:
            assert back[name] == json.loads(json.dumps(value))


def test_dictionaries_of_other_classes_are_taken_as_they_are():
    assert pack({"a": Raises(b=1)}).values() == {"a": {"b": 1}}


def test_a_packed_state_is_a_copy():
    array = np.zeros(3)
    packed = pack({"a": array})
    array += 1
    assert packed.arrays["a"].tolist() == [0, 0, 0]

"""State that goes into a checkpoint and comes out with every bit."""

from collections import Counter, deque
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import gtsam
import numpy as np
import pytest

from loam_gtsam.io.state import checkpointed, freeze, thaw


@checkpointed
class Colour(StrEnum):
    RED = "red"


@checkpointed
class Pair(NamedTuple):
    first: Any
    second: Any


@checkpointed
@dataclass(frozen=True, slots=True)
class Plain:
    value: Any


@checkpointed
class Counting:
    def __init__(self, count):
        self.count, self.other = count, None

    def __getstate__(self):
        return self.count

    def __setstate__(self, count):
        self.__init__(count)


@checkpointed
class Called:
    calls = 0

    def __init__(self, *arguments):
        Called.calls += 1


class Unmarked:
    pass


class Root:
    def __init__(self, value=None):
        self.value = value


def copied(value, shared=None):
    root, again = Root(value), Root()
    thaw(freeze({"root": root}, shared or {}), {"root": again}, shared or {})
    return again.value


@pytest.mark.parametrize(
    "value",
    [
        None, True, 3, -(2**70), 0.1, float("inf"), "text", [1, [2.5]], (1, (2,)), {3, 4},
        {1: "a", (2, 3): None}, Counter({"x": 2}), Colour.RED, Pair(1, [2]), Plain((1, 2)),
    ],
    ids=str,
)  # fmt: skip
def test_values_come_back_as_they_were(value):
    back = copied(value)
    assert back == value
    assert type(back) is type(value)


def test_a_queue_keeps_its_bound():
    back = copied(deque([1, 2], maxlen=2))
    assert (back, back.maxlen) == (deque([1, 2]), 2)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64, np.int32, np.bool_, np.uint8])
@pytest.mark.parametrize("shape", [(), (0, 3), (4,), (2, 3)])
@pytest.mark.parametrize("order", "CF")
def test_arrays_keep_every_bit_and_their_order_in_memory(dtype, shape, order):
    numbers = np.random.default_rng(0).normal(size=shape)
    if shape and 0 not in shape:
        numbers.flat[0] = np.nan if np.issubdtype(dtype, np.floating) else 0.0
    array = np.asarray(numbers.astype(dtype), order=order)
    back = copied(array)
    assert back.dtype == array.dtype
    assert back.shape == array.shape
    assert back.tobytes() == array.tobytes()
    assert back.flags.f_contiguous == array.flags.f_contiguous
    assert back.flags.writeable


def test_numbers_of_numpy_stay_numbers_of_numpy():
    back = copied(np.float32(0.1))
    assert back == np.float32(0.1)
    assert type(back) is np.float32


def test_poses_keep_every_bit():
    rng = np.random.default_rng(0)
    for _ in range(100):
        pose = gtsam.Pose3.Expmap(rng.normal(size=6)).compose(
            gtsam.Pose3.Expmap(rng.normal(size=6))
        )
        assert np.array_equal(copied(pose).matrix(), pose.matrix())
        assert np.array_equal(copied(pose.rotation()).matrix(), pose.rotation().matrix())


def test_what_is_one_object_stays_one_and_may_hold_itself():
    array, ring = np.ones(3), Plain([])
    ring.value.append(ring)
    first, second, back = copied([array, array, ring])
    assert first is second
    assert back.value[0] is back


def test_a_class_may_say_itself_what_its_state_is():
    counting = Counting(3)
    counting.other = Unmarked()
    assert copied(counting).count == 3


def test_roots_and_what_is_shared_are_referred_to():
    given = Unmarked()
    assert copied([given], {"given": given})[0] is given
    roots = {"a": Root(), "b": Root()}
    roots["a"].value = [roots["b"]]
    again = {"a": Root(), "b": Root()}
    thaw(freeze(roots, {}), again, {})
    assert again["a"].value[0] is again["b"]


@pytest.mark.parametrize(
    "value", [Unmarked(), len, [{"x": Unmarked()}], np.array([None])], ids="abcd"
)
def test_what_nobody_marked_is_refused(value):
    with pytest.raises(TypeError, match="cannot be in a checkpoint"):
        freeze({"root": Root(value)}, {})


def damaged(**changes):
    frozen = freeze({"root": Root([np.ones(3), Plain(1)])}, {})
    text = frozen["structure"].tobytes().decode()
    for old, new in changes.get("text", {}).items():
        assert old in text
        text = text.replace(old, new)
    frozen["structure"] = np.frombuffer(text.encode(), np.uint8)
    for name in changes.get("without", ()):
        del frozen[name]
    return frozen


@pytest.mark.parametrize(
    "changes",
    [
        {"without": ["float64"]},
        {"without": ["structure"]},
        {"text": {"Plain": "Unmarked"}},
        {"text": {"test_state.Plain": "os.system"}},
        {"text": {'"object"': '"call"'}},
        {"text": {"[3]": "[4]"}},
        {"text": {"}": ""}},
        {"text": {'"root"': '"other"'}},
    ],
    ids=str,
)
def test_a_damaged_state_is_an_error_and_runs_nothing(changes):
    with pytest.raises(ValueError, match=r"."):
        thaw(damaged(**changes), {"root": Root()}, {})


@pytest.mark.parametrize("name", ["Pair", "Colour"])
def test_no_constructor_is_called_but_those_of_enums_and_named_tuples(name):
    frozen = freeze({"root": Root([Pair(1, 2), Colour.RED])}, {})
    text = frozen["structure"].tobytes().decode().replace(f"test_state.{name}", "test_state.Called")
    frozen["structure"] = np.frombuffer(text.encode(), np.uint8)
    with pytest.raises(ValueError, match="Called"):
        thaw(frozen, {"root": Root()}, {})
    assert Called.calls == 0

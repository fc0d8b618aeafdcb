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


def test_a_queue_keeps_its_bound_and_numbers_of_numpy_their_type():
    back, number = copied([deque([1, 2], maxlen=2), np.float32(0.1)])
    assert (back, back.maxlen) == (deque([1, 2]), 2)
    assert (number, type(number)) == (np.float32(0.1), np.float32)


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


def test_poses_keep_every_bit():
    rng = np.random.default_rng(0)
    for _ in range(100):
        first, second = (gtsam.Pose3.Expmap(rng.normal(size=6)) for _ in range(2))
        pose = first.compose(second)
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


@pytest.mark.parametrize("value", [Unmarked(), len, [{"x": Unmarked()}], np.array([None])])
def test_what_nobody_marked_is_refused(value):
    with pytest.raises(TypeError, match="cannot be in a checkpoint"):
        freeze({"root": Root(value)}, {})


def changed(frozen, old, new):
    text = frozen["structure"].tobytes().decode()
    assert old in text
    return frozen | {"structure": np.frombuffer(text.replace(old, new).encode(), np.uint8)}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Plain", "Unmarked"), ("test_state.Plain", "os.system"), ('"object"', '"call"'),
        ("[3]", "[4]"), ("}", ""), ('"root"', '"other"'), ("float64", None), ("structure", None),
    ],
)  # fmt: skip
def test_a_damaged_state_is_an_error_and_runs_nothing(old, new):
    frozen = freeze({"root": Root([np.ones(3), Plain(1)])}, {})
    if new is None:
        del frozen[old]
    else:
        frozen = changed(frozen, old, new)
    with pytest.raises(ValueError, match=r"."):
        thaw(frozen, {"root": Root()}, {})


@pytest.mark.parametrize("name", ["Pair", "Colour"])
def test_no_constructor_is_called_but_those_of_enums_and_named_tuples(name):
    frozen = freeze({"root": Root([Pair(1, 2), Colour.RED])}, {})
    with pytest.raises(ValueError, match="Called"):
        thaw(changed(frozen, f"test_state.{name}", "test_state.Called"), {"root": Root()}, {})
    assert Called.calls == 0

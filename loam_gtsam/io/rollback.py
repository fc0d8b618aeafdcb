"""Calls that change nothing if they raise: what objects were before, and back to it.

Arrays, poses and whatever else is never changed in place are not copied, so that a whole map is
remembered in the time that it takes to list its cubes.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import is_dataclass
from enum import Enum
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import gtsam

from loam_gtsam.config import Section

_PACKAGE = __name__.partition(".")[0]
_P = ParamSpec("_P")
_R = TypeVar("_R")
_S = TypeVar("_S")


def whole(method: Callable[Concatenate[_S, _P], _R]) -> Callable[Concatenate[_S, _P], _R]:
    """Decorator of a method: if it raises, its object is what it was before the call."""

    @wraps(method)
    def call(self: _S, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        before = Before(self)
        try:
            return method(self, *args, **kwargs)
        except BaseException:
            before.restore()
            raise

    return call


class Before:
    """The state of an object, and of all that belongs to it, at a moment.

    Followed are containers and objects of this package. An object that has a method ``restorer()``
    is asked instead; it returns a function that brings the object back. Objects of a user, frozen
    ones, arrays and those of GTSAM are taken not to change, but for values and graphs of factors.
    """

    def __init__(self, root: object) -> None:
        self._restorers: list[Callable[[], None]] = []
        seen: dict[int, object] = {}
        stack = [root]
        while stack:
            value = stack.pop()
            how = _how(type(value))
            if how is None or id(value) in seen:
                continue
            seen[id(value)] = value
            restore, parts = how(value)
            stack += parts
            if restore is not None:
                self._restorers.append(restore)

    def restore(self) -> None:
        """Bring all objects back."""
        for restore in self._restorers:
            restore()


_Restore = Callable[[], None] | None
_How = Callable[[Any], tuple[_Restore, list[Any]]]


def _sequence(value: Any) -> tuple[_Restore, list[Any]]:
    held = list(value)

    def restore() -> None:
        value.clear()
        value.extend(held)

    return restore, held


def _keyed(value: Any) -> tuple[_Restore, list[Any]]:
    held = value.copy()

    def restore() -> None:
        value.clear()
        value.update(held)

    return restore, list(held.values()) if isinstance(held, dict) else []


def _tuple(value: Any) -> tuple[_Restore, list[Any]]:
    return None, list(value)


def _values(value: Any) -> tuple[_Restore, list[Any]]:
    held = gtsam.Values(value)

    def restore() -> None:
        value.clear()
        value.insert(held)

    return restore, []


def _factors(value: Any) -> tuple[_Restore, list[Any]]:
    held = gtsam.NonlinearFactorGraph(value)

    def restore() -> None:
        value.resize(0)
        value.push_back(held)

    return restore, []


def _object(slots: list[str], value: Any) -> tuple[_Restore, list[Any]]:
    held = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    attributes = getattr(value, "__dict__", None)
    copied = None if attributes is None else dict(attributes)

    def restore() -> None:
        for name, part in held.items():
            object.__setattr__(value, name, part)
        if copied is not None:
            value.__dict__.clear()
            value.__dict__.update(copied)

    return restore, [*held.values(), *(copied or {}).values()]


def _asked(value: Any) -> tuple[_Restore, list[Any]]:
    return value.restorer(), []


_HOW: dict[type, _How | None] = {
    list: _sequence,
    deque: _sequence,
    dict: _keyed,
    Counter: _keyed,
    set: _keyed,
    gtsam.Values: _values,
    gtsam.NonlinearFactorGraph: _factors,
}


def _how(kind: type) -> _How | None:
    """How an object of a type is remembered; None if it never changes."""
    if kind not in _HOW:
        _HOW[kind] = _choose(kind)
    return _HOW[kind]


def _choose(kind: type) -> _How | None:
    if issubclass(kind, tuple):
        return _tuple
    if kind.__module__.partition(".")[0] != _PACKAGE or issubclass(kind, (Enum, Section, type)):
        return None
    if hasattr(kind, "restorer"):
        return _asked
    frozen: Any = getattr(kind, "__dataclass_params__", None) if is_dataclass(kind) else None
    return None if frozen is not None and frozen.frozen else partial(_object, _slots(kind))


def _slots(kind: type) -> list[str]:
    return [name for base in kind.__mro__ for name in vars(base).get("__slots__", ())]

"""State of objects as plain arrays and JSON, and back: what a checkpoint is made of.

Nothing that is read can run code: classes are looked up by name among those of this package that
are imported and those that a user marked with :func:`checkpointed`; arrays are read without pickle.
Every bit survives, and so does the memory order of arrays, on which the rounding of sums depends.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from enum import Enum
from typing import Any, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

Frozen = dict[str, NDArray[Any]]
""":data:`STRUCTURE`, JSON as bytes, and all elements of the arrays of a dtype under its name."""
STRUCTURE = "structure"

_T = TypeVar("_T", bound=type)
_MARKED: dict[str, type] = {}
_PACKAGE = __name__.partition(".")[0]


def checkpointed(cls: _T) -> _T:
    """Class decorator for classes of a user: their instances may be in a checkpoint.

    What :meth:`object.__getstate__` gives is kept, and set again by ``__setstate__`` or attribute
    by attribute, as in :mod:`copy`.
    """
    _MARKED[_name(cls)] = cls
    return cls


def freeze(roots: Mapping[str, object], shared: Mapping[str, object]) -> Frozen:
    """Turn the state of objects into arrays.

    Parameters
    ----------
    roots : objects whose state is kept, by name; they may refer to each other
    shared : objects to which the roots refer and which are there again when the state is read:
        configuration, samples of an IMU

    Raises
    ------
    TypeError
        If an object is of a class that is neither of this package nor :func:`checkpointed`.
    """
    writer = _Writer({id(value): name for name, value in (*shared.items(), *roots.items())})
    states = {}
    for name, root in roots.items():
        try:
            states[name] = writer.encode(root.__getstate__())
        except TypeError as error:
            raise TypeError(f"{_name(type(root))}: {error}") from error
    return writer.frozen(states)


def thaw(
    frozen: Mapping[str, NDArray[Any]], roots: Mapping[str, Any], shared: Mapping[str, Any]
) -> None:
    """Bring ``roots`` into the state in which objects of the same names were frozen.

    Raises
    ------
    ValueError
        If the state is damaged, or of other objects.
    """
    try:
        reader = _Reader(frozen, {**shared, **roots})
        states = reader.structure["roots"]
        if states.keys() != roots.keys():
            raise ValueError(f"expected the state of {sorted(roots)}, got that of {sorted(states)}")
        for name, root in roots.items():
            _set_state(root, reader.decode(states[name]))
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(f"the state does not fit: {type(error).__name__}: {error}") from error


def _name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _class_of(name: str, base: type = object) -> type:
    """The class of that name, derived from ``base``; a KeyError if a checkpoint cannot have it."""
    module, _, cls = name.rpartition(".")
    found: Any = _MARKED.get(name)
    if module.partition(".")[0] == _PACKAGE:
        found = getattr(sys.modules.get(module), cls, None)
    if not (isinstance(found, type) and issubclass(found, base) and _name(found) == name):
        raise KeyError(name)
    return found


def _set_state(value: Any, state: Any) -> None:
    if hasattr(value, "__setstate__"):
        value.__setstate__(state)
        return
    for part in state if isinstance(state, tuple) else (state,):
        for key, entry in (part or {}).items():
            object.__setattr__(value, key, entry)


class _Writer:
    """Encoder of objects; what it has met before, or is known by name, is only referred to."""

    def __init__(self, known: Mapping[int, str]) -> None:
        self._known = known
        self._seen: dict[int, int] = {}
        self._kept: list[object] = []  # or their ids would be given to others
        self._arrays: list[list[Any]] = []
        self._elements: dict[str, list[NDArray[Any]]] = {}
        self._sizes: Counter[str] = Counter()

    def frozen(self, states: Mapping[str, Any]) -> Frozen:
        text = json.dumps({"roots": states, "arrays": self._arrays})
        columns = {name: np.concatenate(parts) for name, parts in self._elements.items()}
        return {STRUCTURE: np.frombuffer(text.encode(), np.uint8), **columns}

    def encode(self, value: Any) -> Any:
        """``value`` as JSON: plain ones as they are, others as a list that begins with a tag."""
        if isinstance(value, Enum):
            return ["enum", self._class(value), value.value]
        if value is None or type(value) in (bool, int, float, str):
            return value
        if id(value) in self._known:
            return ["shared", self._known[id(value)]]
        if id(value) in self._seen:
            return ["again", self._seen[id(value)]]
        number = self._seen[id(value)] = len(self._kept)
        self._kept.append(value)
        return [*self._tagged(value), number]

    def _tagged(self, value: Any) -> list[Any]:
        kind = type(value)
        if isinstance(value, (np.ndarray, np.generic)):
            tag = "scalar" if isinstance(value, np.generic) else "array"
            return [tag, self._array(np.asarray(value))]
        if kind in (list, tuple, set):
            return [kind.__name__, self._each(value)]
        if kind is deque:
            return ["deque", self._each(value), value.maxlen]
        if kind in (dict, Counter):
            return [kind.__name__, [self._each(pair) for pair in value.items()]]
        if kind in (gtsam.Pose3, gtsam.Rot3):
            return ["pose" if kind is gtsam.Pose3 else "rotation", self._array(value.matrix())]
        if isinstance(value, tuple):
            return ["named", self._class(value), self._each(value)]
        return ["object", self._class(value), self.encode(value.__getstate__())]

    def _each(self, values: Any) -> list[Any]:
        return [self.encode(value) for value in values]

    def _class(self, value: object) -> str:
        name = _name(type(value))
        with suppress(KeyError):
            if _class_of(name) is type(value):
                return name
        raise TypeError(
            f"{name} cannot be in a checkpoint; if its attributes say all about it, mark the class "
            "with loam_gtsam.io.state.checkpointed, else leave it out of what __getstate__ gives"
        )

    def _array(self, array: NDArray[Any]) -> int:
        if array.dtype.kind not in "biuf":
            raise TypeError(f"an array of {array.dtype} cannot be in a checkpoint")
        turned = array.flags.f_contiguous and not array.flags.c_contiguous
        flat = (array.T if turned else array).ravel()
        name = array.dtype.name
        self._elements.setdefault(name, []).append(flat)
        self._arrays.append([name, list(array.shape), turned, self._sizes[name]])
        self._sizes[name] += flat.size
        return len(self._arrays) - 1


class _Reader:
    """Decoder of what :class:`_Writer` encoded."""

    def __init__(self, frozen: Mapping[str, NDArray[Any]], known: Mapping[str, Any]) -> None:
        self._frozen, self._known = frozen, known
        self.structure = json.loads(frozen[STRUCTURE].tobytes())
        self._made: dict[int, Any] = {}

    def decode(self, entry: Any) -> Any:
        """The value of an entry of the structure."""
        if not isinstance(entry, list):
            return entry
        tag = entry[0]
        if tag == "enum":
            return _class_of(entry[1], Enum)(entry[2])
        if tag == "shared":
            return self._known[entry[1]]
        if tag == "again":
            return self._made[entry[1]]
        if tag in _LEAVES:
            leaf = self._made[entry[-1]] = _LEAVES[tag](self, entry)
            return leaf
        # What may refer to itself is known before its content is.
        if tag == "object":
            made: Any = object.__new__(_class_of(entry[1]))
            self._made[entry[-1]] = made
            _set_state(made, self.decode(entry[2]))
            return made
        container = self._made[entry[-1]] = _CONTAINERS[tag]()
        if tag == "list":
            container.extend(map(self.decode, entry[1]))
        else:
            for key, value in map(self.each, entry[1]):
                container[key] = value
        return container

    def each(self, entries: list[Any]) -> list[Any]:
        return [self.decode(part) for part in entries]

    def array(self, number: int) -> NDArray[Any]:
        name, shape, turned, start = self.structure["arrays"][number]
        size = int(np.prod(shape, dtype=np.int64))
        flat = self._frozen[name][start : start + size].copy()
        return flat.reshape(shape[::-1]).T if turned else flat.reshape(shape)


_CONTAINERS: dict[str, Callable[[], Any]] = {"list": list, "dict": dict, "Counter": Counter}
_LEAVES: dict[str, Callable[[_Reader, list[Any]], Any]] = {
    "array": lambda reader, entry: reader.array(entry[1]),
    "scalar": lambda reader, entry: reader.array(entry[1])[()],
    "tuple": lambda reader, entry: tuple(reader.each(entry[1])),
    "set": lambda reader, entry: set(reader.each(entry[1])),
    "deque": lambda reader, entry: deque(reader.each(entry[1]), maxlen=entry[2]),
    "named": lambda reader, entry: _class_of(entry[1], tuple)(*reader.each(entry[2])),
    "pose": lambda reader, entry: gtsam.Pose3(reader.array(entry[1])),
    "rotation": lambda reader, entry: gtsam.Rot3(reader.array(entry[1])),
}

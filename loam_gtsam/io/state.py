"""State of objects as plain arrays and JSON, and back: what a checkpoint is made of.

Nothing that is read can run code: classes are looked up by name among those of this package that
are in use and those that a user marked with :func:`checkpointed`; arrays are read without pickle.
Every bit survives, and so does the memory order of arrays, on which the rounding of sums depends.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, deque
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

Frozen = dict[str, NDArray[Any]]
"""``structure``, JSON as bytes, and all elements of the arrays of a dtype under its name."""

_T = TypeVar("_T", bound=type)
_CLASSES: dict[str, type] = {}
_KINDS = "biuf"
_STRUCTURE = "structure"


def checkpointed(cls: _T) -> _T:
    """Class decorator: instances may be in a checkpoint.

    What :meth:`object.__getstate__` gives is kept, and set again by ``__setstate__`` or attribute
    by attribute, as in :mod:`copy`.
    """
    _CLASSES[_name(cls)] = cls
    return cls


def freeze(roots: Mapping[str, object], shared: Mapping[str, object]) -> Frozen:
    """The state of objects.

    Parameters
    ----------
    roots : whose state is kept; they may refer to each other
    shared : what they refer to and what is not kept, for it is there again: configuration, samples

    Raises
    ------
    TypeError
        If something is of a class that is neither of this package nor :func:`checkpointed`.
    """
    writer = _Writer({id(value): name for name, value in (*shared.items(), *roots.items())})
    states = {name: writer.take(_state(root)) for name, root in roots.items()}
    return writer.frozen(states)


def thaw(
    frozen: Mapping[str, NDArray[Any]], roots: Mapping[str, Any], shared: Mapping[str, Any]
) -> None:
    """Bring ``roots`` into the state in which others of the same names were frozen.

    Raises
    ------
    ValueError
        If that cannot be: the state is damaged, or of other objects.
    """
    try:
        reader = _Reader(frozen, {**shared, **roots})
        states = reader.structure["roots"]
        if states.keys() != roots.keys():
            raise ValueError(f"expected the state of {sorted(roots)}, got that of {sorted(states)}")
        for name, root in roots.items():
            _set_state(root, reader.give(states[name]))
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(f"the state does not fit: {type(error).__name__}: {error}") from error


def _name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _find(name: str) -> type | None:
    """The class of that name, if it may be in a checkpoint."""
    if name in _CLASSES:
        return _CLASSES[name]
    module, _, cls = name.rpartition(".")
    if module.partition(".")[0] != __name__.partition(".")[0]:
        return None
    found = getattr(sys.modules.get(module), cls, None)
    return found if isinstance(found, type) and _name(found) == name else None


def _class(name: str) -> type:
    found = _find(name)
    if found is None:
        raise KeyError(name)
    return found


def _state(value: Any) -> Any:
    return value.__getstate__()


def _set_state(value: Any, state: Any) -> None:
    if hasattr(value, "__setstate__"):
        value.__setstate__(state)
        return
    for part in state if isinstance(state, tuple) else (state,):
        for key, entry in (part or {}).items():
            object.__setattr__(value, key, entry)


class _Writer:
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
        return {_STRUCTURE: np.frombuffer(text.encode(), np.uint8), **columns}

    def take(self, value: Any) -> Any:
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
        if isinstance(value, np.ndarray):
            return ["array", self._array(value)]
        if isinstance(value, np.generic):
            return ["scalar", self._array(np.asarray(value))]
        if kind in (list, tuple, set):
            return [kind.__name__, [self.take(entry) for entry in value]]
        if kind is deque:
            return ["deque", [self.take(entry) for entry in value], value.maxlen]
        if kind in (dict, Counter):
            return [kind.__name__, [[self.take(k), self.take(v)] for k, v in value.items()]]
        if kind is gtsam.Pose3:
            return ["pose", self._array(value.matrix())]
        if kind is gtsam.Rot3:
            return ["rotation", self._array(value.matrix())]
        if isinstance(value, tuple):
            return ["named", self._class(value), [self.take(entry) for entry in value]]
        return ["object", self._class(value), self.take(_state(value))]

    def _class(self, value: object) -> str:
        name = _name(type(value))
        if _find(name) is not type(value):
            raise TypeError(
                f"{name} cannot be in a checkpoint; mark the class with "
                "loam_gtsam.io.state.checkpointed if its attributes say all about it"
            )
        return name

    def _array(self, array: NDArray[Any]) -> int:
        if array.dtype.kind not in _KINDS:
            raise TypeError(f"an array of {array.dtype} cannot be in a checkpoint")
        turned = array.flags.f_contiguous and not array.flags.c_contiguous
        flat = (array.T if turned else array).ravel()
        name = array.dtype.name
        self._elements.setdefault(name, []).append(flat)
        self._arrays.append([name, list(array.shape), turned, self._sizes[name]])
        self._sizes[name] += flat.size
        return len(self._arrays) - 1


class _Reader:
    def __init__(self, frozen: Mapping[str, NDArray[Any]], known: Mapping[str, Any]) -> None:
        self._frozen, self._known = frozen, known
        self.structure = json.loads(frozen[_STRUCTURE].tobytes())
        self._made: dict[int, Any] = {}

    def give(self, entry: Any) -> Any:
        """The value of an entry of the structure."""
        if not isinstance(entry, list):
            return entry
        tag = entry[0]
        if tag == "enum":
            return _class(entry[1])(entry[2])
        if tag == "shared":
            return self._known[entry[1]]
        if tag == "again":
            return self._made[entry[1]]
        # What may refer to itself is known before its content is.
        if tag in ("list", "dict", "Counter"):
            return self._filled(tag, entry)
        if tag == "object":
            made: Any = object.__new__(_class(entry[1]))
            self._made[entry[-1]] = made
            _set_state(made, self.give(entry[2]))
            return made
        leaf = self._made[entry[-1]] = _LEAVES[tag](self, entry)
        return leaf

    def _filled(self, tag: str, entry: list[Any]) -> Any:
        if tag == "list":
            items = self._made[entry[-1]] = []
            items.extend(self.give(part) for part in entry[1])
            return items
        pairs = self._made[entry[-1]] = {} if tag == "dict" else Counter()
        for key, value in entry[1]:
            pairs[self.give(key)] = self.give(value)
        return pairs

    def parts(self, entries: list[Any]) -> list[Any]:
        return [self.give(part) for part in entries]

    def array(self, number: int) -> NDArray[Any]:
        name, shape, turned, start = self.structure["arrays"][number]
        size = int(np.prod(shape, dtype=np.int64))
        flat = self._frozen[name][start : start + size].copy()
        return flat.reshape(shape[::-1]).T if turned else flat.reshape(shape)


_LEAVES: dict[str, Callable[[_Reader, list[Any]], Any]] = {
    "array": lambda reader, entry: reader.array(entry[1]),
    "scalar": lambda reader, entry: reader.array(entry[1])[()],
    "tuple": lambda reader, entry: tuple(reader.parts(entry[1])),
    "set": lambda reader, entry: set(reader.parts(entry[1])),
    "deque": lambda reader, entry: deque(reader.parts(entry[1]), maxlen=entry[2]),
    "named": lambda reader, entry: _class(entry[1])(*reader.parts(entry[2])),
    "pose": lambda reader, entry: gtsam.Pose3(reader.array(entry[1])),
    "rotation": lambda reader, entry: gtsam.Rot3(reader.array(entry[1])),
}

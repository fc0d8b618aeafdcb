"""A table of rows with distinct integer keys, in ascending order of the keys."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.geometry import find_in_sorted
from loam_gtsam.types import BoolArray, IntArray

Columns = tuple[NDArray[Any], ...]

_WAITING = 0.1
"""New rows are merged with the others when they exceed this share of them."""


class KeyTable:
    """Rows in ascending order of their keys, at most one row a key.

    A merge takes time in proportion to all rows, so new rows wait until they are 10 % of them.

    Parameters
    ----------
    keys : (N,) ascending and distinct
    columns : (N, ...) each, what belongs to the keys; none for a plain set of keys
    """

    __slots__ = ("_merged", "_waiting")
    _merged: Columns
    _waiting: Columns

    def __init__(self, keys: IntArray, *columns: NDArray[Any]) -> None:
        self._put(keys, *columns)

    def _put(self, *rows: NDArray[Any]) -> None:
        self._set(rows, tuple(column[:0] for column in rows))

    def _set(self, merged: Columns, waiting: Columns) -> None:
        self._merged, self._waiting = merged, waiting

    def restorer(self) -> Callable[[], None]:
        """A function that brings the table back to what it is now: no array changes in place."""
        return partial(self._set, self._merged, self._waiting)

    def __len__(self) -> int:
        return len(self._merged[0]) + len(self._waiting[0])

    @property
    def n_waiting(self) -> int:
        """Rows that are not merged with the others yet."""
        return len(self._waiting[0])

    @property
    def columns(self) -> Columns:
        """Keys (N,) and columns (N, ...) of all rows; not copied if none is waiting."""
        return _joined(self._merged, self._waiting) if self.n_waiting else self._merged

    def holds(self, keys: IntArray) -> BoolArray:
        """(N,) which of the keys are in the table."""
        held = find_in_sorted(self._merged[0], keys)[1]
        if self.n_waiting:
            held |= find_in_sorted(self._waiting[0], keys)[1]
        return held

    def look_up(self, keys: IntArray, column: int, into: NDArray[Any]) -> None:
        """Write into (N, ...) what a column holds for those of the keys that are in the table."""
        for rows in (self._merged, self._waiting):  # joining them would take far longer
            at, present = find_in_sorted(rows[0], keys)
            into[present] = rows[column][at[present]]

    def add(self, keys: IntArray, *columns: NDArray[Any]) -> IntArray:
        """Add rows, of ascending distinct keys, whose keys the table does not hold yet.

        Returns (M,) indices of the rows that were added, ascending.
        """
        new = np.flatnonzero(~self.holds(keys))
        rows: Columns = (keys, *columns)
        if len(new) < len(keys):
            rows = tuple(column.take(new, axis=0) for column in rows)
        self.append(*rows)
        return new

    def append(self, *rows: NDArray[Any]) -> None:
        """Add rows none of whose keys the table holds; like :meth:`add`, without the search."""
        self._waiting = _joined(self._waiting, rows)
        if self.n_waiting > _WAITING * len(self._merged[0]):
            self.merge()

    def merge(self) -> None:
        """Put the new rows in their places among the others, for many calls of :attr:`columns`."""
        if self.n_waiting:
            self._put(*self.columns)


def _joined(held: Columns, new: Columns) -> Columns:
    """The rows of both, of which no key is in both."""
    if len(held[0]) == 0:
        return new
    keys = np.concatenate((held[0], new[0]))
    order = np.argsort(keys, kind="stable")  # merges two sorted runs; half of np.insert's time
    others = zip(held[1:], new[1:], strict=True)
    return (keys[order], *(np.concatenate(pair).take(order, axis=0) for pair in others))

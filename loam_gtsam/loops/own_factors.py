"""Checks of a user's own factors and variables before GTSAM sees them.

GTSAM ends the process, or leaves iSAM2 broken, on some of what is refused here.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.loops.keyframes import is_pose_key
from loam_gtsam.types import InputError

_UNDETERMINED = 1e-9
"""Smallest singular value of new variables, columns scaled to length one, that counts."""


def checked_factors(
    given: object, start: object, known: gtsam.Values
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Factors and the start values of their new variables, if they can be added to a graph.

    Parameters
    ----------
    given : a factor, or a graph of factors
    start : start values of the variables that are not known; None if there are none
    known : variables of the graph

    Raises
    ------
    InputError
        If something is of a wrong type or not finite, a key is unknown or taken, or the factors do
        not determine the new variables.
    """
    factors = gtsam.NonlinearFactorGraph()
    if isinstance(given, gtsam.NonlinearFactorGraph):
        factors.push_back(given)
    elif isinstance(given, gtsam.NonlinearFactor):
        factors.add(given)
    else:
        raise InputError(
            f"factor: expected a gtsam.NonlinearFactor or NonlinearFactorGraph, got "
            f"{type(given).__name__}"
        )
    if not isinstance(start, (gtsam.Values, type(None))):
        raise InputError(f"values: expected gtsam.Values or None, got {type(start).__name__}")
    new = gtsam.Values() if start is None else gtsam.Values(start)
    _check_values(new, known)
    keys = _check_keys(factors, new, known)
    values = gtsam.Values(known)
    values.insert(new)
    ordering = gtsam.Ordering()
    for key in [*new.keys(), *sorted(keys - set(new.keys()))]:
        ordering.push_back(key)
    try:
        error = factors.error(values)
        matrix, right = factors.linearize(values).jacobian(ordering)
    except (RuntimeError, ValueError, IndexError) as problem:
        raise InputError(f"factor: GTSAM cannot evaluate it: {problem}") from problem
    if not (np.isfinite(error) and np.isfinite(matrix).all() and np.isfinite(right).all()):
        raise InputError("factor: its error, Jacobian or noise is NaN or infinite")
    columns = matrix[:, : new.dim()]
    lengths = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(lengths > 0.0, lengths, 1.0)
    if new.size() and np.linalg.matrix_rank(scaled, tol=_UNDETERMINED) < new.dim():
        raise InputError(
            f"factor: does not determine the new variables {_names(new.keys())}; give the factors "
            "that do together in a NonlinearFactorGraph, or add a prior to it"
        )
    return factors, new


def value_at(values: gtsam.Values, key: int) -> Any:
    """The variable of a key, whatever its type.

    Raises
    ------
    InputError
        If there is none, or GTSAM cannot hand it to Python.
    """
    if not values.exists(key):
        raise InputError(f"key: expected one of a variable in the graph, got {_names([key])}")
    getters = sorted((name for name in dir(gtsam.Values) if name.startswith("at")), key=len)
    for name in ("atPose3", "atPoint3", *getters):
        try:
            return getattr(values, name)(key)
        except RuntimeError:
            continue
    raise InputError(f"variable {_names([key])}: GTSAM cannot hand its type to Python")


def _check_values(new: gtsam.Values, known: gtsam.Values) -> None:
    """Refuse start values that are not finite, or of keys that are taken."""
    for key in new.keys():  # noqa: SIM118 (no mapping)
        if is_pose_key(key):
            raise InputError(f"values: {_names([key])} is of a keyframe; use another letter than x")
        if known.exists(key):
            raise InputError(f"values: {_names([key])} is in the graph already")
    # No coordinate is its own difference from itself if it is NaN or infinite.
    if not np.isfinite(new.localCoordinates(new).vector()).all():
        raise InputError("values: expected finite numbers, got NaN or infinite ones")


def _check_keys(
    factors: gtsam.NonlinearFactorGraph, new: gtsam.Values, known: gtsam.Values
) -> set[int]:
    """The keys of factors, if each is known or new and each new one is used."""
    used: set[int] = set()
    for place in range(factors.size()):
        keys = factors.at(place).keys()
        if len(keys) == 0 or len(set(keys)) < len(keys):
            raise InputError(f"factor: expected different keys, one or more, got {_names(keys)}")
        used |= set(keys)
    unknown = sorted(key for key in used if not (known.exists(key) or new.exists(key)))
    if unknown:
        raise InputError(
            f"factor: no variable has the keys {_names(unknown)}; gtsam.symbol('x', i) is the "
            "pose of keyframe i, other variables need a start value in values"
        )
    unused = set(new.keys()) - used
    if unused or not used:
        raise InputError(f"values: no factor is on {_names(unused) or 'any variable'}")
    return used


def _names(keys: Iterable[int]) -> str:
    return ", ".join(gtsam.DefaultKeyFormatter(key) for key in keys)

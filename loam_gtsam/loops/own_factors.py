"""Factors and variables of a user's own in a pose graph, checked before GTSAM sees them.

GTSAM ends the process, or leaves iSAM2 broken, on some of what is refused here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from loam_gtsam.errors import own_code
from loam_gtsam.geometry import as_vector
from loam_gtsam.loops.incremental import IncrementalGraph
from loam_gtsam.loops.keyframes import Keyframe, is_pose_key, noise_model, numbered
from loam_gtsam.types import FloatArray, InputError

_UNDETERMINED = 1e-9  # least singular value that counts, columns of length one


class FactorGraph:
    """Poses of keyframes, in order of time, and variables of a user's own, and factors on them."""

    keyframes: list[Keyframe]
    _graph: IncrementalGraph

    def add_factor(
        self,
        factor: gtsam.NonlinearFactor | gtsam.NonlinearFactorGraph,
        values: gtsam.Values | None = None,
    ) -> None:
        """Add any factor of GTSAM on poses of keyframes and on variables of your own.

        The factor is believed: it is no loop closure that could be switched off. It may be a
        CustomFactor, best one of :func:`loam_gtsam.factors.checked_factor`. GTSAM cannot serialise
        a CustomFactor, so writing the graph to a file or to a checkpoint then raises OutputError.

        Parameters
        ----------
        factor : a factor, or several that are to be added together; ``gtsam.symbol("x", i)`` is the
            key of the pose ``map_T_lidar`` of keyframe ``i``
        values : start values of variables of your own (landmarks, biases, extrinsics) that are not
            in the graph yet, whose keys have another letter than ``x``

        Raises
        ------
        InputError
            If something is of a wrong type or not finite, a key is unknown or taken, or the new
            variables are not determined. The graph is then as it was before.
        """
        self._graph.add(*_checked(factor, values, self._graph.values))

    def add_position(self, index: int, position: FloatArray, covariance: FloatArray) -> None:
        """Add a measured position (3,) of a keyframe, as from GPS, metres, covariance (3, 3) m^2.

        Raises
        ------
        InputError
            If there is no such keyframe, or the covariance is not positive semi-definite.
        """
        where, noise = as_vector(position, "position"), noise_model(covariance, 3)
        self.add_factor(gtsam.GPSFactor(self._key(index), where, noise))

    def add_gravity(
        self, index: int, up_lidar: FloatArray, sigma: float, up_map: Sequence[float] = (0, 0, 1)
    ) -> None:
        """Add the direction of gravity at a keyframe: its roll and pitch, not its yaw.

        Parameters
        ----------
        up_lidar, up_map : (3,) the upward direction in the axes of lidar and map; any length
        sigma : standard deviation, rad

        Raises
        ------
        InputError
            If there is no such keyframe, or a direction has no length.
        """
        here, there = _direction("up_lidar", up_lidar), _direction("up_map", up_map)
        if not sigma > 0.0:
            raise InputError(f"sigma: expected rad above 0, got {sigma!r}")
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        self.add_factor(gtsam.AttitudeFactorPose3(self._key(index), there, noise, here))

    @property
    def has_own_factors(self) -> bool:
        """Whether there may be factors beside those of odometry and loop closures."""
        return self._graph.has_own_factors

    def own_code(self) -> AbstractContextManager[None]:
        """A block that evaluates factors of a user's own: what they raise is a PartError."""
        return own_code("graph", "factors" if self.has_own_factors else None)

    @property
    def own(self) -> Sequence[int]:
        """Which of the factors of the graph as it is saved :meth:`add_factor` added: positions."""
        return self._graph.own

    def pose(self, index: int) -> gtsam.Pose3:
        """``map_T_lidar`` of a keyframe."""
        return self._graph.values.atPose3(self._key(index))

    def covariance(self, index: int) -> FloatArray:
        """(6, 6) marginal covariance of a keyframe's pose in the map."""
        return self._graph.covariance(self._key(index))

    def relative(self, earlier: int, later: int) -> tuple[gtsam.Pose3, FloatArray]:
        """``earlier_T_later`` of two keyframes and its (6, 6) covariance."""
        first, second = self._key(earlier), self._key(later)
        if earlier == later:
            return gtsam.Pose3(), np.zeros((6, 6))
        return self._graph.relative(first, second)

    @property
    def values(self) -> gtsam.Values:
        """Estimates of all variables, a copy: poses of keyframes and variables of your own."""
        return gtsam.Values(self._graph.values)

    def estimate(self, key: int) -> Any:
        """Estimate of a variable of :meth:`add_factor`, in the type in which it was added.

        Raises
        ------
        InputError
            If there is no variable of that key, or GTSAM cannot hand it to Python.
        """
        values = self._graph.values
        if not values.exists(key):
            raise InputError(f"key: expected one of a variable in the graph, got {_names([key])}")
        getters = sorted((name for name in dir(gtsam.Values) if name.startswith("at")), key=len)
        for name in ("atPose3", "atPoint3", *getters):
            try:
                return getattr(values, name)(key)
            except RuntimeError:
                continue
        raise InputError(f"variable {_names([key])}: GTSAM cannot hand its type to Python")

    def estimate_covariance(self, key: int) -> FloatArray:
        """(d, d) marginal covariance of a variable of :meth:`add_factor`, in its tangent space."""
        self.estimate(key)
        return self._graph.covariance(key)

    def _key(self, index: int) -> int:
        return numbered(self.keyframes, index).key


def _checked(
    given: object, start: object, known: gtsam.Values
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """``factor`` and ``values`` of :meth:`FactorGraph.add_factor`, checked and copied."""
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


def _check_values(new: gtsam.Values, known: gtsam.Values) -> None:
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


def _direction(name: str, vector: ArrayLike) -> gtsam.Unit3:
    array = as_vector(vector, name)
    if not np.linalg.norm(array) > 0.0:
        raise InputError(f"{name}: expected a direction, got the zero vector")
    return gtsam.Unit3(array)


def _names(keys: Iterable[int]) -> str:
    return ", ".join(gtsam.DefaultKeyFormatter(key) for key in keys)

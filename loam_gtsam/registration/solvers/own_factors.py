"""A user's own factors on the pose of a sweep."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import gtsam
import numpy as np

from loam_gtsam.errors import PartError, check_kind, is_own, own_code
from loam_gtsam.factors import checked_factor
from loam_gtsam.registration.solvers.base import (
    POSE_KEY,
    Associate,
    MotionPrior,
    ScanSolver,
    Solution,
)
from loam_gtsam.types import FloatArray, InputError

_SUREST = 1e-8  # of a factor; a scan knows 1e-4 to 1e-3, and ten digits are left of that
LAST_KEY: int = gtsam.symbol("x", 1)
"""Key of the pose of the last sweep, for factors between the last sweep and the current one."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseContext:
    """The frame for which the mapper asks a user's own factors.

    Attributes
    ----------
    key : of the unknown pose ``map_T_lidar`` at the middle of the sweep
    middle_stamp, map_T_middle : nanoseconds, and the predicted pose; for a measurement of another
        moment, as the start of the sweep, ask for it at this one
    last : stamp, nanoseconds, and pose of the middle of the last sweep
    last_key : key of the pose in ``last``, for factors between the two sweeps; that pose does not
        change any more, and is as well known as the covariance of its scan says
    """

    key: int
    middle_stamp: int
    map_T_middle: gtsam.Pose3
    last: tuple[int, gtsam.Pose3]
    last_key: int = LAST_KEY

    @property
    def stamp(self) -> int:
        """Deprecated name of ``middle_stamp``."""
        _renamed("stamp", "middle_stamp")
        return self.middle_stamp

    @property
    def guess(self) -> gtsam.Pose3:
        """Deprecated name of ``map_T_middle``."""
        _renamed("guess", "map_T_middle")
        return self.map_T_middle


def _renamed(old: str, new: str) -> None:
    what = f"PoseContext.{old} is now {new}, and gone in 0.3"
    warnings.warn(what, DeprecationWarning, stacklevel=3)


ExtraFactors = Callable[[PoseContext], Iterable[gtsam.NonlinearFactor] | gtsam.NonlinearFactorGraph]
"""A function that returns or yields factors on ``context.key``, or on ``context.key`` and
``context.last_key``; the mapper calls the function once for every sweep that is solved."""


class OwnFactors(NamedTuple):
    """A user's factors for a frame, all turned into factors on the unknown pose alone."""

    alone: Sequence[gtsam.NonlinearFactor] = ()  # on that pose from the beginning
    since_last: Sequence[gtsam.NonlinearFactor] = ()  # between the last pose and that one


def own_factors(
    extra: ExtraFactors, context: PoseContext, error: FloatArray | None = None
) -> OwnFactors:
    """Ask for a user's factors.

    Parameters
    ----------
    extra : the user's
    context : of the frame
    error : (6, 6) covariance of the last pose in the map as the scans see it; None if it is not
        known, and taken to be exact

    Raises
    ------
    PartError
        If the callable raises.
    InputError
        If the callable returns anything but GTSAM factors on these keys, or one of them is not
        finite at the predicted pose; GTSAM's own errors name no cause.
    """
    with own_code("extra_factors", extra):
        given: object = extra(context)
        factors = _listed(given)
    if factors is None:
        raise InputError(
            "extra_factors: expected a list of factors, empty if there are none; got "
            f"{type(given).__name__}"
        )
    near = gtsam.Values()
    near.insert(context.key, context.map_T_middle)
    near.insert(context.last_key, context.last[1])
    alone: list[gtsam.NonlinearFactor] = []
    since_last: list[gtsam.NonlinearFactor] = []
    for factor in factors:
        keys = list(factor.keys()) if isinstance(factor, gtsam.NonlinearFactor) else []
        both = sorted(keys) == sorted([context.key, context.last_key])
        if keys != [context.key] and not both:
            raise InputError(
                "extra_factors: expected GTSAM factors on context.key, or on context.key and "
                f"context.last_key ({_names([context.key, context.last_key])}); got "
                f"{type(factor).__name__} on the keys {_names(keys)}"
            )
        with own_code("extra_factors", extra):
            check_finite(factor, near, "extra_factors")
            if both:
                since_last.append(_with_last_held(factor, context, error))
            else:
                alone.append(factor)
    return OwnFactors(alone, since_last)


def _listed(given: object) -> list[gtsam.NonlinearFactor] | None:
    """What a user gave as factors, of a graph as well; None if they are no several."""
    if isinstance(given, gtsam.NonlinearFactorGraph):
        return [given.at(place) for place in range(given.size())]
    return list(given) if isinstance(given, Iterable) else None


def _names(keys: Iterable[int]) -> str:
    return f"[{', '.join(map(gtsam.DefaultKeyFormatter, keys))}]"


def check_finite(factor: gtsam.NonlinearFactor, near: gtsam.Values, name: str) -> None:
    """InputError, in which the factor is one of ``name``, if it is not finite at ``near``.

    Or a constraint, or so sure that beside it all else is lost in rounding.
    """
    linear = factor.linearize(near)  # None if the factor does not act there
    if linear is None:
        return
    if isinstance(linear, gtsam.JacobianFactor) and linear.isConstrained():
        raise InputError(
            f"{name}: expected no constraint, got {type(factor).__name__} with a constrained noise "
            "model (sigma 0?); use a small sigma"
        )
    jacobian, error = linear.jacobian()
    if not np.isfinite(np.column_stack([jacobian, error])).all():
        raise InputError(
            f"{name}: expected factors that are finite at the predicted pose, got "
            f"{type(factor).__name__} with NaN in its error, Jacobian or noise (sigma 0?)"
        )
    if np.abs(jacobian).max(initial=0.0) > 1.0 / _SUREST:
        raise InputError(
            f"{name}: expected factors with standard deviations of {_SUREST:g} or more, got "
            f"{type(factor).__name__} with less; what is that sure needs no estimate"
        )


@contextmanager
def own_priors(
    priors: object, map_T_middle: gtsam.Pose3
) -> Iterator[Sequence[gtsam.NonlinearFactor]]:
    """A block in which factors that a user gave with a sweep are evaluated, under their name.

    It yields a list of them; ``map_T_middle`` is the predicted pose.

    Raises
    ------
    PartError
        What such a factor raises. Beside ``extra_factors`` or a solver of the user's own nobody
        can tell whose exception it was: then the error has the name of that part, and a note.
    InputError
        If they are anything but GTSAM factors on :data:`POSE_KEY`, or one of them is not finite at
        the predicted pose.
    """
    with own_code("priors", "given to register"):
        factors = _listed(priors)
    near = gtsam.Values()
    near.insert(POSE_KEY, map_T_middle)
    factor: Any
    for factor in [priors] if factors is None else factors:
        keys = list(factor.keys()) if isinstance(factor, gtsam.NonlinearFactor) else None
        if factors is None or keys != [POSE_KEY]:
            raise InputError(
                "priors: expected a list of GTSAM factors on POSE_KEY of "
                f"loam_gtsam.registration.solvers alone, got {type(factor).__name__}"
                + ("" if keys is None else f" on {_names(keys)}")
            )
        with own_code("priors", "given to register"):
            check_finite(factor, near, "priors")
    try:
        with own_code("priors", "given to register" if factors else None):
            yield factors or ()
    except PartError as error:
        if factors and error.part != "priors":
            error.add_note("or raised by one of the priors given to register")
        raise


@dataclass(frozen=True, slots=True, eq=False)
class NamedSolver(ScanSolver):
    """A solver, and factors, whose exceptions name the part of a user's own that raised them.

    ``factors`` is where a user's factors come from; None if there are none.
    """

    solver: ScanSolver
    factors: object

    def solve(
        self,
        associate: Associate,
        guess: gtsam.Pose3,
        priors: Sequence[gtsam.NonlinearFactor] = (),
        motion: MotionPrior | None = None,
    ) -> Solution:
        """See :meth:`ScanSolver.solve`."""
        own = is_own(self.solver)
        part, code = ("solver", self.solver) if own else ("extra_factors", self.factors)
        with own_code(part, code):
            found = self.solver.solve(associate, guess, priors, motion)
            check_kind(found, Solution, "what solve returns", "rematch makes one, see ScanSolver")
            return found

    def told(
        self, factors: Sequence[gtsam.NonlinearFactor], near: gtsam.Pose3
    ) -> MotionPrior | None:
        """See :meth:`MotionPrior.of_factors`."""
        with own_code("extra_factors", self.factors):
            return MotionPrior.of_factors(factors, near)


def _with_last_held(
    factor: gtsam.NonlinearFactor, context: PoseContext, error: FloatArray | None
) -> gtsam.NonlinearFactor:
    """The whitened factor, robust kernel included, with the last pose held at its value.

    Its noise is larger by the ``error`` (6, 6) of the last pose, as the factor sees that where the
    sweep is expected.
    """

    def whitened(pose: gtsam.Pose3) -> tuple[FloatArray, dict[int, FloatArray]]:
        both = gtsam.Values()
        both.insert(context.key, pose)
        both.insert(context.last_key, context.last[1])
        linear = factor.linearize(both)
        jacobian, right = linear.jacobian()
        parts = np.split(np.asarray(jacobian), 2, axis=1)
        return -np.asarray(right), dict(zip(linear.keys(), parts, strict=True))

    weight = np.eye(factor.dim())
    if error is not None:
        by_last = whitened(context.map_T_middle)[1][context.last_key]
        weight = np.linalg.inv(np.linalg.cholesky(weight + by_last @ error @ by_last.T))

    def held(values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        residual, jacobians = whitened(values.atPose3(POSE_KEY))
        return weight @ residual, [np.ascontiguousarray(weight @ jacobians[context.key])]

    return checked_factor(gtsam.noiseModel.Unit.Create(factor.dim()), [POSE_KEY], held)

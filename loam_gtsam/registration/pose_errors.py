"""How wrong a pose may be: covariances of poses in the map, and of the motion between two.

The inverse of the information takes every match as independent, its standard deviation as right,
the motion within a sweep as known and the map as exact. Here the residuals themselves tell the
scatter, matches close together count as one, and what a constant velocity misses and the drift of
the map are added. Equations: docs/maths/covariance.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from loam_gtsam.config import Config
from loam_gtsam.frontend.deskew import MovingSweep
from loam_gtsam.geometry import symmetric
from loam_gtsam.registration.scan_error import SeenGround, scan_error
from loam_gtsam.registration.solvers import Solution
from loam_gtsam.types import FloatArray, InputError, MapUpdate, SweepMotion, Uncertainty


def relative_covariance(earlier: MapUpdate, later: MapUpdate) -> FloatArray:
    """Covariance of ``earlier.map_T_lidar.between(later.map_T_lidar)``.

    What a factor between two poses needs: the own errors of both frames and what the map drifted
    between them. The drift before is common to both and cancels.

    Parameters
    ----------
    earlier, later : solved frames of one run

    Returns
    -------
    (6, 6)
        Tangent order of the package, perturbation on the right: along the axes of the later frame.

    Raises
    ------
    InputError
        If a frame was not solved, or they are not in the order of time.
    """
    parts = []
    for name, update in (("earlier", earlier), ("later", later)):
        if update.uncertainty is None:
            raise InputError(
                f"{name}: expected a frame that was solved, got one with status {update.status}; "
                "choose another one"
            )
        parts.append(update.uncertainty)
    if later.stamp <= earlier.stamp:
        raise InputError(
            f"later: expected a stamp after {earlier.stamp}, got {later.stamp}; swap the two"
        )
    first, second = parts
    to_later = later.map_T_lidar.between(earlier.map_T_lidar).AdjointMap()
    from_map = later.map_T_lidar.inverse().AdjointMap()
    covariance = second.own + to_later @ first.own @ to_later.T
    covariance += from_map @ (second.drift - first.drift) @ from_map.T
    if second.follows == earlier.stamp:
        common = second.shared @ to_later.T
        covariance -= common + common.T
    return symmetric(covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Middle:
    """A solved frame at the middle of its sweep.

    Attributes
    ----------
    covariance : (6, 6) of the scan's own error
    kept : (6,) share of it in the pose at the reference time
    to_reference : (6, 6) adjoint
    reference_stamp : nanoseconds
    """

    stamp: int
    map_T_lidar: gtsam.Pose3
    covariance: FloatArray
    kept: FloatArray
    to_reference: FloatArray
    reference_stamp: int


class PoseErrors:
    """Calibrates the covariances of a run, frame by frame.

    Parameters
    ----------
    config : ``covariance``, and what tells the weights of the matches and the gyro's noise
    """

    def __init__(self, config: Config) -> None:
        self.config = config.covariance
        graph = config.solver.method == "gtsam"
        self._kernel = config.solver.kernel
        self._kernel_width = config.solver.kernel_width if graph else np.inf
        # Rows of the classical solvers count as measured to 1 m; they have no priors to find.
        self._with_priors = graph
        self._gyro_noise = config.imu.gyro_noise
        self._seen = SeenGround(self.config.ground_cell)
        self._motion = _Acceleration(self.config.window)
        self._drift = np.zeros((6, 6))
        self._last: _Middle | None = None

    def calibrated(self, update: MapUpdate, sweep: MovingSweep, solution: Solution) -> MapUpdate:
        """The update of a solved frame with its covariance; to be called once for each, in order.

        Parameters
        ----------
        update : of the frame
        sweep : its features, with the motion of the solution
        solution : of the solve, at the middle of the sweep
        """
        first = self._seen.is_empty
        scan = scan_error(
            solution,
            self._kernel_width,
            self._seen,
            self.config,
            kernel=self._kernel,
            with_priors=self._with_priors,
        )
        if scan is None:
            self._last = None
            return update
        middle = solution.map_T_lidar
        to_reference = update.map_T_lidar.between(middle).AdjointMap()
        to_map = middle.AdjointMap()
        # At the first solve all ground is new, and none goes for it: half of what a change makes.
        factor = 0.5 * self.config.drift if first else self.config.drift
        self._drift = self._drift + to_map @ (factor * scan.renewed) @ to_map.T
        own, shared, now = self._own(update.stamp, sweep, middle, scan.covariance, to_reference)
        from_map = update.map_T_lidar.inverse().AdjointMap()
        by_scan = to_reference @ (np.eye(6) - scan.user) @ np.linalg.inv(to_reference)
        drifted = by_scan @ from_map
        uncertainty = Uncertainty(
            own=own,
            shared=shared,
            follows=None if self._last is None else self._last.reference_stamp,
            drift=self._drift,
            residual_variance=scan.residual_variance,
            effective_matches=scan.effective_matches,
        )
        self._last = now
        covariance = symmetric(own + drifted @ self._drift @ drifted.T)
        return replace(update, covariance=covariance, uncertainty=uncertainty)

    def cut(self) -> None:
        """The frames to come do not follow those before: their clock is another."""
        self._last = None

    def _own(
        self,
        reference_stamp: int,
        sweep: MovingSweep,
        middle: gtsam.Pose3,
        covariance: FloatArray,
        to_reference: FloatArray,
    ) -> tuple[FloatArray, FloatArray, _Middle]:
        """The frame's own error at the reference time, and what it shares with the last one's.

        The reference is reached from the middle by the velocity since the last middle, and so has
        a share in the errors of both.
        """
        last = self._last
        if last is not None and sweep.stamp <= last.stamp:  # sweeps of unlike length
            last = None
        seconds = np.inf if last is None else (sweep.stamp - last.stamp) * 1e-9
        share = np.full(6, sweep.middle / seconds)
        turned = sweep.motion in (SweepMotion.GYRO, SweepMotion.ORIENTATION)
        if turned:  # the rotation within the sweep is measured
            share[:3] = 0.0
        kept = 1.0 - share
        own = kept[:, None] * covariance * kept
        shared = np.zeros((6, 6))
        if last is not None:
            across = share[:, None] * middle.between(last.map_T_lidar).AdjointMap()
            own = own + across @ last.covariance @ across.T
            shared = to_reference @ across @ (last.covariance * last.kept) @ last.to_reference.T
            self._motion.add(last, sweep.stamp, middle, covariance)
        # Half the acceleration times this is the distance from a line through the last two middles
        # to the reference time, and from the middle to the mean over the sweep.
        bend = sweep.duration**2 / 24.0
        if np.isfinite(seconds):
            bend += 0.5 * sweep.middle * (seconds - sweep.middle)
        missed = bend**2 * self._motion.variances
        if turned:
            missed[:3] = 0.0
        if sweep.motion is SweepMotion.GYRO:
            missed[:3] = self._gyro_noise**2 * abs(sweep.middle)
        own = to_reference @ (own + np.diag(missed)) @ to_reference.T
        now = _Middle(sweep.stamp, middle, covariance, kept, to_reference, reference_stamp)
        return symmetric(own), shared, now


class _Acceleration:
    """Mean square of the body acceleration, from the poses at the middles of three sweeps."""

    def __init__(self, window: int) -> None:
        self._window = window
        self._count = 0
        self._mean = np.zeros(6)
        self._last: tuple[int, FloatArray] | None = None

    @property
    def variances(self) -> FloatArray:
        """(6,) (rad/s^2)^2 and (m/s^2)^2."""
        variances: FloatArray = np.maximum(self._mean, 0.0)
        return variances

    def add(
        self, last: _Middle, stamp: int, map_T_lidar: gtsam.Pose3, covariance: FloatArray
    ) -> None:
        """Account for the motion from one middle to the next."""
        seconds = (stamp - last.stamp) * 1e-9
        velocity = gtsam.Pose3.Logmap(last.map_T_lidar.between(map_T_lidar)) / seconds
        before, self._last = self._last, (stamp, velocity)
        if before is None or before[0] != last.stamp:
            return
        # Errors of three poses are in a second difference, with weights 1, -2, 1.
        noise = 6.0 * np.diag(covariance) / seconds**4
        self._count += 1
        gain = max(1.0 / self._count, 1.0 / self._window)
        squared = ((velocity - before[1]) / seconds) ** 2
        self._mean = self._mean + gain * (squared - noise - self._mean)

"""What the motion within a sweep misses."""

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from loam_gtsam.factors import MatchRows
from loam_gtsam.registration.solvers.scan_error import ScanError
from loam_gtsam.registration.solvers.sweep_velocity import ToldVelocity
from loam_gtsam.registration.uncertainty.missed_motion import (
    by_acceleration,
    by_jerk,
    unresolved,
)

SPAN = 0.1  # seconds of a sweep, and to the last one
EXPECTED = np.diag([1e3, 2e3, 3e3, 100.0, 200.0, 300.0])  # information of the expected velocity


def test_what_sways_between_sweeps_that_are_far_apart_may_do_so_within_one():
    assert unresolved(0.1, 0.1) == (0.1, 1.0)
    assert unresolved(0.05, 0.1) == (0.05, 1.0)  # sweeps that overlap
    assert unresolved(0.5, 0.0) == (0.5, 1.0)  # all points at one time
    assert unresolved(0.5, 0.1) == (0.1, pytest.approx(25.0))
    assert unresolved(0.0, 0.1) == (0.0, 1.0)  # the frame follows none


def turning_lidar(middle):
    """A sweep whose sides are seen at different times, and its error but for the noise."""
    rng = np.random.default_rng(0)
    azimuth = rng.uniform(-np.pi, np.pi, 4000)
    seconds = SPAN * azimuth / (2.0 * np.pi)
    radius = 5.0 + 3.0 * np.cos(azimuth - 1.0)
    points = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.0 * azimuth])
    points[:, 2] = rng.uniform(-1.5, 2.0, 4000)
    normals = rng.standard_normal((4000, 3)) * [0.3, 1.0, 2.0]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    offsets = -np.einsum("ij,ij->i", normals, points)
    rows = MatchRows(points, normals, offsets, np.full(4000, 20.0))
    jacobian = rows.residuals(gtsam.Pose3())[1]
    bread = np.linalg.inv(jacobian.T @ jacobian)
    ways = (
        bread @ (jacobian.T * by @ jacobian) for by in (seconds, seconds**2 / 2.0, seconds**3 / 6.0)
    )
    none = np.zeros((6, 6))
    told = ToldVelocity.of(rows, np.zeros(4000), seconds, gtsam.Pose3(), 0.0, SPAN, with_jerk=True)
    scan = ScanError(*[none] * 6, np.zeros(6), 1.0, 10.0, *ways, told=told)
    sweep = SimpleNamespace(middle=middle, duration=SPAN)
    return sweep, scan, jacobian, seconds


def solved(jacobian, seconds, middle, curve, at_reference):
    """(6, 6) by which the pose at the reference time is off, for motions of (R,) along each axis.

    Pose and velocity are solved together, on a parabola through the last middle.
    """
    along = seconds + seconds**2 / SPAN
    both = np.hstack([jacobian, jacobian * along[:, None]])
    information = both.T @ both
    information[6:, 6:] += EXPECTED
    found = np.linalg.solve(information, both.T @ (jacobian * curve[:, None]))
    return found[:6] + (middle**2 / SPAN - middle) * found[6:] - at_reference * np.eye(6)


@pytest.mark.parametrize("middle", [0.05, 0.0])
def test_a_jerk_moves_the_pose_as_a_solve_of_pose_and_velocity_has_it(middle):
    sweep, scan, jacobian, seconds = turning_lidar(middle)
    drawn = by_acceleration(sweep, SPAN, scan)
    found = by_jerk(sweep, SPAN, scan, drawn @ scan.told.bent(EXPECTED) * 2.0 / SPAN)
    curve = (seconds**3 + SPAN * seconds**2) / 6.0
    exact = solved(jacobian, seconds, middle, curve, (SPAN * middle**2 - middle**3) / 6.0)
    beside = ~np.eye(6, dtype=bool)
    scale = np.abs(exact[beside]).max()
    assert scale > SPAN**3 / 200.0
    np.testing.assert_allclose(found[beside], exact[beside], atol=0.1 * scale)
    # Along its own axis it counts by at least what the reference time makes of it.
    assert (np.diag(found) <= np.minimum(np.diag(exact), 0.0) + 0.1 * SPAN**3 / 48.0).all()

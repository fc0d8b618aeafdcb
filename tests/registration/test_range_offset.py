"""Ranges that are all too long by the same: seen in the residuals, told by the covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from support.cli import shown
from support.quick import begin_quickly
from support.solved import POSE, solved, surroundings
from support.walls import MAP, MIDDLE, face, matched

from loam_gtsam import Config, RunResult, SimulatedWorld, run
from loam_gtsam.cli.report import inspection
from loam_gtsam.config import CovarianceConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.datasets import ArrayDataset
from loam_gtsam.io.run_files import summarise
from loam_gtsam.registration.matches import PlaneMatches
from loam_gtsam.registration.solvers.scan_error import ScanError, scan_error
from loam_gtsam.registration.solvers.seen_ground import SeenGround
from loam_gtsam.registration.uncertainty.range_offset import RangeOffset
from loam_gtsam.studies.evaluation import nees
from loam_gtsam.types import FloatArray, MapUpdate, Scan

OFFSET = 0.03
ALONE = Config().changed("imu.coupling=off")


def farther(points: FloatArray, lidar: FloatArray, by: float) -> FloatArray:
    """Points (N, 3) where they seem to be if ranges are too long."""
    rays = points - lidar
    return points + by * rays / np.linalg.norm(rays, axis=1)[:, None]


# --- how much a match changes with it


def wall_matches(offset: float, seen_from: FloatArray, lidar: FloatArray) -> PlaneMatches:
    """Of the wall y = 0, mapped from one place and seen again from another."""
    planes = CubeMap(MAP, 0.05)
    planes.insert(farther(face(0.0), seen_from, offset), seen_from)
    found = matched(planes, farther(MIDDLE, lidar, offset), lidar).planes
    assert len(found) == len(MIDDLE)
    return found


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_distances_change_by_what_matches_say_per_metre(side: float) -> None:
    before, now = np.array([-6.0, 2.0 * side, 0.5]), np.array([1.0, 5.0 * side, 0.0])
    small = 1e-3
    with_it, without = (wall_matches(offset, before, now) for offset in (small, 0.0))
    assert without.by_range is not None
    changes = (with_it.distances - without.distances) / small
    np.testing.assert_allclose(without.by_range, changes, atol=0.02)
    assert np.abs(without.by_range).min() > 0.3


def test_a_wall_seen_from_the_same_place_says_nothing_of_it() -> None:
    here = np.array([1.0, 5.0, 0.0])
    by_range = wall_matches(OFFSET, here, here + np.array([0.01, 0.0, 0.0])).by_range
    assert by_range is not None
    assert not by_range.any()


# --- what a scan makes of it


def around(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points on walls around the lidar, their normals, and what their distances change by."""
    rng = np.random.default_rng(seed)
    points, normals, _ = surroundings(rng)
    return points, normals, rng.uniform(-0.5, 1.0, len(points))


def error_of(seed: int, errors: FloatArray, by_range: FloatArray, seen: SeenGround) -> ScanError:
    """Of the scan ``around`` of a seed, whose matches are off by errors, metres."""
    points, normals, _ = around(seed)
    solution, _ = solved(points, normals, errors, by_range=by_range)
    error = scan_error(solution, np.inf, seen, CovarianceConfig())
    assert error is not None
    return error


def test_a_scan_tells_the_offset_and_how_far_it_has_moved_the_pose() -> None:
    points, normals, by_range = around(1)
    errors = OFFSET * by_range
    step = solved(points, normals, errors)[1]
    error = error_of(1, errors, by_range, SeenGround())
    np.testing.assert_allclose(OFFSET * error.by_offset, step, rtol=1e-2, atol=1e-6)
    assert error.offset == pytest.approx(OFFSET, rel=1e-3)
    assert np.linalg.norm(step[3:]) > 1e-3
    rng, told = np.random.default_rng(0), []
    for _ in range(200):
        noise = rng.normal(0.0, 0.02, len(errors))
        error = error_of(1, errors + noise, by_range, SeenGround())
        told.append((error.offset, error.offset_information**-0.5))
    offsets, sigmas = np.array(told).T
    assert np.mean(offsets) == pytest.approx(OFFSET, abs=4.0 * offsets.std() / 200**0.5)
    assert 0.8 < np.mean(sigmas) / offsets.std() < 1.6


def test_a_scan_follows_what_it_is_matched_with() -> None:
    """What it has moved the pose by goes into the map, and from there into the next pose."""
    by_range, none = around(1)[2], np.zeros(1500)
    first = error_of(1, none, by_range, SeenGround())
    for before, expected in (([], np.zeros(6)), ([first.by_offset], first.by_offset)):
        seen = SeenGround()
        for moved in before:
            seen.add(POSE.AdjointMap() @ moved)
        for _ in range(2):  # what is matched again is where it was
            found = error_of(1, none, none, seen)
            np.testing.assert_allclose(found.by_offset, expected, rtol=1e-6, atol=1e-9)
            assert found.offset_information < 1e-6  # all is moved alike


def test_ground_seen_before_tells_nothing_new() -> None:
    errors = np.random.default_rng(3).normal(0.0, 0.02, 1500)
    seen, by_range = SeenGround(), around(2)[2]
    first, again = (error_of(2, errors, by_range, seen) for _ in range(2))
    assert first.offset_information > 1e3
    assert again.offset_information == pytest.approx(0.0, abs=1e-9)


# --- what a run makes of it


def told(offset: float, information: float) -> RangeOffset:
    ranges = RangeOffset(0.03, removed=0.01)
    nothing = np.zeros((6, 6))
    error = ScanError(*[nothing] * 6, np.zeros(6), 1.0, 1.0)
    ranges.add(replace(error, offset=offset, offset_information=information))
    return ranges


@pytest.mark.parametrize(
    ("offset", "information", "said"),
    [
        (0.03, 1e6, "3.0 cm too long (standard deviation 0.1 cm)"),
        (-0.05, 1e5, "4.9 cm too short (standard deviation 0.3 cm)"),
        (0.015, 1e8, ""),  # within what data sheets promise
        (0.03, 1e3, ""),  # may be chance
    ],
)
def test_only_a_large_and_sure_offset_is_a_problem(offset, information, said) -> None:
    problem = told(offset, information).problem
    assert bool(problem) == bool(said)
    assert said in problem
    advised = told(offset, information).advised
    assert (f"sensor.range_offset={advised:.3f}" in problem) == bool(said)
    expected = 0.01 + (offset if said else 0.0)
    assert advised == pytest.approx(expected, abs=1e-3)


def test_the_square_of_the_offset_is_that_of_mean_and_deviation() -> None:
    unknown = RangeOffset(0.03)
    assert (unknown.mean, unknown.sigma) == (0.0, pytest.approx(0.03))
    assert unknown.mean_square == pytest.approx(0.03**2)
    assert told(0.05, 1e9).mean_square == pytest.approx(0.05**2, rel=1e-3)
    assert told(0.05, 1e-9).mean_square == pytest.approx(0.03**2, rel=1e-3)


@pytest.fixture(scope="module")
def street() -> SimulatedWorld:
    return SimulatedWorld("street_loop", frames=45, columns=720)


@pytest.fixture(scope="module")
def clean(street: SimulatedWorld) -> RunResult:
    return run(street, ALONE)


@pytest.fixture(scope="module")
def too_long(street: SimulatedWorld) -> ArrayDataset:
    def spoilt(sweep: Scan) -> Scan:
        points = farther(sweep.points.astype(np.float64), np.zeros(3), OFFSET)
        return replace(sweep, points=points.astype(np.float32))

    return ArrayDataset([spoilt(s) for s in street], truth=street.truth, sensor=street.sensor)


@pytest.fixture(scope="module")
def mapped(too_long: ArrayDataset) -> RunResult:
    return run(too_long, ALONE)


def squared_error(street: SimulatedWorld, updates: Sequence[MapUpdate]) -> float:
    """Of the motion since the second frame, over its told covariance, in degrees of freedom."""
    assert street.truth is not None
    return nees(updates[1:], street.truth, window=len(updates) - 2).mean


def test_a_run_tells_the_offset_of_its_ranges(clean: RunResult, mapped: RunResult) -> None:
    for result, offset in ((clean, 0.0), (mapped, OFFSET)):
        ranges = result.range_offset
        assert ranges is not None
        assert ranges.mean == pytest.approx(offset, abs=0.007)
        assert bool(ranges.problem) == (offset > 0.0)
        assert (ranges.problem in result.notes) == (offset > 0.0)
        assert summarise(result)["ranges"] == ranges.as_dict()


def test_inspect_tells_it(too_long: ArrayDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    begin_quickly(monkeypatch)
    assert "problem: the ranges look" in shown(inspection(too_long, ALONE)[0])


def test_covariances_count_what_wrong_ranges_do(
    street: SimulatedWorld, mapped: RunResult, clean: RunResult
) -> None:
    unknown = [
        u
        if u.uncertainty is None
        else replace(u, uncertainty=replace(u.uncertainty, blind=np.zeros((6, 10))))
        for u in mapped.updates
    ]
    assert squared_error(street, unknown) > 2.5
    assert squared_error(street, mapped.updates) < 2.0
    # Right ranges make the covariance hardly larger.
    last = clean.updates[-1]
    assert last.uncertainty is not None
    blind = last.uncertainty.blind[3:, 9]
    assert np.linalg.norm(blind) ** 2 < 0.2 * np.trace(last.covariance[3:, 3:])


def test_ranges_are_made_right_by_the_configuration(
    clean: RunResult, too_long: ArrayDataset
) -> None:
    made_right = run(too_long, ALONE.changed(f"sensor.range_offset={OFFSET}"))
    assert made_right.range_offset is not None
    assert made_right.range_offset.problem == ""
    assert made_right.range_offset.advised == OFFSET
    for one, other in zip(clean.updates, made_right.updates, strict=True):
        np.testing.assert_allclose(one.map_T_lidar.matrix(), other.map_T_lidar.matrix(), atol=5e-3)

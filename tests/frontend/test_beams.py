"""Errors of single beams are taken from the points of a sweep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loam_gtsam import Config, SimulatedWorld, extract_features
from loam_gtsam.config import dump_config, load_config
from loam_gtsam.frontend.beams import Rays, elevations_of, errors_at, moved, without_beam_errors
from loam_gtsam.frontend.organise import organise
from loam_gtsam.types import ConfigError, FloatArray, Scan, SweepError

CONFIG = Config().changed("sensor.times=field")


def errors_of(rings: int, seed: int) -> FloatArray:
    """(R, 3) metres, rad and rad."""
    return np.random.default_rng(seed).normal(0.0, [0.02, 1e-3, 1e-3], (rings, 3))


def sweep_of_the_world() -> Scan:
    return next(iter(SimulatedWorld("room", frames=1, columns=300, dropout=0.0, range_noise=0.0)))


def as_rows(elevations: FloatArray, errors: FloatArray) -> list[tuple[float, ...]]:
    degrees = np.degrees(np.column_stack((elevations, errors[:, 1:])))
    table = np.column_stack((degrees[:, 0], errors[:, 0], degrees[:, 1:]))
    return [tuple(row) for row in table.tolist()]


def test_points_with_errors_of_their_beams_come_back() -> None:
    right = sweep_of_the_world()
    assert right.rings is not None
    errors = errors_of(16, 1)
    wrong = Scan(
        moved(right.points, errors[right.rings]), right.stamp, right.times, right.rings, right.span
    )
    as_measured = organise(wrong, CONFIG)
    elevations = elevations_of(as_measured.xyz, as_measured.ring_starts)
    rows = as_rows(elevations, errors[as_measured.ring_of_start])
    freed = extract_features(wrong, CONFIG.changed({"sensor.beams": rows}))
    exact = extract_features(right, CONFIG)
    np.testing.assert_allclose(
        np.sort(freed.planes, axis=0), np.sort(exact.planes, axis=0), atol=2e-4
    )


def test_a_ring_that_is_none_of_the_beams_stays_as_it_is() -> None:
    sweep = organise(sweep_of_the_world(), CONFIG)
    elevations = elevations_of(sweep.xyz, sweep.ring_starts)
    rows = as_rows(elevations, np.tile([0.05, 0.0, 0.0], (16, 1)))
    cut = sweep.ring_starts[8]
    changed = without_beam_errors(sweep, rows[:8]).xyz
    np.testing.assert_allclose(changed[:, cut:], sweep.xyz[:, cut:], atol=1e-5)
    nearer = np.linalg.norm(sweep.xyz[:, :cut], axis=0) - np.linalg.norm(changed[:, :cut], axis=0)
    np.testing.assert_allclose(nearer, 0.05, atol=1e-5)
    assert without_beam_errors(sweep, ()) is sweep


def test_errors_of_beams_are_for_elevations_within_half_way() -> None:
    rows = [(2.0, 0.02, 0.0, 0.1), (0.0, 0.01, -0.1, 0.0), (4.0, 0.03, 0.0, 0.0)]
    errors = errors_at(np.radians([-1.1, -0.9, 1.1, 4.0, 5.1]), rows)
    errors[:, 1:] = np.degrees(errors[:, 1:])
    none, first = (0.0, 0.0, 0.0), (0.01, -0.1, 0.0)
    expected = [none, first, (0.02, 0.0, 0.1), (0.03, 0.0, 0.0), none]
    np.testing.assert_allclose(errors, expected, atol=1e-12)
    assert not errors_at(np.zeros(3), ()).any()


def test_beams_need_rings() -> None:
    scan = sweep_of_the_world()
    config = CONFIG.changed({"sensor.rings": "none", "sensor.beams": [(0.0, 0.01, 0.0, 0.0)]})
    with pytest.raises(SweepError, match=r"sensor\.beams tells errors of 1 beams.*no rings"):
        extract_features(scan, config)


@pytest.mark.parametrize("rows", ["[[1.0, 2.0]]", "[1.0]", "3", "[[0, 0, 0, 400]]"])
def test_rows_of_beams_that_are_none_are_refused(rows: str) -> None:
    expected = "at most 360.0, got 400" if "400" in rows else "rows of 4 values, got"
    with pytest.raises(ConfigError, match=rf"sensor\.beams: expected {expected}"):
        Config().changed(f"sensor.beams={rows}")


def test_beams_go_through_a_file(tmp_path: Path) -> None:
    config = Config().changed("sensor.beams=[[-15, 0.01, 0.02, -0.03], [1.0, 0, 0, 0]]")
    (tmp_path / "config.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "config.yaml") == config


def test_rays_are_the_derivatives_of_points_by_errors() -> None:
    points = np.random.default_rng(3).normal(0.0, 10.0, (50, 3))
    small = 1e-6
    for kind, ray in enumerate(Rays.of(points)):
        step = np.zeros((50, 3))
        step[:, kind] = small
        change = (moved(points, step) - moved(points, -step)) / (2.0 * small)
        np.testing.assert_allclose(ray, change, atol=1e-6)

"""Beams that disagree are found by what the matches leave; without their errors maps are right."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loam_gtsam import Config, RunResult, SimulatedWorld, run
from loam_gtsam.datasets.sim.disturbances import Disturbance, Disturbed
from loam_gtsam.frontend.beams import moved
from loam_gtsam.registration.uncertainty.beam_errors import BeamErrors, independent
from loam_gtsam.studies.evaluation import absolute_error
from loam_gtsam.types import FloatArray, Scan

ALONE = Config().changed("imu.coupling=off")
WORLD = SimulatedWorld("garage", frames=70, columns=450, seed=1, start="moving")
KINDS = {"ranges": (0.015, 0.0, 0.0), "elevations": (0.0, 1.5e-3, 0.0), "none": (0.0, 0.0, 0.0)}

TURNED = [(float(degrees), 0.0, 0.0, 0.1) for degrees in range(-15, 17, 2)]
"""Azimuths of all beams, taken out of one of the runs; none can tell whether that is right."""


def made(kind: str) -> FloatArray:
    """(16, 3) errors of the beams, of each kind with the mean zero."""
    errors = np.random.default_rng(8).normal(size=(16, 3))
    return (errors - errors.mean(axis=0)) * KINDS[kind]


class OfBeams(Disturbance):
    """Every beam has errors of its own."""

    def __init__(self, kind: str) -> None:
        self._errors = made(kind)

    def apply(self, number: int, scan: Scan) -> Scan:
        """See :meth:`Disturbance.apply`."""
        assert scan.rings is not None
        points = moved(scan.points, self._errors[scan.rings])
        return replace(scan, points=np.where(np.isfinite(scan.points), points, np.nan))


@cache
def mapped(kind: str) -> RunResult:
    config = ALONE.changed({"sensor.beams": TURNED}) if kind == "elevations" else ALONE
    return run(Disturbed(WORLD, [OfBeams(kind)]), config)


def errors_of(result: RunResult) -> BeamErrors:
    assert result.pipeline is not None
    return result.pipeline.mapper.errors.beam_errors


def ate(result: RunResult) -> float:
    return absolute_error(result.trajectory, WORLD.truth).rmse


def test_beams_without_errors_are_not_spoken_of() -> None:
    found = errors_of(mapped("none"))
    assert found.believed == (False, False, False)
    assert found.problem == ""
    assert found.advised == ()
    assert np.abs(found.explained).max() < 0.01


@pytest.mark.parametrize(("number", "kind"), [(0, "ranges"), (1, "elevations")])
def test_errors_of_beams_are_found(number: int, kind: str) -> None:
    wrong = mapped(kind)
    found = errors_of(wrong)
    assert found.believed[number]
    assert kind in found.problem
    assert any("the beams of the lidar disagree" in note for note in wrong.notes)
    told = np.array(found.advised)[:, 1 + number]
    told = told if number == 0 else np.radians(told)
    if kind == "elevations":  # on top of what was taken out
        assert [row[3] for row in found.advised] == [0.1] * 16
    # Few matches tell of elevations above the horizon.
    assert np.corrcoef(told, made(kind)[:, number])[0, 1] > 0.5


def test_a_map_without_errors_of_beams_is_right() -> None:
    wrong = mapped("ranges")
    found = errors_of(wrong)
    config = ALONE.changed({"sensor.beams": found.advised})
    right = run(Disturbed(WORLD, [OfBeams("ranges")]), config)
    left = errors_of(right).explained[0]
    assert left < 0.4 * found.explained[0]  # the map has had a part of them
    assert ate(right) < ate(wrong)


@pytest.mark.parametrize("beams", [16, 64, 128])
def test_errors_that_change_evenly_with_the_elevation_are_not_those_of_beams(beams: int) -> None:
    rng = np.random.default_rng(beams)
    alone = [independent(rng.normal(size=(beams, 3))) for _ in range(200)]
    assert 0.96 < np.mean(alone) < 1.0
    even = np.cos(np.linspace(0.0, 6.0, beams)[:, None] + [0.0, 1.0, 2.0])
    assert not independent(even + 0.1 * rng.normal(size=(beams, 3))).any()


class Askew(Disturbance):
    """The lidar is mounted askew, and another part of its view is hidden in each sweep."""

    def apply(self, number: int, scan: Scan) -> Scan:
        """See :meth:`Disturbance.apply`."""
        hidden = (np.arctan2(scan.points[:, 1], scan.points[:, 0]) + number) % (2.0 * np.pi) < 3.0
        points = scan.points @ Rotation.from_euler("y", 12.0, degrees=True).as_matrix().T
        return replace(scan, points=np.where(hidden[:, None], np.nan, points))


def test_rings_whose_elevations_wander_are_not_those_of_beams() -> None:
    dense = SimulatedWorld("garage", frames=16, columns=300, seed=1, sensor="os1-64")
    found = errors_of(run(Disturbed(dense, [Askew()]), ALONE))
    assert found.believed == (False, False, False)
    assert len(found.as_dict()["advised"] or []) == 0

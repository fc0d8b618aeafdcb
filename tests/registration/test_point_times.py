"""Times of the points that do not fit the motion are found, and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cli import shown

from loam_gtsam import Config, RunResult, SimulatedWorld, run
from loam_gtsam.cli.report import inspection, summary
from loam_gtsam.datasets import ArrayDataset
from loam_gtsam.io.run_files import summarise
from loam_gtsam.types import Scan

ALONE = Config().changed("imu.coupling=off")


@pytest.fixture(scope="module")
def world() -> SimulatedWorld:
    return SimulatedWorld("garage", frames=30, columns=450, speed=5.0, seed=1)


@pytest.fixture(scope="module")
def sweeps(world) -> list[Scan]:
    return list(world)


def timed(sweeps: list[Scan], factor: float) -> list[Scan]:
    """As if the times were of another unit."""
    return [replace(sweep, times=factor * sweep.times) for sweep in sweeps]


def de_skewed(world: SimulatedWorld, sweeps: list[Scan]) -> list[Scan]:
    """The sweeps as if taken at once, their times still there."""
    done = []
    for sweep in sweeps:
        times, point_of = np.unique(sweep.times, return_inverse=True)
        stamps = sweep.stamp + np.concatenate([[0], np.round(times * 1e9)]).astype(np.int64)
        poses = world.truth_at(stamps).map_T_lidar
        moved = (np.linalg.inv(poses[0]) @ poses[1:])[point_of]
        points = np.einsum("nij,nj->ni", moved[:, :3, :3], sweep.points) + moved[:, :3, 3]
        done.append(replace(sweep, points=points))
    return done


def data_of(world: SimulatedWorld, sweeps: list[Scan]) -> ArrayDataset:
    return ArrayDataset(sweeps, truth=world.truth, sensor=world.sensor)


@pytest.fixture(scope="module")
def twice(world, sweeps) -> ArrayDataset:
    return data_of(world, de_skewed(world, sweeps))


@pytest.fixture(scope="module")
def mapped(twice) -> RunResult:
    return run(twice, ALONE)


@pytest.mark.parametrize("coupling", ["off", "tight"])
def test_right_times_are_right(world, sweeps, coupling) -> None:
    data = data_of(world, sweeps)
    data.imu = world.imu
    result = run(data, ALONE.changed({"imu.coupling": coupling}))
    share, deviations = result.pipeline.mapper.point_times.excess
    assert abs(share) < 0.03
    assert 0.0 < abs(deviations) < 5.0
    assert result.times_problem == ""
    assert summarise(result)["point_times"] is None


@pytest.mark.parametrize(("factor", "word"), [(2.0, "less"), (0.5, "more")])
def test_times_of_another_unit_are_found(world, sweeps, factor, word) -> None:
    result = run(data_of(world, timed(sweeps, factor)), ALONE)
    assert f"the points move {word} within the sweeps" in result.times_problem


def test_sweeps_that_were_de_skewed_are_found_and_every_frame_says_so(mapped) -> None:
    assert "de-skewed already (sensor.times=none)" in mapped.times_problem
    said = [update.message == mapped.times_problem for update in mapped.updates]
    assert said[-1]
    assert all(said[said.index(True) :])
    told = summarise(mapped)
    assert told["point_times"] == mapped.times_problem
    assert sum(mapped.times_problem in message for message in told["messages"]) == 1


def test_the_summary_and_inspect_say_so(mapped, twice) -> None:
    text = shown(summary(mapped, "garage", 1.0, {}))
    assert "DO NOT TRUST THIS RUN: the points move less" in text
    text = shown(inspection(twice, ALONE)[0])
    assert "problem: the sweeps are de-skewed already: they fit better with" in text


def test_inspect_tells_other_units_from_that(world, sweeps) -> None:
    text = shown(inspection(data_of(world, timed(sweeps, 2.0)), ALONE)[0])
    assert "problem: the points move less within the sweeps" in text
    text = shown(inspection(data_of(world, sweeps), ALONE)[0])
    assert "30 sweeps mapped" in text
    assert "problem" not in text


@pytest.mark.parametrize(
    "setting", ["sensor.times=none", "deskew.enabled=false", "deskew.model=predicted"]
)
def test_nothing_is_asked_where_nothing_is_de_skewed_anew(twice, setting) -> None:
    result = run(twice, ALONE.changed(setting))
    assert result.pipeline.mapper.point_times.excess == (0.0, 0.0)


def test_a_lidar_at_rest_tells_nothing_and_a_reset_forgets(world, sweeps, mapped) -> None:
    still = [replace(sweeps[0], stamp=sweep.stamp) for sweep in sweeps]
    assert run(data_of(world, still), ALONE).times_problem == ""
    pipeline = mapped.pipeline
    pipeline.reset()
    assert pipeline.mapper.point_times.problem == ""

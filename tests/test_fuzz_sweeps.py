"""Hostile sweeps, IMU data and configurations: a result or a LoamError, and the run goes on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.quick import PREDICTED, QUICK
from support.strategies import FEW, START, WILD, configs, generators, imu_streams, scans

from loam_gtsam.config import (
    Config,
    ImuConfig,
    config_from_dict,
    config_to_dict,
    dump_config,
    parse_config,
)
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.rings import rings_from_labels
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.pipeline import Pipeline
from loam_gtsam.registration.odometry import ConstantVelocity
from loam_gtsam.types import (
    BadSweep,
    Features,
    FeatureSweep,
    FrameStatus,
    ImuSamples,
    LoamError,
    MapUpdate,
    Scan,
)

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@FEW
@given(config=configs())
def test_every_valid_configuration_survives_yaml(config: Config) -> None:
    assert config_from_dict(config_to_dict(config)) == config
    assert parse_config(dump_config(config)) == config


# -- sweeps ----------------------------------------------------------------------------------------

WORLD = SimulatedWorld("room", frames=8, columns=240, sensor="vlp16")
SWEEPS = [WORLD[number] for number in range(8)]


def checked(update: MapUpdate) -> MapUpdate:
    assert np.isfinite(update.map_T_lidar.matrix()).all()
    assert np.isfinite(update.twist).all()
    return update


@given(sweep=scans())
def test_a_hostile_sweep_gives_features_or_a_sweep_error(sweep: Scan) -> None:
    try:
        features = extract_features(sweep, Config())
    except LoamError:
        return
    for column in (features.edges, features.planes, features.edge_times, features.plane_times):
        assert np.isfinite(column).all()


def wrong_by(pipeline: Pipeline, update: MapUpdate, number: int) -> float:
    """Metres from the truth."""
    truth = WORLD.truth.map_T_lidar
    where = np.linalg.inv(truth[0]) @ truth[number]
    return float(np.linalg.norm(update.map_T_lidar.translation() - where[:3, 3]))


@FEW
@given(data=st.data())
def test_hostile_sweeps_never_raise_and_the_next_good_one_is_fine(data: st.DataObject) -> None:
    pipeline = Pipeline(Config())
    begin = data.draw(st.sampled_from([0, 0, 1, 2]))
    for sweep in SWEEPS[:begin]:
        pipeline.process(sweep)
    for _ in range(data.draw(st.integers(1, 2))):
        checked(pipeline.process(data.draw(scans(near=SWEEPS[begin].stamp))))
    after = [checked(pipeline.process(sweep)) for sweep in SWEEPS[begin : begin + 4]]
    assert pipeline.mapper.map_points()[0].shape[1] == 3
    if begin == 2:
        assert after[-1].status.solved, after[-1]
        assert wrong_by(pipeline, after[-1], begin + 3) < 0.2


def test_one_stamp_in_the_far_future_costs_one_sweep() -> None:
    pipeline = Pipeline(QUICK)
    for sweep in SWEEPS[:3]:
        pipeline.process(sweep)
    lost = pipeline.process(replace(SWEEPS[3], stamp=2**61))
    assert lost.status is FrameStatus.BAD_STAMP
    assert "s after the last" in lost.message
    assert pipeline.process(SWEEPS[3]).status.solved
    assert pipeline.process(BadSweep(2**61, "damaged")).status is FrameStatus.BAD_STAMP
    assert pipeline.process(SWEEPS[4]).status.solved


def test_a_motion_is_not_extrapolated_for_ever() -> None:
    last = MapUpdate(START, gtsam.Pose3(), FrameStatus.OK, twist=np.array([0, 0, 0, 20.0, 0, 0]))
    guess = ConstantVelocity()
    for seconds, metres in ((9, 180.0), (10, 200.0), (300, 200.0)):
        pose = guess.at(START + seconds * 10**9, last).map_T_lidar
        assert pose.translation()[0] == pytest.approx(metres)


@pytest.mark.parametrize("metres", [1e6, np.inf, np.nan])
def test_a_guess_outside_the_grid_is_a_status_and_the_map_stays(metres: float) -> None:
    mapper = Pipeline(QUICK).mapper
    features = [extract_features(sweep, QUICK) for sweep in SWEEPS[:3]]
    mapper.register(features[0])
    before = mapper.map_points()[1]
    lost = mapper.register(features[1], gtsam.Pose3(gtsam.Rot3(), np.array([metres, 0.0, 0.0])))
    assert lost.status is FrameStatus.UNUSABLE_SCAN
    assert "position" in lost.message
    np.testing.assert_array_equal(mapper.map_points()[1], before)
    assert mapper.register(features[2]).status.solved


@pytest.mark.parametrize("metres", [400.0, -5000.0, 60_000.0])
def test_a_map_may_start_far_from_its_origin(metres: float) -> None:
    mapper = Pipeline(Config()).mapper
    start = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, metres]))
    for number, sweep in enumerate(SWEEPS[:3]):
        features = extract_features(sweep, Config())
        update = mapper.register(features, start if number == 0 else None)
        assert update.status.solved == (number > 0), update.message
    assert mapper.maps.edges.stats.outside == 0
    assert abs(mapper.map_points()[1][:, 2].mean() - metres) < 10.0


def test_a_first_guess_outside_the_grid_is_a_status_and_the_next_sweep_the_first() -> None:
    mapper = Pipeline(Config()).mapper
    features = [extract_features(sweep, Config()) for sweep in SWEEPS[:2]]
    nowhere = gtsam.Pose3(gtsam.Rot3(), np.array([4e6, 0.0, 0.0]))
    refused = mapper.register(features[0], nowhere)
    assert refused.status is FrameStatus.UNUSABLE_SCAN
    assert "start the map nearer" in refused.message
    assert mapper.register(features[1]).status is FrameStatus.FIRST


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e30])
def test_features_without_a_place_are_refused(value: float) -> None:
    points = np.ones((5, 3))
    points[2, 1] = value
    with pytest.raises(LoamError, match=r"planes: expected metres below .*, got 1 points of 5"):
        Features.from_points(START, np.ones((5, 3)), points)


@pytest.mark.parametrize("stamp", [2**62 + 1, -(2**62) - 1, 10**40])
def test_a_sweep_from_beyond_the_year_2116_is_refused(stamp: int) -> None:
    with pytest.raises(LoamError, match=r"Scan\.stamp: expected integer nanoseconds up to 2\^62"):
        Scan(points=np.zeros((0, 3)), stamp=stamp)
    assert Scan(points=np.zeros((0, 3)), stamp=2**62).stamp == 2**62


@pytest.mark.parametrize("span", [(-1e9, 1e9), (1.7e9, 1.7e9 + 0.1), (0.0, np.nan), (0.0, 3.0)])
def test_a_sweep_far_from_its_stamp_is_a_status(span: tuple[float, float]) -> None:
    pipeline = Pipeline(QUICK)
    pipeline.process(SWEEPS[0])
    update = pipeline.process(replace(SWEEPS[1], span=span))
    assert update.status is FrameStatus.UNUSABLE_SCAN
    assert "s from its stamp" in update.message
    assert pipeline.process(SWEEPS[2]).status.solved


@pytest.mark.parametrize("code", ["u1", "i1", "u2", "i4", "u4", "i8", "u8"])
def test_ring_numbers_may_start_anywhere_in_their_type(code: str) -> None:
    points = SWEEPS[0].points.T.astype(np.float32)
    usual = rings_from_labels(SWEEPS[0].rings, points)
    top = np.iinfo(code).max - 15
    for lowest in (np.iinfo(code).min, top):
        shifted = (SWEEPS[0].rings.astype(object) + int(lowest)).astype(code)
        np.testing.assert_array_equal(rings_from_labels(shifted, points).rings, usual.rings)


def test_a_point_at_the_origin_does_not_put_its_ring_last() -> None:
    rings = np.repeat([0, 1, 2], 4)
    points = np.zeros((3, 12), np.float32)
    points[0], points[2] = 1.0, rings - 1.0
    points[:, 0] = 0.0
    np.testing.assert_array_equal(rings_from_labels(rings, points).rings, rings)


def test_absurd_imu_values_are_left_out_and_quaternions_of_absurd_length_unknown() -> None:
    samples = ImuSamples(
        stamps=np.array([0, 1, 2, 3, 2**62 + 1]) * 1,
        orientation=np.array(
            [[0, 0, 0, 1.0], [0, 0, 0, 1e200], [0, 0, 0, 2.0]] + [[0, 0, 0, 1.0]] * 2
        ),
        gyro=np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [1e300, 0, 0], [0, 0, 0]], float),
        acceleration=np.tile([0.0, 0.0, 9.81], (5, 1)),
    )
    report = ImuBuffer(ImuConfig(), samples).report
    assert (report.samples, report.not_finite, report.no_orientation) == (3, 2, 1)


@FEW
@given(samples=imu_streams(start=SWEEPS[0].stamp), changes=st.sampled_from([
    ("imu.coupling=tight",), ("imu.prior=sigma", PREDICTED), ("imu.prior=blend", PREDICTED),
    ("imu.coupling=loose", PREDICTED),
]))  # fmt: skip
def test_a_hostile_imu_never_raises(samples: Any, changes: tuple[str, ...]) -> None:
    config = Config().changed(*changes)
    buffer = ImuBuffer(config.imu, samples)
    buffer.add(samples)
    assert buffer.report.samples <= len(samples.stamps)
    pipeline = Pipeline(config, imu=buffer)
    for sweep in SWEEPS[:3]:
        checked(pipeline.process(sweep))


@st.composite
def feature_sweeps(draw: st.DrawFn) -> FeatureSweep:
    """What another front end might hand over."""
    rng = draw(generators())
    parts = []
    for _ in range(2):
        points = rng.uniform(-9, 9, (draw(st.sampled_from([0, 1, 200])), 3))
        if draw(st.booleans()):
            points[rng.random(len(points)) < 0.1] = draw(st.sampled_from(WILD))
        parts.append(points)
    stamp = draw(st.integers(START, START + 10**9))
    pose = gtsam.Pose3(gtsam.Rot3(), np.array([draw(st.sampled_from([0.0, 1.0, 1e9, 1e300]))] * 3))
    return FeatureSweep(Features.from_points(stamp, *parts), pose)


@given(data=st.data())
def test_hostile_features_are_refused_or_never_raise(data: st.DataObject) -> None:
    pipeline = Pipeline(Config())
    for _ in range(3):
        try:
            sweep = data.draw(feature_sweeps())
        except LoamError:
            continue
        checked(pipeline.process(sweep))

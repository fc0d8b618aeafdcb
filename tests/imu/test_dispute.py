"""Scans that contradict gyro and accelerometer: one of the two is wrong, and nobody knows which."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from support.quick import QUICK

from loam_gtsam import (
    ArrayDataset,
    Checkpoint,
    FrameStatus,
    ImuSamples,
    RunResult,
    Scan,
    SimulatedWorld,
    run,
)
from loam_gtsam.imu.coupling import Dispute
from loam_gtsam.imu.preintegration_window import InertialState

AT_REST = SimulatedWorld("room", frames=45, columns=450, speed=0.01)
FELT, SECONDS = 0.8, 2.0  # m/s^2 along x from so many seconds on
WORDS = "tell another motion than the scans"


@cache
def sweeps() -> list[Scan]:
    return list(AT_REST)


@cache
def pushed(felt: float, turn: float = 0.0) -> RunResult:
    return run(rested_and_pushed(felt, turn), QUICK)


def rested_and_pushed(felt: float, turn: float = 0.0) -> ArrayDataset:
    """A lidar that sees no motion, while its IMU feels one: as on a ship, or among lorries."""
    imu = AT_REST.imu
    during = ((imu.stamps - AT_REST.stamps[0]) * 1e-9 > SECONDS)[:, None]
    gyro = imu.gyro + during * [0.0, 0.0, turn]
    samples = ImuSamples(imu.stamps, None, gyro, imu.acceleration + during * [felt, 0.0, 0.0])
    return ArrayDataset(sweeps(), imu=samples, sensor=AT_REST.sensor)


def sigma_x(result: RunResult, frame: int) -> float:
    return float(np.sqrt(result.updates[frame].covariance[3, 3]))


def test_a_lidar_that_sees_no_motion_but_feels_one_may_be_there_or_here():
    result = pushed(FELT)
    assert result.status_counts[FrameStatus.OK] == len(AT_REST) - 1
    assert sigma_x(result, 15) < 0.05
    for frame in (30, 44):
        way = 0.5 * FELT * (0.1 * frame + 0.05 - SECONDS) ** 2
        assert sigma_x(result, frame) == pytest.approx(way / np.sqrt(2.0), rel=0.25)
        assert WORDS in result.updates[frame].message
    # As far as the scans are concerned it has not moved, and the map is none the worse.
    assert np.abs(result.trajectory.positions).max() < 0.05
    assert result.imu is not None
    assert result.imu.disputed > 15
    assert any("as in a lift" in problem for problem in result.imu.problems)


@pytest.mark.parametrize("felt", [0.0, 0.02])
def test_an_imu_that_agrees_or_has_a_bias_is_not_disputed(felt):
    result = pushed(felt)
    assert result.imu is not None
    assert result.imu.disputed == 0
    assert sigma_x(result, 44) < 0.05
    assert not any(WORDS in update.message for update in result.updates)


def test_a_turn_that_the_scans_deny_is_for_the_gyro():
    result = pushed(0.0, turn=1.0)
    assert result.imu is not None
    assert result.imu.disputed == 0
    assert result.imu.gyro_left_out > 10


def state(stamp: int) -> InertialState:
    still = np.zeros(3)
    return InertialState(stamp, gtsam.Pose3(), still, still, still, still, np.eye(18))


def disputed(*agreements: bool) -> Dispute:
    dispute, contradictions = Dispute(), 0
    for number, agree in enumerate(agreements):
        contradictions = max(contradictions + (-1 if agree else 5), 0)
        dispute.compared(state(number), contradictions, agree=agree)
    return dispute


def test_only_an_imu_that_had_agreed_is_believed_as_much_as_the_scans():
    assert disputed(*[True] * 5, *[False] * 3).holds
    assert not disputed(*[True] * 4, *[False] * 9).holds
    assert not disputed(*[True] * 5, *[False] * 2).holds  # it is still used
    by_chance = disputed(*[True] * 5, False, *[True] * 5)
    assert by_chance.alone is None
    assert not by_chance.holds


def test_it_ends_when_both_agree_again_or_after_long():
    dispute = disputed(*[True] * 5, *[False] * 3)
    assert not dispute.ends(1e4)
    assert dispute.ends(1.0)
    dispute.alone = replace(dispute.alone, stamp=21 * 10**9)
    assert dispute.ends(1e4)
    dispute.settle()
    assert (dispute.holds, dispute.problem, dispute.frames) == (False, "", 1)


def test_a_dispute_goes_on_in_a_run_that_is_resumed(tmp_path):
    dataset, whole = rested_and_pushed(FELT), pushed(FELT)

    def stop(number: int, _: object) -> None:
        if number == 33:
            raise KeyboardInterrupt

    first = run(dataset, QUICK, on_frame=stop, checkpoint=Checkpoint(tmp_path))
    assert first.interrupted
    resumed = run(dataset, QUICK, checkpoint=Checkpoint(tmp_path, resume=True))
    for one, other in zip(whole.updates, resumed.updates, strict=True):
        assert np.array_equal(one.covariance, other.covariance, equal_nan=True)
        assert one.message == other.message

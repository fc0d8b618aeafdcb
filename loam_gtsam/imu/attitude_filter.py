"""Orientation for an IMU without its own: heading from the gyro, up from the accelerometer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from loam_gtsam.config import ImuConfig
from loam_gtsam.imu.at_rest import rest_at_start
from loam_gtsam.imu.quaternions import (
    exponential,
    from_rot3,
    levelling,
    quaternion_product,
    rotate,
    rotation_steps,
    running_filter,
    running_product,
)
from loam_gtsam.types import FloatArray, ImuSamples, IntArray

BLOCK = 512
"""Samples taken at once. Blocks begin at fixed places of the stream, so that the result does not
depend on how the samples came in."""


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """State of the gravity filter at one sample.

    Attributes
    ----------
    stamp : of the sample, nanoseconds
    rate, bias : (3,) of the gyro, rad/s; the rate includes the bias
    world_R_body : (4, 1) quaternion
    force : (3,) filtered acceleration in the world, m/s^2
    hold, since : stamps up to which the force stays, and from which on it has been averaged
    """

    stamp: int
    rate: FloatArray
    world_R_body: FloatArray
    force: FloatArray
    bias: FloatArray
    hold: int
    since: int


def filter_block(
    state: FilterState,
    stamps: IntArray,
    gyro: FloatArray,
    acceleration: FloatArray,
    seconds: float,
    max_step: float,
) -> tuple[FloatArray, FilterState]:
    """Orientation of the samples behind a state: heading and fast motion from the gyro.

    The gyro is integrated; accelerations turned into that slowly drifting frame are averaged by a
    first-order filter; the frame is then turned the shortest way so that the average points up.
    Returns ``world_R_body``, (4, N) quaternions, and the state at the last sample.

    Parameters
    ----------
    state : at the sample before
    stamps : (N,) nanoseconds, ascending
    gyro, acceleration : (3, N) rad/s and m/s^2
    seconds : time constant. Until so much time has passed since ``state.since``, or since a gap
        longer than this, the filter is a plain average.
    max_step : seconds; over a longer gap the rates count for so long only
    """
    steps = np.diff(stamps, prepend=state.stamp).astype(np.float64) * 1e-9
    lost = steps > seconds
    steps = np.minimum(steps, max_step)
    rates = np.column_stack([state.rate, gyro]) - state.bias[:, None]
    turns = rotation_steps(np.concatenate([[0.0], np.cumsum(steps)]), rates)
    drifting = quaternion_product(state.world_R_body, running_product(exponential(turns)))
    since = np.maximum.accumulate(np.where(lost, stamps, state.since))
    age = (stamps - since).astype(np.float64) * 1e-9
    # An age below one step, as right after such a gap, makes the share 1: nothing older counts.
    share = steps / np.maximum(np.minimum(age, seconds), np.maximum(steps, 1e-9))
    share[stamps <= state.hold] = 0.0
    force = running_filter(1.0 - share, share * rotate(drifting, acceleration), state.force)
    world_R_drifting = levelling(force)
    world_R_body = quaternion_product(world_R_drifting, drifting)
    world_R_body /= np.sqrt((world_R_body * world_R_body).sum(axis=0))
    last = replace(
        state,
        stamp=int(stamps[-1]),
        rate=gyro[:, -1],
        world_R_body=world_R_body[:, -1:],
        force=rotate(world_R_drifting[:, -1:], force[:, -1:])[:, 0],
        since=int(since[-1]),
    )
    return world_R_body, last


class GravityFilter:
    """Gravity filter over a stream that grows at its end, by :func:`filter_block`.

    The filter starts from the rest at the start of the stream if there is one: the mean rate of the
    rest is the bias of the gyro, its mean acceleration counts as if seen for a whole time constant.
    Else the bias is zero, and the mean acceleration of the first ``still_seconds`` is a weak start.
    The heading starts at zero.
    """

    def __init__(self, config: ImuConfig) -> None:
        self._config = config
        # States before each block, and the number of samples that are filtered.
        self._states: list[FilterState] = []
        self._done = self._start_end = 0
        self._start_dropped = False
        self._room = np.zeros((0, 4))

    def changed_from(self, index: int, stamp: int) -> None:
        """The samples from ``index`` on, the earliest of them at ``stamp``, are new ones."""
        del self._states[index // BLOCK + 1 :]
        begin = self._states[0].stamp if self._start_dropped and self._states else self._start_end
        if stamp <= begin:
            # The rest at the start may be another one, or the clock was set back.
            self._states.clear()
            self._start_dropped = False

    def drop(self, count: int) -> None:
        """The first ``count`` samples, whole blocks that are done, are held no longer."""
        del self._states[: count // BLOCK]
        self._done -= count
        self._room = self._room[count:].copy()
        self._start_dropped = True

    def orientations(self, samples: ImuSamples) -> FloatArray | None:
        """(N, 4) quaternions x y z w of ``world_R_lidar`` of all samples, at least one, in order.

        None if the acceleration at the start is not gravity. A view, valid until the next call;
        samples filtered before cost no time.
        """
        stamps, gyro, acceleration = samples.stamps, samples.gyro, samples.acceleration
        count = len(stamps)
        if not self._states:
            start = None if self._start_dropped else self._start(samples)
            if start is None:
                return None
            self._states.append(start)
            self._done = 0
        if count > len(self._room):
            self._room = np.concatenate([self._room, np.zeros((2 * count - len(self._room), 4))])
        while self._done < count:
            begin = (len(self._states) - 1) * BLOCK
            end = min(begin + BLOCK, count)
            block = stamps[begin:end], gyro[begin:end].T, acceleration[begin:end].T
            limits = self._config.filter_seconds, self._config.max_gap
            quaternions, state = filter_block(self._states[-1], *block, *limits)
            self._room[begin:end] = quaternions.T
            self._done = end
            if end - begin == BLOCK:
                self._states.append(state)
        return self._room[:count]

    def _start(self, samples: ImuSamples) -> FilterState | None:
        """The state before the first sample; None if the acceleration is not gravity."""
        config, stamps, gyro = self._config, samples.stamps, samples.gyro
        self._start_end = int(stamps[0]) + round(config.still_seconds * 1e9)
        rest = rest_at_start(config, samples)
        if rest is not None:
            bias, force, hold = rest.gyro, rest.acceleration, rest.last
            learnt = config.filter_seconds
        else:
            part = slice(0, int(np.searchsorted(stamps, self._start_end, side="right")))
            steps = rotation_steps((stamps[part] - stamps[0]) * 1e-9, gyro[part].T)
            turned = np.column_stack([[0.0, 0.0, 0.0, 1.0], running_product(exponential(steps))])
            force = rotate(turned, samples.acceleration[part].T).mean(axis=1)
            bias, hold, learnt = np.zeros(3), int(stamps[part][-1]), config.still_seconds
        weight = float(np.linalg.norm(force))
        if not 0.5 * config.gravity < weight < 1.5 * config.gravity:
            return None
        roll = np.arctan2(force[1], force[2])
        pitch = np.arctan2(-force[0], np.hypot(force[1], force[2]))
        world_R_body = from_rot3(gtsam.Rot3.RzRyRx(roll, pitch, 0.0))
        up, since = np.array([0.0, 0.0, weight]), hold - round(learnt * 1e9)
        return FilterState(int(stamps[0]), gyro[0].copy(), world_R_body, up, bias, hold, since)

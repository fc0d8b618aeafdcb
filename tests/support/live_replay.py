"""Recorded messages for live runs: made from a scene, written into a bag, handed over again."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from support.bags import cloud, store_of, write_bag
from support.bags import imu as imu_sample

from loam_gtsam.datasets.bags.bag_reader import Message, read_messages
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.ros.live import LiveMapper, LiveResult

POINTS, IMU = "/points", "/imu"
MS = 1_000_000


class Clock:
    """Nanoseconds that pass only when a test says so."""

    def __init__(self, now: int = 0) -> None:
        self.now = now

    def __call__(self) -> int:
        return self.now


def recorded(
    world: SimulatedWorld, kind: str = "ros1", *, imu: bool = True, unknown: bool = False
) -> list[Message]:
    """A sweep is received 20 ms after its end, a sample 3 ms after its moment."""
    store = store_of(kind)
    messages = []
    for scan in world:
        columns = {"ring": scan.rings.astype("u2"), "time": scan.times.astype("f4")}
        received = scan.stamp + round(float(scan.times.max()) * 1e9) + 20 * MS
        message = cloud(store, scan.stamp, scan.points, **columns)
        messages.append(Message(POINTS, received, message))
    samples = world.imu if imu else None
    if samples is not None:
        rows = np.hstack([samples.orientation, samples.gyro, samples.acceleration])
        for stamp, row in zip(samples.stamps.tolist(), rows, strict=True):
            message = imu_sample(store, stamp, row, unknown=unknown)
            messages.append(Message(IMU, stamp + 3 * MS, message))
    return sorted(messages, key=lambda message: message.received)


def bag_of(path: Path, messages: Iterable[Message], kind: str = "ros1") -> Path:
    return write_bag(path, kind, [(m.topic, m.received, m.content) for m in messages])


def messages_of(bag: Path) -> list[Message]:
    return [m for m in read_messages(bag, [POINTS, IMU], []) if isinstance(m, Message)]


def hand_over(live: LiveMapper, message: Message) -> None:
    if message.topic == IMU:
        live.add_imu(message.content)
    elif message.topic == POINTS:
        live.add_cloud(message.content, message.received)
    else:
        live.add_features(message.topic, message.content, message.received)


def replay(live: LiveMapper, clock: Clock, messages: Iterable[Message]) -> list[LiveResult]:
    """Hand over every message at the time it was received; what ``observe`` adds to the clock is
    the time that a sweep takes. In the end, wait for what may wait.
    """
    coming = deque(sorted(messages, key=lambda message: message.received))
    results: list[LiveResult] = []
    patience = 2
    while patience:
        while coming and coming[0].received <= clock.now:
            hand_over(live, coming.popleft())
        result = live.step()
        if result is not None:
            results.append(result)
        elif coming:
            clock.now = coming[0].received
        else:
            clock.now += 10_000 * MS
            patience -= 1
    return results

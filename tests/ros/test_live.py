"""A live run computes what a run of the bag does, waits as told, and counts what it drops."""

from __future__ import annotations

import gc
import math
import sys
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import gtsam
import numpy as np
import pytest
from support.bags import ROS1, START, cloud, imu, loam_recording, write_bag
from support.live_replay import (
    IMU,
    MS,
    POINTS,
    Clock,
    bag_of,
    hand_over,
    messages_of,
    recorded,
    replay,
)
from support.quick import QUICK

from loam_gtsam.config import (
    Config,
    DeskewConfig,
    ImuConfig,
    LiveConfig,
    OdometryConfig,
    PoseGraphConfig,
    preset,
)
from loam_gtsam.datasets import open_dataset
from loam_gtsam.datasets.bags.bag_reader import Message
from loam_gtsam.datasets.decode.loam_messages import CLOUD, REQUIRED
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.loops.keyframes import LoopClosure
from loam_gtsam.pipeline import Pipeline, RunResult, effective_config, imu_buffer, run
from loam_gtsam.registration.odometry import make_odometry
from loam_gtsam.registration.solvers import POSE_KEY, make_solver
from loam_gtsam.ros.live import LiveMapper, LiveResult
from loam_gtsam.ros.live_inputs import LiveImu
from loam_gtsam.ros.live_report import OTHER_REASONS, LiveLog
from loam_gtsam.types import ConfigError, FrameStatus, InputError, MapUpdate, PartError, SweepFault

FRAMES = 11
SHORT = 6


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world = SimulatedWorld("shaken", frames=FRAMES, columns=240)
    return bag_of(tmp_path_factory.mktemp("live") / "shaken", recorded(world))


@pytest.fixture(scope="module")
def offline(bag: Path) -> RunResult:
    return run(open_dataset(bag), QUICK)


def poses(updates: Any) -> np.ndarray:
    return np.array([update.map_T_lidar.matrix() for update in updates])


def assert_the_same(live: LiveMapper, results: list[LiveResult], offline: RunResult) -> None:
    """To the last bit, times apart."""
    updates = [result.update for result in results]
    assert [u.status for u in updates] == [u.status for u in offline.updates]
    assert [u.stamp for u in updates] == [u.stamp for u in offline.updates]
    np.testing.assert_array_equal(poses(updates), poses(offline.updates))
    for name in ("information", "covariance", "twist"):
        np.testing.assert_array_equal(
            [getattr(u, name) for u in updates], [getattr(u, name) for u in offline.updates]
        )
    result = live.pipeline.result(updates)
    np.testing.assert_array_equal(result.edge_points, offline.edge_points)
    np.testing.assert_array_equal(result.plane_points, offline.plane_points)
    assert result.map_stats == offline.map_stats
    np.testing.assert_array_equal(result.trajectory.map_T_lidar, offline.trajectory.map_T_lidar)


def lived(messages: list[Message], **options: Any) -> tuple[LiveMapper, list[LiveResult]]:
    """A live run of messages, each handed over when it was received."""
    clock = Clock()
    live = LiveMapper(**({"imu": True} | options), clock=clock)
    return live, replay(live, clock, messages)


def late(messages: list[Message], topic: str, delay: int) -> list[Message]:
    return [replace(m, received=m.received + delay) if m.topic == topic else m for m in messages]


def with_seconds(message: Any, seconds: float) -> Any:
    """The message with other seconds in its stamp."""
    stamp = replace(message.header.stamp, sec=seconds)
    return replace(message, header=replace(message.header, stamp=stamp))


def ahead(message: Message) -> Message:
    """The message with a stamp of an hour later."""
    seconds = message.content.header.stamp.sec + 3600
    return replace(message, content=with_seconds(message.content, seconds))


def shaken_up(messages: list[Message]) -> list[Message]:
    """Each topic keeps its order, but is received up to 150 ms later than it was."""
    rng = np.random.default_rng(0)
    newest: dict[str, int] = {}
    moved = []
    for message in messages:
        received = message.received + int(rng.integers(0, 150 * MS))
        newest[message.topic] = received = max(received, newest.get(message.topic, 0))
        moved.append(replace(message, received=received))
    return moved


@pytest.mark.parametrize(
    "interleaved",
    [
        lambda messages: messages,
        lambda messages: late(messages, IMU, 150 * MS),
        lambda messages: late(messages, IMU, -10_000 * MS),
        lambda messages: [replace(m, received=m.received // 20) for m in messages],
        shaken_up,
    ],
    ids=["as recorded", "imu late", "imu first", "twenty times as fast", "jitter"],
)
def test_a_live_run_is_that_of_the_bag_however_the_messages_come(
    bag: Path, offline: RunResult, interleaved: Any
) -> None:
    live, results = lived(interleaved(messages_of(bag)), config=QUICK)
    assert_the_same(live, results, offline)
    assert repr(results[-1]).startswith(f"LiveResult({results[-1].update}, ")
    report = live.report()
    assert report.statuses == {"first": 1, "ok": FRAMES - 1}
    assert report.received == {"imu": len(messages_of(bag)) - FRAMES, "cloud": FRAMES}
    assert not any([*report.dropped.values(), *report.late.values(), *report.faults.values()])
    assert report.without_imu == report.waiting == 0


def test_it_is_the_same_from_several_threads(bag: Path, offline: RunResult) -> None:
    config = QUICK.changed(live=LiveConfig(when_full="never", imu_wait=60.0))
    updates: list[MapUpdate] = []
    live = LiveMapper(config, imu=True, observe=lambda sweep, update, _: updates.append(update))
    stop = threading.Event()
    messages = messages_of(bag)
    threads = [threading.Thread(target=live.work, args=(stop,))] + [
        threading.Thread(
            target=lambda topic=topic: [hand_over(live, m) for m in messages if m.topic == topic]
        )
        for topic in (IMU, POINTS)
    ]
    for thread in threads:
        thread.start()
    patience = time.monotonic() + 60.0
    while len(updates) < FRAMES and time.monotonic() < patience:
        live.report()  # must not get into the way
        time.sleep(0.001)
    stop.set()
    for thread in threads:
        thread.join(60.0)
    np.testing.assert_array_equal(poses(updates), poses(offline.updates))
    assert live.report().received == {"imu": len(messages) - FRAMES, "cloud": FRAMES}


def test_no_message_is_lost_between_threads(bag: Path) -> None:
    sample = next(m for m in messages_of(bag) if m.topic == IMU)
    live = LiveMapper(Config(live=LiveConfig(queue=5)), imu=True)
    sweep, each = thin(0), 2000

    def produce() -> None:
        for _ in range(each):
            live.add_imu(sample.content)
            live.add_cloud(sweep)

    threads = [threading.Thread(target=produce) for _ in range(4)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
    finally:
        sys.setswitchinterval(interval)
    report = live.report()
    assert report.received == {"imu": 4 * each, "cloud": 4 * each}
    assert report.dropped == {"imu": 0, "sweep": 4 * each - 5}
    assert report.waiting == report.deepest == 5


def test_units_of_g_and_missing_orientations_are_read_as_those_of_a_bag(tmp_path: Path) -> None:
    messages = recorded(SimulatedWorld("shaken", frames=4, columns=240))
    for message in messages:
        if message.topic == IMU:
            a, q = message.content.linear_acceleration, message.content.orientation
            a.x, a.y, a.z = a.x / 9.80665, a.y / 9.80665, a.z / 9.80665
            q.x = q.y = q.z = q.w = 0.1  # with a covariance that does not say so
    path = bag_of(tmp_path / "bag", messages)
    live, results = lived(messages_of(path), config=QUICK)
    assert_the_same(live, results, run(open_dataset(path), QUICK))
    aid = live.pipeline.mapper.imu
    assert aid is not None
    assert aid.level is not None
    assert "gravity_filter" in aid.buffer.report.orientation


def test_messages_of_rclpy_are_read_as_those_of_rosbags(bag: Path, offline: RunResult) -> None:
    messages = messages_of(bag)
    for number, message in enumerate(messages):
        if message.topic == POINTS:  # rclpy hands bytes out as array.array
            content = replace(message.content, data=array("B", message.content.data.tobytes()))
            messages[number] = replace(message, content=content)
    assert_the_same(*lived(messages, config=QUICK), offline)


class OneLoop:
    """A user's loop closer, which remembers how many keyframes it saw."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.seen = 0

    def detect(self, keyframe: Any, history: Any) -> LoopClosure | None:
        self.seen += 1
        if self.seen != 4:
            return None
        motion = history.relative(0, 3)[0].compose(gtsam.Pose3(gtsam.Rot3(), np.full(3, 0.02)))
        return LoopClosure(0, 3, motion, np.eye(6) * 1e-6)


def near_the_start(_: Any) -> list[gtsam.NonlinearFactor]:
    """A user's own factors."""
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    return [gtsam.PriorFactorPose3(POSE_KEY, gtsam.Pose3(), noise)]


AT_THE_END = DeskewConfig(model="predicted", rotation="orientation", reference="end")
PARTS: dict[str, tuple[Config, Any]] = {
    "loops": (
        QUICK.changed(pose_graph=PoseGraphConfig(keyframe_distance=1e-4, max_chi2=1e9)),
        lambda: {"loop_closer": OneLoop()},
    ),
    "tight": (
        Config(imu=ImuConfig(lidar_R_imu_deg=(1.0, -2.0, 3.0))),
        dict,
    ),
    "de-skew by orientation": (
        Config(deskew=AT_THE_END, imu=ImuConfig(average_seconds=0.0)),
        dict,
    ),
    "longer averages": (
        QUICK.changed(imu=ImuConfig(average_seconds=0.2, still_seconds=0.3)),
        dict,
    ),
    "own factors": (QUICK, lambda: {"extra_factors": near_the_start}),
    "own solver": (QUICK, lambda: {"solver": make_solver(preset("aloam").solver)}),
    "own odometry": (
        QUICK,
        lambda: {"odometry": make_odometry(OdometryConfig(method="scan_to_scan"))},
    ),
}


@pytest.fixture(scope="module")
def short_bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Of an IMU that tells its orientation, and of one that does not."""
    world = SimulatedWorld("shaken", frames=SHORT, columns=240)
    recordings = [recorded(world, "mcap", unknown=unknown) for unknown in (False, True)]
    folder = tmp_path_factory.mktemp
    return [bag_of(folder("short") / "bag", messages, "mcap") for messages in recordings]


@pytest.fixture(scope="module")
def plain(short_bags: list[Path]) -> Callable[[bool, Any], RunResult]:
    """Runs of these bags without any part, by the model of the de-skew."""

    @cache
    def run_of(unknown: bool, model: Any) -> RunResult:
        return run(open_dataset(short_bags[unknown]), Config(deskew=DeskewConfig(model=model)))

    return run_of


# One half of the parts with an IMU that tells its orientation, the other half with one without.
@pytest.mark.parametrize(
    ("unknown", "name"), [(number % 2 == 1, name) for number, name in enumerate(PARTS)]
)
def test_with_every_part_a_live_run_is_that_of_the_bag_and_again_after_a_reset(
    short_bags: list[Path], plain: Callable[[bool, Any], RunResult], unknown: bool, name: str
) -> None:
    config, parts = PARTS[name]
    short_bag, without = short_bags[unknown], plain(unknown, config.deskew.model)
    dataset = open_dataset(short_bag)
    pipeline = Pipeline(config, imu=imu_buffer(dataset, config), **parts())
    expected = pipeline.result([pipeline.process(sweep) for sweep in dataset])
    assert expected.loops or (poses(expected.updates) != poses(without.updates)).any()
    clock = Clock()
    live = LiveMapper(config, imu=True, clock=clock, **parts())
    assert_the_same(live, replay(live, clock, messages_of(short_bag)), expected)
    live.reset()
    assert_the_same(live, replay(live, clock, messages_of(short_bag)), expected)
    report = live.report()
    assert (report.statuses["first"], sum(report.statuses.values())) == (2, 2 * SHORT)
    assert report.late == {"imu": 0}
    assert report.without_imu == 0


def test_a_run_goes_on_after_the_clock_was_set_back_if_it_is_reset(bag: Path) -> None:
    def observe(sweep: Any, update: MapUpdate, pipeline: Pipeline) -> None:
        if update.fault is SweepFault.CLOCK_SET_BACK:
            live.reset()

    clock = Clock()
    live = LiveMapper(QUICK, imu=True, clock=clock, observe=observe)
    messages = messages_of(bag)
    later = [replace(m, received=m.received + 3600 * 1000 * MS) for m in messages]
    results = replay(live, clock, [*map(ahead, messages), *later])
    statuses = [str(result.update.status) for result in results]
    assert statuses[FRAMES:] == ["bad_stamp"] * 5 + ["first"] + ["ok"] * (FRAMES - 6)


def test_sweeps_from_the_future_cost_the_next_ones_no_samples(tmp_path: Path) -> None:
    messages = recorded(SimulatedWorld("shaken", frames=28, columns=90))
    for number in [n for n, m in enumerate(messages) if m.topic == POINTS][22:25]:
        messages[number] = ahead(messages[number])
    path = bag_of(tmp_path / "bag", messages)
    live, results = lived(messages_of(path), config=QUICK)
    assert_the_same(live, results, run(open_dataset(path), QUICK))
    assert live.report().statuses["bad_stamp"] == 3


def bytes_of(root: object) -> int:
    """What an object and all that it refers to take."""
    seen, todo, total = set(), [root], 0
    while todo:
        item = todo.pop()
        if id(item) not in seen and not isinstance(item, type | ModuleType):
            seen.add(id(item))
            total += sys.getsizeof(item)
            todo += gc.get_referents(item)
    return total


def test_a_run_of_twice_as_many_sweeps_keeps_no_more() -> None:
    clock = Clock(START)
    live = LiveMapper(imu=True, clock=clock)
    sample, sizes = np.eye(10)[3], []
    for number in range(2400):
        for part in range(2):
            live.add_imu(imu(ROS1, START + (100 * number + 50 * part) * MS, sample))
        live.add_cloud(thin(number))
        clock.now += 100 * MS
        while live.step() is not None:
            clock.now += number % 7
        if number % 1200 == 1199:
            sizes.append(bytes_of([live._log, live._imu, live._queue, live.pipeline]))
    assert sum(live.report().statuses.values()) > 2380
    assert sizes[1] < 1.01 * sizes[0]


def test_a_sweep_waits_for_its_samples_and_no_longer(bag: Path) -> None:
    messages = messages_of(bag)
    sweeps = [m for m in messages if m.topic == POINTS]
    clock = Clock(sweeps[0].received)
    live = LiveMapper(Config(live=LiveConfig(imu_wait=0.3)), imu=True, clock=clock)
    hand_over(live, sweeps[0])
    assert live.step() is None
    clock.now += 300 * MS + 500 * MS - 1  # still_seconds more, for the level
    assert live.step() is None
    clock.now += 1
    assert live.step() is not None
    assert live.report().without_imu == 1
    # After the first sweep nothing waits for the level, though there is none.
    clock.now = sweeps[1].received
    hand_over(live, sweeps[1])
    assert live.step() is None
    clock.now += 300 * MS
    assert live.step() is not None
    # The third has its samples, all but the last of them.
    end = sweeps[2].received - 20 * MS
    clock.now = sweeps[2].received
    hand_over(live, sweeps[2])
    samples = [m for m in messages if m.topic == IMU]
    for message in samples:
        if message.received - 3 * MS < end:
            hand_over(live, message)
    assert live.step() is None
    hand_over(live, next(m for m in samples if m.received - 3 * MS >= end))
    result = live.step()
    assert result is not None
    assert result.received == result.started
    assert live.report().without_imu == 2
    # Those of the times of the first two sweeps came after them.
    late = live.report().late["imu"]
    assert late == sum(m.received - 3 * MS <= sweeps[1].received - 20 * MS for m in samples)


def test_what_waits_in_the_end_counts_and_is_mapped(bag: Path) -> None:
    messages = messages_of(bag)
    sweeps = [m for m in messages if m.topic == POINTS][:2]
    live = LiveMapper(QUICK, imu=True, clock=Clock())
    for message in sweeps:
        hand_over(live, message)
    assert live.step() is None
    assert live.report().waiting == 2
    assert [result.update.status for result in live.finish()] == ["first", "ok"]
    assert (live.report().waiting, live.report().without_imu) == (0, 2)
    assert live.finish() == []


def test_a_sweep_at_which_a_part_raises_is_tried_again(bag: Path) -> None:
    calls: list[None] = []

    def once(_: Any) -> list[gtsam.NonlinearFactor]:
        calls.append(None)
        if len(calls) == 1:
            raise ValueError("not yet")
        return []

    live = LiveMapper(QUICK, extra_factors=once, clock=Clock())
    for message in [m for m in messages_of(bag) if m.topic == POINTS][:2]:
        hand_over(live, message)
    assert live.step() is not None
    with pytest.raises(PartError, match="not yet"):
        live.step()
    assert live.report().waiting == 1
    assert [result.update.status for result in live.finish()] == ["ok"]


def test_sweeps_wait_for_samples_by_the_clock_that_is_put_right() -> None:
    imu = LiveImu(ImuConfig(time_offset=-0.05), None)
    imu.add((1000 * MS, np.zeros(10)))
    assert imu.covers(950 * MS)
    assert not imu.covers(951 * MS)
    imu.hand_over(imu.take(), 950 * MS)
    imu.hand_over([(1000 * MS, np.zeros(10)), (1001 * MS, np.zeros(10))], 960 * MS)
    assert imu.late == 1


def test_impatience_is_counted_and_changes_the_result(bag: Path, offline: RunResult) -> None:
    hasty = QUICK.changed(live=LiveConfig(imu_wait=0.0))
    live, results = lived(late(messages_of(bag), IMU, 500 * MS), config=hasty)
    assert live.report().without_imu > FRAMES // 2
    assert live.report().late["imu"] > 0
    assert (poses(r.update for r in results) != poses(offline.updates)).any()


def test_without_an_imu_nothing_waits(bag: Path) -> None:
    first = next(m for m in messages_of(bag) if m.topic == POINTS)
    for live in (LiveMapper(), LiveMapper(Config(imu=ImuConfig(coupling="off")), imu=True)):
        for message in messages_of(bag)[:20]:
            if message.topic == IMU:
                hand_over(live, message)
        hand_over(live, first)
        assert live.step() is not None
        assert "imu" not in live.report().received


def test_one_sample_from_the_future_opens_no_gate(bag: Path) -> None:
    messages = messages_of(bag)
    samples = [m for m in messages if m.topic == IMU]
    live = LiveMapper(imu=True, clock=Clock())
    hand_over(live, next(m for m in messages if m.topic == POINTS))
    wild = replace(samples[0], content=imu(ROS1, START + 10**15, np.eye(10)[3]))
    for message in (wild, samples[0]):
        hand_over(live, message)
    assert live.step() is None


def thin(number: int) -> Any:
    """A sweep that is mapped in no time: nothing can be made of it."""
    return cloud(ROS1, START + number * 100 * MS, np.zeros((0, 3)))


@pytest.mark.parametrize(
    ("when_full", "left", "dropped", "deepest"),
    [
        ("drop_oldest", [6, 7, 8, 9], 6, 4),
        ("keep_newest", [8, 9], 8, 4),
        ("never", list(range(10)), 0, 10),
    ],
)
def test_what_makes_room_in_a_full_queue(
    when_full: Any, left: list[int], dropped: int, deepest: int
) -> None:
    live = LiveMapper(Config(live=LiveConfig(queue=4, when_full=when_full)))
    for number in range(10):
        live.add_cloud(thin(number))
    report = live.report()
    assert report.dropped.get("sweep", 0) == dropped
    assert (report.waiting, report.deepest) == (len(left), deepest)
    stamps = [result.update.stamp for result in iter(live.step, None)]
    assert stamps == [START + number * 100 * MS for number in left]
    assert live.report().waiting == 0


@pytest.mark.parametrize("cost", [60, 130, 270])
@pytest.mark.parametrize("queue", [1, 3])
def test_drops_and_latencies_are_exact(cost: int, queue: int) -> None:
    count = 40
    jitter = np.random.default_rng(cost).integers(0, 90, count)
    received = [START + (100 * n + int(jitter[n])) * MS for n in range(count)]
    messages = [Message(POINTS, received[n], thin(n)) for n in range(count)]
    clock = Clock()

    def observe(*_: Any) -> None:
        clock.now += cost * MS

    live = LiveMapper(Config(live=LiveConfig(queue=queue)), observe=observe, clock=clock)
    results = replay(live, clock, messages)

    # The same by hand: who waits, who is dropped, when each is begun.
    waiting: deque[int] = deque()
    begun, dropped, free, n = [], 0, 0, 0
    while n < count or waiting:
        if not waiting:
            free = max(free, received[n])
        while n < count and received[n] <= free:
            if len(waiting) == queue:
                waiting.popleft()
                dropped += 1
            waiting.append(n)
            n += 1
        begun.append((waiting.popleft(), free))
        free += cost * MS

    assert [(r.update.stamp - START) // (100 * MS) for r in results] == [who for who, _ in begun]
    assert [r.started for r in results] == [when for _, when in begun]
    report = live.report()
    assert report.dropped.get("sweep", 0) == dropped
    assert (dropped > 0) == (cost > 100)
    assert sum(report.statuses.values()) + dropped == count
    waits = sorted((when - received[who]) * 1e-9 for who, when in begun)
    rank = math.ceil(0.95 * len(waits)) - 1
    assert report.latency["waiting"].p95 == waits[rank]
    assert report.latency["waiting"].worst == waits[-1]
    assert report.latency["mapping"].worst == 0.0
    assert report.latency["publishing"].median == pytest.approx(cost * 1e-3)
    assert report.latency["total"].worst == pytest.approx(waits[-1] + cost * 1e-3)


def test_samples_that_find_no_room_are_counted(bag: Path) -> None:
    samples = [m for m in messages_of(bag) if m.topic == IMU]
    live = LiveMapper(Config(live=LiveConfig(imu_queue=30)), imu=True)
    for message in samples:
        hand_over(live, message)
    assert live.report().dropped == {"imu": len(samples) - 30}


def without(name: str) -> Any:
    return lambda m: replace(m, fields=[f for f in m.fields if f.name != name])


def stamped(seconds: float) -> Any:
    return lambda m: with_seconds(m, seconds)


def accelerated(x: float) -> Any:
    return lambda m: replace(m, linear_acceleration=replace(m.linear_acceleration, x=x))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda m: None, "header.stamp"),
        (lambda m: object(), "header.stamp"),
        (stamped(math.nan), "NaN"),
        (stamped(-5), "expected 0 to 2"),
        (stamped(2**40), "expected 0 to 2"),
        (without("y"), "no field y"),
        (lambda m: replace(m, data=m.data[:1000]), "damaged"),
        (lambda m: replace(m, point_step=0), "point_step"),
        (lambda m: replace(m, fields=None), "expected a PointCloud2 message"),
        (lambda m: replace(m, width="wide"), "expected a PointCloud2 message"),
        (lambda m: replace(m, width=0, row_step=0, data=m.data[:0]), "sweep of 0 points"),
        (lambda m: replace(m, data=np.full_like(m.data, 255)), "0 finite"),
    ],
)
def test_a_faulty_cloud_is_counted_with_its_reason_and_the_run_goes_on(
    bag: Path, spoil: Any, reason: str
) -> None:
    sweeps = [m for m in messages_of(bag) if m.topic == POINTS][:3]
    spoilt = replace(sweeps[1], content=spoil(sweeps[1].content))
    live, results = lived([sweeps[0], spoilt, sweeps[2]], imu=False, config=QUICK)
    statuses = [result.update.status for result in results]
    assert statuses[0] is FrameStatus.FIRST
    assert statuses[1] is FrameStatus.UNUSABLE_SCAN
    assert statuses[2].solved
    faults = live.report().faults
    assert list(faults.values()) == [1]
    assert reason in next(iter(faults))
    # Its stamp is that of its message, or the receive time says which it may be.
    assert results[1].update.stamp == pytest.approx(START + 100 * MS, abs=1 * MS)


def test_damage_in_a_bag_has_the_same_effect_live(bag: Path, tmp_path: Path) -> None:
    messages = messages_of(bag)
    for sweep in [m for m in messages if m.topic == POINTS][8:10]:
        cut = replace(sweep.content, data=sweep.content.data[:1000])
        messages[messages.index(sweep)] = replace(sweep, content=cut)
    path = bag_of(tmp_path / "damaged", messages)
    live, results = lived(late(messages_of(path), IMU, 150 * MS), config=QUICK)
    assert_the_same(live, results, run(open_dataset(path), QUICK))
    assert live.report().statuses["unusable_scan"] == 2


def test_faults_before_the_first_good_cloud_leave_no_frame(bag: Path) -> None:
    first = next(m for m in messages_of(bag) if m.topic == POINTS)
    live = LiveMapper()
    live.add_cloud(None)
    live.add_cloud(None)
    hand_over(live, first)
    result = live.step()
    assert result is not None
    assert result.update.status is FrameStatus.FIRST
    assert sum(live.report().faults.values()) == 2


def test_sweeps_out_of_order_are_counted_and_skipped(bag: Path) -> None:
    sweeps = [m for m in messages_of(bag) if m.topic == POINTS]
    live = LiveMapper(QUICK)
    for number in (0, 1, 3, 2, 3, 4):
        hand_over(live, sweeps[number])
    statuses = [result.update.status for result in iter(live.step, None)]
    bad = [status is FrameStatus.BAD_STAMP for status in statuses]
    assert bad == [False, False, False, True, True, False]
    assert live.report().late == {"sweep": 2}
    assert live.report().statuses["bad_stamp"] == 2


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda m: None, "header.stamp"),
        (lambda m: replace(m, angular_velocity=None), "expected an Imu message"),
        (lambda m: replace(m, orientation_covariance=[]), "expected an Imu message"),
        (stamped(math.nan), "NaN"),
        (stamped(-1), "expected 0 to 2"),
        (accelerated(math.inf), "NaN or infinity"),
    ],
)
def test_faulty_samples_are_counted_and_left_out(bag: Path, spoil: Any, reason: str) -> None:
    samples = [m for m in messages_of(bag) if m.topic == IMU]
    live = LiveMapper(imu=True)
    live.add_imu(spoil(samples[0].content))
    live.add_imu(samples[1].content)
    assert [reason in fault for fault in live.report().faults] == [True]
    assert live.report().received == {"imu": 2}


def test_faulty_samples_that_are_no_messages_are_counted_alike() -> None:
    samples = SimulatedWorld("room", frames=1, columns=90).imu
    assert samples is not None
    gyro, acceleration, stamps = (
        part.copy() for part in (samples.gyro, samples.acceleration, samples.stamps)
    )
    gyro[3, 1], acceleration[5, 2], stamps[0] = math.nan, math.inf, -1
    live = LiveMapper(imu=True)
    live.add_imu(replace(samples, gyro=gyro, acceleration=acceleration, stamps=stamps))
    wrong = "imu: stamp of -1 ns: expected 0 to 2^31 s"
    assert live.report().faults == {"imu: NaN or infinity": 2, wrong: 1}
    assert live.report().received == {"imu": len(stamps)}


def test_reasons_stay_few_however_many_there_are() -> None:
    log = LiveLog()
    for number in range(100):
        log.fault(f"needs {number} bytes")
    faults = log.report(0, {}).faults
    assert len(faults) == 31
    assert faults[OTHER_REASONS] == 70
    log.fault("needs 3 bytes")
    assert log.report(0, {}).faults["needs 3 bytes"] == 2
    log = LiveLog()
    log.fault("no number: " + 10_000 * "9")
    assert [len(reason) for reason in log.faults] == [300]


def replayed_topics(
    recording: Any, topics: tuple[str, ...] = (*REQUIRED, CLOUD), **options: Any
) -> tuple[LiveMapper, list[LiveResult]]:
    messages = [Message(*entry) for entry in recording if entry[0] in topics]
    return lived(messages, imu=False, features=topics, **options)


@pytest.mark.parametrize(("loam_axes", "config"), [(False, Config()), (True, QUICK)])
def test_a_live_run_of_loam_topics_is_that_of_the_bag(
    tmp_path: Path, loam_axes: bool, config: Config
) -> None:
    recording = loam_recording(loam_axes=loam_axes)
    offline = run(open_dataset(write_bag(tmp_path / "topics", "ros1", recording)), config)
    delays = {CLOUD: 250 * MS, REQUIRED[0]: 80 * MS}
    delayed = [(topic, at + delays.get(topic, 0), message) for topic, at, message in recording]
    for received in (recording, delayed):
        live, results = replayed_topics(received, config=config)
        assert_the_same(live, results, offline)
        assert not any(live.report().unmatched.values())
    assert results[0].received == START + 250 * MS


@pytest.mark.parametrize(("offset", "matched"), [(5, True), (-5, True), (6, False), (-6, False)])
def test_messages_make_a_sweep_if_their_stamps_agree_to_5_ms(offset: int, matched: bool) -> None:
    recording = loam_recording(count=4, offsets={REQUIRED[1]: offset * MS})
    _, results = replayed_topics(recording, config=QUICK)
    assert len(results) == (4 if matched else 0)


def test_messages_without_partners_are_counted_by_topic() -> None:
    recording = loam_recording(count=6)
    gone = [n for n, entry in enumerate(recording) if entry[0] == REQUIRED[2]][2]
    others = [e for n, e in enumerate(recording) if n != gone]
    live, results = replayed_topics(others, config=QUICK)
    assert len(results) == 5
    expected = dict.fromkeys((*REQUIRED, CLOUD), 1) | {REQUIRED[2]: 0}
    assert live.report().unmatched == expected


def test_faulty_features_are_counted_and_the_run_goes_on() -> None:
    recording = loam_recording(count=4)
    spoilt = [n for n, entry in enumerate(recording) if entry[0] == REQUIRED[0]]
    recording[spoilt[1]] = (*recording[spoilt[1]][:2], None)
    place = recording[spoilt[2]]
    recording[spoilt[2]] = (*place[:2], without("x")(place[2]))
    live, results = replayed_topics(recording, config=QUICK)
    assert len(results) == 3
    assert results[1].update.status is FrameStatus.UNUSABLE_SCAN
    without_stamp, without_field = live.report().faults
    assert "header.stamp" in without_stamp
    assert "no field x" in without_field


def test_axes_that_cannot_be_told_yet_are_told_by_a_later_sweep() -> None:
    topics = REQUIRED
    recording = loam_recording(count=3)
    empty = next(n for n, entry in enumerate(recording) if entry[0] == REQUIRED[1])
    recording[empty] = (*recording[empty][:2], cloud(ROS1, START, np.zeros((0, 3))))
    live, results = replayed_topics(recording, topics)
    statuses = [result.update.status for result in results]
    assert statuses[:2] == [FrameStatus.UNUSABLE_SCAN, FrameStatus.FIRST]
    assert "cannot tell the axes" in next(iter(live.report().faults))
    live, results = replayed_topics(recording, topics, axes="lidar")
    assert results[0].update.status is not FrameStatus.UNUSABLE_SCAN


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"features": REQUIRED[:2]}, "expected /laser_odom_to_init among them"),
        ({"axes": "camera"}, "one of auto, lidar, loam"),
    ],
)
def test_options_that_contradict_each_other_are_errors(options: Any, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        LiveMapper(**options)


@pytest.mark.parametrize(
    "options", [{"imu": ImuConfig()}, {"features": extract_features}], ids=["imu", "features"]
)
def test_options_of_a_wrong_kind_are_named(options: Any) -> None:
    with pytest.raises(InputError, match=f"{next(iter(options))}: expected a "):
        LiveMapper(**options)


def test_sweeps_and_samples_need_no_messages() -> None:
    world = SimulatedWorld("room", frames=3, columns=300)
    expected = run(world, QUICK)
    hurried = count(0, 10**10).__next__  # nothing waits for samples that never come
    live = LiveMapper(effective_config(QUICK, world), imu=True, clock=hurried)
    live.add_imu(world.imu)
    updates = []
    for scan in world:
        buffer = deepcopy(scan)
        live.add_scan(buffer)
        for column in (buffer.points, buffer.times, buffer.rings):
            column[:] = 0  # the driver fills its arrays anew
        while (result := live.step()) is not None:
            updates.append(result.update)
    np.testing.assert_allclose(poses(updates), poses(expected.updates), atol=1e-9)
    assert live.report().received["imu"] == len(world.imu.stamps)
    with pytest.raises(InputError, match="expected a Scan, got ndarray"):
        live.add_scan(np.zeros((9, 3)))  # type: ignore[arg-type]


def test_messages_of_the_other_kind_are_errors() -> None:
    with pytest.raises(InputError, match="expects LOAM's topics"):
        LiveMapper(features=REQUIRED).add_cloud(thin(0))
    with pytest.raises(InputError, match="expected one of none; got '/points'"):
        LiveMapper().add_features(POINTS, thin(0))


def test_the_report_is_a_copy_and_a_line() -> None:
    live = LiveMapper(Config(live=LiveConfig(queue=1)))
    before = live.report()
    for number in range(3):
        live.add_cloud(thin(number))
    while live.step() is not None:
        pass
    assert before.received == before.latency == {}
    said = (
        "1 sweeps mapped (unusable_scan 1)",
        "dropped: sweep 2",
        "0 waiting (most: 1)",
        "; total ",
    )
    assert [part for part in said if part not in str(live.report())] == []

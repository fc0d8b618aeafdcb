"""Which stamps are used, which are refused and why, and what follows a clock that was set."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from rich.console import Console
from support.list_dataset import ListDataset
from support.quick import QUICK

from loam_gtsam import Checkpoint, Features, FeatureSweep, Mapper, MapUpdate
from loam_gtsam.cli.report import summary
from loam_gtsam.datasets import SimulatedWorld
from loam_gtsam.frontend.stamp_check import IN_A_ROW, StampCheck
from loam_gtsam.pipeline import Pipeline, RunResult, run
from loam_gtsam.types import BadSweep, FrameStatus, Scan, SweepFault

TENTH = 10**8
SECOND = 10**9
DAY = 86_400 * SECOND
START = 1_700_000_000 * SECOND


def judged(stamps: list[int], seconds: float = 0.0) -> list[str]:
    """The fault of each stamp after the first, empty if it was used."""
    check, last, faults = StampCheck(), stamps[0], []
    for stamp in stamps[1:]:
        refusal = check.refuse(stamp, last, seconds)
        faults.append("" if refusal is None else str(refusal.fault))
        if refusal is None:
            last = stamp
        elif refusal.clock_step:
            last += refusal.clock_step
    return faults


def steps(first: int, count: int, step: int = TENTH) -> list[int]:
    return [first + k * step for k in range(count)]


def test_stamps_that_ascend_are_used():
    assert judged(steps(START, 20)) == [""] * 19
    assert judged([START, START + 1_000_000, START + 10 * SECOND]) == ["", ""]


@pytest.mark.parametrize(
    ("off", "fault"),
    [
        (0, "duplicate_stamp"),
        (1, "too_soon"),
        (TENTH // 4 - 1, "too_soon"),
        (TENTH // 4, ""),
        (-1, "late"),
        (-10 * SECOND, "late"),
        (-10 * SECOND - 1, "stamp_back"),
        (-START, "stamp_back"),
        (10 * SECOND, ""),
        (10 * SECOND + 1, "stamp_ahead"),
        (3650 * DAY, "stamp_ahead"),
    ],
)
def test_one_stamp_that_is_off_costs_one_sweep(off, fault):
    good = steps(START, 5)
    after = steps(good[-1] + (off if not fault else 0) + TENTH, 3)
    assert judged([*good, good[-1] + off, *after]) == ["", "", "", "", fault, "", "", ""]


def test_before_an_interval_is_known_the_time_of_a_sweep_tells_what_is_too_soon():
    """Without either, stamps that are no nanoseconds are found."""
    for seconds, least in ((0.1, 25_000_000), (0.0, 1_000_000)):
        early = StampCheck().refuse(START + least - 1, START, seconds)
        assert early is not None
        assert early.fault is SweepFault.TOO_SOON
        assert StampCheck().refuse(START + least, START, seconds) is None
    assert "expected nanoseconds" in early.message
    early = StampCheck().refuse(START + TENTH, START, 1.0)
    assert early is not None
    assert early.message.endswith("the times of its points span 1 s: are they seconds?")


def test_the_sweep_after_one_whose_end_alone_was_seen_is_not_too_soon():
    """If the stamp is that of the first point that is left."""
    for took, answer in ((0.012, ""), (TENTH * 1e-9, "too_soon"), (0.0, "too_soon")):
        check, stamps = StampCheck(), [*steps(START, 5), START + 5 * TENTH - 12_000_000]
        for last, stamp in pairwise(stamps):
            assert check.refuse(stamp, last, took if stamp == stamps[-1] else 0.1) is None
        refusal = check.refuse(START + 5 * TENTH, stamps[-1], 0.1)
        assert (refusal.fault if refusal else "") == answer


def test_a_sensor_may_become_faster_and_a_gap_is_no_usual_interval():
    faults = judged([*steps(START, 6), *steps(START + 6 * TENTH, 40, TENTH // 5)])
    assert set(faults[:6]) == {""}
    assert faults[6:].count("too_soon") < 6
    assert set(faults[-20:]) == {""}
    assert judged([*steps(START, 4), *steps(START + 9 * SECOND, 4)]) == [""] * 7


def test_a_slow_sensor_may_take_ten_of_its_steps():
    good = steps(START, 4, 60 * SECOND)
    assert judged([*good, good[-1] + 600 * SECOND]) == ["stamp_ahead", "", "", ""]
    assert judged([*good, good[-1] + 601 * SECOND])[-1] == "stamp_ahead"
    assert judged([*good, good[-1] - 600 * SECOND])[-1] == "late"


@pytest.mark.parametrize("gap", [0.5, 1.0, 2.0, 9.9])
@pytest.mark.parametrize("seconds", [0.0, 0.1])
@pytest.mark.parametrize("before", [1, 2])
def test_a_gap_among_the_first_sweeps_costs_none(gap, seconds, before):
    after = steps(START + (before - 1) * TENTH + round(gap * 1e9), 20)
    assert judged([*steps(START, before), *after], seconds) == [""] * (before + 19)


def test_after_one_step_the_time_of_a_sweep_tells_what_is_too_soon():
    soon = START + SECOND + TENTH // 5
    assert judged([START, START + SECOND, soon], 0.1) == ["", "too_soon"]
    assert judged([START, START + SECOND, START + SECOND], 0.1) == ["", "duplicate_stamp"]
    assert judged([START, START + TENTH, START + TENTH + TENTH // 5], 1.0) == ["too_soon"] * 2


@pytest.mark.parametrize("early", [DAY, 60 * SECOND, START])
def test_a_first_stamp_long_before_the_others_is_a_clock_set_ahead(early):
    faults = judged([START - TENTH - early, *steps(START, 20)], 0.1)
    assert faults == ["stamp_ahead"] * (IN_A_ROW - 1) + ["clock_set_ahead"] + [""] * 15


def test_a_wrong_second_stamp_costs_one_sweep():
    assert judged([START, START + DAY, *steps(START + 2 * TENTH, 9)]) == ["stamp_ahead"] + [""] * 9


def test_a_clock_set_ahead_is_followed_after_some_sweeps():
    faults = judged([*steps(START, 5), *steps(START + DAY, 10)])
    assert faults == [""] * 4 + ["stamp_ahead"] * (IN_A_ROW - 1) + ["clock_set_ahead"] + [""] * 5


def test_after_the_clock_was_set_it_goes_on_from_one_step_before():
    check = StampCheck()
    check.refuse(START + TENTH, START)
    there = steps(START + DAY, IN_A_ROW)
    refusals = [check.refuse(stamp, START + TENTH) for stamp in there]
    last = refusals[-1]
    assert last is not None
    assert START + TENTH + last.clock_step == there[0] - TENTH
    assert "86399.8 s ahead" in last.message
    assert all(refusal is not None and refusal.clock_step == 0 for refusal in refusals[:-1])


@pytest.mark.parametrize("sign", [1, -1])
def test_wrong_stamps_that_do_not_agree_are_no_clock(sign):
    wrong = [START + sign * DAY * k for k in (9, 3, 7, 2, 5, 4, 8, 1)]
    fault = "stamp_ahead" if sign > 0 else "stamp_back"
    assert judged([*steps(START, 3), *wrong]) == ["", "", *[fault] * 8]


def test_a_good_sweep_between_wrong_ones_starts_the_count_again():
    good, wrong = steps(START, 9), steps(START + DAY, 8)
    mixed = [*good[:3], *wrong[:4], good[3], *wrong[4:]]
    assert judged(mixed) == ["", "", *["stamp_ahead"] * 4, "", *["stamp_ahead"] * 4]


def test_sweeps_that_come_twice_count_once_towards_a_clock():
    twice = [stamp for stamp in steps(START + DAY, IN_A_ROW) for _ in range(2)]
    faults = judged([*steps(START, 3), *twice])
    assert faults[2:].count("stamp_ahead") == 2 * IN_A_ROW - 2
    assert faults[-2] == "clock_set_ahead"


def test_a_clock_set_back_is_said_and_not_followed():
    faults = judged([*steps(START, 5), *steps(START - DAY, 20), START + 5 * TENTH])
    back = 20 - IN_A_ROW + 1
    assert faults[4:] == ["stamp_back"] * (IN_A_ROW - 1) + ["clock_set_back"] * back + [""]


@pytest.fixture(scope="module")
def drive() -> list[Scan]:
    world = SimulatedWorld("street_loop", frames=52, columns=450)
    return [world[number] for number in range(28, 52)]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def truth() -> np.ndarray:
    poses = SimulatedWorld("street_loop", frames=52, columns=450).truth.map_T_lidar[28:52]
    return np.linalg.inv(poses[0]) @ poses


def goes_on_from(step: int, result: RunResult) -> None:
    """The sweeps before a step of the clock cost no pose, and those after some are found again."""
    assert result.faults == {"stamp_ahead": IN_A_ROW - 1, "clock_set_ahead": 1}
    assert len(result.updates) == len(truth())
    for number in range(step + IN_A_ROW, len(truth())):
        update = result.updates[number]
        assert update.status is FrameStatus.OK
        away = update.map_T_lidar.translation() - truth()[number, :3, 3]
        assert np.linalg.norm(away) < 0.15


def test_a_run_goes_on_where_it_is_when_the_clock_is_set_ahead(drive):
    later = [replace(scan, stamp=scan.stamp + 365 * DAY) for scan in drive[15:]]
    result = run(ListDataset([*drive[:15], *later]))
    goes_on_from(15, result)
    for update in result.updates[15 + IN_A_ROW :]:
        assert np.sqrt(np.diag(update.covariance)).max() < 0.1
    first = result.updates[15 + IN_A_ROW]
    before = result.updates[14]
    np.testing.assert_allclose(first.twist[3:], before.twist[3:], atol=0.6)  # not over a year
    assert (np.diff(result.trajectory.stamps) > 0).all()


def test_a_run_whose_first_stamp_is_wrong_begins_there_all_the_same(drive):
    result = run(ListDataset([replace(drive[0], stamp=0), *drive[1:]]))
    goes_on_from(1, result)
    sigmas = np.sqrt(np.diag(result.updates[-1].covariance))
    assert sigmas.max() < 2.0  # of the first motion, not of 54 years


def test_a_clock_set_back_says_what_to_do_and_a_reset_does_it(drive):
    pipeline = Pipeline(QUICK)
    for scan in drive[:4]:
        pipeline.process(scan)
    earlier = [replace(scan, stamp=scan.stamp - DAY) for scan in drive[4:12]]
    updates = [pipeline.process(scan) for scan in earlier[:6]]
    assert [update.fault for update in updates[-2:]] == [SweepFault.CLOCK_SET_BACK] * 2
    assert "reset the mapper" in updates[-1].message
    pipeline.mapper.reset()
    statuses = [pipeline.process(scan).status for scan in earlier[6:]]
    assert statuses == [FrameStatus.FIRST, FrameStatus.OK]


@pytest.mark.parametrize("moment", ["start", "end"])
def test_an_unusable_sweep_does_not_cost_the_next_one(drive, moment):
    # The stamp of a sweep may be its end, and the pose that of its start: one sweep earlier.
    scans = drive[:6]
    if moment == "end":
        scans = [
            replace(scan, stamp=scan.stamp + TENTH, times=scan.times - 0.1, span=(-0.1, 0.0))
            for scan in scans
        ]
    empty = replace(scans[3], points=scans[3].points[:0], times=None, rings=None)
    unread = BadSweep(scans[4].stamp, "unreadable")
    result = run(ListDataset([*scans[:3], empty, unread, scans[5]]))
    assert result.faults == {"empty": 1, "unreadable": 1}
    assert result.updates[5].status is FrameStatus.OK
    assert np.diff(result.trajectory.stamps).tolist() == [TENTH] * 5


def test_recorded_odometry_of_a_late_sweep_is_not_counted_twice(rng):
    walls = rng.uniform(-8.0, 8.0, (4000, 3))
    walls[np.arange(4000), np.arange(4000) % 3] = 8.0 * rng.choice([-1.0, 1.0], 4000)
    columns = np.column_stack([np.repeat([[5.0, 5.0], [-5.0, 4.0]], 60, axis=0),
                               np.tile(np.linspace(-3.0, 3.0, 60), 2)])  # fmt: skip

    def sweep(number: int) -> FeatureSweep:
        odom_T_lidar = gtsam.Pose3(gtsam.Rot3(), np.array([0.8 * number, 0.0, 0.0]))
        seen = [points - odom_T_lidar.translation() for points in (columns, walls)]
        return FeatureSweep(Features.from_points(number * TENTH, *seen), odom_T_lidar)

    asked: list[gtsam.Pose3] = []
    pipeline = Pipeline()
    register = pipeline.mapper.register

    def watched(features: Features, guess: gtsam.Pose3 | None = None) -> MapUpdate:
        asked.append(guess)
        return register(features, guess)

    pipeline.mapper.register = watched  # type: ignore[method-assign]
    for number in (0, 1, 3, 2, 4):
        pipeline.process(sweep(number))
    np.testing.assert_allclose(asked[-1].translation(), [3.2, 0.0, 0.0], atol=0.05)


def test_features_that_are_not_finite_are_a_fault(rng):
    mapper = Mapper()
    points = rng.uniform(-5.0, 5.0, (300, 3))
    mapper.register(Features.from_points(0, points[:100], points))
    names = "edges", "planes", "edge_times", "plane_times", "edge_prominence", "edge_sigmas"
    for number, name in enumerate(names, 1):
        features = Features.from_points(number * TENTH, points[:100], points)
        features = replace(features, edge_prominence=np.ones(100), edge_sigmas=np.ones(100))
        spoilt = getattr(features, name).copy()
        spoilt[7] = np.nan
        update = mapper.register(replace(features, **{name: spoilt}))
        assert (update.status, update.fault) == ("unusable_scan", "not_finite")


def test_a_run_that_was_stopped_between_doubted_sweeps_goes_on_as_it_was(drive, tmp_path):
    later = [replace(scan, stamp=scan.stamp + DAY) for scan in drive[6:14]]
    dataset = ListDataset([*drive[:6], *later])

    def stop(number: int, update: MapUpdate) -> None:
        if number == 8:
            raise KeyboardInterrupt

    whole = run(dataset, QUICK)
    run(dataset, QUICK, on_frame=stop, checkpoint=Checkpoint(tmp_path / "here"))
    on = run(dataset, QUICK, checkpoint=Checkpoint(tmp_path / "here", resume=True))
    assert [u.fault for u in on.updates] == [u.fault for u in whole.updates]
    assert on.faults == {"stamp_ahead": IN_A_ROW - 1, "clock_set_ahead": 1}
    np.testing.assert_array_equal(on.trajectory.map_T_lidar, whole.trajectory.map_T_lidar)


def test_the_summary_on_the_screen_names_what_was_not_used():
    scans = list(SimulatedWorld("room", frames=3, columns=300))
    nothing = replace(scans[1], points=np.full_like(scans[1].points, np.nan))
    console = Console(file=StringIO(), width=100)
    for sweeps in ([scans[0], nothing, scans[2], scans[2]], scans):
        console.print(summary(run(ListDataset(sweeps), QUICK), "x", 1.0, {}))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "1 not_finite, 1 duplicate_stamp" in text
    assert text.count("not used") == 1

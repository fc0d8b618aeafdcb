"""Features extracted ahead, in processes of their own."""

import errno
import logging
import multiprocessing
import os
import signal

import numpy as np
import pytest
from support.list_dataset import ListDataset
from support.quick import QUICK

from loam_gtsam import Config, SimulatedWorld, run
from loam_gtsam.frontend.features import extract_features, thinned
from loam_gtsam.frontend.workers import extract, extract_ahead
from loam_gtsam.types import BadSweep, DatasetError, Features, FrameStatus, Scan

pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(scope="module")
def sweeps():
    world = SimulatedWorld("room", frames=6, columns=450)
    return list(world)


@pytest.fixture(scope="module")
def whole(sweeps):
    """The run of all sweeps, without processes."""
    return run(ListDataset(sweeps), QUICK)


def kill_all():
    for child in multiprocessing.active_children():
        child.kill()
        child.join()


def numbered(sweeps):
    return [(sweep, float(number)) for number, sweep in enumerate(sweeps)]


def test_a_run_is_the_same_at_any_number_of_processes(sweeps):
    broken = Scan(sweeps[2].points[:3], sweeps[2].stamp)
    mixed = [*sweeps[:2], broken, BadSweep(sweeps[3].stamp, "unreadable"), *sweeps[4:]]
    results = [run(ListDataset(mixed), QUICK, workers=workers) for workers in (0, 2)]
    messages = [[update.message for update in result.updates] for result in results]
    assert messages[0] == messages[1]
    assert "unreadable" in messages[0][3]
    statuses = [update.status for update in results[0].updates]
    assert statuses[2:4] == [FrameStatus.UNUSABLE_SCAN] * 2
    poses = [result.trajectory.map_T_lidar for result in results]
    assert np.array_equal(poses[0], poses[1])


def test_only_the_sweeps_asked_for_are_read(sweeps):
    read = []

    class Watched(ListDataset):
        def __iter__(self):
            for number, sweep in enumerate(super().__iter__()):
                read.append(number)
                yield sweep

    assert len(run(Watched(sweeps), QUICK, max_frames=2, workers=1).updates) == 2
    assert read == [0, 1]


def test_an_error_of_the_data_comes_after_the_sweeps_before_it(sweeps):
    def source():
        yield from numbered(sweeps[:2])
        raise DatasetError("the file ends here")

    found = extract_ahead(source(), Config(), 1)
    for number in (0.0, 1.0):
        assert next(found)[1] == number
    with pytest.raises(DatasetError, match="ends here"):
        next(found)


def test_a_process_that_dies_costs_nothing_but_time(sweeps, whole, caplog):
    def kill(number, update):
        if number == 1:
            kill_all()

    with caplog.at_level(logging.WARNING, "loam_gtsam.frontend.workers"):
        killed = run(ListDataset(sweeps), QUICK, workers=1, on_frame=kill)
    assert caplog.text.count("died") == 1
    assert np.array_equal(killed.trajectory.map_T_lidar, whole.trajectory.map_T_lidar)


def test_a_process_that_is_stopped_costs_nothing_but_time(sweeps, whole, caplog, monkeypatch):
    def stop(number, update):
        if number == 0:  # the process has answered once, and is quick from now on
            monkeypatch.setattr("loam_gtsam.frontend.workers._SILENCE", 0.5)
            (child,) = multiprocessing.active_children()
            os.kill(child.pid, signal.SIGSTOP)

    stopped = run(ListDataset(sweeps), QUICK, workers=1, on_frame=stop)
    assert caplog.text.count("did not answer for 0.5 s") == 1
    assert multiprocessing.active_children() == []
    assert np.array_equal(stopped.trajectory.map_T_lidar, whole.trajectory.map_T_lidar)


@pytest.mark.parametrize(("room", "used"), [(0, 0), (1, 1)])
def test_without_shared_memory_there_are_fewer_processes(sweeps, caplog, monkeypatch, room, used):
    asked = []

    def fallocate(*given):
        asked.append(given)
        if len(asked) > room:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", fallocate)
    found = extract_ahead(numbered(sweeps[:3]), Config(), 2)
    first = next(found)[2]
    assert (first is None) is (used == 0)
    assert len(multiprocessing.active_children()) == used
    assert [number for _, number, _ in found] == [1.0, 2.0]
    assert multiprocessing.active_children() == []
    assert caplog.text.count("No space left on device") == 1
    assert ("the features are extracted here" in caplog.text) is (used == 0)


def test_a_sweep_too_large_to_hand_over_is_left_to_the_caller(sweeps):
    first = sweeps[0]
    times = 1 + 800_000 // len(first.points)
    large = Scan(np.tile(first.points, (times, 1)), first.stamp)
    assert large.points.nbytes > 1 << 23
    found = [found for *_, found in extract_ahead(numbered([large, first, large]), Config(), 1)]
    assert found[0] is None
    assert found[2] is None
    assert np.array_equal(found[1].features.planes, extract(first, Config()).features.planes)


def test_the_sweeps_of_a_process_that_died_are_left_to_others(sweeps):
    found = []
    for _, number, extraction in extract_ahead(numbered(sweeps), Config(), 1):
        found.append((number, extraction is None))
        kill_all()
    assert [number for number, _ in found] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert not found[0][1]
    assert all(missing for _, missing in found[3:])


def test_processes_end_with_a_run_that_is_given_up(sweeps):
    found = extract_ahead(numbered(sweeps), Config(), 2)
    assert next(found)[2] is not None
    assert len(multiprocessing.active_children()) == 2
    found.close()
    assert multiprocessing.active_children() == []


def test_without_processes_nothing_is_read_ahead(sweeps):
    source = iter(numbered(sweeps))
    sweep, _, extraction = next(extract_ahead(source, Config(), 0))
    assert sweep is sweeps[0]
    assert extraction is None
    assert len(list(source)) == len(sweeps) - 1


@pytest.mark.parametrize(
    "changes",
    [
        (
            "odometry.method=scan_to_scan",
            "deskew.reference=end",
            "sensor.times=azimuth",
            "features.plane_voxel=0.0",
            "map.edge_voxel=0.1",
        ),
        ("deskew.enabled=false", "features.post_depth=0.0", "features.range_noise=0.0"),
    ],
)
def test_processes_hand_over_every_bit_of_the_features(sweeps, changes):
    config = Config().changed(*changes)
    for sweep, _, found in extract_ahead(numbered(sweeps[:3]), config, 1):
        here = extract(sweep, config).features
        for name in Features.__slots__:
            one, other = getattr(here, name), getattr(found.features, name)
            assert np.array_equal(one, other), name
            assert type(one) is type(other)


@pytest.mark.parametrize(("method", "thin"), [("constant_velocity", True), ("scan_to_scan", False)])
def test_features_are_thinned_where_nobody_needs_them_all(sweeps, method, thin):
    config = Config().changed(f"odometry.method={method}")
    whole = extract_features(sweeps[0], config)
    found = extract(sweeps[0], config).features
    assert (len(found.planes) < len(whole.planes)) is thin
    if thin:
        assert np.array_equal(found.planes, thinned(whole, config.map).planes)
    else:
        assert np.array_equal(found.planes, whole.planes)


def test_extraction_says_why_there_are_no_features(sweeps):
    good, few = extract(sweeps[0], Config()), Scan(np.zeros((3, 3), np.float32), 0)
    assert good.features is not None
    assert good.problem == ""
    assert extract(few, Config()).features is None
    assert "points" in extract(few, Config()).problem

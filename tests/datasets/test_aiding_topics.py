"""GNSS fixes and wheels from topics of bags, found by the type of their messages."""

import json

import numpy as np
import pytest
from support.bags import (
    LATENCY,
    ROS1,
    START,
    cloud,
    fix,
    odometry,
    store_of,
    sweeps,
    twist,
    write_bag,
)
from support.cli import loam
from support.quick import QUICK_START

from loam_gtsam.datasets import SimulatedWorld, open_dataset
from loam_gtsam.datasets.decode.geodesy import geodetic_of
from loam_gtsam.maps import SavedMap
from loam_gtsam.types import DatasetError

ORIGIN = np.array([47.5, 8.5, 450.0])


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_topics_are_found_by_their_types(tmp_path, kind):
    store, recording = store_of(kind), sweeps(kind)
    for n in range(4):
        stamp = START + n * 100_000_000
        fixes = {
            0: fix(store, stamp, ORIGIN),
            1: fix(store, stamp, ORIGIN, status=-1),
            2: fix(store, stamp, [np.nan] * 3),
            3: fix(store, stamp, ORIGIN + np.array([1e-5, 0.0, 1.0]), known=0),
        }
        recording.append(("/gps/fix", stamp + LATENCY, fixes[n]))
        recording.append(("/odom", stamp + LATENCY, odometry(store, stamp, [0.5 * n, 0.0, 0.0])))
    path = write_bag(tmp_path / "drive", kind, recording)
    dataset = open_dataset(path)
    assert (dataset.gnss_topic, dataset.wheels_topic) == ("/gps/fix", "/odom")
    assert dataset.gnss.stamps.tolist() == [START, START + 300_000_000]
    np.testing.assert_allclose(dataset.gnss.covariances[0], np.diag([0.04, 0.04, 0.16]))
    assert np.isnan(dataset.gnss.covariances[1]).all()
    np.testing.assert_allclose(dataset.wheels.start_T_body[:, 0, 3], [0.0, 0.5, 1.0, 1.5])
    info = dataset.info()
    assert "2 fixes (/gps/fix)" in info.facts["GNSS"]
    assert any("2 of 4 messages have no fix" in problem for problem in info.problems)
    assert any("1 of 2 fixes without a covariance" in problem for problem in info.problems)
    with pytest.raises(DatasetError, match=r"no topic '/fix'.*gps/fix"):
        open_dataset(path, gnss_topic="/fix")
    with pytest.raises(DatasetError, match="expected nav_msgs/msg/Odometry"):
        open_dataset(path, wheels_topic="/gps/fix")
    # A part of a data set has what the whole has.
    assert dataset.part(start=1).gnss is dataset.gnss


def test_twists_are_taken_before_odometry(tmp_path):
    recording = sweeps("ros1")
    for n in range(4):
        stamp = START + n * 100_000_000
        recording.append(("/odom", stamp, odometry(ROS1, stamp, [9.0 * n, 0.0, 0.0])))
        recording.append(("/speed", stamp, twist(ROS1, stamp, 2.0, 0.0)))
    dataset = open_dataset(write_bag(tmp_path / "drive", "ros1", recording))
    np.testing.assert_allclose(dataset.wheels.start_T_body[:, 0, 3], [0.0, 0.2, 0.4, 0.6])
    assert dataset.gnss is None


def test_a_run_with_gnss_places_its_map_on_the_earth(tmp_path):
    world = SimulatedWorld("room", frames=30, columns=300)
    recording = []
    for scan in world:
        columns = {"ring": scan.rings.astype("u2"), "time": scan.times.astype("f4")}
        message = cloud(ROS1, scan.stamp, scan.points, **columns)
        recording.append(("/points", scan.stamp, message))
    stamps = world.truth.stamps[2:-1]
    noise = np.random.default_rng(0).normal(0.0, 0.01, (len(stamps), 3))
    positions = world.truth_at(stamps).positions + noise
    for stamp, enu in zip(stamps, positions, strict=True):
        place = geodetic_of((enu @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])[None], ORIGIN)[0]
        known = (1e-4, 1e-4, 1e-4)
        recording.append(("/fix", int(stamp), fix(ROS1, int(stamp), place, covariance=known)))
    path = write_bag(tmp_path / "drive", "ros1", recording)
    near = ["--set", "pose_graph.keyframe_distance=0.1", "--set", "aiding.gnss_memory=0"]
    near += QUICK_START
    done = loam("run", path, "--gnss", *near, "--output", tmp_path / "out", "--no-plot")
    assert done.exit_code == 0, done.output
    assert "fixes used" in " ".join(done.output.split())
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    enu = summary["gnss"]["enu"]
    with SavedMap(tmp_path / "out" / "map.lgmap") as saved:
        assert saved.frame.earth is not None
        assert saved.frame.earth.as_dict() == enu
        # x of the map is north there.
        assert saved.frame.earth.heading_deg == pytest.approx(90.0, abs=2.0)
    first = (tmp_path / "out" / "trajectory_enu.tum").read_text().splitlines()[0]
    assert first.startswith(f"# origin: latitude {enu['latitude_deg']:.9f}")
    done = loam("refine", path, tmp_path / "out", "--rounds", 1, "--no-plot")
    assert "trajectory_enu.tum" in done.output
    report = json.loads((tmp_path / "out" / "refined" / "report.json").read_text())
    moved = np.subtract(report["enu"]["enu_T_map"], enu["enu_T_map"])
    assert 0.0 < np.abs(moved).max() < 0.05
    plain = loam("run", path, "--wheels", "--output", tmp_path / "no", "--frames", 2)
    assert plain.exit_code == 1
    assert "aiding.wheels: the data have nothing of wheels" in " ".join(plain.output.split())

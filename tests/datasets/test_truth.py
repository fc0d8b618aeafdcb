"""Reference poses of any data set, and parts of a data set."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support import bags
from support.list_dataset import ListDataset
from support.trajectories import winding

from loam_gtsam.datasets import ArrayDataset, SimulatedWorld, open_dataset
from loam_gtsam.datasets.base import DatasetInfo, PartOf
from loam_gtsam.datasets.decode.geodesy import east_north_up
from loam_gtsam.datasets.truth import extrinsic, read_truth
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.io.trajectories import write_tum
from loam_gtsam.pipeline import run
from loam_gtsam.studies.evaluation import absolute_error, nees, relative_error
from loam_gtsam.types import DatasetError, InputError, Scan, Trajectory

TRUTH = winding(12)


@pytest.fixture(scope="module")
def world():
    return SimulatedWorld("room", frames=8, columns=300)


def same(found: Trajectory, wanted: Trajectory = TRUTH) -> None:
    np.testing.assert_array_equal(found.stamps, wanted.stamps)
    np.testing.assert_allclose(found.map_T_lidar, wanted.map_T_lidar, atol=1e-6)


def rows(path):
    """Stamp in ns, x y z, qx qy qz qw as texts."""
    write_tum(path / "x.tum", TRUTH)
    lines = [line.split() for line in (path / "x.tum").read_text().splitlines()]
    numbers = [line for line in lines if not line[0].startswith("#")]
    return [[str(s), *line[1:]] for s, line in zip(TRUTH.stamps, numbers, strict=True)]


def test_tum_euroc_and_kitti_give_the_same_poses(tmp_path):
    table = rows(tmp_path)
    same(read_truth(tmp_path / "x.tum"))
    euroc = tmp_path / "data.csv"
    lines = [",".join([*row[:4], row[7], *row[4:7], "0", "0"]) for row in table]
    euroc.write_text("\n".join(["#timestamp, p_RS_R_x [m], ...", *lines]))
    same(read_truth(euroc))
    kitti = tmp_path / "00.txt"
    told: list[str] = []
    np.savetxt(kitti, TRUTH.map_T_lidar[:, :3].reshape(-1, 12))
    first = np.linalg.inv(TRUTH.map_T_lidar[0])
    same(
        read_truth(kitti, stamps=TRUTH.stamps, problems=told),
        Trajectory(TRUTH.stamps, first @ TRUTH.map_T_lidar),
    )
    assert "those at the stamps of the sweeps" in " ".join(told)


def test_the_extrinsic_moves_the_poses_to_the_lidar(tmp_path):
    rows(tmp_path)
    lever = extrinsic("0.1, 0.2 -0.3  0 0 0.7071068 0.7071068")
    found = read_truth(tmp_path / "x.tum", body_T_lidar=lever)
    same(found, Trajectory(TRUTH.stamps, TRUTH.map_T_lidar @ lever))
    np.testing.assert_allclose(lever[:3, 3], [0.1, 0.2, -0.3])
    np.testing.assert_allclose(lever[:3, 0], [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(extrinsic("1 2 3")[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(extrinsic(" ".join(map(str, lever[:3].ravel()))), lever)
    for text in ("1 2", "a b c", "2 0 0 0 0 1 0 0 0 0 1 0", "0 0 0 0 0 0 0"):
        with pytest.raises(DatasetError, match="extrinsic: expected x y z"):
            extrinsic(text)


def test_a_byte_order_mark_costs_no_pose(tmp_path):
    table = rows(tmp_path)
    (tmp_path / "x.tum").write_text(
        "".join(f"{int(row[0]) * 1e-9:.9f} {' '.join(row[1:])}\n" for row in table), "utf-8-sig"
    )
    assert len(read_truth(tmp_path / "x.tum")) == len(TRUTH)


@pytest.mark.parametrize("matrix", [2.0 * np.eye(4), np.diag([1, 1, -1, 1]), np.ones((4, 4))])
def test_poses_are_moved_by_a_rigid_transform_only(world, matrix):
    with pytest.raises(InputError, match="body_T_lidar: expected a rigid transform"):
        world.with_truth(TRUTH, body_T_lidar=matrix)


def positions(tmp_path):
    file = tmp_path / "gps.txt"
    lines = [f"{s * 1e-9:.9f} {p[0]:.9f} {p[1]:.9f} {p[2]:.9f}" for s, p in
             zip(TRUTH.stamps, TRUTH.positions, strict=True)]  # fmt: skip
    file.write_text("\n".join(lines))
    return file


def test_positions_alone_give_the_error_of_positions_and_nothing_else(tmp_path):
    truth = read_truth(positions(tmp_path))
    assert np.isnan(truth.map_T_lidar[:, :3, :3]).all()
    turned = Trajectory(TRUTH.stamps, extrinsic("5 6 7 0 0 1 0") @ TRUTH.map_T_lidar)
    error = absolute_error(turned, truth)
    assert error.rmse < 1e-3
    assert np.isnan(error.rotation_rmse_deg)
    for refused in (
        lambda: relative_error(turned, truth),
        lambda: absolute_error(turned, truth, aligned="start"),
    ):
        with pytest.raises(InputError, match="positions alone"):
            refused()


def test_positions_of_a_prism_are_compared_where_the_prism_is(tmp_path):
    """The file is of the prism, 0.5 m beside the lidar and turned; a run has poses of the lidar."""
    prism_T_lidar = extrinsic("0.5 -0.2 0.3 0 0 0.7071068 0.7071068")
    run = Trajectory(TRUTH.stamps, extrinsic("5 6 7 0 0 1 0") @ TRUTH.map_T_lidar @ prism_T_lidar)
    file = positions(tmp_path)
    assert absolute_error(run, read_truth(file)).rmse > 0.01
    moved = read_truth(file, body_T_lidar=prism_T_lidar)
    np.testing.assert_allclose(moved.point, inverse_pose(prism_T_lidar)[:3, 3])
    assert absolute_error(run, moved).rmse < 1e-6
    assert absolute_error(run, read_truth(file, body_T_lidar=extrinsic("0 0 0"))).rmse > 0.01


def test_a_sparse_reference_is_not_interpolated():
    """A lidar that goes round a circle, and four places of it that were surveyed."""
    angles = np.linspace(0.0, 2.0 * np.pi, 201)
    poses = np.tile(np.eye(4), (201, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = 10.0 * np.cos(angles), 10.0 * np.sin(angles)
    run = Trajectory(100_000_000 * np.arange(201), poses)
    surveyed = Trajectory(run.stamps[10::50] + 50_000_000, poses[10::50] + 0.5 * (
        poses[11::50] - poses[10::50]))  # fmt: skip
    error = absolute_error(run, surveyed)
    assert error.stamps.tolist() == surveyed.stamps.tolist()
    assert error.rmse < 1e-6
    with pytest.raises(InputError, match="3 or more points of the sparse reference"):
        absolute_error(Trajectory(run.stamps[:80], poses[:80]), surveyed)


@pytest.mark.parametrize("kind", ["PoseStamped", "Odometry"])
@pytest.mark.parametrize("bag", ["ros1", "mcap"])
def test_topics_of_poses(tmp_path, kind, bag):
    store = bags.store_of(bag)
    table = [[float(x) for x in row[1:]] for row in rows(tmp_path)]
    recording = []
    for stamp, row in zip(TRUTH.stamps.tolist(), table, strict=True):
        message = bags.odometry(store, stamp, row[:3], row[3:])
        if kind == "PoseStamped":
            make = store.types["geometry_msgs/msg/PoseStamped"]
            message = make(header=message.header, pose=message.pose.pose)
        recording.append(("/pose", stamp, message))
    path = bags.write_bag(tmp_path / "poses", bag, recording)
    same(read_truth(path))
    same(read_truth(path, topic="/pose"))
    with pytest.raises(DatasetError, match="topic '/other' is none of"):
        read_truth(path, topic="/other")


def test_gps_fixes_become_metres_east_north_and_up():
    metres = east_north_up(np.array([
        [48.0, 11.0, 500.0], [48.001, 11.0, 500.0], [48.0, 11.001, 510.0],
    ]))  # fmt: skip
    # A thousandth of a degree: of latitude 111.2 m there, of longitude 74.6 m (WGS 84).
    np.testing.assert_allclose(metres[0], 0.0)
    np.testing.assert_allclose(metres[1], [0.0, 111.2, 0.0], atol=0.03)
    np.testing.assert_allclose(metres[2], [74.63, 0.0, 10.0], atol=0.03)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no numbers"),
        ("1 2 3\n", "lines of 3 columns"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n", "expected lines like the first one"),
        ("1 0 0 0 0 0 0 0\n", "quaternion of length 0"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "1 poses without stamps"),
    ],
)
def test_what_is_no_truth_is_told(tmp_path, text, told):
    file = tmp_path / "truth.txt"
    file.write_text(text)
    with pytest.raises(DatasetError, match=told):
        read_truth(file)


def test_a_data_set_with_truth_is_judged_by_it(world, tmp_path):
    truth = world.truth
    write_tum(tmp_path / "mine.tum", truth)
    given = world.with_truth(tmp_path / "mine.tum", body_T_lidar=extrinsic("0 0 1"))
    assert len(given) == len(world)
    assert given.name == world.name
    raised = (truth.map_T_lidar @ [0.0, 0.0, 1.0, 1.0])[:, :3]
    np.testing.assert_allclose(given.truth.positions, raised, atol=1e-8)
    assert "mine.tum" in given.info().facts["reference poses"]
    direct = world.with_truth(truth)
    np.testing.assert_array_equal(direct.truth.map_T_lidar, truth.map_T_lidar)
    result = run(direct)
    assert nees(result.updates, direct.truth).mean < 5.0


def test_poses_of_another_time_and_none_at_all_are_a_problem_once(world):
    other = Trajectory(np.arange(2), np.tile(np.eye(4), (2, 1, 1)))
    data = ArrayDataset(list(world))
    for truth, said in ((other, "none of the sweeps'"), (other[:0], "given: no poses in it")):
        given = data.with_truth(truth)
        for _ in range(2):
            assert [said in problem for problem in given.info().problems] == [True]


def test_parts_of_a_data_set(world):
    stamps = [scan.stamp for scan in world]
    for part, wanted in (
        (world.part(2), stamps[2:]),
        (world.part(1, 3), stamps[1::3]),
        (world.part(begin_s=0.2, end_s=0.5), stamps[2:6]),
        (world.part(1, 2).part(1), stamps[3::2]),
        (world.with_truth(TRUTH).part(every=4), stamps[::4]),
    ):
        assert [scan.stamp for scan in part] == wanted
        assert len(part) == len(wanted)
        assert part.truth is not None
        assert part.name != world.name
        assert "sweeps" in part.info().facts["used"]
    for wrong in ({"start": -1}, {"every": 0}, {"begin_s": 3.0, "end_s": 2.0}):
        with pytest.raises(InputError, match="part: expected a whole start of 0 or more"):
            world.part(**wrong)
    for none in ({"start": 8}, {"begin_s": 0.8}, {"begin_s": 0.21, "end_s": 0.29}):
        with pytest.raises(InputError, match=r"some of the 8 sweeps of .*, got none"):
            world.part(**none)


@pytest.mark.parametrize("wrong", [0, 1, 4, 7, 19])
@pytest.mark.parametrize("by", [-(10**12), 10**12])
@pytest.mark.parametrize("known", [True, False])
def test_one_wrong_stamp_costs_a_part_one_sweep(wrong, by, known):
    scans = [Scan(points=np.zeros((1, 3)), stamp=10**13 + k * 10**8) for k in range(20)]
    spoilt = [replace(s, stamp=s.stamp + by * (k == wrong)) for k, s in enumerate(scans)]
    data = ArrayDataset(spoilt) if known else ListDataset(spoilt)
    assert list(PartOf(data, 0, 2)) == spoilt[::2]
    begins = 1 if wrong == 0 else 0  # the first stamp that is right counts as the beginning
    inside = spoilt[begins + 2 : begins + 11]
    part = PartOf(data, 0, 1, 0.2, 1.0)
    assert list(part) == [scan for scan in inside if scan is not spoilt[wrong]]
    assert len(part) == (len(list(part)) if known else 20)


def test_a_part_is_not_read_to_the_end_of_the_data():
    scans = [Scan(points=np.zeros((1, 3)), stamp=k * 10**8) for k in range(20)]
    unread = ListDataset([*scans, RuntimeError("read on")])
    assert len(list(PartOf(unread, 0, 1, end_s=1.0))) == 11


def test_the_length_of_a_time_window_is_exact_where_stamps_are_known(world):
    known = SimpleNamespace(
        name="x", sensor={}, stamps=np.arange(10) * 100_000_000, imu=None, truth=None
    )
    assert len(PartOf(known, 0, 2, 0.2, 0.7)) == 3
    for data in (world, ArrayDataset(list(world))):
        assert (
            data.part(begin_s=0.15, end_s=0.35).info().facts["used"] == "0.15 to 0.35 s: 2 sweeps"
        )
    unknown = ListDataset(list(world))
    unknown.info = lambda: DatasetInfo("list", "")
    used = [PartOf(unknown, 0, 1, begin).info().facts["used"] for begin in (0.0, 0.15)]
    assert used == [": 8 sweeps", "from 0.15 s: at most 8 sweeps"]
    assert len(open_dataset("sim:room?frames=8").part(1, 2)) == 4

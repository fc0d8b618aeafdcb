"""Trajectories that are written are read again, by this package and by others."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.trajectories import winding

from loam_gtsam.datasets.decode.tables import read_tum
from loam_gtsam.io.trajectories import write_kitti, write_tum
from loam_gtsam.types import DatasetError, Trajectory


@settings(deadline=None)  # a busy machine is no fault
@given(st.lists(st.integers(-(2**62), 2**62), min_size=1, max_size=5, unique=True))
def test_tum_stamps_survive_to_the_nanosecond(tmp_path_factory, stamps):
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    write_tum(path, Trajectory(np.array(stamps, np.int64), poses))
    assert read_tum(path).stamps.tolist() == stamps


def test_tum_poses_survive(tmp_path):
    trajectory = winding(50, step=30.0)
    write_tum(tmp_path / "t.tum", trajectory, comments={"made by": "a\ntest"})
    again = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(again.stamps, trajectory.stamps)
    np.testing.assert_allclose(again.map_T_lidar, trajectory.map_T_lidar, atol=1e-9)
    first = (tmp_path / "t.tum").read_text().splitlines()[:2]
    assert first[0] == "# made by: a test"
    assert first[1].startswith("# columns:")


def test_positions_alone_are_written_without_an_attitude(tmp_path):
    known = winding(3)
    poses = known.map_T_lidar.copy()
    poses[1, :3, :3] = np.nan  # of a prism
    write_tum(tmp_path / "t.tum", Trajectory(known.stamps, poses))
    assert "# attitude: not known in 1 lines" in (tmp_path / "t.tum").read_text()
    again = read_tum(tmp_path / "t.tum").map_T_lidar
    np.testing.assert_allclose(again[[0, 2]], known.map_T_lidar[[0, 2]], atol=1e-9)
    np.testing.assert_allclose(again[1, :3, 3], poses[1, :3, 3], atol=1e-9)
    np.testing.assert_array_equal(again[1, :3, :3], np.eye(3))


def test_kitti_has_twelve_numbers_a_line(tmp_path):
    trajectory = winding(3)
    write_kitti(tmp_path / "t.txt", trajectory)
    rows = np.loadtxt(tmp_path / "t.txt")
    np.testing.assert_allclose(rows, trajectory.map_T_lidar[:, :3].reshape(3, 12), rtol=1e-11)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# fine\n1.0 0 0 0 0 0 0\n", r"t\.tum:2: expected 8 numbers.*7 columns"),
        ("1.0 0 0 0 0 0 0 1\n1.1 0 0 x 0 0 0 1\n", r"t\.tum:2: expected 8 numbers"),
        ("abc 0 0 0 0 0 0 1\n", r"t\.tum:1: expected 8 numbers"),
        ("nan 0 0 0 0 0 0 1\n", r"t\.tum:1: expected 8 numbers"),
        ("1.0 0 0 nan 0 0 0 1\n", r"t\.tum:1: .*NaN"),
        ("1.0 0 0 0 0 0 0 1\n\n1.1 0 0 0 0 0 0 0\n", r"t\.tum:3: .*quaternion of length 0"),
    ],
)
def test_read_tum_names_the_bad_line(tmp_path, text, message):
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(DatasetError, match=message):
        read_tum(tmp_path / "t.tum")
    with pytest.raises(DatasetError, match="cannot read"):
        read_tum(tmp_path / "none.tum")

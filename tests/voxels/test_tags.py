"""Tags of points: views come back to half a degree, turn with their points, and tell the side."""

import numpy as np
import pytest

from loam_gtsam.voxels.tags import look, second, sines, tags_of, turn, views

X, Y, Z = np.eye(3)


def test_a_view_is_the_direction_to_the_lidar() -> None:
    rng = np.random.default_rng(0)
    points, lidar = rng.normal(0.0, 20.0, (500, 3)), np.array([1.0, -2.0, 0.5])
    expected = (lidar - points) / np.linalg.norm(lidar - points, axis=1)[:, None]
    for seen_from in (lidar, np.tile(lidar, (500, 1))):
        tags = tags_of(500, 7)
        look(tags, points, seen_from)
        found = views(tags)[:, :3].astype(float)
        cosines = (found * expected).sum(axis=1) / np.linalg.norm(found, axis=1)
        assert np.degrees(np.arccos(np.minimum(cosines, 1.0))).max() < 0.5
        assert (tags[:, 0] == 7).all()
        assert not second(tags).any()


def test_a_point_at_the_lidar_and_a_point_that_nobody_saw_have_no_view() -> None:
    tags = tags_of(2, 0)
    look(tags[:1], Z[None], Z)
    assert not views(tags).any()
    np.testing.assert_array_equal(sines(views(tags)[:, None], np.stack([X, Y], axis=1)), 0.0)


def test_views_turn_with_their_points_and_points_stay_second() -> None:
    tags = tags_of(1, 3)
    look(tags, np.zeros((1, 3)), 5.0 * X)
    views(tags)[:, 3] = 1
    turn(tags, np.stack([Y, -X, Z], axis=1))
    assert views(tags).tolist() == [[0, 127, 0, 1]]
    assert second(tags).tolist() == [True]
    assert tags[0, 0] == 3


def test_the_sine_is_positive_on_the_side_of_the_normal() -> None:
    tags = tags_of(3, 0)
    look(tags, np.zeros((3, 3)), np.array([[5.0, 0, 0], [-3.0, 4.0, 0], [0, 0, 9.0]]))
    seen = np.stack([views(tags), views(tags)])  # two groups of three neighbours
    found = sines(seen, np.stack([X, -Y], axis=1))
    np.testing.assert_allclose(found, [[1.0, 0.0], [-0.6, -0.8], [0.0, 0.0]], atol=4e-3)
    assert found.T[0] == pytest.approx([1.0, -0.6, 0.0], abs=4e-3)

"""A wall of 0.2 m in closed form: each face is matched from its own side only, and both are mapped.

The wall stands along x, its front at y = 0 and its back at y = 0.2; it ends at x = 3.
"""

import gtsam
import numpy as np
import pytest
from support.walls import CONFIG, MAP, MIDDLE, NONE, face, matched

from loam_gtsam.config import Config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.geometry import OBLIQUE_EDGE
from loam_gtsam.pipeline import run
from loam_gtsam.registration.association import associate
from loam_gtsam.registration.frame_matcher import MapPair
from loam_gtsam.types import FloatArray
from loam_gtsam.voxels.tags import Faces, second

FRONT, BACK = np.array([0.0, -2.0, 0.0]), np.array([0.0, 2.2, 0.0])  # positions of the lidar
THICKNESS = 0.2


def wall(*seen: tuple[float, FloatArray | None], voxel: float = 0.05) -> CubeMap:
    """A map of faces at some y, each seen from a position."""
    planes = CubeMap(MAP, voxel)
    for y, lidar in seen:
        planes.insert(face(y), lidar)
    return planes


def at(y: float, points: FloatArray = MIDDLE) -> FloatArray:
    """The points at another y."""
    return points + np.array([0.0, y, 0.0])


def test_the_back_of_a_wall_is_not_matched_with_its_front() -> None:
    planes = wall((0.0, FRONT))
    behind = at(THICKNESS)
    matches = matched(planes, behind, BACK)
    assert len(matches.planes) == 0
    np.testing.assert_array_equal(matches.faces.rows, np.arange(len(behind)))
    np.testing.assert_allclose(matches.faces.normals, np.tile([0.0, 1.0, 0.0], (len(behind), 1)))
    assert len(matched(planes, MIDDLE, FRONT).planes) == len(MIDDLE)
    # Were it not for the views, all would match.
    blind = matched(wall((0.0, None)), behind, BACK)
    assert len(blind.planes) == len(behind)
    assert len(blind.faces.rows) == 0


@pytest.mark.parametrize(("y", "lidar"), [(0.0, FRONT), (THICKNESS, BACK)])
def test_of_both_faces_the_visible_one_is_matched(y: float, lidar: FloatArray) -> None:
    planes = wall((0.0, FRONT), (THICKNESS, BACK))
    points = at(y)
    matches = matched(planes, points, lidar)
    assert len(matches.planes) == len(points)
    np.testing.assert_allclose(np.abs(matches.planes.normals[:, 1]), 1.0, atol=1e-9)
    np.testing.assert_allclose(matches.planes.distances, 0.0, atol=1e-9)
    # Without views the planes lie between the faces.
    blind = matched(wall((0.0, None), (THICKNESS, None)), points, lidar)
    assert np.abs(blind.planes.distances).mean() > 0.03


def test_matches_with_one_visible_face_are_those_of_a_map_without_views() -> None:
    planes, blind = (matched(wall((0.0, seen)), MIDDLE, FRONT).planes for seen in (FRONT, None))
    for name in ("indices", "normals", "offsets", "distances", "sigmas", "weights"):
        np.testing.assert_array_equal(getattr(planes, name), getattr(blind, name))


def test_who_walks_past_a_face_sees_the_same_face_from_both_ends() -> None:
    """Views 170 degrees apart, of which each tells the side, and views too flat to tell it."""
    for away in (2.0, 0.3):
        planes = wall((0.0, np.array([-20.0, -away, 0.0])))
        lidar = np.array([20.0, -away, 0.0])
        config = CONFIG.changed(min_incidence_sine=0.0)
        matches = matched(planes, MIDDLE, lidar, config)
        assert len(matches.planes) == len(MIDDLE)
        assert len(matches.faces.rows) == 0


def test_a_view_that_is_too_flat_to_tell_the_side_counts_for_both() -> None:
    """Five points spread by half a metre, 3 cm off each: their normal is known to 3 degrees."""
    flat, steep = (np.array([20.0, 20.0 * sine, 0.0]) for sine in (0.03, 0.5))
    points = MIDDLE
    assert len(matched(wall((0.0, flat)), points, FRONT).planes) == len(points)
    assert len(matched(wall((0.0, steep)), points, FRONT).planes) == 0


def test_the_sweep_knows_a_wide_flat_surface_better_than_five_points_of_the_map_do() -> None:
    """A view from behind at 6 degrees, as of the ceiling below a floor: five points know 9."""
    behind, points = (
        wall((0.0, np.array([20.0, 2.0, 1.0]))),
        at(0.0, MIDDLE + np.array([0.0, 0.0, 0.9])),
    )
    assert len(matched(behind, points, FRONT).planes) == 0
    assert len(matched(behind, points[:1], FRONT).planes) == 1  # alone it is no surface
    rough = points + np.outer(np.resize([0.1, 0.5], len(points)), [0.0, 1.0, 0.0])
    assert len(matched(behind, rough, FRONT).planes) > 0.9 * len(points)


def test_an_edge_at_the_end_of_the_wall_is_matched_from_both_sides() -> None:
    edges, planes = CubeMap(MAP, 0.05), CubeMap(MAP, 0.4)
    edge = np.column_stack([np.full(9, 3.0), np.zeros(9), np.linspace(-1.0, 1.0, 9)])
    edges.insert(edge, FRONT)
    inner = edge[1:-1]
    for lidar in (FRONT, BACK):
        pose = gtsam.Pose3(gtsam.Rot3(), lidar)
        matches = associate(inner - lidar, NONE, pose, edges, planes, CONFIG)
        assert len(matches.edges) == len(inner)


def test_views_do_not_break_a_plane_that_is_no_wall() -> None:
    """Over a step of 0.2 m the plane is tilted: points on either side of it need not be hidden."""
    ahead, behind = np.array([6.0, -1.5, 0.0]), np.array([-6.0, -1.5, 0.0])
    along = np.arange(-1.0, 0.0, 0.25)
    z = np.arange(-1.0, 1.01, 0.25)
    panel = np.array([[x, 0.0, h] for x in along for h in z])
    recess = at(THICKNESS, panel * np.array([-1.0, 1.0, 1.0]))
    queries = np.array([[0.0, 0.1, h] for h in (-0.4, 0.1, 0.6)])
    found = []
    for seen in ((ahead, behind), (None, None)):
        planes = CubeMap(MAP, 0.05)
        planes.insert(panel, seen[0])
        planes.insert(recess, seen[1])
        found.append(matched(planes, queries, behind).planes)
    assert len(found[0]) == len(queries)
    np.testing.assert_array_equal(found[0].normals, found[1].normals)


def test_the_second_face_enters_voxels_that_the_first_one_holds() -> None:
    planes, first_only = (wall((0.1, FRONT), voxel=0.4 / OBLIQUE_EDGE) for _ in range(2))
    held = planes.count()
    behind = face(0.1 + THICKNESS)
    first_only.insert(behind, BACK)
    matches = matched(planes, behind, BACK)
    assert len(matches.planes) == 0
    planes.insert(behind, BACK, matches.faces)
    assert planes.count() > 1.8 * held > 1.1 * first_only.count()
    points = at(0.1 + THICKNESS)
    found = matched(planes, points, BACK).planes
    assert len(found) > 0.6 * len(points) > len(matched(first_only, points, BACK).planes)
    np.testing.assert_allclose(found.distances, 0.0, atol=1e-9)
    # A second time there is no place left, nor anything new.
    planes.insert(behind, BACK, matches.faces)
    assert planes.count() <= 2 * held


def test_a_face_seen_from_all_around_stays_one_point_a_voxel() -> None:
    """Even of points that are said to be by another face: the view of the first one decides."""
    planes = wall((0.1, np.array([-20.0, -4.0, 0.0])), voxel=0.4)
    planes.insert(face(0.12), np.array([-20.0, -4.0, 0.0]))  # no voxel of these points is left free
    held = planes.count()
    points = face(0.12)
    every = np.arange(len(points))
    towards = Faces(every, np.tile([0.0, -1.0, 0.0], (len(points), 1)), np.full(len(points), 0.1))
    planes.insert(points, np.array([20.0, -4.0, 0.0]), towards)
    assert planes.count() == held
    planes.insert(points, BACK, towards._replace(normals=-towards.normals))
    assert 1.5 * held < planes.count() <= 2 * held


def test_means_have_no_side() -> None:
    config = MAP.changed(insertion="centroid")
    planes = CubeMap(config, 0.05)
    planes.insert(face(0.0), FRONT)
    behind = at(THICKNESS)
    assert len(matched(planes, behind, BACK).planes) == len(behind)
    thinned = wall((0.0, FRONT)).thinned(2.0)
    assert not thinned.nearest(MIDDLE, 1, 1.0, thinned.neighbourhood(np.eye(4))).views.any()


def test_sides_move_with_their_points() -> None:
    """After a turn of the map by a third about (1, 1, 1), which leaves the voxels; with seconds."""
    planes = wall((0.1, FRONT), voxel=0.4)
    behind = face(0.1 + THICKNESS)
    planes.insert(behind, BACK, matched(planes, behind, BACK).faces)
    count = planes.count()
    turned = gtsam.Pose3(gtsam.Rot3(np.roll(np.eye(3), 1, axis=0)), np.zeros(3))
    assert planes.move({0: turned.matrix()}) == count
    assert planes.count() > 0.95 * count
    edges = CubeMap(MAP, 0.1)
    for y, lidar in ((0.1, FRONT), (0.1 + THICKNESS, BACK)):
        points = at(y) - lidar
        pose = turned.compose(gtsam.Pose3(gtsam.Rot3(), lidar))
        matches = associate(NONE, points, pose, edges, planes, CONFIG)
        sure = matches.planes.sigmas < 0.1  # those through both faces say that they are rough
        assert np.count_nonzero(sure) > 0.6 * len(points)
        assert np.abs(matches.planes.distances[sure]).max() < 0.02


@pytest.mark.parametrize("megabytes", [100.0, 0.0])
def test_sides_survive_the_archive(tmp_path, megabytes: float) -> None:
    config = MAP.changed(
        window=(3, 3, 3), window_margin=1, archive_megabytes=megabytes, archive_dir=str(tmp_path)
    )
    planes = CubeMap(config, 0.4)
    planes.insert(face(0.1), FRONT)
    behind = face(0.1 + THICKNESS)
    planes.insert(behind, BACK, matched(planes, behind, BACK).faces)
    cubes = planes.neighbourhood(np.eye(4))
    before = planes.nearest(behind, 5, 1.0, cubes)
    assert planes.recenter(np.array([500.0, 0.0, 0.0])) > 0
    planes.recenter(np.zeros(3))
    after = planes.nearest(behind, 5, 1.0, cubes)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)
    assert before.views[..., 3].any()


def test_second_points_have_a_place_of_their_own() -> None:
    faces = Faces(np.array([0]), np.array([[0.0, 1.0, 0.0]]), np.array([0.1]))
    planes = CubeMap(MAP, 0.4)
    planes.insert(np.array([[0.1, 0.1, 0.1]]), FRONT)
    planes.insert(np.array([[0.1, 0.3, 0.1]]), BACK, faces)
    found = planes.nearest(np.array([[0.1, 0.3, 0.1]]), 2, 1.0, planes.neighbourhood(np.eye(4)))
    assert found.views[0, :, 3].tolist() == [1, 0]
    assert second(np.zeros((1, 2), np.int32)).tolist() == [False]


def test_what_fills_a_map_is_second_in_no_voxel_of_it() -> None:
    """A second point of large voxels has a small one for itself, or there is one already."""
    large = wall((0.1, FRONT), voxel=0.4 / OBLIQUE_EDGE)
    behind = face(0.1 + THICKNESS)
    large.insert(behind, BACK, matched(large, behind, BACK).faces)
    small = CubeMap(MAP, 0.1)
    small.insert(behind, BACK)
    held = small.count()
    small.fill(large)
    assert second(large.contents()[0, 0, 0].tags).any()
    assert held < small.count() <= held + len(face(0.1))
    assert not any(second(cube.tags).any() for cube in small.contents().values())
    before = small.count()
    small.fill(large)
    assert small.count() == before


def test_a_sweep_brings_its_faces_into_the_map_however_it_was_de_skewed(monkeypatch) -> None:
    brought, insert = [], MapPair.insert

    def noted(maps: MapPair, posed: PosedSweep, pose: gtsam.Pose3, keyframe: int, matches=None):
        brought.append(matches is not None and matches.faces is not None)
        insert(maps, posed, pose, keyframe, matches)

    monkeypatch.setattr(MapPair, "insert", noted)
    run(SimulatedWorld("room", frames=14, columns=450), Config())
    assert len(brought) > 10
    assert all(brought[-6:])

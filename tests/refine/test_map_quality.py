"""How sharp a map is, on shapes of which that is known."""

import numpy as np
import pytest

from loam_gtsam.refine.map_quality import common_thickness, map_quality
from loam_gtsam.types import InputError


def _wall(scatter, count=8_000, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.0, 0.25, 0.0], [5.0, 0.25, 3.0], (count, 3))
    points[:, 1] += scatter * rng.normal(size=count)
    return points


def test_a_wall_is_as_thick_as_its_points_scatter_and_entropy_tells_which_is_thinner() -> None:
    thin, thick = map_quality(_wall(0.005)), map_quality(_wall(0.015))
    assert thin.thickness == pytest.approx(0.005, rel=0.05)
    assert thick.thickness == pytest.approx(0.015, rel=0.05)
    assert thin.planar_share == 1.0
    assert np.abs(thin.normals[:, 1]).min() > 0.99
    assert thick.entropy - thin.entropy == pytest.approx(np.log(3.0), rel=0.05)
    before, after, planes = common_thickness(thick, thin)
    assert (before, after) == (thick.thickness, thin.thickness)
    assert planes == thin.planes


def test_a_cloud_is_no_plane_and_one_sweep_tells_nothing() -> None:
    cloud = np.random.default_rng(1).uniform(0.0, 2.0, (5000, 3))
    assert map_quality(cloud).planes == 0
    assert np.isnan(map_quality(cloud).thickness)
    wall = _wall(0.01, 5000)
    assert map_quality(wall, np.zeros(5000, int)).planes == 0
    assert map_quality(wall, np.arange(5000) % 3).planes > 0
    nothing = map_quality(np.empty((0, 3)))
    assert nothing.planes == 0
    assert np.isnan(nothing.entropy)
    assert common_thickness(nothing, nothing)[2] == 0


def test_what_is_no_map_is_refused() -> None:
    with pytest.raises(InputError, match=r"points: expected \(N, 3\)"):
        map_quality(np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"sweeps: expected \(10,\) integers"):
        map_quality(np.zeros((10, 3)), np.zeros(9, int))
    with pytest.raises(InputError, match="voxel: expected a positive length"):
        map_quality(np.zeros((10, 3)), voxel=0.0)

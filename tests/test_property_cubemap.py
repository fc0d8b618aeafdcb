"""The cube map against the slow and obvious way: 10,000 random operations, and laws of its own."""

from collections import Counter
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.cubes import SMALL
from support.strategies import FEW, generators

from loam_gtsam.config import MapConfig
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import OBLIQUE_EDGE, transform

Cell = tuple[int, int, int]
Point = tuple[float, float, float]

CUBE, VOXEL = 4.0, 0.5
EDGES = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]])
"""Of oblique voxels, three times as long."""


def voxel_size(config: MapConfig) -> float:
    """That of voxels with edges of VOXEL."""
    return VOXEL / OBLIQUE_EDGE if config.insertion == "settled" else VOXEL


class Reference:
    """All (position, owner) in a dictionary, by their voxel; the window is a question."""

    def __init__(self, config: MapConfig) -> None:
        self.config = config
        self.cubes: dict[Cell, dict[Cell, tuple[Any, int]]] = {}
        self.low = [-(n // 2) for n in config.window]
        self.outside = 0

    def recenter(self, position: Any) -> None:
        for axis, (c, n) in enumerate(zip(cube_of(position), self.config.window, strict=True)):
            margin = self.config.window_margin
            self.low[axis] = min(self.low[axis], c - margin)
            self.low[axis] = max(self.low[axis], c - (n - 1 - margin))

    def inside(self, cube: Cell) -> bool:
        (i, j, k), (a, b, c), (u, v, w) = cube, self.low, self.config.window
        return a <= i < a + u and b <= j < b + v and c <= k < c + w

    def insert(self, points: Any, owner: int) -> None:
        new: dict[tuple[Cell, Cell], list[Any]] = {}
        for point in points:
            if self.inside(cube_of(point)):
                new.setdefault((cube_of(point), self.voxel_of(point)), []).append(point)
            else:
                self.outside += 1
        for (cube, voxel), group in new.items():
            held = self.cubes.setdefault(cube, {})
            if self.config.insertion == "settled":
                held.setdefault(voxel, (group[0], owner))
                continue
            old, by = held.get(voxel, (None, owner))
            everything = group if old is None else [*group, old]
            held[voxel] = (np.mean(everything, axis=0), by)

    def move(self, moves: dict[int, Any]) -> int:
        taken: dict[int, list[Any]] = {owner: [] for owner in moves}
        for held in self.cubes.values():
            for voxel in [v for v, (_, owner) in held.items() if owner in moves]:
                point, owner = held.pop(voxel)
                taken[owner].append(transform(moves[owner], point[None])[0])
        for owner in sorted(moves):
            for point in taken[owner]:
                held = self.cubes.setdefault(cube_of(point), {})
                held.setdefault(self.voxel_of(point), (point, owner))
        return sum(map(len, taken.values()))

    def voxel_of(self, point: Any) -> Cell:
        settled = self.config.insertion == "settled"
        x, y, z = (int(np.floor(c / VOXEL)) for c in (EDGES @ point / 3.0 if settled else point))
        return x, y, z

    def neighbourhood(self, pose: Any) -> list[Cell]:
        centre = cube_of(pose[:3, 3])
        around = (cube for cube, held in self.cubes.items() if held and self.inside(cube))
        near = (c for c in around if np.abs(np.subtract(c, centre)).max() <= 1)
        return sorted(cube for cube in near if self.visible(cube, pose))

    def visible(self, cube: Cell, pose: Any) -> bool:
        """Whether a corner is 30 to 150 degrees off the up axis, by the law of cosines (LOAM)."""
        sensor, up = pose[:3, 3], pose[:3, 3] + 10.0 * pose[:3, 2]
        for number in range(8):
            corner = CUBE * np.array([i + (0.5 if number >> k & 1 else -0.5)
                                      for k, i in enumerate(cube)])  # fmt: skip
            one, two = ((sensor - corner) ** 2).sum(), ((up - corner) ** 2).sum()
            cosine = (100.0 + one - two) / (20.0 * np.sqrt(one))
            if abs(cosine) < np.cos(np.radians(30.0)):
                return True
        return False

    def points(self, cubes: list[Cell] | None = None, archived: bool = False) -> Any:
        chosen = [cube for cube in sorted(self.cubes) if archived or self.inside(cube)]
        if cubes is not None:
            chosen = sorted(set(cubes) & set(chosen))
        rows = [self.cubes[cube][voxel][0] for cube in chosen for voxel in sorted(self.cubes[cube])]
        return np.array(rows).reshape(-1, 3)


def cube_of(point: Any) -> Cell:
    x, y, z = (int(np.floor((c + 0.5 * CUBE) / CUBE)) for c in point)
    return x, y, z


def k_nearest(points: Any, queries: Any, k: int, limit: float) -> Any:
    """(M, k) squared distances, infinite where there is no neighbour."""
    squared = ((queries[:, None, :] - points[None]) ** 2).sum(axis=2)
    squared[squared >= limit**2] = np.inf
    squared = np.pad(squared, ((0, 0), (0, k)), constant_values=np.inf)
    return np.sort(squared, axis=1)[:, :k]


OPERATIONS = ["insert", "recenter", "neighbourhood", "nearest", "points", "archive", "count"]
WEIGHTS = np.array([25, 15, 15, 25, 8, 2, 10])


@pytest.mark.parametrize(
    ("insertion", "megabytes", "steps"),
    [
        ("settled", 100.0, 2000),
        ("centroid", 100.0, 2000),
        ("settled", 2e-3, 500),
        ("centroid", 0.0, 500),
    ],
)
def test_five_thousand_random_operations_in_all_are_those_of_a_dictionary(
    insertion: str, megabytes: float, steps: int, tmp_path: Path
) -> None:
    config = SMALL.changed(
        insertion=insertion, archive_megabytes=megabytes, archive_dir=str(tmp_path),
        field_of_view=True,
    )  # fmt: skip
    rng = np.random.default_rng(steps + int(megabytes))
    cubes, reference = CubeMap(config, voxel_size(config)), Reference(config)
    position, around = np.zeros(3), ()
    pose = np.eye(4)
    seen: Counter[str] = Counter()
    for _ in range(steps):
        operation = rng.choice(OPERATIONS, p=WEIGHTS / WEIGHTS.sum())
        seen[operation] += 1
        if operation == "insert":
            cubes.owner = int(rng.integers(0, 5))
            spread = rng.choice([0.5, 3.0, 9.0])
            points = position + rng.normal(0.0, spread, (rng.integers(0, 12), 3))
            cubes.insert(points)
            reference.insert(points, cubes.owner)
        elif operation == "recenter":
            position = position + rng.normal(0.0, rng.choice([0.5, 4.0, 12.0]), 3) - 0.1 * position
            cubes.recenter(position)
            reference.recenter(position)
            assert cubes.window[0] == tuple(reference.low)
        elif operation == "neighbourhood":
            pose = gtsam.Pose3.Expmap(np.append(rng.normal(size=3), [0, 0, 0])).matrix()
            pose[:3, 3] = position + rng.normal(0.0, 2.0, 3)
            around = cubes.neighbourhood(pose)
            assert list(around) == reference.neighbourhood(pose)
        elif operation == "nearest":
            queries = position + rng.normal(0.0, 3.0, (6, 3))
            border = np.round((queries[:3] - 0.5 * CUBE) / CUBE) * CUBE + 0.5 * CUBE
            queries[:3] = np.where(rng.random((3, 3)) < 0.5, border, queries[:3])
            k, limit = int(rng.integers(1, 7)), float(rng.choice([0.5, 2.0, np.inf]))
            found, squared, _ = cubes.nearest(queries, k, limit, around)
            near = reference.points(list(around))
            np.testing.assert_allclose(squared, k_nearest(near, queries, k, limit), rtol=1e-9,
                                       atol=1e-12)  # fmt: skip
            away = ((found - queries[:, None]) ** 2).sum(axis=2)
            known = np.isfinite(squared)
            np.testing.assert_allclose(away[known], squared[known], rtol=1e-9, atol=1e-12)
            assert np.isnan(found[~known]).all()
        elif operation == "points":
            np.testing.assert_allclose(cubes.points(), reference.points(), rtol=0, atol=1e-9)
        elif operation == "archive":
            found = cubes.points(archived=True)
            np.testing.assert_allclose(found, reference.points(archived=True), rtol=0, atol=1e-9)
            assert cubes.count() + cubes.stats.archived_points == len(found)
        else:
            assert cubes.count() == len(reference.points())
            assert cubes.count(around) == len(reference.points(list(around)))
    stats = cubes.stats
    assert stats.outside == reference.outside
    assert stats.dropped_cubes == 0
    assert min(seen.values()) > 0.005 * steps
    assert min(stats.evicted, stats.restored) > 30
    assert len(cubes.points(archived=True)) > 200


@FEW
@given(rng=generators(), insertion=st.sampled_from(["settled", "centroid"]))
def test_moved_points_are_those_of_a_dictionary(rng: np.random.Generator, insertion: str) -> None:
    """Whole voxels, and turns that leave the voxels: no point comes to lie in that of another."""
    config = SMALL.changed(insertion=insertion)
    cubes, reference = CubeMap(config, voxel_size(config)), Reference(config)
    for _ in range(10):
        position = rng.normal(0.0, 6.0, 3)
        cubes.recenter(position)
        reference.recenter(position)
        owner = int(rng.integers(0, 3))
        # Owners apart by height, each in its own band of voxels, before and after the move.
        points = position + rng.normal(0.0, 3.0, (40, 3))
        points[:, 2] = 0.25 + owner
        cubes.owner = owner
        cubes.insert(points)
        reference.insert(points, owner)
        if rng.random() < 0.4:
            moves = {}
            for which in range(int(rng.integers(1, 4))):
                moves[which] = np.eye(4)
                if insertion == "settled":
                    moves[which][:3, :3] = np.roll(np.eye(3), rng.integers(0, 3), axis=0)
                    moves[which][:3, 3] = VOXEL * EDGES.T @ rng.integers(-3, 4, 3)
                else:
                    turn = gtsam.Rot3.Yaw(0.5 * np.pi * rng.integers(0, 4)).matrix()
                    moves[which][:3, :3] = np.round(turn)
                    moves[which][:2, 3] = VOXEL * rng.integers(-9, 10, 2)
            assert cubes.move(moves) == reference.move(moves)
            found, expected = cubes.points(archived=True), reference.points(archived=True)
            order = [np.lexsort(np.round(part, 6).T) for part in (found, expected)]
            np.testing.assert_allclose(found[order[0]], expected[order[1]], rtol=0, atol=1e-9)

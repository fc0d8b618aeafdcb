"""Scan registration against closed forms, a sequential reference, and real sweeps."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loam_gtsam.config import Config, DeskewConfig, FeatureConfig, SensorConfig
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.curvature import (
    curvature,
    running_sums,
    squared_gaps,
    unreliable_points,
    window_fits,
)
from loam_gtsam.frontend.features import (
    averaged_along_rings,
    cut_into_runs,
    extract_features,
    pick_by_sector,
    sector_bounds,
    thinned,
    voxel_filter_by_ring,
)
from loam_gtsam.frontend.organise import organise
from loam_gtsam.frontend.rings import ELEVATIONS
from loam_gtsam.types import Features, Scan, SweepError

LOAM = FeatureConfig(post_depth=0.0)
ROUGH_TOO = Config(features=FeatureConfig(range_noise=0.0, post_depth=0.0))
AROUND = np.arange(-179.9, 180.0, 0.2)
AHEAD = np.arange(-50.1, 50.2, 0.2)


def world(
    distance: Callable[[np.ndarray], np.ndarray],
    elevations: np.ndarray = ELEVATIONS["vlp16"],
    azimuth_deg: np.ndarray = AROUND,
) -> Scan:
    """A scan of vertical surfaces at a horizontal distance, ring after ring, clockwise."""
    azimuth = np.deg2rad(azimuth_deg[::-1])
    horizontal = distance(azimuth)
    rings = np.repeat(np.arange(len(elevations)), len(azimuth))
    x, y = horizontal * np.cos(azimuth), horizontal * np.sin(azimuth)
    z = np.tan(np.deg2rad(elevations))[:, None] * horizontal
    points = np.stack((*np.broadcast_arrays(x, y, z),), axis=-1).reshape(-1, 3)
    times = np.tile(0.1 * (np.pi - azimuth) / (2 * np.pi), len(elevations))
    return Scan(points, 5_000_000_000, times=times, rings=rings)


def room(azimuth: np.ndarray) -> np.ndarray:
    """Square room, walls 10 m away."""
    return 10.0 / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth)))


def pole_and_wall(azimuth: np.ndarray) -> np.ndarray:
    """Wall 10 m ahead, a thin pole 5 m away at 11 degrees."""
    wall = 10.0 / np.cos(azimuth)
    return np.where(np.abs(azimuth - np.deg2rad(11.0)) < np.deg2rad(1.3), 5.0, wall)


def noisy_scan(seed: int = 0, points_per_ring: int = 1200, rings: int = 4) -> Scan:
    """A room with noise on one side and random steps: features of every kind, none regular."""
    rng = np.random.default_rng(seed)
    scan = world(room, np.linspace(-9.0, 9.0, rings), np.linspace(-179, 179, points_per_ring))
    noise = np.where(scan.points[:, 1] > 0.0, 0.005, 0.0002)
    scale = 1.0 + noise * rng.normal(size=len(scan.points))
    steps = rng.integers(0, len(scan.points), 20)
    for step in steps:
        scale[step : step + 15] *= rng.uniform(0.6, 1.0)
    return replace(scan, points=scan.points * scale[:, None])


def test_square_room_has_edges_at_its_corners_and_planes_on_its_walls() -> None:
    features = extract_features(world(room), Config())
    horizontal = np.abs(features.edges[:, :2])
    # A corner lies between two columns, 7 cm apart along either wall.
    assert np.all(horizontal > 9.9)
    assert np.all(np.bincount(features.edge_rings, minlength=16) == 4)
    assert len(features.sharp) == len(features.edges)
    # A voxel may straddle a corner, its centroid then lies up to a voxel inside.
    off_wall = np.abs(np.abs(features.planes[:, :2]).max(axis=1) - 10.0)
    assert off_wall.max() < 0.2
    assert np.mean(off_wall < 1e-5) > 0.97
    assert np.all(np.bincount(features.plane_rings[features.flat], minlength=16) == 24)


def test_pole_is_an_edge_and_the_wall_it_hides_is_not() -> None:
    scan = world(pole_and_wall, azimuth_deg=AHEAD)
    edges = extract_features(scan, Config()).edges
    assert len(edges) == 2 * 16
    assert np.allclose(np.hypot(edges[:, 0], edges[:, 1]), 5.0)
    unguarded = Config(features=FeatureConfig(occlusion_gap=1e9, grazing_ratio=1e9))
    flank = extract_features(scan, unguarded).edges
    assert np.any(np.hypot(flank[:, 0], flank[:, 1]) > 9.0)


def test_grazed_wall_gives_no_edges() -> None:
    def street(azimuth: np.ndarray) -> np.ndarray:
        return np.minimum(2.0 / np.maximum(np.abs(np.sin(azimuth)), 1e-9), 60.0)

    scan = world(street, azimuth_deg=np.arange(-179.9, -0.5, 0.2))
    unguarded = Config(features=FeatureConfig(grazing_ratio=1e9))
    far = lambda f: np.count_nonzero(np.abs(f.edges[:, 0]) > 12.0)  # noqa: E731
    assert far(extract_features(scan, unguarded)) > 0
    assert far(extract_features(scan, Config())) == 0


def test_sectors_split_what_has_a_window() -> None:
    bounds = sector_bounds(np.array([0, 12, 15, 57]), 5, 3)
    assert bounds[:3].tolist() == [[5, 5], [5, 6], [6, 7]]
    assert np.all(bounds[3:6, 0] == bounds[3:6, 1])  # the ring of three points
    assert bounds[6:].tolist() == [[20, 30], [30, 41], [41, 52]]


def sequential_picks(
    xyz: np.ndarray, starts: np.ndarray, settings: FeatureConfig
) -> tuple[list[int], list[int], list[int]]:
    """(sharp, edges, flat) by LOAM's own order: sector by sector, edges then flat points."""
    window = settings.half_window
    bend = curvature(xyz, window)
    gaps = squared_gaps(xyz, starts)
    taken = unreliable_points(xyz, gaps, starts, settings)
    sharp: list[int] = []
    edges: list[int] = []
    flat: list[int] = []

    def suppress(i: int) -> None:
        taken[i] = True
        for way in (1, -1):
            for k in range(1, window + 1):
                if gaps[i + way * k - (way > 0)] > settings.max_gap:
                    break
                taken[i + way * k] = True

    for low, high in sector_bounds(starts, window, settings.sectors):
        order = low + np.argsort(bend[low:high], kind="stable")
        count = 0
        for i in order[::-1]:
            if taken[i] or bend[i] <= settings.edge_curvature:
                continue
            if count == settings.edges_per_sector:
                break
            (sharp if count < settings.sharp_per_sector else edges).append(int(i))
            count += 1
            suppress(int(i))
        count = 0
        for i in order:
            if taken[i] or bend[i] >= settings.plane_curvature:
                continue
            if count == settings.flat_per_sector:
                break
            flat.append(int(i))
            count += 1
            suppress(int(i))
    return sharp, sharp + edges, flat


class Picked:
    """Where, in organised order, the edge, sharp and flat points of a scan are."""

    def __init__(self, scan: Scan, config: Config) -> None:
        # Both leave the points as they were measured.
        config = config.changed("features.thinning=voxels", "features.beam_width=1")
        self.sweep = organise(scan, config)
        self.features = extract_features(scan, config)
        where = {tuple(point): i for i, point in enumerate(self.sweep.xyz.T.astype(np.float64))}
        rows = lambda points: sorted(where[tuple(point)] for point in points)  # noqa: E731
        self.edges = rows(self.features.edges)
        self.sharp = rows(self.features.edges[self.features.sharp])
        self.flat = rows(self.features.planes[self.features.flat])


def test_picks_of_one_sector_are_those_of_the_sequential_algorithm() -> None:
    settings = FeatureConfig(sectors=1, edges_per_sector=12, post_depth=0.0)
    config = Config(features=settings)
    for seed in range(5):
        found = Picked(noisy_scan(seed), config)
        expected = sequential_picks(found.sweep.xyz, found.sweep.ring_starts, settings)
        assert (found.sharp, found.edges, found.flat) == tuple(map(sorted, expected))


def test_picks_of_six_sectors_differ_only_near_borders() -> None:
    found = Picked(noisy_scan(3), Config(features=LOAM))
    _, edges, _ = sequential_picks(found.sweep.xyz, found.sweep.ring_starts, LOAM)
    assert len(set(found.edges) ^ set(edges)) < 0.1 * len(edges)


def counts_by_sector(rows: list[int], sweep_starts: np.ndarray) -> np.ndarray:
    bounds = sector_bounds(sweep_starts, 5, 6)
    return np.array([sum(low <= row < high for row in rows) for low, high in bounds])


@pytest.mark.parametrize("points_per_ring", [22, 60, 800])
def test_counts_and_spacing(points_per_ring: int) -> None:
    # Suppression never stops early, and nothing but spacing and counts rejects.
    loose = {"max_gap": 1e9, "occlusion_gap": 1e9, "grazing_ratio": 1e9, "post_depth": 0.0}
    settings = FeatureConfig(**loose)
    found = Picked(noisy_scan(1, points_per_ring), Config(features=settings))
    edges, flat = found.edges, found.flat
    for rows, most in ((edges, 20), (found.sharp, 2), (flat, 4)):
        assert counts_by_sector(rows, found.sweep.ring_starts).max() <= most
    assert np.diff(sorted(edges + flat)).min() > 5
    bend = curvature(found.sweep.xyz, 5)
    assert bend[edges].min() > 0.1
    assert max(bend[flat], default=0.0) < 0.1


def test_every_sector_with_edges_has_a_sharp_one() -> None:
    # Sectors of a few points: many wait for a neighbour's pick before they get their first.
    settings = FeatureConfig(sectors=150, sharp_per_sector=1, edges_per_sector=3)
    found = Picked(noisy_scan(), Config(features=settings))
    bounds = sector_bounds(found.sweep.ring_starts, 5, 150)
    sector_of = lambda rows: np.searchsorted(bounds[:, 0], rows, side="right")  # noqa: E731
    assert np.array_equal(sector_of(found.sharp), np.unique(sector_of(found.edges)))


def test_suppression_stops_at_a_gap() -> None:
    score = np.zeros(40, np.float32)
    score[[18, 20]] = 2.0, 1.0
    eligible = score > 0.0
    cells = np.array([[5, 35]])
    for gap_at, expected in ((None, [18]), (19, [18, 20]), (20, [18])):
        linked = np.ones(40, dtype=bool)
        if gap_at is not None:
            linked[gap_at] = False
        found, rank = pick_by_sector(score, eligible, cells, 5, linked, 5, np.ones(40, dtype=bool))
        assert found.tolist() == expected
        assert rank.tolist() == list(range(len(expected)))


def test_limit_of_zero_picks_nothing() -> None:
    scan = noisy_scan()
    none = FeatureConfig(sharp_per_sector=0, edges_per_sector=0, flat_per_sector=0)
    features = extract_features(scan, Config(features=none))
    assert (len(features.edges), len(features.sharp), len(features.flat)) == (0, 0, 0)
    assert len(features.planes) > 100


def test_rest_is_the_voxel_filtered_remainder_of_each_ring() -> None:
    found = Picked(noisy_scan(2), ROUGH_TOO)
    sweep, features, used = found.sweep, found.features, {*found.edges, *found.flat}
    ring = np.repeat(sweep.ring_of_start, np.diff(sweep.ring_starts))
    first = sweep.span[0]  # the reference time
    groups: dict[tuple[int, ...], list[int]] = {}
    for row in np.flatnonzero(window_fits(sweep.ring_starts, 5)):
        if row not in used:
            cell = np.floor(sweep.xyz[:, row] * np.float32(1 / 0.2)).astype(int)
            groups.setdefault((int(ring[row]), *cell.tolist()), []).append(int(row))
    expected = np.array([
        [*sweep.xyz[:, rows].mean(axis=1, dtype=float), sweep.times[rows].mean() - first, key[0]]
        for key, rows in sorted(groups.items())
    ])  # fmt: skip
    assert len(features.flat) > 20
    rest = slice(len(features.flat), None)
    assert features.planes[rest] == pytest.approx(expected[:, :3], abs=1e-5)
    assert features.plane_times[rest] == pytest.approx(expected[:, 3], abs=1e-12)
    assert np.array_equal(features.plane_rings[rest], expected[:, 4])


def test_rings_that_meet_in_a_voxel_stay_apart() -> None:
    xyz = np.full((3, 4), 0.1, np.float32)
    points, times, rings = voxel_filter_by_ring(xyz, np.arange(4.0), np.array([0, 0, 1, 1]), 0.2)
    assert points == pytest.approx(np.full((2, 3), 0.1))
    assert (times.tolist(), rings.tolist()) == ([0.5, 2.5], [0, 1])


def test_voxels_two_hundred_thousand_apart_are_not_taken_for_one() -> None:
    far = np.array([[0.0005, 262.1445, 0.0], [0.0015, 0.0005, 0.0]], np.float32)
    points, times, rings = voxel_filter_by_ring(far.T, np.arange(2.0), np.array([0, 0]), 0.001)
    assert points == pytest.approx(far)
    assert (times.tolist(), rings.tolist()) == ([0.0, 1.0], [0, 0])


def test_runs_end_at_their_length_at_gaps_and_with_the_ring() -> None:
    y = np.concatenate([0.01 * np.arange(100), 2.0 + 0.01 * np.arange(50), np.zeros(30)])
    xyz = np.stack([np.full(180, 10.0), y, np.zeros(180)]).astype(np.float32)
    gaps = squared_gaps(xyz, np.array([0, 150, 180]))
    chosen = np.setdiff1d(np.arange(180), [3, 60])
    starts = cut_into_runs(running_sums(xyz), gaps, chosen, 0.25, 5)
    parts = np.split(chosen, starts[1:])
    assert {100, 150} <= {part[0] for part in parts}
    assert max(np.ptp(y[part]) for part in parts) < 0.3
    assert np.median([len(part) for part in parts]) > 10
    points, times, rings = averaged_along_rings(
        xyz, np.arange(180.0), np.repeat([4, 7], [150, 30]), chosen, starts
    )
    assert points[:, 1] == pytest.approx([y[part].mean() for part in parts], abs=1e-6)
    assert times == pytest.approx([part.mean() for part in parts])
    assert rings.tolist() == [4 if part[0] < 150 else 7 for part in parts]


def wall(tilt: float, seed: int) -> Scan:
    """A noisy wall 4 m ahead, where voxels of 0.2 m have a border, that leans forward."""
    rng = np.random.default_rng(seed)
    azimuth = np.deg2rad(np.arange(-50.0, 50.0, 0.1))
    rays = np.stack(
        [
            np.stack([np.cos(azimuth), np.sin(azimuth), np.full(len(azimuth), np.tan(lift))], 1)
            for lift in np.deg2rad(ELEVATIONS["vlp16"])
        ]
    )
    reach = 4.0 / (rays[..., 0] - tilt * rays[..., 2])
    lengths = np.linalg.norm(rays, axis=-1)
    reach += 0.02 * rng.standard_normal(reach.shape) / lengths
    points = (reach[..., None] * rays).reshape(-1, 3).astype(np.float32)
    times = np.tile(np.linspace(0.0, 0.1, len(azimuth)), 16)
    return Scan(points, 0, times=times, rings=np.repeat(np.arange(16), len(azimuth)))


@pytest.mark.parametrize(
    ("thinning", "lowest", "highest"), [("runs", 0.9, 1.1), ("voxels", 0, 0.7)]
)
def test_runs_keep_the_lean_of_a_wall_that_voxels_take_away(
    thinning: str, lowest: float, highest: float
) -> None:
    tilt, slopes = np.deg2rad(0.5), []
    for seed in range(4):
        config = Config().changed("map.small_below=0", f"features.thinning={thinning}")
        planes = extract_features(wall(tilt, seed), config).planes
        slopes.append(np.polyfit(planes[:, 2], planes[:, 0], 1)[0])
    assert lowest < np.mean(slopes) / tilt < highest


def test_flat_runs_are_those_with_flat_points() -> None:
    scan = noisy_scan(2)
    found, features = Picked(scan, Config()), extract_features(scan, Config())
    runs = features.planes[features.flat]
    measured = found.features.planes[found.features.flat]
    nearest = np.linalg.norm(runs[:, None] - measured, axis=2).min(axis=1)
    assert 20 < len(runs) <= len(measured)
    assert nearest.max() < 0.2


@pytest.mark.parametrize("bound", [0.1, 1e-3])
def test_flat_points_are_below_the_bound(bound: float) -> None:
    settings = FeatureConfig(plane_curvature=bound, flat_per_sector=100)
    found = Picked(noisy_scan(), Config(features=settings))
    assert 0.1 * bound < curvature(found.sweep.xyz, 5)[found.flat].max() < bound


def test_voxel_of_zero_keeps_every_point() -> None:
    scan = noisy_scan()
    every = FeatureConfig(plane_voxel=0.0, range_noise=0.0)
    features = extract_features(scan, Config(features=every))
    assert len(features.edges) + len(features.planes) == len(scan.points) - 4 * 10


@pytest.mark.parametrize(("reference", "shift"), [("start", -0.02), ("end", 0.09), ("stamp", 0.0)])
def test_reference_time(reference: str, shift: float) -> None:
    scan = world(room)
    scan = replace(scan, span=(-0.02, 0.09))
    config = Config(deskew=DeskewConfig(reference=reference))  # type: ignore[arg-type]
    features = extract_features(scan, config)
    assert features.stamp == 5_000_000_000 + round(shift * 1e9)
    assert features.span == pytest.approx((-0.02 - shift, 0.09 - shift))
    azimuth = np.arctan2(features.edges[:, 1], features.edges[:, 0])
    measured = 0.1 * (np.pi - azimuth) / (2 * np.pi)
    assert features.edge_times == pytest.approx(measured - shift, abs=1e-9)


def assert_same(one: Features, two: Features) -> None:
    for name in Features.__slots__:
        assert np.array_equal(getattr(one, name), getattr(two, name)), name


def test_order_of_the_points_does_not_matter_and_runs_repeat() -> None:
    scan = noisy_scan(5)
    order = np.random.default_rng(0).permutation(len(scan.points))
    assert scan.times is not None
    assert scan.rings is not None
    shuffled = replace(
        scan, points=scan.points[order], times=scan.times[order], rings=scan.rings[order]
    )
    expected = extract_features(scan, Config())
    assert_same(extract_features(scan, Config()), expected)
    assert_same(extract_features(shuffled, Config()), expected)


def test_rings_too_short_for_a_window_are_refused_and_one_long_one_is_enough() -> None:
    scan = noisy_scan(0, points_per_ring=10)
    with pytest.raises(SweepError, match="longest of 4 rings has 10 points, at least 11"):
        extract_features(scan, Config())
    longer = noisy_scan(0, points_per_ring=11)
    assert len(extract_features(longer, ROUGH_TOO).planes) > 0


@pytest.mark.parametrize(("noise", "kept"), [(0.02, True), (0.3, False)])
def test_foliage_gives_no_planes_and_a_noisy_wall_does(noise: float, kept: bool) -> None:
    scan = world(lambda azimuth: np.full(len(azimuth), 12.0))
    ranges = np.linalg.norm(scan.points, axis=1)
    off = noise * np.random.default_rng(1).normal(size=len(ranges))
    scan = replace(scan, points=scan.points * (1 + off / ranges)[:, None])
    bare = len(extract_features(scan, ROUGH_TOO).planes)
    share = len(extract_features(scan, Config()).planes) / bare
    assert share > 0.9 if kept else share < 0.4


def real_scan(folder: Path, number: int = 0) -> Scan:
    path = folder / f"{number:06d}.bin"
    if not path.exists():
        pytest.skip(f"no {path}")
    return Scan(np.fromfile(path, dtype=np.float32).reshape(-1, 4)[:, :3], 0)


def test_town_gives_what_the_published_code_gave(shared_data: Path) -> None:
    # Edge points per sweep in the recording of the C++ loam_velodyne on the same sweeps.
    for number, recorded in enumerate((1813, 1805, 1791, 1788, 1808, 1789)):
        scan = real_scan(shared_data / "sim_town" / "scans", number)
        features = extract_features(scan, Config(features=LOAM))
        assert abs(len(features.edges) - recorded) <= 5


def test_kitti_and_ouster_sweeps(shared_data: Path) -> None:
    for folder, model in (("kitti_2011_09_26_0002", "hdl64"), ("ouster_os1_128", "os1-128")):
        scan = real_scan(shared_data / folder / "velodyne")
        rings = 64 if model == "hdl64" else 128
        times = SensorConfig(times="none" if model == "os1-128" else "auto")
        features = extract_features(scan, Config(sensor=times))
        assert len(features.sharp) > rings * 6
        assert len(features.flat) > rings * 12
        assert len(features.edges) < rings * 120
        assert features.plane_rings.max() == rings - 1


@pytest.mark.parametrize("known", [False, True])
def test_thinned_features_are_the_centroids_of_their_voxels(known: bool) -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-2.0, 2.0, (500, 3))
    times = rng.uniform(0.0, 0.1, 500)
    raw = Features.from_points(7, points, points[:300])
    raw = replace(raw, edge_times=times, plane_times=times[:300], span=(0.0, 0.1), not_finite=3)
    if known:
        raw = replace(raw, edge_prominence=times + 1.0, edge_sigmas=times + 2.0)
    config = Config().map.changed(edge_voxel=0.5, plane_voxel=1.0, insertion="centroid")
    thin = thinned(raw, config)
    for size, held, moments, all_points in (
        (0.5, thin.edges, thin.edge_times, points),
        (1.0, thin.planes, thin.plane_times, points[:300]),
    ):
        cells = [tuple(cell) for cell in np.floor(all_points / size).astype(int)]
        assert len(held) == len(moments) == len(set(cells))
        for point, moment in zip(held, moments, strict=True):
            inside = [cell == tuple(np.floor(point / size).astype(int)) for cell in cells]
            np.testing.assert_allclose(point, all_points[inside].mean(axis=0), atol=1e-12)
            assert moment == pytest.approx(times[: len(inside)][inside].mean(), abs=1e-12)
    assert (thin.stamp, thin.span, thin.not_finite) == (7, (0.0, 0.1), 3)
    for column, more in ((thin.edge_prominence, 1.0), (thin.edge_sigmas, 2.0)):
        assert (column is not None) is known
        if column is not None:
            np.testing.assert_allclose(column, thin.edge_times + more)
    assert len(thin.edge_rings) == len(thin.edges)
    assert len(thin.plane_rings) == len(thin.planes)
    assert thinned(thin, config) is thin
    assert len(thinned(thin, config.changed(plane_voxel=2.0)).planes) < len(thin.planes)


def shrunk(scan, factor):
    return replace(scan, points=(factor * scan.points).astype(np.float32))


def test_in_a_small_place_features_are_twice_as_dense():
    """Three quarters of the points of this room are nearer than 7 m; four times as large, none."""
    scan = SimulatedWorld("room", frames=1, columns=450)[0]
    ranges = np.linalg.norm(scan.points, axis=1)
    small = extract_features(scan, Config())
    assert small.reach == pytest.approx(np.quantile(ranges, 0.75), rel=0.01)
    fixed = Config().changed("map.small_below=0")
    same = extract_features(scan, fixed)
    assert len(small.planes) > 1.2 * len(same.planes)
    assert thinned(small, Config().map).voxel_sizes == (0.1, 0.2)
    assert thinned(small, fixed.map).voxel_sizes == (0.2, 0.4)
    halved = fixed.changed("features.plane_voxel=0.1")
    np.testing.assert_array_equal(extract_features(scan, halved).planes, small.planes)
    hall = shrunk(scan, 4.0)
    large, given = (extract_features(hall, config) for config in (Config(), fixed))
    assert large.reach == pytest.approx(4.0 * small.reach, rel=1e-6)
    np.testing.assert_array_equal(large.planes, given.planes)
    assert thinned(large, Config().map).voxel_sizes == (0.2, 0.4)

"""Rings and times of a sweep: every source, every refusal."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from loam_gtsam.config import Config, DeskewConfig, SensorConfig
from loam_gtsam.datasets.sim.patterns import PATTERNS
from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.frontend.features import extract_features
from loam_gtsam.frontend.organise import assign_rings, organise, usable_columns
from loam_gtsam.frontend.rings import (
    ELEVATIONS,
    are_level,
    azimuths_about_axis,
    rings_from_file_order,
)
from loam_gtsam.types import Scan, SweepError, SweepFault

VLP16 = ELEVATIONS["vlp16"]
COLUMNS = 360


def sensor(**fields: object) -> Config:
    return Config(sensor=SensorConfig(**fields))  # type: ignore[arg-type]


def firing(
    elevations: np.ndarray, clockwise: bool = True, start_deg: float = 180.0, turn: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points, rings, fraction of the sweep) in firing order, half a step off the start azimuth."""
    columns = round(COLUMNS * turn)
    fraction = (np.arange(columns) + 0.5) / COLUMNS
    azimuth = np.deg2rad(start_deg) + (-1 if clockwise else 1) * 2 * np.pi * fraction
    distance = 10.0 + 3.0 * np.sin(3 * azimuth)
    azimuth, elevation = np.meshgrid(azimuth, np.deg2rad(elevations), indexing="ij")
    horizontal = distance[:, None] * np.cos(elevation)
    x, y = horizontal * np.cos(azimuth), horizontal * np.sin(azimuth)
    points = np.stack((x, y, distance[:, None] * np.sin(elevation)), axis=-1).reshape(-1, 3)
    rings = np.tile(np.arange(len(elevations)), columns)
    return points.astype(np.float32), rings, np.repeat(fraction, len(elevations))


def rings_of(scan: Scan, config: Config) -> np.ndarray:
    return assign_rings(usable_columns(scan, config), config.sensor).rings


def test_drops_points_with_all_their_columns() -> None:
    points, rings, fraction = firing(VLP16)
    bad = np.array([3, 500, 1000, 4000])
    points[bad] = [[np.nan] * 3, [np.inf, 0, 0], [0.1, 0.1, 0.1], [200.0, 0, 0]]
    times = 0.1 * fraction
    sweep = organise(Scan(points, 0, times=times, rings=rings), Config())
    assert sweep.dropped == 4
    kept = np.setdiff1d(np.arange(len(points)), bad)
    assert np.array_equal(np.sort(sweep.index), kept)
    assert np.array_equal(sweep.times, times[sweep.index])
    assert np.array_equal(sweep.xyz.T, points[sweep.index])


def test_beams_that_did_not_return_are_no_points_at_any_least_range() -> None:
    points, rings, fraction = firing(VLP16)
    points[::7] = 0.0
    scan = Scan(points, 0, times=0.1 * fraction, rings=rings)
    config = Config().changed("sensor.min_range=0")
    assert organise(scan, config).dropped == len(points[::7])
    features = extract_features(scan, config)
    for part in (features.edge_prominence, features.edge_sigmas):
        assert part is not None
        assert np.isfinite(part).all()


@pytest.mark.parametrize("offset", [0.2, -0.2])
def test_takes_an_offset_from_all_ranges(offset: float) -> None:
    points, rings, _ = firing(VLP16)
    points[:3] = [[np.nan, 0, 0], [0.0, 0.0, 0.0], [0.0, 0.6, 0.0]]
    sweep = organise(Scan(points, 0, rings=rings), sensor(times="none", range_offset=offset))
    assert (2 in sweep.index) == (offset < 0.0)  # nearer than sensor.min_range only if made so
    assert not np.isin([0, 1], sweep.index).any()
    raw = points[sweep.index].astype(np.float64)
    ranges = np.linalg.norm(raw, axis=1, keepdims=True)
    np.testing.assert_allclose(sweep.xyz.T, raw * (1.0 - offset / ranges), atol=1e-5)
    whole, again = (
        extract_features(Scan(clouds, 0, rings=numbers), sensor(times="none", range_offset=removed))
        for clouds, numbers, removed in (
            (points, rings, offset),
            (sweep.xyz.T, rings[sweep.index], 0.0),
        )
    )
    np.testing.assert_array_equal(whole.planes, again.planes)
    np.testing.assert_array_equal(whole.edges, again.edges)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_refuses_a_sweep_without_usable_points(value: float) -> None:
    with pytest.raises(SweepError, match=r"sweep of 50 points.*0 of them within 0\.5 to 120 m"):
        organise(Scan(np.full((50, 3), value), 0), Config())


def test_refuses_an_empty_sweep_and_ten_points_but_takes_eleven() -> None:
    points, rings, _ = firing(VLP16)
    for count in (0, 10):
        with pytest.raises(SweepError, match=f"sweep of {count} points.*at least 11"):
            organise(Scan(points[:count], 0, rings=rings[:count]), sensor(times="none"))
    assert len(organise(Scan(points[:11], 0, rings=rings[:11]), sensor(times="none")).index) == 11


def test_a_sweep_in_millimetres_is_asked_about_its_unit() -> None:
    points = firing(VLP16)[0]
    with pytest.raises(
        SweepError, match=r"0 of them within .*; half are farther than \d+ m: are they in"
    ):
        organise(Scan(points * 1e3, 0), Config())


def test_all_sources_agree() -> None:
    points, rings, _ = firing(VLP16)
    by_row = np.argsort(rings, kind="stable")
    from_field = rings_of(Scan(points, 0, rings=rings), sensor(rings="field"))
    from_elevation = rings_of(Scan(points, 0), sensor(rings="elevation"))
    from_rows = rings_of(Scan(points[by_row], 0, rows=16), sensor(rings="rows"))
    # Ring after ring in ascending azimuth from straight ahead, as KITTI's files are.
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    by_file = np.lexsort((azimuth, rings))
    from_file = rings_of(Scan(points[by_file], 0), sensor(rings="rows"))
    assert np.array_equal(from_field, rings)
    assert np.array_equal(from_elevation, rings)
    assert np.array_equal(from_rows, rings[by_row])
    assert np.array_equal(from_file, rings[by_file])


def test_auto_prefers_field_then_rows_then_elevation() -> None:
    points, rings, _ = firing(VLP16)
    by_row = np.argsort(rings, kind="stable")
    config = Config()
    for scan, method in (
        (Scan(points, 0, rings=rings), "field"),
        (Scan(points[by_row], 0, rows=16), "rows"),
        (Scan(points[by_row], 0), "file order"),
        (Scan(points, 0), "elevation"),
    ):
        found = organise(scan, config).rings
        assert (found.method, found.count) == (method, 16)
        assert "16 rings" in found.note


@pytest.mark.parametrize("largest", [900, 100_000])
def test_ring_labels_of_any_kind_are_ordered_by_elevation(largest: int) -> None:
    points, rings, _ = firing(VLP16)
    labels = np.array([7, -3, largest, 12, 5, 99, 44, 8, 1, 2, 3, 4, 6, 9, 10, 11])
    scan = Scan(points, 0, rings=labels[rings])
    assert np.array_equal(rings_of(scan, Config()), rings)


def test_rows_survive_dropped_points_and_empty_rows() -> None:
    points, rings, _ = firing(VLP16)
    order = np.argsort(rings, kind="stable")
    image, ring_image = points[order].copy(), rings[order]
    image[ring_image == 4] = np.nan
    image[::7] = np.nan
    sweep = organise(Scan(image, 0, rows=16), Config())
    assert sweep.rings.count == 15
    expected = ring_image - (ring_image > 4)
    columns = usable_columns(Scan(image, 0, rows=16), Config())
    assert np.array_equal(sweep.rings.rings, expected[columns.index])


@pytest.mark.parametrize("model", sorted(ELEVATIONS))
def test_velodyne_tables_are_detected(model: str) -> None:
    points, rings, _ = firing(ELEVATIONS[model])
    noise = np.random.default_rng(1).normal(0, 0.02, (len(points), 1))
    points = (points * (1 + noise / 10)).astype(np.float32)  # range noise leaves the elevation
    found = organise(Scan(points, 0), Config()).rings
    assert np.array_equal(found.rings, rings)
    assert model in found.note
    assert np.array_equal(rings_of(Scan(points, 0), sensor(model=model)), rings)


def test_beams_that_saw_nothing_leave_no_hole_in_the_numbers() -> None:
    points, rings, _ = firing(VLP16)
    seen = (rings < 9) | (rings > 11)
    found = organise(Scan(points[seen], 0), Config()).rings
    assert found.count == 13
    assert np.array_equal(found.rings, rings[seen] - 3 * (rings[seen] > 11))


def test_stray_returns_make_no_beams() -> None:
    points, rings, _ = firing(np.linspace(-20.0, 20.5, 32))
    stray = np.random.default_rng(0).integers(0, len(points), 150)
    points[stray, 2] += np.linspace(-0.8, 0.8, 150, dtype=np.float32)
    found = organise(Scan(points, 0), Config()).rings
    assert found.count == 32
    good = np.setdiff1d(np.arange(len(points)), stray)
    assert np.array_equal(found.rings[good], rings[good])


@pytest.mark.parametrize("cut", [0.0, 180.0, 30.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_file_order_with_ragged_ring_starts(cut: float, sign: float) -> None:
    # At a quarter turn the first ring may begin late; elsewhere the cut is known to half a degree.
    late = 2.0 if cut % 90.0 == 0.0 else 0.4
    turned = [np.arange(late, 359.5, 0.2), np.arange(0.1, 359.7, 0.2), np.arange(0.3, 359.9, 0.2)]
    azimuth = np.deg2rad(cut + sign * np.concatenate(turned))
    azimuth = np.arctan2(np.sin(azimuth), np.cos(azimuth)).astype(np.float32)
    found, _ = rings_from_file_order(azimuth)
    assert found is not None
    assert np.array_equal(found.rings, np.repeat(np.arange(3), [len(part) for part in turned]))


@pytest.mark.parametrize("beams", [16, 32, 64, 128])
@pytest.mark.parametrize("height", [0.0, 0.03618])
def test_ouster_beams_are_found_in_the_data(beams: int, height: float) -> None:
    # Units differ from the nominal angles: stretch the spacing smoothly.
    nominal = np.linspace(-1.0, 1.0, beams)
    elevations = (nominal - 0.03 * np.sin(3 * nominal)) * 21.3
    points, rings, _ = firing(elevations)
    points[:, 2] += np.float32(height)
    config = sensor(model=f"os1-{beams}", min_range=3.0)
    assert np.array_equal(rings_of(Scan(points, 0), config), rings)
    assert np.array_equal(rings_of(Scan(points, 0), Config()), rings)


def test_model_with_fewer_beams_than_the_data_is_refused() -> None:
    points, _, _ = firing(np.linspace(-21.0, 20.7, 64))
    assert rings_of(Scan(points, 0), sensor(model="os1-64")).max() == 63
    with pytest.raises(SweepError, match="near one of 64, at most 32 expected"):
        rings_of(Scan(points, 0), sensor(model="os1-32"))


def test_sources_without_rings_are_refused_with_the_reason() -> None:
    points, rings, _ = firing(VLP16)
    for given, config, says in (
        (points, sensor(rings="field"), "ring field: the scan has none"),
        (points[rings == 3], sensor(rings="rows"), r"runs around 1 time\(s\)"),
        (
            firing(ELEVATIONS["hdl32"])[0],
            sensor(model="vlp16"),
            r"points lie between .* of vlp16 \(-15 to 15 degrees\)",
        ),
    ):
        with pytest.raises(SweepError, match=says):
            rings_of(Scan(given, 0), config)


def scattered(count: int = 5000) -> np.ndarray:
    """Points all around, in no order."""
    direction = np.random.default_rng(0).normal(size=(count, 3))
    return 10 * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_elevations_without_beams_are_refused_with_what_was_tried_if_a_model_is_set() -> None:
    with pytest.raises(SweepError) as caught:
        organise(Scan(scattered(), 0), sensor(model="os1-64"))
    for part in ("ring field: the scan has none", "row order: azimuth", "elevation: no table",
                 "sensor.rings to none for one that sweeps no rings"):  # fmt: skip
        assert part in str(caught.value)


def test_points_in_no_order_have_no_rings_and_stay_as_they_are() -> None:
    times = np.linspace(0.0, 0.1, 5000)
    for config in (Config(), sensor(rings="none")):
        sweep = organise(Scan(scattered(), 0, times=times), config)
        assert not sweep.rings.known
        assert sweep.rings.note.startswith("no rings (")
        assert np.array_equal(sweep.index, np.arange(5000))
        assert np.array_equal(sweep.times, times)


def test_neither_rings_nor_times_are_refused_unless_the_points_are_said_to_be_de_skewed() -> None:
    with pytest.raises(SweepError, match=r"neither rings nor times .* set sensor.times to none"):
        organise(Scan(scattered(), 0), Config())
    assert organise(Scan(scattered(), 0), sensor(times="none")).times.max() == 0.0
    assert organise(Scan(scattered(), 0), sensor(times="azimuth")).times.max() > 0.09
    assert organise(Scan(scattered(), 0), Config().changed("deskew.enabled=false")).span == (0, 0)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_numbered_beams_of_a_lidar_that_sweeps_no_rings_are_none(pattern: str) -> None:
    scan = SimulatedWorld("room", sensor=pattern, frames=1, columns=4000).sweep(0)
    numbered = replace(scan, rings=np.arange(len(scan.points)) % 4)
    assert not organise(numbered, Config()).rings.known
    with pytest.raises(SweepError, match="field: elevations do not run smoothly around a ring"):
        organise(numbered, sensor(model="os1-64"))
    assert organise(numbered, sensor(rings="field")).rings.count == 4  # who asks for them, has them


def test_rings_of_a_lidar_that_is_mounted_askew_are_rings() -> None:
    points, rings, _ = firing(VLP16)
    askew = points @ gtsam.Rot3.Ypr(0.3, 0.7, -0.5).matrix().T
    assert organise(Scan(askew, 0, rings=rings), Config()).rings.count == 16


@pytest.mark.parametrize(("pitch", "level"), [(0.0, True), (12.0, True), (17.0, False)])
def test_rings_about_another_axis_than_z_are_not_level(pitch: float, level: bool) -> None:
    points, rings, _ = firing(VLP16)
    sweep = organise(
        Scan(points @ gtsam.Rot3.Pitch(np.radians(pitch)).matrix().T, 0, rings=rings), Config()
    )
    assert are_level(sweep.xyz, sweep.ring_starts) is level


def test_a_beam_that_swings_up_and_down_sweeps_no_level_ring() -> None:
    """As that of a Mid-360 whose points are in their order, which runs around."""
    azimuth = np.linspace(0.0, 4.0 * np.pi, 8000, endpoint=False)
    elevation = np.radians(22.0 + 29.0 * np.sin(40.3 * azimuth))
    flat = np.cos(elevation)
    points = 10.0 * np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], 1)
    sweep = organise(Scan(points, 0, times=np.linspace(0.0, 0.1, 8000)), Config())
    assert sweep.rings.method == "file order"
    assert not are_level(sweep.xyz, sweep.ring_starts)


@pytest.mark.parametrize("count", [1, 300])
def test_too_few_and_too_many_rings_are_refused(count: int) -> None:
    points, rings, _ = firing(np.linspace(-20.0, 20.0, count))
    with pytest.raises(SweepError, match=f"{count} ring.*expected 2 to 256"):
        organise(Scan(points, 0, rings=rings), Config())


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("start_deg", [180.0, 0.0, 90.0])
@pytest.mark.parametrize(("stamp", "offset"), [("start", 0.0), ("middle", -0.5), ("end", -1.0)])
def test_times_from_azimuth(clockwise: bool, start_deg: float, stamp: str, offset: float) -> None:
    points, rings, fraction = firing(VLP16, clockwise, start_deg)
    config = sensor(times="azimuth", start_azimuth_deg=start_deg, period=0.2, stamp=stamp)
    sweep = organise(Scan(points, 0, rings=rings), config)
    assert sweep.times == pytest.approx(0.2 * (fraction[sweep.index] + offset), abs=1e-6)
    assert sweep.span == pytest.approx((0.2 * offset, 0.2 * (offset + 1.0)))
    assert ("counterclockwise" in sweep.timing.note) != clockwise


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("start_deg", [170.0, 45.0, -90.0])
def test_points_in_firing_order_show_where_a_sweep_begins(
    clockwise: bool, start_deg: float
) -> None:
    points, rings, fraction = firing(VLP16, clockwise, start_deg)
    rng = np.random.default_rng(1)
    seen = (rings < 4) | (points[:, 0] > 0.0)  # beams above the ground see things ahead only
    seen &= rng.random(len(seen)) < 0.9
    scan = Scan(points[seen], 0, rings=rings[seen])
    sweep = organise(scan, sensor(times="azimuth"))
    np.testing.assert_allclose(sweep.times, 0.1 * fraction[seen][sweep.index], atol=5e-4)
    told = float(sweep.timing.note.split(" from ")[-1].split()[0])
    assert told == pytest.approx(start_deg, abs=1.0)
    # Without rings that go all around it is not known.
    ahead = Scan(points[points[:, 0] > 0.0], 0, rings=rings[points[:, 0] > 0.0])
    assert "from 180 degrees" in organise(ahead, sensor(times="azimuth")).timing.note


def test_sweep_that_overlaps_its_start_keeps_its_order() -> None:
    points, rings, fraction = firing(VLP16, start_deg=187.0, turn=1.04)
    sweep = organise(Scan(points, 0, rings=rings), sensor(start_azimuth_deg=180.0))
    expected = 0.1 * (fraction[sweep.index] - 7.0 / 360.0)
    assert expected.min() < 0.0 < 0.1 < expected.max()
    assert sweep.times == pytest.approx(expected, abs=1e-6)


def test_a_spin_that_contradicts_the_order_is_obeyed() -> None:
    points, rings, _ = firing(VLP16, start_deg=187.0, turn=1.04)
    sweep = organise(Scan(points, 0, rings=rings), sensor(spin="counterclockwise"))
    azimuth = np.arctan2(sweep.xyz[1], sweep.xyz[0])
    assert sweep.times == pytest.approx(0.1 * (azimuth / (2 * np.pi) + 0.5), abs=1e-6)


def test_ring_major_files_do_not_tell_the_sense_but_can_be_told() -> None:
    points, rings, fraction = firing(VLP16)
    ascending = np.lexsort((np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi), rings))
    for spin, expected in (("auto", fraction), ("counterclockwise", 1.0 - fraction)):
        sweep = organise(Scan(points[ascending], 0), sensor(spin=spin))
        assert sweep.times == pytest.approx(0.1 * expected[ascending][sweep.index], abs=1e-6)
        same = np.diff(sweep.rings.rings[: len(sweep.index) // 16]) == 0
        assert np.all(np.diff(sweep.times[: len(sweep.index) // 16])[same] > 0)


def test_shuffled_points_need_the_sense_of_rotation() -> None:
    points, rings, fraction = firing(VLP16)
    order = np.random.default_rng(0).permutation(len(points))
    scan = Scan(points[order], 0, rings=rings[order])
    with pytest.raises(SweepError, match=r"cannot tell the sense of rotation.*set sensor\.spin"):
        organise(scan, Config())
    sweep = organise(scan, sensor(spin="clockwise"))
    assert sweep.times == pytest.approx(0.1 * fraction[order][sweep.index], abs=1e-6)


def test_times_from_the_field_and_its_absence() -> None:
    points, rings, fraction = firing(VLP16)
    times = 0.1 * fraction - 0.03
    sweep = organise(Scan(points, 0, rings=rings, times=times), Config())
    assert sweep.timing.method == "field"
    assert sweep.span == (times.min(), times.max())
    assert np.array_equal(sweep.times, times[sweep.index])
    given = Scan(points, 0, rings=rings, times=times, span=(-0.05, 0.2))
    assert organise(given, Config()).span == (-0.05, 0.2)
    with pytest.raises(SweepError, match=r"no times; set sensor\.times to azimuth"):
        organise(Scan(points, 0, rings=rings), sensor(times="field"))


def test_no_times_when_told_or_not_needed() -> None:
    points, rings, _ = firing(VLP16)
    scan = Scan(points, 0, rings=rings, times=np.linspace(0, 0.1, len(points)))
    for config, given in (
        (sensor(times="none"), scan),
        (Config(deskew=DeskewConfig(enabled=False)), replace(scan, times=None)),
    ):
        sweep = organise(given, config)
        assert (sweep.timing.method, sweep.span) == ("none", (0.0, 0.0))
        assert not sweep.times.any()
    assert organise(replace(scan, times=None), Config()).timing.method == "azimuth"


def test_a_few_nonsense_times_are_dropped_but_wrong_units_are_refused() -> None:
    points, rings, fraction = firing(VLP16)
    times = 0.1 * fraction
    times[[5, 77]] = 1e9, np.nan
    sweep = organise(Scan(points, 0, rings=rings, times=times), Config())
    assert sweep.dropped == 2
    assert sweep.span[1] < 0.1
    with pytest.raises(SweepError, match=r"point times span .* s in one sweep.*not in seconds"):
        organise(Scan(points, 0, rings=rings, times=1e9 * fraction), Config())


def test_a_sweep_whose_times_are_nan_is_told_so() -> None:
    points, rings, fraction = firing(VLP16)
    nowhen = Scan(points, 0, rings=rings, times=np.nan * fraction)
    with pytest.raises(SweepError, match=r"0 of .* points have a time that is finite") as caught:
        organise(nowhen, Config())
    assert caught.value.fault is SweepFault.BAD_TIMES


@pytest.mark.parametrize(("times", "power"), [("field", 1), ("field", 6), ("none", 1)])
def test_order_is_ring_by_ring_in_firing_order(times: str, power: int) -> None:
    """With the power, many points are measured within a thousandth of the sweep."""
    points, rings, fraction = firing(VLP16)
    fraction = fraction**power
    shuffled = np.random.default_rng(2).permutation(len(points))
    reference = np.lexsort((fraction, rings))
    for order in (np.arange(len(points)), reference, reference[::-1], shuffled):
        scan = Scan(points[order], 0, rings=rings[order], times=0.1 * fraction[order])
        sweep = organise(scan, sensor(times=times))
        assert np.array_equal(order[sweep.index], reference)
        assert np.array_equal(sweep.ring_starts, np.arange(17) * COLUMNS)
        assert np.array_equal(sweep.ring_of_start, np.arange(16))


def read_bin(path: Path) -> np.ndarray:
    if not path.exists():
        pytest.skip(f"no {path}")
    return np.fromfile(path, dtype=np.float32).reshape(-1, 4)[:, :3]


def test_simulated_town(shared_data: Path) -> None:
    points = read_bin(shared_data / "sim_town" / "scans" / "000007.bin")
    sweep = organise(Scan(points, 0), Config())
    assert (sweep.rings.count, sweep.rings.method) == (16, "elevation")
    azimuth = np.arctan2(points[:, 1].astype(float), points[:, 0])[sweep.index]
    assert sweep.times == pytest.approx(0.1 * (np.pi - azimuth) / (2 * np.pi), abs=1e-6)


def test_kitti_has_64_rings_falling_in_elevation(shared_data: Path) -> None:
    points = read_bin(shared_data / "kitti_2011_09_26_0002" / "velodyne" / "000020.bin")
    sweep = organise(Scan(points, 0), sensor(stamp="middle"))
    assert (sweep.rings.count, sweep.rings.method) == (64, "file order")
    slope = sweep.xyz[2] / np.hypot(sweep.xyz[0], sweep.xyz[1])
    medians = [np.median(part) for part in np.split(slope, sweep.ring_starts[1:-1])]
    assert np.all(np.diff(medians) < 0)
    forward = np.abs(np.arctan2(sweep.xyz[1], sweep.xyz[0])) < 0.01
    assert np.abs(sweep.times[forward]).max() < 2e-4  # the stamp is when it faces forward


def test_ouster_has_128_rings_with_one_point_a_column(shared_data: Path) -> None:
    folder = shared_data / "ouster_os1_128"
    points = read_bin(folder / "velodyne" / "000001.bin")
    nanoseconds = np.fromfile(folder / "t_ns" / "000001.u64", dtype=np.uint64).astype(np.int64)
    times = 1e-9 * (nanoseconds - nanoseconds[0])
    sweep = organise(Scan(points, 0, times=times), Config())
    assert sweep.rings.count == 128
    for part in np.split(sweep.times, sweep.ring_starts[1:-1]):
        repeated = np.count_nonzero(np.diff(part) == 0.0)
        assert repeated <= 0.01 * len(part)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (30.0, 40.0), (180.0, 0.0)])
def test_times_from_azimuth_are_about_the_axis_of_the_rings(angles: tuple[float, float]) -> None:
    """Points may be in the axes of a base on which the lidar is mounted askew."""
    scan = next(iter(SimulatedWorld("room", frames=1, columns=450)))
    assert scan.times is not None
    turn = Rotation.from_euler("yx", angles, degrees=True).as_matrix().T
    found = organise(Scan(scan.points @ turn, scan.stamp, rings=scan.rings), Config())
    assert found.timing.method == "azimuth"
    np.testing.assert_allclose(found.times, scan.times[found.index], atol=1e-4)


def test_rings_that_have_no_axis_leave_azimuths_as_they_are() -> None:
    """As the arcs of a rosette, whose numbers are those of its beams."""
    rng = np.random.default_rng(2)
    xyz = rng.normal(size=(3, 600)).astype(np.float32)
    about_z = np.arctan2(xyz[1], xyz[0])
    azimuths = azimuths_about_axis(xyz, np.arange(600) % 6, about_z)
    np.testing.assert_array_equal(azimuths, np.arctan2(xyz[1], xyz[0]))

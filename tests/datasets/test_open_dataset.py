"""What ``open_dataset`` makes of a path, and sweeps that are arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.bags import START, sweep_points, write_sweeps

from loam_gtsam.datasets import ArrayDataset, Dataset, KittiDataset, open_dataset
from loam_gtsam.types import ConfigError, DatasetError, InputError, LoamError, Scan


def test_a_folder_above_the_sweeps_says_where_they_are(tmp_path: Path) -> None:
    write_sweeps(tmp_path / "sequences" / "07" / "velodyne", 1)
    with pytest.raises(DatasetError, match=r"There may be sweeps in .*sequences/07/velodyne$"):
        open_dataset(tmp_path)
    file = next((tmp_path / "sequences" / "07" / "velodyne").rglob("*.bin"))
    with pytest.raises(DatasetError, match="one sweep; give the folder that holds them"):
        open_dataset(file)


def test_a_world_is_not_made_of_words() -> None:
    with pytest.raises(DatasetError, match="frames: expected a number, got 'few'"):
        open_dataset("sim:room?frames=few")
    for frames in ("2.5", "2.0", "inf", "nan"):
        with pytest.raises(ConfigError, match="frames: expected a whole number, got"):
            open_dataset(f"sim:room?frames={frames}")


def test_nothing_to_open(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no such file or folder; expected a folder with"):
        open_dataset(tmp_path / "none")
    with pytest.raises(DatasetError, match=r"no sweeps .*; looked in the folder itself"):
        open_dataset(tmp_path)
    (tmp_path / "cloud.las").write_text("x")
    with pytest.raises(DatasetError, match=r"it has files .las; .*docs/own_sensor.md"):
        open_dataset(tmp_path)
    with pytest.raises(DatasetError, match=r"unknown kind of file '.las'; expected"):
        open_dataset(tmp_path / "cloud.las")
    (tmp_path / "a.bag").write_text("x")
    with pytest.raises(DatasetError, match=r"open one of its bags instead: a.bag"):
        open_dataset(tmp_path)
    with pytest.raises(DatasetError, match="not a folder"):
        KittiDataset(tmp_path / "a.bag")


def test_options_reach_the_loader_they_belong_to(tmp_path: Path) -> None:
    folder = write_sweeps(tmp_path / "a")
    assert len(open_dataset(folder, topic=None)) == 3  # None is not given
    with pytest.raises(DatasetError, match="KittiDataset takes no option topic; it takes vert"):
        open_dataset(folder, topic="/points")


@pytest.mark.parametrize(
    ("hertz", "more", "period"),
    [
        (20.0, {}, 0.05),
        (10.0, {}, None),
        (2.0, {}, None),  # some sweeps may be left out
        (100.0, {}, None),  # no lidar: stamps of another unit
        (20.0, {"sensor": {"period": 0.04}}, 0.04),
        (20.0, {"times": np.linspace(0.0, 0.05, 300)}, None),  # they say it all
    ],
)
def test_sweeps_without_times_take_no_longer_than_until_the_next(
    hertz: float, more: dict[str, Any], period: float | None
) -> None:
    clouds = [sweep_points(number) for number in range(4)]
    times = None if "times" not in more else [more["times"][: len(cloud)] for cloud in clouds]
    stamps = [START + round(number * 1e9 / hertz) for number in range(4)]
    data = ArrayDataset(clouds, stamps, times=times, sensor=more.get("sensor"))
    assert data.sensor.get("period") == (None if period is None else pytest.approx(period))


def test_built_in_world() -> None:
    world = open_dataset("sim:room?frames=2&seed=3")
    assert len(world) == 2
    with pytest.raises(DatasetError, match="expected sim:SCENE"):
        open_dataset("sim:room?frames")
    with pytest.raises(DatasetError, match="takes no option colour"):
        open_dataset("sim:room?colour=red")
    with pytest.raises(LoamError, match="palace"):
        open_dataset("sim:palace")


def test_arrays() -> None:
    scans = [sweep_points(0), np.column_stack([sweep_points(1), np.ones(300)])]
    times = [np.linspace(0, 0.1, 300)] * 2
    rings = [np.arange(300) % 16] * 2
    dataset = ArrayDataset(scans, [0, 100_000_000], times=times, rings=rings, name="mine")
    assert isinstance(dataset, Dataset)
    got = list(dataset)
    assert [scan.stamp for scan in got] == [0, 100_000_000]
    np.testing.assert_array_equal(got[1].points, sweep_points(1))
    assert got[1].times is times[1]
    assert dataset.info().facts["point times"] == "given for 2 of 2 sweeps"
    again = ArrayDataset(iter(got))
    assert repr(dataset) == "ArrayDataset('mine': 2 sweeps)"
    assert repr(again.part(1)) == "PartOf('arrays from sweep 1': 1 sweeps)"
    assert len(again) == 2
    assert list(again) == list(again) == got


def test_array_stamps_in_seconds() -> None:
    seconds = [1_700_000_000.25, 1_700_000_000.375]
    dataset = ArrayDataset([sweep_points(0)] * 2, stamps_s=seconds)
    assert [scan.stamp for scan in dataset] == [START + 250_000_000, START + 375_000_000]


def test_array_disorder_is_reported() -> None:
    assert "earlier" in ArrayDataset([sweep_points(0)] * 2, [5, 3]).info().problems[0]
    assert ArrayDataset([], []).info().problems == ["no sweeps"]


@pytest.mark.parametrize(("step", "told"), [(1.0, False), (2.0, False), (100.0, True)])
def test_stamps_too_far_apart_are_a_problem(step: float, told: bool) -> None:
    stamps = np.arange(4) * round(step * 1e9)
    problems = ArrayDataset([sweep_points(0)] * 4, stamps).info().problems
    assert (problems == []) is not told
    assert not told or problems[0].startswith("a sweep comes each 100 s: if the lidar is not that")


def test_array_times_that_are_fractions_of_the_sweep_are_refused() -> None:
    clouds, stamps = [sweep_points(0)] * 5, np.arange(5) * 10**8
    fractions = [np.linspace(0.0, 1.0, 300)] * 5
    with pytest.raises(InputError, match=r"times: .* span 1 s, but a sweep follows each 0\.1 s"):
        ArrayDataset(clouds, stamps, times=fractions)
    scans = [Scan(c, int(s), t) for c, s, t in zip(clouds, stamps, fractions, strict=True)]
    with pytest.raises(InputError, match="multiplied by its duration"):
        ArrayDataset(scans)
    seconds = [0.1 * column for column in fractions]
    ArrayDataset(clouds, stamps, times=seconds)
    two_lidars = [0, 10**7, 10**8, 11 * 10**7, 2 * 10**8]
    ArrayDataset(clouds, two_lidars, times=seconds)


@pytest.mark.parametrize(
    ("arguments", "options", "match"),
    [
        (([np.zeros((3, 2))], [0]), {}, r"scans\[0\]: expected an \(N, 3\).*got \(3, 2\)"),
        (([[1.0, 2.0, 3.0]], [0]), {}, r"scans\[0\]: .*got list"),
        (([np.zeros((3, 3), int)], [0]), {}, r"scans\[0\]: Scan.points: .* floats"),
        (([np.zeros((3, 3))], [0.0]), {}, "makes them of seconds"),
        (([np.zeros((3, 3))],), {}, "give the stamps"),
        (([np.zeros((3, 3))], [0]), {"stamps_s": [0.0]}, "give the stamps of the sweeps once"),
        (([np.zeros((3, 3))],), {"stamps_s": [np.nan]}, "stamps_s: expected"),
        (([np.zeros((3, 3))],), {"stamps_s": [1.7e12]}, "stamps_s: .* seconds.* milliseconds;"),
        (([np.zeros((3, 3))],), {"stamps_s": [1.7e15]}, r"got 1.7e\+15, .* microseconds;"),
        (([np.zeros((3, 3))],), {"stamps_s": [1.7e18]}, "stamps_s: .* seconds.* nanoseconds;"),
        (([np.zeros((3, 3))],), {"stamps_s": [-1.7e25]}, "stamps_s: .* seconds.* another unit;"),
        (([np.zeros((3, 3))], [0, 1]), {}, "stamps: expected 1 entries, got 2"),
        (([np.zeros((3, 3))], [0]), {"times": []}, "times: expected 1 entries, got 0"),
        (([np.zeros((3, 3))], [0]), {"times": [np.zeros(2)]}, r"scans\[0\]: Scan.times"),
        (([np.zeros((3, 3))], [0]), {"rings": [np.zeros(3)]}, r"scans\[0\]: Scan.rings"),
        (([Scan(np.zeros((3, 3)), 0)], [0]), {}, "carry their own"),
        (([Scan(np.zeros((3, 3)), 0), np.zeros((3, 3))],), {}, "either Scan objects alone"),
        (([], []), {"imu": np.zeros((9, 7))}, r"imu: .* got ndarray; ImuSamples\(stamps, ori"),
        (([], []), {"truth": np.zeros((9, 8))}, r"truth: .* got ndarray; Trajectory\(stamps, map"),
        (([], []), {"gnss": np.zeros((9, 4))}, r"gnss: .* got ndarray; GnssFixes\(stamps, geo"),
        (
            ([], []),
            {"wheels": np.zeros((9, 4))},
            r"wheels: .* got ndarray; WheelSamples\(stamps, st",
        ),
        (([np.zeros((3, 3))] * 3, [0, 10**5, 2 * 10**5]), {}, "100000 ns apart; expected nano"),
    ],
)
def test_bad_arrays(arguments: tuple[Any, ...], options: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        ArrayDataset(*arguments, **options)

"""Folders of sweeps: which files are sweeps, and what the numbers in their names are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from loam_gtsam.datasets import KittiDataset, open_dataset

FIRST = 1_700_000_000_123_456_789


def write(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        np.save(folder / f"{name}.npy", np.ones((5, 4), "f4"))
    return folder


@pytest.mark.parametrize(
    ("names", "unit", "stamps"),
    [
        (["1700000000.1", "1700000000.25", "1700000000.3"], "s", [100, 250, 300]),
        (["1699999999.95", "1700000000.0", "1700000000.05"], "s", [-50, 0, 50]),
        (["c1_1700000000100", "c2_1700000000200", "c4_1700000000400"], "ms", [100, 200, 400]),
        (["1700000000100000", "1700000000200000"], "us", [100, 200]),
        (["1700000000100000000_x", "1700000000200000000_x"], "ns", [100, 200]),
    ],
)
def test_names_that_are_times_are_the_stamps(
    tmp_path: Path, names: list[str], unit: str, stamps: list[int]
) -> None:
    dataset = open_dataset(write(tmp_path, *names))
    expected = [1_700_000_000_000_000_000 + stamp * 1_000_000 for stamp in stamps]
    assert dataset.stamps.tolist() == expected
    info = dataset.info()
    assert info.facts["stamps from"] == f"the names of the files, {unit}"
    assert not any("assumed" in text for text in info.problems)


@pytest.mark.parametrize(
    "names",
    [
        ["1700000000", "1700000001"],  # seconds without a fraction may count
        ["0000000000100", "0000000000101"],  # 13 digits of a count
        ["000007", "000008"],
        ["one"],
    ],
)
def test_names_that_count_without_a_gap_are_sweeps_of_10_hz(
    tmp_path: Path, names: list[str]
) -> None:
    dataset = open_dataset(write(tmp_path, *names))
    assert dataset.stamps.tolist() == [i * 100_000_000 for i in range(len(names))]
    info = dataset.info()
    assert "no times.txt: 10 Hz assumed" in info.problems
    assert "stamps from" not in info.facts


def test_a_number_without_a_file_is_a_sweep_that_is_missing(tmp_path: Path) -> None:
    dataset = open_dataset(write(tmp_path / "gap", "scan_3", "scan_4", "scan_9", "scan_10"))
    assert dataset.stamps.tolist() == [n * 100_000_000 for n in (3, 4, 9, 10)]
    assert any("scan" not in text and "3 to 10" in text for text in dataset.info().problems)
    assert any("for 4 of which there is no file" in text for text in dataset.info().problems)
    third = open_dataset(write(tmp_path / "third", "000000", "000003", "000006"))
    assert np.diff(third.stamps).tolist() == [300_000_000] * 2
    (tmp_path / "third" / "times.txt").write_text("0\n0.1\n0.2\n")
    assert np.diff(open_dataset(tmp_path / "third").stamps).tolist() == [100_000_000] * 2


@pytest.mark.parametrize(
    "names",
    [
        ["20240101120000", "20240101120100", "20240101120200"],  # dates
        ["1700000000100", "1700000009100"],  # milliseconds, each 9 s
        ["9" * 30, "9" * 29 + "8"],
        ["0.5", "0.6"],
        ["1_2", "1_4", "2_1"],
    ],
)
def test_numbers_that_are_neither_are_named(tmp_path: Path, names: list[str]) -> None:
    dataset = open_dataset(write(tmp_path, *names))
    assert dataset.stamps.tolist() == [i * 100_000_000 for i in range(len(names))]
    assert any("neither count the sweeps nor are times" in text for text in dataset.info().problems)


# -- files that are no sweeps ----------------------------------------------------------------------

NUMBERED = [f"{i:06d}" for i in range(8)]


def test_a_map_among_numbered_sweeps_is_left_out_and_named(tmp_path: Path) -> None:
    dataset = KittiDataset(write(tmp_path, *NUMBERED, "map", "map_final2"))
    assert len(dataset) == 8
    (problem,) = (text for text in dataset.info().problems if "left out" in text)
    assert problem.startswith("map.npy, map_final2.npy left out: named otherwise than the 8 sweeps")
    (tmp_path / "times.txt").write_text("".join(f"{i / 10}\n" for i in range(10)))
    assert len(KittiDataset(tmp_path)) == 10  # each has its stamp


@pytest.mark.parametrize("names", [["a", "b", "c", "1"], ["front_1", "front_2", "rear_1"]])
def test_names_without_a_great_majority_are_all_sweeps(tmp_path: Path, names: list[str]) -> None:
    dataset = KittiDataset(write(tmp_path, *names))
    assert len(dataset) == len(names)
    assert not any("left out" in text for text in dataset.info().problems)


def test_the_sweeps_are_the_kind_with_most_files(tmp_path: Path) -> None:
    folder = write(tmp_path, *NUMBERED)
    (folder / "calib.bin").write_bytes(bytes(160))
    dataset = KittiDataset(folder)
    assert len(dataset) == 8
    said = "1 .bin file left out: the sweeps are the 8 .npy files"
    assert said in dataset.info().problems
    for name in NUMBERED:  # the same sweeps in both formats
        (folder / f"{name}.bin").write_bytes(bytes(160))
    (folder / "calib.bin").unlink()
    assert KittiDataset(folder).info().kind == "KITTI folder"


def test_a_lone_file_does_not_hide_the_folder_of_sweeps(tmp_path: Path) -> None:
    write(tmp_path / "scans", *NUMBERED)
    write(tmp_path, "map")
    assert len(open_dataset(tmp_path)) == 8
    assert len(open_dataset(write(tmp_path / "other", "000000"))) == 1

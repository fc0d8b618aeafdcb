"""``merge --refine``: several runs adjusted together, from the command line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from support.cli import loam

from loam_gtsam.datasets.truth import read_truth

DRIVE = "sim:rooms?frames=50&columns=300&speed=3&seed=1"
STARTS = 0, 20
FRAMES = 30


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> list[Path]:
    """A drive that was run in two parts."""
    folder = tmp_path_factory.mktemp("parts")
    for number, start in enumerate(STARTS):
        done = loam(
            "run", DRIVE, "--start", start, "--frames", FRAMES, "--output", folder / str(number),
            "--set", "pose_graph.keyframe_distance=0.5", "--no-plot", "--quiet",
        )  # fmt: skip
        assert done.exit_code == 0, done.output
    return [folder / str(number) for number in range(2)]


def refine(parts, *options):
    return loam("merge", *parts, "--output", "both", "--refine", DRIVE, "--refine", DRIVE, *options)


def plain(done):
    """What a command said, without the frames around it."""
    return " ".join(done.output.replace("│", " ").split())


def test_runs_are_merged_and_refined_together(parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = refine(parts, "--start", STARTS[0], "--start", STARTS[1])
    assert done.exit_code == 0, done.output
    assert "Written to both/refined: trajectory_1.tum, trajectory_1_kitti.txt" in plain(done)
    refined = Path("both/refined")
    report = json.loads((refined / "report.json").read_text())
    assert report["frames"] == 2 * FRAMES
    thick = [report[when]["held_out_thickness_mm"] for when in ("before", "after")]
    assert thick[1] < 1.01 * thick[0]  # both are the noise of the ranges
    assert [row["run"] for row in report["runs"]] == [str(part) for part in parts]
    assert all(row["ate_rmse_m"] < 0.005 for row in report["runs"])
    assert report["moved_most_run"] in [str(part) for part in parts]
    for number in (1, 2):
        way = read_truth(refined / f"trajectory_{number}.tum")
        first = read_truth(f"both/trajectory_{number}.tum")
        assert len(way) == len(first) == FRAMES
        assert abs(way.map_T_lidar - first.map_T_lidar).max() < 0.05
        assert (
            len((refined / f"trajectory_{number}_covariance.csv").read_text().split()) == FRAMES + 1
        )
    assert (refined / "map.ply").stat().st_size > 10_000
    assert (refined / "section.png").stat().st_size > 1000


def test_what_cannot_be_refined_says_what_was_expected(parts, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one = loam("merge", *parts, "--refine", DRIVE)
    assert one.exit_code == 2
    assert "data set of each of the 2 maps" in plain(one)
    start = refine(parts, "--start", STARTS[1])
    assert start.exit_code == 2
    assert "one for each of the 2 --refine, got 1" in " ".join(
        start.output.replace("│", "").split()
    )
    missing = loam("merge", *parts, "--refine", DRIVE, "--refine", "nothing")
    assert missing.exit_code == 1
    assert "nothing: no such file" in missing.output
    alone = Path("alone.lgmap")
    shutil.copy(parts[1] / "map.lgmap", alone)
    no_run = refine([parts[0], alone])
    assert no_run.exit_code == 1
    assert "alone.lgmap: --refine expects the map of one run" in no_run.output
    assert not Path("both").exists()
    # Without --start the sweeps are not those of the second run.
    other = refine(parts, "--no-plot")
    assert other.exit_code == 1
    told = plain(other)
    assert f"{parts[1]} and " in told
    assert "give the data set of the run" in told
    assert not Path("both/refined").exists()

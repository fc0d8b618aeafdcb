"""Messages that are no whole sweeps of one lidar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.bags import ROS1, START, Recording, cloud, write_bag

from loam_gtsam.datasets import open_dataset
from loam_gtsam.types import DatasetError

COUNT = 720


def bag(path: Path, parts: int, *, rings: bool = True, seen: float = 1.0) -> Path:
    """Four turns of a lidar, each in so many messages; it sees so much of the horizon."""
    turn = np.linspace(0.0, 1.0, COUNT, endpoint=False)
    angle = 2.0 * np.pi * seen * turn
    points = 9.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(40.0 * angle)])
    recording: Recording = []
    for number in range(4 * parts):
        which = (turn >= (number % parts) / parts) & (turn < (number % parts + 1) / parts)
        stamp = START + number * 100_000_000 // parts
        time = 0.1 * (turn[which] - turn[which][0])
        columns = {"time": time.astype("f4")}
        if rings:
            columns["ring"] = (np.arange(COUNT)[which] % 16).astype("u2")
        some = points[which].astype("f4")
        recording.append(("/points", stamp, cloud(ROS1, stamp, some, **columns)))
    return write_bag(path, "ros1", recording)


@pytest.mark.parametrize("parts", [2, 3, 4])
def test_parts_of_a_sweep_are_named(tmp_path: Path, parts: int) -> None:
    (problem,) = open_dataset(bag(tmp_path / "run", parts)).info().problems
    assert problem.startswith("messages in a row look in different directions: they hold parts")


@pytest.mark.parametrize(
    ("parts", "rings", "seen"), [(1, True, 1.0), (1, True, 0.2), (2, False, 1.0)]
)
def test_whole_sweeps_and_those_without_rings_are_not(
    tmp_path: Path, parts: int, rings: bool, seen: float
) -> None:
    assert open_dataset(bag(tmp_path / "run", parts, rings=rings, seen=seen)).info().problems == []


def test_packets_that_tell_no_unit_are_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"a message comes each 5 ms: if they hold parts of a"):
        open_dataset(bag(tmp_path / "run", 20))
    with pytest.raises(DatasetError) as caught:
        open_dataset(bag(tmp_path / "whole", 1), time_unit="s", time_field="x")
    assert "a message comes" not in str(caught.value)


@pytest.mark.parametrize(("other", "said"), [("rear", True), ("/front", False)])
def test_several_frames_on_one_topic_are_named(tmp_path: Path, other: str, said: bool) -> None:
    points = np.random.default_rng(0).uniform(-9, 9, (COUNT, 3)).astype("f4")
    columns = {"time": np.linspace(0.0, 0.1, COUNT).astype("f4"), "ring": np.arange(COUNT) % 16}
    columns["ring"] = columns["ring"].astype("u2")
    recording: Recording = []
    for number in range(6):
        stamp = START + number * 100_000_000
        message = cloud(ROS1, stamp, points, **columns)
        message.header.frame_id = other if number % 2 else "front"
        recording.append(("/points", stamp, message))
    problems = open_dataset(write_bag(tmp_path / "run", "ros1", recording)).info().problems
    assert [text for text in problems if "of several frames (front: 3, rear: 3)" in text] == (
        problems if said else []
    )
    assert len(problems) == said

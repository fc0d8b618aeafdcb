"""What a run writes into a bag, and how sweeps wait in a live run."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Section, parameter


class BagConfig(Section):
    """What a run writes into a bag."""

    map_frame: str = parameter(
        "camera_init",
        "frame_id of poses and clouds; whatever its name, its axes are those of the map",
        source="LOAM",
    )
    lidar_frame: str = parameter("aft_mapped", "child_frame_id of the poses", source="LOAM")
    registered: bool = parameter(
        True, "write /velodyne_cloud_registered, which makes up most of a bag"
    )
    surround_every: int = parameter(
        5,
        "frames from one /laser_cloud_surround to the next; 0 writes none",
        source="LOAM",
        low=0,
    )


class LiveConfig(Section):
    """How sweeps wait, and which are dropped, when they come as they are measured."""

    queue: int = parameter(
        20, "sweeps that may wait while another one is mapped; see when_full", low=1
    )
    when_full: Literal["drop_oldest", "keep_newest", "never"] = parameter(
        "drop_oldest",
        "what makes room for a new sweep: the one that has waited longest is dropped, or all that "
        "wait are, or nothing is and the queue grows",
    )
    imu_queue: int = parameter(
        20_000, "IMU samples that may wait for the next sweep; the oldest are dropped", low=1
    )
    imu_wait: float = parameter(
        0.2,
        "a sweep waits for the IMU samples up to its end, but not longer than this after it was "
        "received; until the map is levelled, imu.still_seconds more",
        unit="s",
        low=0.0,
    )

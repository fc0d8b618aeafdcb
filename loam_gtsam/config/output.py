"""The sections of the configuration on what a run publishes, and on the queues of a live one."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Section, parameter


class BagConfig(Section):
    """The topics and frames that a run writes into a bag, or publishes."""

    map_frame: str = parameter("camera_init", source="LOAM")
    """Poses and clouds have this frame_id; whatever its name, its axes are those of the map."""
    lidar_frame: str = parameter("aft_mapped", source="LOAM")
    """Poses have this child_frame_id."""
    registered: bool = parameter(True)
    """The topic /velodyne_cloud_registered is written, which makes up most of a bag."""
    surround_every: int = parameter(5, source="LOAM", low=0)
    """The topic /laser_cloud_surround gets a message once in this many frames; 0 writes none."""


class LiveConfig(Section):
    """The queues of a live run, in which sweeps wait, and which of them are dropped."""

    queue: int = parameter(20, low=1, high=10_000)
    """At most this many sweeps wait while another one is mapped; when_full applies to any more."""
    when_full: Literal["drop_oldest", "keep_newest", "never"] = parameter("drop_oldest")
    """Room for a new sweep is made in this way: the sweep that has waited longest is dropped, or
    all waiting sweeps are dropped, or none is dropped and the queue grows."""
    imu_queue: int = parameter(20_000, low=1, high=10_000_000)
    """At most this many IMU samples wait for the next sweep; the oldest are dropped first."""
    imu_wait: float = parameter(0.2, unit="s", low=0.0, high=60.0)
    """A sweep waits for the IMU samples up to its end, but not longer than this after it was
    received; until the map is levelled, it waits imu.still_seconds more."""

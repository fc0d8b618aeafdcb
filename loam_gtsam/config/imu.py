"""The inertial measurement unit."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Finite, Section, parameter


class ImuConfig(Section):
    """Use of an inertial measurement unit; nothing here matters without one."""

    enabled: bool = parameter(True, "false: as if there were no IMU")
    prior: Literal["off", "blend", "equivalent", "sigma"] = parameter(
        "equivalent",
        "how roll and pitch of the IMU act on the pose: not at all; mixed in after the solve; by a "
        "factor of the weight's share of what the scan knows, which gives the same mean; by a "
        "gravity direction of the given sigma",
        source="LOAM blends",
    )
    weight: float = parameter(
        0.01,
        "share of the IMU's roll and pitch (blend, equivalent)",
        source="LOAM uses 0.002; on slopes that is too little to be seen",
        low=0.0,
        high=0.999,
    )
    sigma_deg: float = parameter(
        0.5,
        "standard deviation of the IMU's gravity direction, its slow errors included (sigma; and "
        "equivalent where the scan or the angles cannot do it)",
        unit="degrees",
        low=1e-4,
    )
    level: bool = parameter(
        True, "the map's z axis points up from the start; false: the map is the first pose's frame"
    )
    still_seconds: float = parameter(
        0.5, "window before the first sweep in which the platform may be at rest", unit="s", low=0.0
    )
    average_seconds: float = parameter(
        0.1,
        "roll and pitch of a frame are the mean over this, brought to its moment by the gyro; 0: "
        "those of the moment",
        unit="s",
        source="one sweep, so that no sample counts twice; LOAM: 0",
        low=0.0,
    )
    max_gap: float = parameter(
        0.1, "a longer gap between samples is not bridged", unit="s", low=1e-3
    )
    lidar_R_imu_deg: tuple[Finite, Finite, Finite] = parameter(
        (0.0, 0.0, 0.0),
        "roll, pitch, yaw of the rotation Rz Ry Rx that takes IMU vectors into the lidar frame",
        unit="degrees",
    )
    lidar_t_imu: tuple[Finite, Finite, Finite] = parameter(
        (0.0, 0.0, 0.0), "position of the IMU in the lidar frame (pre-integration)", unit="m"
    )
    filter_seconds: float = parameter(
        60.0,
        "time constant of the gravity filter that stands in for a missing orientation",
        unit="s",
        low=0.1,
    )
    preintegration: bool = parameter(
        False,
        "predict every pose from gyro and accelerometer, with velocity and biases estimated over "
        "the last frames, and let the prediction take over where the scan says nothing",
    )
    lag: int = parameter(20, "frames in the pre-integration's graph", low=2)
    gravity: float = parameter(9.81, "of the place", unit="m/s^2", low=0.0)
    gyro_noise: float = parameter(
        2e-4, "white noise density of the gyro", unit="rad/s/sqrt(Hz)", low=1e-9
    )
    acceleration_noise: float = parameter(
        2e-3, "white noise density of the accelerometer", unit="m/s^2/sqrt(Hz)", low=1e-9
    )
    gyro_bias_walk: float = parameter(
        2e-5, "random walk of the gyro's bias", unit="rad/s^2/sqrt(Hz)", low=1e-12
    )
    acceleration_bias_walk: float = parameter(
        2e-4, "random walk of the accelerometer's bias", unit="m/s^3/sqrt(Hz)", low=1e-12
    )

"""The inertial measurement unit."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Finite, Section, parameter


class ImuConfig(Section):
    """The use of an inertial measurement unit (IMU); without one, nothing here matters."""

    enabled: bool = parameter(True)
    """The measurements of the IMU are used; false maps as if there were no IMU."""
    prior: Literal["off", "blend", "equivalent", "sigma"] = parameter(
        "equivalent", source="LOAM blends"
    )
    """Roll and pitch of the IMU act on the pose in this way: off, not at all; blend, mixed in after
    the solve; equivalent, by a factor that has the weight's share of what the scan knows, which
    gives the same mean; sigma, by a gravity direction of the given standard deviation."""
    weight: float = parameter(
        0.01, source="LOAM uses 0.002; on slopes that is too little to be seen", low=0.0, high=0.999
    )
    """Roll and pitch of the IMU have this share in the result of blend and equivalent."""
    sigma_deg: float = parameter(0.5, unit="degrees", low=1e-4)
    """The gravity direction of the IMU has this standard deviation, its slow errors included. It is
    used by sigma, and by equivalent where the scan or the angles allow no equivalent factor."""
    level: bool = parameter(True)
    """The z axis of the map points up from the start; false makes the first pose's frame the map's
    frame."""
    still_seconds: float = parameter(0.5, unit="s", low=0.0)
    """The platform may be at rest for this long before the first sweep; that window is examined."""
    average_seconds: float = parameter(
        0.1, unit="s", source="the period of a sweep, so that no sample counts twice; LOAM uses 0",
        low=0.0,
    )  # fmt: skip
    """Roll and pitch of a frame are the mean over this duration, brought to the moment of the frame
    by the gyro; 0 takes those of the moment itself."""
    max_gap: float = parameter(0.1, unit="s", low=1e-3)
    """A gap between samples that is longer than this is not bridged."""
    lidar_R_imu_deg: tuple[Finite, Finite, Finite] = parameter((0.0, 0.0, 0.0), unit="degrees")
    """These are roll, pitch and yaw of the rotation Rz Ry Rx that takes vectors from the frame of
    the IMU into the frame of the lidar."""
    lidar_t_imu: tuple[Finite, Finite, Finite] = parameter((0.0, 0.0, 0.0), unit="m")
    """The IMU has this position in the frame of the lidar; pre-integration uses it."""
    filter_seconds: float = parameter(60.0, unit="s", low=0.1)
    """The attitude filter, which replaces a missing orientation, has this time constant."""
    preintegration: bool = parameter(False)
    """Every pose is predicted from gyro and accelerometer, with velocity and biases estimated over
    the last frames, and the prediction decides directions that the scan does not fix."""
    lag: int = parameter(20, low=2)
    """The graph of the pre-integration keeps this many frames."""
    gravity: float = parameter(9.81, unit="m/s^2", low=0.0)
    """The gravitational acceleration has this magnitude at the place of the recording."""
    gyro_noise: float = parameter(2e-4, unit="rad/s/sqrt(Hz)", low=1e-9)
    """The white noise of the gyro has this density."""
    acceleration_noise: float = parameter(2e-3, unit="m/s^2/sqrt(Hz)", low=1e-9)
    """The white noise of the accelerometer has this density."""
    gyro_bias_walk: float = parameter(2e-5, unit="rad/s^2/sqrt(Hz)", low=1e-12)
    """The random walk of the gyro's bias has this density."""
    acceleration_bias_walk: float = parameter(2e-4, unit="m/s^3/sqrt(Hz)", low=1e-12)
    """The random walk of the accelerometer's bias has this density."""

"""The section of the configuration on other sensors: a GNSS receiver, and wheels."""

from __future__ import annotations

from loam_gtsam.config.base import Angle, Offset, Section, parameter


class AidingConfig(Section):
    """Other sensors: a GNSS receiver, which acts on the pose graph, and wheels, which predict."""

    gnss: bool = parameter(False)
    """Positions of a GNSS receiver tie the pose graph, once the run is complete; the place of the
    map on the earth is estimated with it."""
    lidar_t_antenna: tuple[Offset, Offset, Offset] = parameter((0.0, 0.0, 0.0), unit="m")
    """The antenna has this position in the frame of the lidar."""
    antenna_sigma: float = parameter(0.05, unit="m", low=1e-4)
    """The position of the antenna is known to this standard deviation, and is estimated."""
    gnss_sigma: float = parameter(0.0, unit="m", low=0.0)
    """A fix without a covariance has this standard deviation along each axis; 0 leaves it out."""
    gnss_memory: float = parameter(10.0, unit="s", low=0.0)
    """The errors of fixes within this time of each other are alike: they count as one."""
    wheels: bool = parameter(False)
    """The way by the wheels predicts the motion from sweep to sweep, which decides along directions
    that the scan does not fix, unless the accelerometer predicts (imu.coupling tight)."""
    lidar_R_wheels_deg: tuple[Angle, Angle, Angle] = parameter((0.0, 0.0, 0.0), unit="degrees")
    """These are roll, pitch and yaw of the rotation Rz Ry Rx that takes vectors from the frame of
    the vehicle into the frame of the lidar."""
    lidar_t_wheels: tuple[Offset, Offset, Offset] = parameter((0.0, 0.0, 0.0), unit="m")
    """The point of the vehicle whose way the wheels tell has this position in the frame of the
    lidar; for two driven wheels it is the middle of their axle."""

"""The sections of what a run may add: an IMU, loop closures, a bag, a live sensor."""

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


class PoseGraphConfig(Section):
    """The choice of keyframes, the graph of their poses, and which loop closures it uses."""

    keyframe_distance: float = parameter(4.0, unit="m", low=0.0)
    """A frame is a keyframe if it is at least this far from the last keyframe."""
    keyframe_angle_deg: float = parameter(30.0, unit="degrees", low=0.0)
    """A frame is a keyframe as well if it is turned by at least this against the last keyframe."""
    walk: float = parameter(0.02, unit="m/sqrt(m)", low=0.0)
    """The odometry drifts by more than its covariances know, like a random walk. The standard
    deviation of the position grows by this times the square root of the distance travelled."""
    turn_walk_deg: float = parameter(0.02, unit="degrees/sqrt(m)", low=0.0)
    """The standard deviation of the rotation grows by this times the square root of the distance
    travelled, for the same reason as that of the position (walk)."""
    max_chi2: float = parameter(
        40.0, source="one of 10,000 right loops exceeds 28, if all covariances "
        "are exact", low=0.0,
    )  # fmt: skip
    """A loop closure is used if its squared Mahalanobis distance (6 degrees of freedom) from what
    all the others say is not above this."""
    kernel_width: float = parameter(
        5.0, source="far above sqrt(6), the norm of a right loop closure", low=0.1
    )
    """The Huber kernel on the whitened norm of a loop closure has this width in iSAM2; .inf turns
    the kernel off."""
    believed_loops: int = parameter(6, low=2)
    """If at least this many loop closures agree pairwise, they are used although the odometry
    contradicts them."""
    follow_distance: float = parameter(0.05, unit="m", low=0.0)
    """Map points follow their keyframe once a loop closure has moved it by more than this as seen
    from the newest keyframe; an error of follow_angle_deg in the newest one is allowed for."""
    follow_angle_deg: float = parameter(0.2, unit="degrees", low=0.0)
    """Map points follow their keyframe as well once it has been turned by more than this."""


class LoopConfig(Section):
    """The search for loop closures, and the tests that a candidate has to pass."""

    enabled: bool = parameter(False)
    """Loop closures are searched for during a run, and the map follows them."""
    min_way: float = parameter(30.0, unit="m", low=0.0)
    """Two keyframes form a loop closure only if at least this was travelled between them."""
    gate: float = parameter(10.0, unit="m", low=0.0)
    """A candidate lies within a gate about the keyframe. The radius of the gate is the sum of three
    parts, of which this is the constant one."""
    gate_sigmas: float = parameter(3.0, low=0.0)
    """The second part of the gate is this many standard deviations of the two positions."""
    gate_drift: float = parameter(0.02, low=0.0)
    """The third part of the gate is this share of the distance travelled between the two keyframes,
    for drift that the covariances do not know."""
    rings: int = parameter(20, source="Scan Context", low=1)
    """The place descriptor has this many rings."""
    sectors: int = parameter(60, source="Scan Context", low=4)
    """The place descriptor has this many sectors."""
    reach: float = parameter(60.0, unit="m", source="Scan Context uses 80", low=1.0)
    """The place descriptor covers points up to this range."""
    max_unlike: float = parameter(
        0.6, source="Scan Context uses 0.2 to 0.6, but verifies nothing", low=0.0
    )
    """A candidate is not tried if the distance of the two place descriptors, 0 for equal ones, is
    above this."""
    tries: int = parameter(2, low=1)
    """At most this many candidates are verified for a keyframe."""
    neighbours: int = parameter(6, low=0)
    """The submap of a candidate holds its features and those of this many keyframes on either side
    of it."""
    search: float = parameter(8.0, unit="m", low=1.0)
    """The keyframe is searched for within this radius about the candidate."""
    min_share: float = parameter(0.5, low=0.0, high=1.0)
    """At least this share of the features off level ground must have a match in the submap."""
    min_agreement: float = parameter(
        0.9, source="right loops have 0.97 or more, those shifted by 3 m along a street 0.75, "
        "other wrong ones less than 0.5", low=0.0, high=1.0,
    )  # fmt: skip
    """At least this share of the matches must lie within three standard deviations."""
    min_aligned: float = parameter(30.0, low=0.0)
    """Every direction must be fixed by at least this many matches, counted as for
    solver.min_aligned."""


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

    queue: int = parameter(20, low=1)
    """At most this many sweeps wait while another one is mapped; when_full applies to any more."""
    when_full: Literal["drop_oldest", "keep_newest", "never"] = parameter("drop_oldest")
    """Room for a new sweep is made in this way: the sweep that has waited longest is dropped, or
    all waiting sweeps are dropped, or none is dropped and the queue grows."""
    imu_queue: int = parameter(20_000, low=1)
    """At most this many IMU samples wait for the next sweep; the oldest are dropped first."""
    imu_wait: float = parameter(0.2, unit="s", low=0.0)
    """A sweep waits for the IMU samples up to its end, but not longer than this after it was
    received; until the map is levelled, it waits imu.still_seconds more."""

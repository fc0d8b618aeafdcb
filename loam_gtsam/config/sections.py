"""Every parameter, section by section: the estimator, then what a run may add to it."""

from __future__ import annotations

import math
from typing import Literal

from loam_gtsam.config.base import Angle, BeamRow, Count, Offset, Section, parameter


class SensorConfig(Section):
    """The properties of the lidar and of its sweeps that the data itself does not tell."""

    in_order = (("min_range", "max_range"),)

    model: Literal["auto", "vlp16", "hdl32", "hdl64", "os1-16", "os1-32", "os1-64", "os1-128"] = (
        parameter("auto")
    )
    """The model of the lidar selects the table of beam elevations for rings from elevations; auto
    detects the model from the data."""
    rings: Literal["auto", "field", "rows", "elevation", "none"] = parameter("auto")
    """Ring numbers of the points come from a field of the cloud, from its rows or from the
    elevations of the points; auto tries these in this order, and else there are none (Livox)."""
    times: Literal["auto", "field", "azimuth", "none"] = parameter("auto")
    """Times of the points come from a field of the cloud or from the azimuths of the points; auto
    tries the two in this order, and none maps the sweeps without de-skewing."""
    spin: Literal["auto", "clockwise", "counterclockwise"] = parameter("auto")
    """The lidar rotates in this sense, seen from above; it is used for times from azimuths."""
    start_azimuth_deg: float | None = parameter(None, unit="degrees", low=-360.0, high=360.0)
    """A sweep starts at this azimuth, counted from x towards y, for times from azimuths; null takes
    where rings begin that go all around in the order of firing, else 180."""
    period: float = parameter(0.1, unit="s", low=1e-4, high=1e3)
    """A sweep lasts this long; the duration is used for times from azimuths."""
    stamp: Literal["auto", "start", "middle", "end"] = parameter("auto")
    """The stamp of a sweep is this moment of it, for times from azimuths; auto takes what the
    layout of the data set implies (KITTI: middle), else the start."""
    min_range: float = parameter(0.5, unit="m", source="A-LOAM uses 0.3 to 5", low=0.0)
    """Points nearer to the lidar than this are dropped."""
    max_range: float = parameter(120.0, unit="m", low=0.0)
    """Points farther from the lidar than this are dropped."""
    range_offset: float = parameter(0.0, unit="m", low=-1.0, high=1.0)
    """All ranges are too long by this, and are made shorter. The end of a run says by how much they
    look too long: a driver may count them from another point of the lidar than its centre."""

    beams: tuple[BeamRow, ...] = parameter(())
    """Errors of single beams: of each its elevation (degrees), by how much its ranges are too long
    (m), and its elevations and azimuths too large (degrees). The points are corrected by them. A
    run in which they show writes them to beams.yaml."""


class FeatureConfig(Section):
    """Scan registration: the choice of edge and plane features among the points of a sweep."""

    in_order = (("sharp_per_sector", "edges_per_sector"),)

    sectors: int = parameter(6, source="LOAM", low=1, high=1000)
    """Every ring is divided into this many sectors, which each give their own features."""
    half_window: int = parameter(5, source="LOAM", low=1, high=100)
    """The curvature at a point takes this many neighbours on either side of it in its ring."""
    edge_curvature: float = parameter(0.1, unit="m^2", source="LOAM", low=0.0)
    """An edge point needs at least this curvature, the squared norm of the sum of differences."""
    beam_width: float = parameter(1e-3, unit="rad", source="half of data sheets", low=0.0, high=1.0)
    """Edges before drops are moved outwards by half of the gap between beams of this width; 1 turns
    this off."""
    range_noise: float = parameter(0.02, unit="m", source="LOAM takes all that is no edge", low=0.0)
    """The ranges of the sensor have this standard deviation. A plane point lies where its ring
    scatters by less than four times this about a smooth surface; 0 turns the test off."""
    post_depth: float = parameter(0.5, unit="m", source="LOAM has no such search", low=0.0)
    """A pole, a run of a ring too short for the curvature, is an edge where it stands in front of
    what is on both sides of it by more than this; 0 turns the search for poles off."""
    post_width: float = parameter(2.0, unit="m", source="twice matching.max_distance", low=0.0)
    """A run of a ring is a pole only if it is narrower: all of it is within reach of its middle."""
    plane_curvature: float = parameter(0.1, unit="m^2", source="LOAM", low=0.0)
    """A plane point has at most this curvature."""
    sharp_per_sector: int = parameter(2, source="LOAM", low=0)
    """At most this many edge points of a sector count as sharp; scan-to-scan odometry uses them."""
    edges_per_sector: int = parameter(20, source="LOAM", low=0)
    """At most this many edge points are taken from a sector, the sharp ones included."""
    flat_per_sector: int = parameter(4, source="LOAM", low=0)
    """At most this many plane points of a sector count as flat; scan-to-scan odometry uses them."""
    max_gap: float = parameter(0.05, unit="m^2", source="LOAM", low=0.0)
    """The suppression beside a chosen point stops at a gap with a squared width above this."""
    occlusion_gap: float = parameter(0.1, unit="m^2", source="LOAM", low=0.0)
    """Two neighbours with a squared distance above this may be the rim of an occlusion."""
    occlusion_ratio: float = parameter(0.1, source="LOAM", low=0.0)
    """Neighbours are on one ray if their distance, scaled to one range, is below this times it."""
    grazing_ratio: float = parameter(0.0002, source="LOAM", low=0.0)
    """A beam grazes if both squared gaps beside its point exceed this times its squared range."""
    plane_voxel: float = parameter(0.2, unit="m", source="LOAM", low=0.0)
    """The plane points of one ring are averaged over runs, or voxels, of this length."""
    thinning: Literal["runs", "voxels"] = parameter("runs", source="LOAM has voxels")
    """Plane points are averaged over runs along a ring, whose ends do not depend on range noise, or
    over voxels."""


class DeskewConfig(Section):
    """De-skewing: the removal of the motion distortion from a sweep."""

    enabled: bool = parameter(True)
    """Sweeps are de-skewed with the predicted motion, and again with the solution."""
    model: Literal["predicted", "constant", "linear"] = parameter("linear", source="LOAM predicts")
    """The velocity within a sweep is the predicted one (and rest at the start), or leads from the
    last pose to the solved one (constant), or changes as poses and points tell (linear, if no IMU
    does). Unless predicted, the first motion is searched for, with eight sweeps together."""
    rotation: Literal["auto", "orientation", "constant_velocity"] = parameter("auto")
    """The rotation within a sweep comes from the gyro of an IMU where that covers the sweep, else
    from a constant velocity (auto), or from the attitude of the IMU (orientation)."""
    reference: Literal["start", "middle", "end", "stamp"] = parameter("start")
    """The pose of a sweep is that of the lidar at this moment of the sweep."""


class OdometryConfig(Section):
    """The prediction of the motion, from which the mapper starts."""

    method: Literal["constant_velocity", "scan_to_scan"] = parameter("constant_velocity")
    """The predicted motion repeats the last one, or comes from scan-to-scan registration."""
    iterations: int = parameter(25, source="LOAM", low=1, high=1000)
    """Scan-to-scan registration takes at most this many iterations."""
    max_distance: float = parameter(5.0, unit="m", source="LOAM", low=0)
    """Scan-to-scan registration matches no points farther apart than this."""
    ring_gap: int = parameter(2, source="LOAM", low=1, high=1000)
    """Scan-to-scan registration searches this many rings above and below the ring of a match."""


class MapConfig(Section):
    """The map of edge and plane points, in cubes of which those in a window are in memory."""

    in_order = (("edge_voxel", "cube_size"), ("plane_voxel", "cube_size"))

    cube_size: float = parameter(50.0, unit="m", source="LOAM", low=1.0)
    """Every cube of the map has this edge length."""
    window: tuple[Count, Count, Count] = parameter((21, 21, 11), source="LOAM")
    """The window holds this many cubes along x, y and z."""
    window_margin: int = parameter(3, unit="cubes", source="LOAM", low=0)
    """The window shifts when the cube of the sensor is this near the edge of the window."""
    neighbourhood: tuple[Count, Count, Count] = parameter((5, 5, 5), source="LOAM")
    """A sweep is matched with this many cubes around the sensor, along x, y and z."""
    field_of_view: bool = parameter(True, source="LOAM")
    """A sweep is matched only with cubes that have a corner 30 to 150 degrees off the up axis."""
    edge_voxel: float = parameter(0.2, unit="m", source="LOAM", low=0.01)
    """The edge map keeps one point per voxel of this size."""
    plane_voxel: float = parameter(0.4, unit="m", source="LOAM", low=0.01)
    """The plane map keeps one point per voxel of this size."""
    small_below: float = parameter(7.0, unit="m", source="LOAM has one size of voxels", low=0.0)
    """A place is small where three quarters of a sweep's points are nearer than this. There the
    voxels of map and features and covariance.ground_cell have half their size, and lines and planes
    are fitted to twice as many neighbours; 0 keeps these values everywhere."""
    insertion: Literal["settled", "centroid"] = parameter("settled")
    """New points enter a cube in this way: settled keeps the first point of a voxel, and one of
    each face of a thin wall; centroid filters the cube again with its new points, as LOAM does."""
    insert_unmatched: bool = parameter(False)
    """A sweep with too few matches is inserted where it is expected, as by LOAM; else left out."""
    archive_megabytes: float = parameter(512.0, unit="MB", low=0.0)
    """Cubes that left the window take at most this much memory. Beyond it, the oldest go to
    archive_dir, or are dropped and counted if archive_dir is not set."""
    archive_dir: str | None = parameter(None)
    """Archived cubes go to this folder; null keeps them in memory."""


class RelocalizationConfig(Section):
    """The test whether a sweep is lost, and the search for its place."""

    in_order = (
        ("min_agreement", "found_agreement"),
        ("min_share", "found_share"),
        ("radius", "max_radius"),
    )

    enabled: bool = parameter(True, source="LOAM believes every solve")
    """Every sweep is tested, and is lost if it fits the map less well than the sweeps before it;
    false believes every solve."""
    memory: int = parameter(10, low=1, high=10_000)
    """The usual shares are medians over up to this many earlier sweeps; none is lost before 4."""
    min_agreement: float = parameter(
        0.8, source="0.88 or more is usual, at most 0.75 when kidnapped", low=0.0, high=1.0
    )
    """A sweep is lost if the share of its matches within three standard deviations is below this
    times the usual share."""
    min_share: float = parameter(0.4, low=0.0, high=1.0)
    """A sweep is lost as well if the share of its features that are matched and agree is below this
    times the usual share."""
    found_agreement: float = parameter(0.9, low=0.0, high=1.0)
    """A lost sweep is found again only if the share of its matches within three standard deviations
    is at least this times the usual share."""
    found_share: float = parameter(0.6, low=0.0, high=1.0)
    """A lost sweep is found again only if the share of its features that are matched and agree is
    at least this times the usual share."""
    max_acceleration: float = parameter(60.0, unit="m/s^2", low=0.0)
    """A pose is a jump if it is farther from the predicted one than this acceleration explains. It
    is handed out without a motion, and the velocity from before stays."""
    max_turn_acceleration: float = parameter(60.0, unit="rad/s^2", low=0.0)
    """A pose is a jump as well if its rotation differs from the predicted one by more than this
    angular acceleration explains."""
    radius: float = parameter(10.0, unit="m", low=0.0, high=100.0)
    """The search begins within this radius about the predicted pose."""
    radius_growth: float = parameter(1.0, unit="m", low=0.0)
    """The radius of the search grows by this with every lost sweep."""
    max_radius: float = parameter(30.0, unit="m", low=0.0, high=100.0)
    """The radius of the search does not grow beyond this."""
    new_piece: int = parameter(20, low=0, high=1_000_000)
    """After so many sweeps in a row that are not found, the run goes on in another piece of map,
    that of these sweeps, with a covariance of where it is. With 0 it stays lost."""


class MatchingConfig(Section):
    """The association of features with lines and planes of the map."""

    max_edges: int = parameter(500, source="LOAM matches all", low=0)
    """At most this many edges are matched, evenly spread; 0 matches all. All enter the map."""
    max_planes: int = parameter(2000, source="LOAM matches all", low=0)
    """At most this many plane points are matched, evenly spread; 0 matches all. All are mapped."""
    trial_edges: int = parameter(150, low=1)
    """At most this many edge features are matched where many poses are tried, in the search for a
    lost sweep and for a loop closure."""
    trial_planes: int = parameter(500, low=1)
    """At most this many plane features are matched where many poses are tried."""
    neighbours: int = parameter(5, source="LOAM", low=3, high=100)
    """A line or plane is fitted to this many map points nearest to a feature."""
    max_distance: float = parameter(1.0, unit="m", source="LOAM", low=0.01)
    """A feature is matched only if its nearest map points are all within this distance."""
    wide_search: float = parameter(4.0, source="LOAM has no such search", low=1.0, high=100.0)
    """While the map is thin, and planes near by are few or leave a translation open, other features
    are matched with planes within this times max_distance, among voxels enlarged by this factor:
    at the start the rings of a sweep are too far apart. 1 turns the search off."""
    wide_below: float = parameter(8.0, low=0.0)
    """A translation is open if fewer planes than this fix it, counted as if they lay across it.
    Lines, and planes while the map is thin, are then searched for more widely, too."""
    line_ratio: float = parameter(10.0, source="LOAM uses 3", low=1.0)
    """A line needs its largest eigenvalue above this times the second one."""
    plane_fit: Literal["centroid", "unit_offset"] = parameter(
        "centroid", source="LOAM and A-LOAM use unit_offset"
    )
    """Planes are fitted in this way: about the centroid, or by A n = -1 (unit_offset), which cannot
    represent a plane through the map origin."""
    plane_tolerance: float = parameter(
        0.09, unit="m", source="three point_sigma; LOAM uses 0.2", low=0.0
    )
    """A plane is accepted only if none of its map points is farther from it than this."""
    plane_ratio: float = parameter(0.2, low=0.0, high=1.0)
    """A plane needs its second eigenvalue above this times the largest one: points along one ring
    of a sparse sensor have no normal."""
    max_ring_cosine: float = parameter(0.5, low=0.0)
    """The cosine between an edge and its ring is at most this; a line along a ring is no edge."""
    min_incidence_sine: float = parameter(0.05, low=0.0, high=1.0)
    """The sine of the angle between a plane and the viewing ray is at least this, for a plane that
    contains the ray says nothing."""
    keep_translation: float = parameter(0.05, unit="m", source="LOAM uses 0", low=0.0)
    """Lines and planes are kept, and only distances and weights renewed, while the pose has moved
    less than this since the search and turned less than keep_rotation_deg; 0 searches each time."""
    keep_rotation_deg: float = parameter(0.3, unit="degrees", source="LOAM uses 0", low=0.0)
    """Lines and planes are searched for again when the pose has turned by this since the search."""
    point_sigma: float = parameter(0.03, unit="m", low=1e-6)
    """A measured point has this standard deviation about a surface."""
    fit_uncertainty: bool = parameter(True)
    """The variance of a match includes that of the line or plane at the point (regression
    leverage); false gives every match point_sigma."""
    weight_slope: float = parameter(0.9, source="LOAM", low=0.0)
    """A match has the weight 1 - slope * |distance|, for planes over sqrt(range), with this slope;
    0 gives all matches the same weight."""
    weight_range: Literal["lidar", "map"] = parameter("lidar", source="LOAM uses map")
    """The range in the weight of a plane is that from the lidar or from the map origin."""
    min_weight: float = parameter(0.1, source="LOAM", low=0.0, high=1.0)
    """A match with a smaller weight than this is dropped."""


class SolverConfig(Section):
    """The solve for the pose of a sweep."""

    method: Literal["gtsam", "loam", "aloam"] = parameter("gtsam")
    """The pose is solved by a factor graph (gtsam), by LOAM's Gauss-Newton on Euler angles (loam),
    or by A-LOAM's robust Levenberg-Marquardt (aloam)."""
    iterations: int = parameter(20, source="LOAM uses 10", low=1, high=200)
    """A solve associates the features with the map at most this many times."""
    inner_iterations: int = parameter(2, source="A-LOAM uses 4", low=1, high=1000)
    """After each association, Levenberg-Marquardt takes at most this many iterations."""
    rotation_tolerance_deg: float = parameter(0.05, unit="degrees", source="LOAM", low=0.0)
    """The solve stops when an association turns the pose by less than this and moves it by less
    than translation_tolerance."""
    translation_tolerance: float = parameter(0.0005, unit="m", source="LOAM", low=0.0)
    """The solve stops when an association moves the pose by less than this and turns it by less
    than rotation_tolerance_deg."""
    kernel: Literal["huber", "geman_mcclure"] = parameter("geman_mcclure")
    """The method gtsam has this robust kernel on the matches; geman_mcclure all but ignores matches
    that are far off, for traffic and crowds."""
    kernel_width: float = parameter(
        1.345, source="95 % efficiency on normal noise", low=0.1, high=math.inf
    )
    """The Huber kernel on the matches has this width, in units of their scatter; the Geman-McClure
    kernel is 2.816 times as wide, which makes the two alike on normal noise. .inf is no kernel."""
    step_sigmas: float = parameter(0.5, low=0.0)
    """The solve stops as well when an association moves the pose by less than this many of its
    standard deviations; 0 turns this rule off."""
    min_matches: int = parameter(50, source="LOAM", low=6)
    """A sweep with fewer matches than this is not solved."""
    min_map_edges: int = parameter(0, source="LOAM uses 11", low=0)
    """A sweep is solved only if the local map has at least this many edge points."""
    min_map_planes: int = parameter(50, source="A-LOAM uses 51, LOAM uses 101", low=0)
    """A sweep is solved only if the local map has at least this many plane points."""
    degeneracy: Literal["prior", "project", "off"] = parameter("prior", source="LOAM projects")
    """Degenerate directions, which a scan does not fix, are treated like this: prior adds the
    predicted motion with its own covariance; project keeps that motion exactly, which the methods
    loam and aloam do for prior, too; off believes the scan."""
    min_aligned: float = parameter(8.0, low=0.0)
    """A direction is degenerate if fewer matches than this fix it, counted as if their normals
    pointed that way."""
    acceleration_sigma: float = parameter(2.0, unit="m/s^2", low=1e-6, high=1e4)
    """Along degenerate directions, constant velocity is believed to within this acceleration."""
    turn_sigma: float = parameter(2.0, unit="rad/s^2", low=1e-6, high=1e4)
    """Along degenerate directions, a constant turn rate is believed to within this acceleration."""
    start_speed: float = parameter(10.0, unit="m/s", low=1e-6)
    """Along degenerate directions, the speed at the start of a run is zero to within this."""
    start_turn: float = parameter(0.5, unit="rad/s", low=1e-6)
    """Along degenerate directions, the turn rate at the start of a run is zero to within this."""
    degeneracy_threshold: float = parameter(0.0, source="LOAM uses 100", low=0.0)
    """The method loam projects the step out of eigenvectors of A^T A that have eigenvalues below
    this (mixed rad and m, so that it depends on the number of matches); with 0 it is min_aligned
    that tells which directions are degenerate."""
    degeneracy_projector: Literal["correct", "published"] = parameter("correct")
    """The method loam projects by V^-1 V2 with eigenvectors as rows (correct), or as columns like
    the published Eigen port, which is no projection onto the good directions; only to study it."""
    shorten_steps: bool = parameter(True)
    """The method loam halves a step that does not lower the cost as the gradient promises; without
    this, the pose moves back and forth where edges alone fix it. LOAM takes every step."""
    huber_delta: float = parameter(0.1, unit="m", source="A-LOAM", low=0.0)
    """The loss of the method aloam turns linear at this residual; 0 keeps it quadratic."""
    cost_tolerance: float = parameter(1e-6, source="the default of Ceres", low=0.0)
    """A step of the method aloam that changes the cost by less than this share ends the inner
    iterations and is not taken."""


class CovarianceConfig(Section):
    """The calibration of covariances; beside an IMU, poses depend on them too."""

    match_cell: float = parameter(
        1.6, unit="m", source="neighbours lie within matching.max_distance", low=0.01
    )
    """Matches in one cell of this size count as one error, for they share points of the map."""
    ground_cell: float = parameter(0.8, unit="m", low=0.01)
    """A cell of this size is new ground when it is matched for the first time."""
    drift: float = parameter(1.0, source="docs/maths/covariance.md, equation 6", low=0.0)
    """The error of the map grows by this times the share of new ground in a frame's covariance."""
    window: int = parameter(10, low=1, high=10_000)
    """The acceleration that constant velocity misses is averaged over this many frames."""


class ImuConfig(Section):
    """The use of an inertial measurement unit (IMU); without one, nothing here matters."""

    coupling: Literal["tight", "loose", "off"] = parameter("tight")
    """The measurements of the IMU act in this way: tight, gyro and accelerometer predict every pose
    and are estimated together with the scans (pose, velocity, biases, gravity); loose, the gyro
    turns prediction and sweep; off, not at all. Roll and pitch act by the prior, unless off."""
    prior: Literal["off", "blend", "equivalent", "sigma"] = parameter(
        "equivalent", source="LOAM blends"
    )
    """Roll and pitch of the IMU act on the pose in this way: off, not at all; blend, mixed in after
    the solve; equivalent, by a factor that has the weight's share of what the scan knows, which
    gives the same mean; sigma, by a gravity direction of the given standard deviation."""
    weight: float = parameter(0.002, source="LOAM", low=0.0, high=0.999)
    """Roll and pitch of the IMU have this share in the result of blend and equivalent."""
    sigma_deg: float = parameter(0.5, unit="degrees", low=1e-4)
    """The gravity direction of the IMU has this standard deviation, its slow errors included. It is
    used by sigma, and by equivalent where the scan or the angles allow no equivalent factor."""
    level: bool = parameter(True)
    """The z axis of the map points up from the start; false takes the frame of the first pose."""
    still_seconds: float = parameter(0.5, unit="s", low=0.0, high=60.0)
    """The platform may be at rest for this long before the first sweep; that window is examined."""
    average_seconds: float = parameter(
        0.1, unit="s", source="the period of a sweep; LOAM uses 0", low=0.0, high=60.0
    )
    """Roll and pitch of a frame are the mean over this duration, brought to the moment of the frame
    by the gyro; 0 takes those of the moment itself."""
    time_offset: float = parameter(0.0, unit="s", low=-10.0, high=10.0)
    """This is added to the stamps of the samples, where the IMU has another clock than the sweeps:
    negative if its stamps are late. The end of a run says by how much they are."""
    max_gap: float = parameter(0.1, unit="s", low=1e-3, high=60.0)
    """A gap between samples that is longer than this is not bridged."""
    lidar_R_imu_deg: tuple[Angle, Angle, Angle] = parameter((0.0, 0.0, 0.0), unit="degrees")
    """These are roll, pitch and yaw of the rotation Rz Ry Rx that takes vectors from the frame of
    the IMU into the frame of the lidar."""
    lidar_t_imu: tuple[Offset, Offset, Offset] = parameter((0.0, 0.0, 0.0), unit="m")
    """The IMU has this position in the frame of the lidar; the tight coupling uses it."""
    filter_seconds: float = parameter(60.0, unit="s", low=0.1)
    """The attitude filter, which replaces a missing orientation, has this time constant."""
    lag: int = parameter(20, low=2, high=1000)
    """The graph of the tight coupling keeps this many frames."""
    gravity: float = parameter(9.81, unit="m/s^2", low=1.5, high=100.0)
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
    max_chi2: float = parameter(40.0, source="one of 10,000 right loops exceeds 28", low=0.0)
    """A loop closure is used if its squared Mahalanobis distance (6 degrees of freedom) from what
    all the others say is not above this."""
    kernel_width: float = parameter(
        5.0, source="right loops have a norm of sqrt(6)", low=0.1, high=math.inf
    )
    """In iSAM2 a loop closure has a Huber kernel, this wide after whitening; .inf turns it off."""
    believed_loops: int = parameter(6, low=2, high=1000)
    """At least this many loop closures that agree pairwise are used even against the odometry, if
    it may have drifted so far: by 1 % of the way and 0.02 degrees a metre."""
    visits: int = parameter(4, low=0, high=10_000)
    """This many keyframes that come back to a place stay in the graph; one more, which would lower
    a standard deviation by less than a tenth, is forgotten when the next keyframe comes."""
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
    """A candidate lies within a radius about the keyframe, of three parts; this one is constant."""
    gate_sigmas: float = parameter(3.0, low=0.0)
    """The second part of that radius is this many standard deviations of the two positions."""
    gate_drift: float = parameter(0.02, low=0.0)
    """The third part of that radius is this share of the distance travelled between the keyframes,
    for drift that the covariances do not know."""
    rings: int = parameter(20, source="Scan Context", low=1, high=200)
    """The place descriptor has this many rings."""
    sectors: int = parameter(60, source="Scan Context", low=4, high=360)
    """The place descriptor has this many sectors."""
    reach: float = parameter(60.0, unit="m", source="Scan Context uses 80", low=1.0)
    """The place descriptor covers points up to this range."""
    max_unlike: float = parameter(0.6, source="Scan Context uses 0.2 to 0.6", low=0.0)
    """A candidate is tried if the distance of the two place descriptors is not above this."""
    tries: int = parameter(2, low=1, high=100)
    """At most this many candidates are verified for a keyframe."""
    neighbours: int = parameter(6, low=0, high=1000)
    """The submap of a candidate has its features and those of so many keyframes on either side."""
    search: float = parameter(8.0, unit="m", low=1.0, high=100.0)
    """The keyframe is searched for within this radius about the candidate."""
    min_share: float = parameter(0.5, low=0.0, high=1.0)
    """Off level ground at least this part of the usual share of the features must have a match."""
    min_agreement: float = parameter(
        0.9, source="right loops have 0.97 or more, wrong ones at most 0.75", low=0.0, high=1.0
    )
    """At least this share of the matches must lie within three standard deviations."""
    min_aligned: float = parameter(30.0, low=0.0)
    """Every direction must be fixed by this many matches, counted as for solver.min_aligned."""

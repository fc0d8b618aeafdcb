"""Keyframes, their pose graph, and loop closures."""

from __future__ import annotations

from loam_gtsam.config.base import Section, parameter


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

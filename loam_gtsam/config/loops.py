"""Keyframes, their pose graph, and loop closures."""

from __future__ import annotations

from loam_gtsam.config.base import Section, parameter


class PoseGraphConfig(Section):
    """Keyframes and the graph of their poses."""

    keyframe_distance: float = parameter(
        4.0, "a frame is a keyframe if it is as far as this from the last one", unit="m", low=0.0
    )
    keyframe_angle_deg: float = parameter(
        30.0, "or has turned as much as this", unit="degrees", low=0.0
    )
    walk: float = parameter(
        0.02,
        "drift of the odometry beside what its covariances know, as a random walk: so many times "
        "the square root of the way between two keyframes",
        unit="m/sqrt(m)",
        low=0.0,
    )
    turn_walk_deg: float = parameter(0.02, "and of its rotation", unit="degrees/sqrt(m)", low=0.0)
    max_chi2: float = parameter(
        40.0,
        "a loop is used if its squared Mahalanobis distance (6 freedoms) from what all the others "
        "say is not above",
        source="28 is exceeded by one of 10,000 right ones, were all covariances exact",
        low=0.0,
    )
    kernel_width: float = parameter(
        5.0,
        "width of the Huber kernel on the whitened norm of a loop, in iSAM2; .inf turns it off",
        source="far above sqrt(6), the norm of a right one",
        low=0.1,
    )
    believed_loops: int = parameter(
        6, "so many loops that agree pairwise are used although the odometry contradicts", low=2
    )
    follow_distance: float = parameter(
        0.05,
        "map points follow their keyframe once a loop has moved it by more than this, seen from "
        "the newest one, from which it may be off by the angle below as well",
        unit="m",
        low=0.0,
    )
    follow_angle_deg: float = parameter(
        0.2, "or turned it by more than this", unit="degrees", low=0.0
    )


class LoopConfig(Section):
    """Where loops are looked for, and when one is believed."""

    enabled: bool = parameter(False, "look for loops during a run, and let the map follow")
    min_way: float = parameter(
        30.0, "keyframes that are not as far as this back on the way are no loop", unit="m", low=0.0
    )
    gate: float = parameter(
        10.0, "candidates are within this of the keyframe, and", unit="m", low=0.0
    )
    gate_sigmas: float = parameter(
        3.0, "so many standard deviations of both their positions farther, and", low=0.0
    )
    gate_drift: float = parameter(
        0.02, "this share of the way between them: drift that the covariances do not know", low=0.0
    )
    rings: int = parameter(20, "of the place descriptor", source="Scan Context", low=1)
    sectors: int = parameter(60, "of it", source="Scan Context", low=4)
    reach: float = parameter(
        60.0,
        "of it; what is farther away is not in it",
        unit="m",
        source="Scan Context: 80",
        low=1.0,
    )
    max_unlike: float = parameter(
        0.6,
        "distance of two descriptors, 0 for equal ones, above which a candidate is not tried",
        source="Scan Context: 0.2 to 0.6, but there nothing is verified",
        low=0.0,
    )
    tries: int = parameter(2, "candidates that are verified for a keyframe at most", low=1)
    neighbours: int = parameter(
        6, "keyframes on either side of a candidate whose features make up the submap", low=0
    )
    search: float = parameter(
        8.0, "around the candidate in which the keyframe is searched for", unit="m", low=1.0
    )
    min_share: float = parameter(
        0.5,
        "share of the features off level ground that must find a match in the submap",
        low=0.0,
        high=1.0,
    )
    min_agreement: float = parameter(
        0.9,
        "share of their matches that must lie within three standard deviations",
        source="right ones 0.97 or more, 3 m along a street 0.75, other wrong ones below 0.5",
        low=0.0,
        high=1.0,
    )
    min_aligned: float = parameter(
        30.0,
        "every direction must be fixed by as many matches, counted as for solver.min_aligned",
        low=0.0,
    )

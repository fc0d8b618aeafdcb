"""The registration of a sweep with the map: matches, the solve, its covariance."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Section, parameter


class MatchingConfig(Section):
    """The association of features with lines and planes of the map."""

    max_edges: int = parameter(500, source="LOAM matches all", low=0)
    """At most this many edge features of a sweep are matched, evenly spread over it; 0 matches all.
    All features enter the map."""
    max_planes: int = parameter(2000, source="LOAM matches all", low=0)
    """At most this many plane features of a sweep are matched, evenly spread over it; 0 matches
    all. All features enter the map."""
    trial_edges: int = parameter(150, low=1)
    """At most this many edge features are matched where many poses are tried, in the search for a
    lost sweep and for a loop closure."""
    trial_planes: int = parameter(500, low=1)
    """At most this many plane features are matched where many poses are tried."""
    neighbours: int = parameter(5, source="LOAM", low=3)
    """A line or plane is fitted to this many map points nearest to a feature."""
    max_distance: float = parameter(1.0, unit="m", source="LOAM", low=0.0)
    """A feature is matched only if its nearest map points are all within this distance."""
    wide_search: float = parameter(4.0, source="LOAM has no such search", low=1.0)
    """With fewer matches than solver.min_matches, the search is repeated with max_distance and the
    voxels of the map enlarged by this factor. This helps at the start on open ground, where the
    rings of one sweep are too far apart; 1 turns the search off."""
    wide_below: float = parameter(8.0, low=0.0)
    """Lines are searched for within wide_search times max_distance, too, if fewer planes than this
    fix a translation, counted as if they lay across it."""
    line_ratio: float = parameter(10.0, source="LOAM uses 3", low=1.0)
    """A line needs its largest eigenvalue above this times the second one."""
    plane_fit: Literal["centroid", "unit_offset"] = parameter(
        "centroid", source="LOAM and A-LOAM use unit_offset"
    )
    """Planes are fitted in this way: about the centroid, or by A n = -1 (unit_offset), which cannot
    represent a plane through the map origin."""
    plane_tolerance: float = parameter(0.2, unit="m", source="LOAM", low=0.0)
    """A plane is accepted only if none of its map points is farther from it than this."""
    plane_ratio: float = parameter(0.2, low=0.0, high=1.0)
    """A plane needs its second eigenvalue above this times the largest one: points along one ring
    of a sparse sensor have no normal."""
    max_ring_cosine: float = parameter(0.5, low=0.0)
    """The cosine between an edge line and its ring is at most this, for a line along the ring is
    no edge."""
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
    weight_range: Literal["lidar", "map"] = parameter(
        "lidar", source="LIO-SAM uses lidar, LOAM uses map"
    )
    """The range in the weight of a plane is that from the lidar or from the map origin."""
    min_weight: float = parameter(0.1, source="LOAM", low=0.0, high=1.0)
    """A match with a smaller weight than this is dropped."""


class SolverConfig(Section):
    """The solve for the pose of a sweep."""

    method: Literal["gtsam", "loam", "aloam"] = parameter("gtsam")
    """The pose is solved by a factor graph (gtsam), by LOAM's Gauss-Newton on Euler angles (loam),
    or by A-LOAM's robust Levenberg-Marquardt (aloam)."""
    iterations: int = parameter(10, source="LOAM", low=1)
    """A solve associates the features with the map at most this many times."""
    inner_iterations: int = parameter(2, source="A-LOAM uses 4", low=1)
    """After each association, Levenberg-Marquardt takes at most this many iterations."""
    rotation_tolerance_deg: float = parameter(0.05, unit="degrees", source="LOAM", low=0.0)
    """The solve stops when an association turns the pose by less than this and moves it by less
    than translation_tolerance."""
    translation_tolerance: float = parameter(0.0005, unit="m", source="LOAM", low=0.0)
    """The solve stops when an association moves the pose by less than this and turns it by less
    than rotation_tolerance_deg."""
    kernel: Literal["huber", "geman_mcclure"] = parameter("huber")
    """The method gtsam has this robust kernel on the matches; geman_mcclure all but ignores matches
    that are far off, for traffic and crowds."""
    kernel_width: float = parameter(1.345, source="95 % efficiency on normal noise", low=0.1)
    """The Huber kernel on the matches has this width, in units of their scatter; .inf turns it off.
    The Geman-McClure kernel is 2.816 times as wide, which makes the two alike on normal noise."""
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
    """Degenerate directions, which a scan does not fix, are treated like this by the method gtsam:
    prior adds the predicted motion with its own covariance; project keeps that motion exactly;
    off believes the scan."""
    min_aligned: float = parameter(8.0, low=0.0)
    """A direction is degenerate if fewer matches than this fix it, counted as if their normals
    pointed that way."""
    acceleration_sigma: float = parameter(2.0, unit="m/s^2", low=1e-6)
    """The motion of constant velocity is believed to within this acceleration along degenerate
    directions."""
    turn_sigma: float = parameter(2.0, unit="rad/s^2", low=1e-6)
    """The motion of constant velocity is believed to within this angular acceleration along
    degenerate directions."""
    degeneracy_threshold: float = parameter(100.0, source="LOAM", low=0.0)
    """The method loam projects the step out of eigenvectors of A^T A that have eigenvalues below
    this (mixed rad and m); 0 turns the projection off."""
    degeneracy_projector: Literal["correct", "published"] = parameter("correct")
    """The method loam projects by V^-1 V2 with eigenvectors as rows (correct), or as columns like
    the published Eigen port, which is no projection onto the good directions; only to study it."""
    huber_delta: float = parameter(0.1, unit="m", source="A-LOAM", low=0.0)
    """The loss of the method aloam turns linear at this residual; 0 keeps it quadratic."""
    cost_tolerance: float = parameter(1e-6, source="the default of Ceres", low=0.0)
    """A step of the method aloam that changes the cost by less than this share ends the inner
    iterations and is not taken."""


class CovarianceConfig(Section):
    """The calibration of the covariances that are handed out; no pose depends on it."""

    match_cell: float = parameter(
        1.6, unit="m", source="neighbours lie within matching.max_distance", low=0.01
    )
    """The residuals of matches in one cell of this size count as one error, for they share map
    points."""
    ground_cell: float = parameter(0.8, unit="m", low=0.01)
    """A cell of this size is new ground when it is matched for the first time."""
    drift: float = parameter(
        6.0,
        source="fitted on seeds 100-103 of the built-in scenes, see docs/consistency.md",
        low=0.0,
    )
    """The error of the map grows by this times the share of new ground in a frame's covariance."""
    window: int = parameter(10, low=1)
    """The acceleration, which the motion of constant velocity misses, is averaged over this many
    frames."""

"""The registration of a sweep with the map: matches, the solve, its covariance."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Section, parameter


class MatchingConfig(Section):
    """Association of features with the map."""

    max_edges: int = parameter(
        500,
        "edge features matched at most, evenly spread over the sweep; 0: all. All enter the map",
        source="LOAM matches all",
        low=0,
    )
    max_planes: int = parameter(2000, "and plane features", source="LOAM matches all", low=0)
    trial_edges: int = parameter(
        150, "edge features matched at most where many poses are tried: a search, a loop", low=1
    )
    trial_planes: int = parameter(500, "and plane features", low=1)
    neighbours: int = parameter(5, "map points a feature is matched with", source="LOAM", low=3)
    max_distance: float = parameter(
        1.0, "distance of the farthest of them", unit="m", source="LOAM", low=0.0
    )
    wide_search: float = parameter(
        4.0,
        "with fewer matches than solver.min_matches, search again with this times max_distance in "
        "a map of this times as large voxels, as at the start on open ground, where the rings of "
        "one sweep are too far apart; 1: no such search",
        source="LOAM has none",
        low=1.0,
    )
    wide_below: float = parameter(
        8.0,
        "search for lines, too, by wide_search times max_distance, if fewer planes than this fix a "
        "translation, counted as if they lay across it",
        low=0.0,
    )
    line_ratio: float = parameter(
        10.0,
        "a line needs its largest eigenvalue above this times the second",
        source="LOAM uses 3",
        low=1.0,
    )
    plane_fit: Literal["centroid", "unit_offset"] = parameter(
        "centroid",
        "the plane is fitted about the centroid, or by A n = -1, which cannot represent a plane "
        "through the map origin",
        source="LOAM and A-LOAM use unit_offset",
    )
    plane_tolerance: float = parameter(
        0.2, "farthest of the five from the plane", unit="m", source="LOAM", low=0.0
    )
    plane_ratio: float = parameter(
        0.2,
        "a plane needs its second eigenvalue above this times the largest: five points along one "
        "ring of a sparse sensor have no normal",
        low=0.0,
        high=1.0,
    )
    max_ring_cosine: float = parameter(
        0.5, "an edge line may not run along the ring: largest cosine between the two", low=0.0
    )
    min_incidence_sine: float = parameter(
        0.05,
        "a plane may not contain the viewing ray: least sine of the angle between the two",
        low=0.0,
        high=1.0,
    )
    keep_translation: float = parameter(
        0.05,
        "lines and planes are kept, and only distances and weights renewed, while the pose has "
        "moved less than this since the search",
        unit="m",
        source="LOAM searches anew each time: 0",
        low=0.0,
    )
    keep_rotation_deg: float = parameter(
        0.3, "and has turned less than this", unit="degrees", source="LOAM: 0", low=0.0
    )
    point_sigma: float = parameter(
        0.03, "standard deviation of a measured point about a surface", unit="m", low=1e-6
    )
    fit_uncertainty: bool = parameter(
        True,
        "a match's variance includes that of the line or plane at the point (regression leverage); "
        "false gives every match point_sigma",
    )
    weight_slope: float = parameter(
        0.9,
        "weight = 1 - slope * |distance| (over sqrt(range) for planes); 0 turns it off",
        source="LOAM",
        low=0.0,
    )
    weight_range: Literal["lidar", "map"] = parameter(
        "lidar",
        "whether the range in a plane's weight is that from the sensor or from the map origin",
        source="LIO-SAM uses lidar, LOAM map",
    )
    min_weight: float = parameter(
        0.1, "a match with a smaller weight is dropped", source="LOAM", low=0.0, high=1.0
    )


class SolverConfig(Section):
    """The per-frame solve."""

    method: Literal["gtsam", "loam", "aloam"] = parameter(
        "gtsam",
        "factor graph; LOAM's Gauss-Newton on Euler angles; A-LOAM's robust Levenberg-Marquardt",
    )
    iterations: int = parameter(10, "associations of a solve at most", source="LOAM", low=1)
    inner_iterations: int = parameter(
        2, "Levenberg-Marquardt iterations per association", source="A-LOAM uses 4", low=1
    )
    rotation_tolerance_deg: float = parameter(
        0.05,
        "stop when an association moves the pose less than this",
        unit="degrees",
        source="LOAM",
        low=0.0,
    )
    translation_tolerance: float = parameter(
        0.0005, "and less than this", unit="m", source="LOAM", low=0.0
    )
    kernel: Literal["huber", "geman_mcclure"] = parameter(
        "huber",
        "method gtsam: robust kernel on the matches; geman_mcclure all but ignores what is far "
        "off: for traffic and crowds",
    )
    kernel_width: float = parameter(
        1.345,
        "width of the Huber kernel on the matches, in units of their scatter; .inf turns it off. "
        "That of the other is 2.816 times as wide, which makes them alike on normal noise",
        source="95 % efficiency on normal noise",
        low=0.1,
    )
    step_sigmas: float = parameter(
        0.5,
        "or when it moves the pose less than this many of its standard deviations; 0 turns it off",
        low=0.0,
    )
    min_matches: int = parameter(50, "fewer matches: no solve", source="LOAM", low=6)
    min_map_edges: int = parameter(
        0, "least edge points of the local map for a solve", source="LOAM uses 11", low=0
    )
    min_map_planes: int = parameter(
        50, "least plane points of the local map", source="A-LOAM uses 51, LOAM 101", low=0
    )
    degeneracy: Literal["prior", "project", "off"] = parameter(
        "prior",
        "method gtsam, along directions that a scan does not fix: the expected motion takes over "
        "with its own covariance; it is kept exactly, as LOAM does; or the scan is believed",
        source="LOAM projects",
    )
    min_aligned: float = parameter(
        8.0,
        "a direction is weak if fewer matches than this fix it, counted as if their normals "
        "pointed that way",
        low=0.0,
    )
    acceleration_sigma: float = parameter(
        2.0,
        "what the constant-velocity motion is believed to within, along weak directions",
        unit="m/s^2",
        low=1e-6,
    )
    turn_sigma: float = parameter(2.0, "and for the rotation", unit="rad/s^2", low=1e-6)
    degeneracy_threshold: float = parameter(
        100.0,
        "method loam: the step is projected out of eigenvectors of A^T A with smaller eigenvalues "
        "(mixed rad and m); 0 turns it off",
        source="LOAM",
        low=0.0,
    )
    degeneracy_projector: Literal["correct", "published"] = parameter(
        "correct",
        "method loam: V^-1 V2 with eigenvectors as rows, or with columns as in the published Eigen "
        "port, which is no projection onto the good directions; only to study it",
    )
    huber_delta: float = parameter(
        0.1,
        "method aloam: residual at which the loss turns linear; 0 turns it off",
        unit="m",
        source="A-LOAM",
        low=0.0,
    )
    cost_tolerance: float = parameter(
        1e-6,
        "method aloam: a step that changes the cost by less than this share ends the inner "
        "iterations and is not taken",
        source="Ceres default",
        low=0.0,
    )


class CovarianceConfig(Section):
    """Calibration of the covariances that are handed out; no pose depends on it."""

    match_cell: float = parameter(
        1.6,
        "residuals of matches in one cell of this size count as one error: they share map points",
        unit="m",
        source="neighbours lie within matching.max_distance",
        low=0.01,
    )
    ground_cell: float = parameter(
        0.8, "a cell of this size is new ground when it is matched for the first time", unit="m",
        low=0.01,
    )  # fmt: skip
    drift: float = parameter(
        6.0,
        "the map's error grows by this many times the share of new ground in a frame's covariance",
        source="fitted on seeds 100-103 of built-in scenes, see docs/consistency.md",
        low=0.0,
    )
    window: int = parameter(
        10,
        "frames over which the acceleration, which the constant velocity misses, is averaged",
        low=1,
    )

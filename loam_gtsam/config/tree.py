"""The whole configuration, its presets, and how one is made from another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pydantic import model_validator

from loam_gtsam.config.additions import (
    BagConfig,
    ImuConfig,
    LiveConfig,
    LoopConfig,
    PoseGraphConfig,
)
from loam_gtsam.config.base import Section, nearest, nested, out_of_order, override
from loam_gtsam.config.estimator import (
    CovarianceConfig,
    DeskewConfig,
    FeatureConfig,
    MapConfig,
    MatchingConfig,
    OdometryConfig,
    RelocalizationConfig,
    SensorConfig,
    SolverConfig,
)
from loam_gtsam.types import ConfigError


class Config(Section):
    """The whole configuration."""

    sensor: SensorConfig = SensorConfig()
    features: FeatureConfig = FeatureConfig()
    deskew: DeskewConfig = DeskewConfig()
    odometry: OdometryConfig = OdometryConfig()
    map: MapConfig = MapConfig()
    matching: MatchingConfig = MatchingConfig()
    solver: SolverConfig = SolverConfig()
    imu: ImuConfig = ImuConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()
    covariance: CovarianceConfig = CovarianceConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    loops: LoopConfig = LoopConfig()
    bag: BagConfig = BagConfig()
    live: LiveConfig = LiveConfig()

    @model_validator(mode="after")
    def _check_matches(self) -> Self:
        most, least = self.matching.max_edges + self.matching.max_planes, self.solver.min_matches
        if most < least and self.matching.max_edges and self.matching.max_planes:
            sought = "matching.max_edges + matching.max_planes"
            raise out_of_order(("matching", "solver"), "solver.min_matches", sought, least, most)
        return self

    def changed(
        self, /, *changes: str | Mapping[str, Any], source: str = "", **sections: Any
    ) -> Self:
        """A copy with other values: all are changed at once, then checked.

        Parameters
        ----------
        changes : texts as ``"solver.iterations=5"``, with a value as YAML writes it, or mappings
            of such keys to values, as ``{"solver.iterations": 5}``
        source : where the changes come from, for error messages
        sections : whole sections, as ``imu=ImuConfig(enabled=False)``

        Raises
        ------
        ConfigError
            If there is no such parameter, or a value does not fit.

        Examples
        --------
        >>> Config().changed("solver.iterations=5", "imu.enabled=false").solver.iterations
        5
        """
        where = f"{source}: " if source else ""
        return override(self.model_copy(update=sections), nested(changes, where), lambda _: where)


_CLASSICAL_FEATURES = FeatureConfig(range_noise=0.0, post_depth=0.0)
_CLASSICAL_MATCHING = MatchingConfig(
    max_edges=0,
    max_planes=0,
    wide_search=1.0,
    line_ratio=3.0,
    plane_fit="unit_offset",
    plane_ratio=0.0,
    max_ring_cosine=1.0,
    min_incidence_sine=0.0,
    fit_uncertainty=False,
    weight_range="map",
    keep_translation=0.0,
)

PRESETS: dict[str, Config] = {
    "default": Config(),
    # Zhang and Singh, LOAM (RSS 2014), constants of the published laserMapping.
    "loam": Config(
        features=_CLASSICAL_FEATURES,
        deskew=DeskewConfig(refine=False, rotation="constant_velocity"),
        odometry=OdometryConfig(method="scan_to_scan"),
        map=MapConfig(insertion="centroid"),
        matching=_CLASSICAL_MATCHING,
        solver=SolverConfig(method="loam", step_sigmas=0.0, min_map_edges=11, min_map_planes=101),
        imu=ImuConfig(prior="blend", weight=0.002, average_seconds=0.0),
        relocalization=RelocalizationConfig(enabled=False),
    ),
    # A-LOAM's laserMapping with the voxel sizes of its VLP-16 settings.
    "aloam": Config(
        features=_CLASSICAL_FEATURES,
        deskew=DeskewConfig(refine=False, rotation="constant_velocity"),
        odometry=OdometryConfig(method="scan_to_scan"),
        map=MapConfig(neighbourhood=(5, 5, 3), field_of_view=False, insertion="centroid"),
        matching=_CLASSICAL_MATCHING.changed(weight_slope=0.0),
        solver=SolverConfig(
            method="aloam",
            iterations=2,
            inner_iterations=4,
            step_sigmas=0.0,
            min_matches=6,  # A-LOAM has no minimum; fewer cannot fix a pose
            min_map_edges=11,
            min_map_planes=51,
        ),
        imu=ImuConfig(enabled=False),
        relocalization=RelocalizationConfig(enabled=False),
    ),
}


def preset(name: str) -> Config:
    """The configuration called ``name``.

    Raises
    ------
    ConfigError
        If there is no such preset.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}{nearest(name, PRESETS)}")
    return PRESETS[name]

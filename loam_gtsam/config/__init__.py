"""Every number of the estimator: named, with unit, meaning and source.

The configuration is a tree of frozen pydantic models. ``Config()`` is the default; :func:`preset`
returns a named one; :meth:`Config.changed` and :meth:`Section.changed` change values;
:func:`load_config` reads YAML (a file may name a preset and override part of it);
:func:`dump_config` writes YAML with the meaning of every key as a comment.
"""

from loam_gtsam.config.base import Section, meaning
from loam_gtsam.config.files import (
    config_from_dict,
    config_to_dict,
    dump_config,
    load_config,
    parse_config,
)
from loam_gtsam.config.frontend import DeskewConfig, FeatureConfig, OdometryConfig, SensorConfig
from loam_gtsam.config.imu import ImuConfig
from loam_gtsam.config.loops import LoopConfig, PoseGraphConfig
from loam_gtsam.config.mapping import MapConfig, RelocalizationConfig
from loam_gtsam.config.output import BagConfig, LiveConfig
from loam_gtsam.config.registration import CovarianceConfig, MatchingConfig, SolverConfig
from loam_gtsam.config.tree import PRESETS, Config, preset

__all__ = [
    "PRESETS",
    "BagConfig",
    "Config",
    "CovarianceConfig",
    "DeskewConfig",
    "FeatureConfig",
    "ImuConfig",
    "LiveConfig",
    "LoopConfig",
    "MapConfig",
    "MatchingConfig",
    "OdometryConfig",
    "PoseGraphConfig",
    "RelocalizationConfig",
    "Section",
    "SensorConfig",
    "SolverConfig",
    "config_from_dict",
    "config_to_dict",
    "dump_config",
    "load_config",
    "meaning",
    "parse_config",
    "preset",
]

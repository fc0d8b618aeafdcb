"""Every number of the estimator: named, with unit, meaning and source.

The configuration is a tree of frozen pydantic models. ``Config()`` is the default; :func:`preset`
returns a named one; :meth:`Config.changed` and :meth:`Section.changed` change values;
:func:`load_config` reads YAML (a file may name a preset and override part of it);
:func:`dump_config` writes YAML with the meaning of every key as a comment.
"""

from loam_gtsam.config.aiding import AidingConfig as AidingConfig
from loam_gtsam.config.base import Section as Section
from loam_gtsam.config.base import meaning as meaning
from loam_gtsam.config.output import BagConfig as BagConfig
from loam_gtsam.config.output import LiveConfig as LiveConfig
from loam_gtsam.config.sections import CovarianceConfig as CovarianceConfig
from loam_gtsam.config.sections import DeskewConfig as DeskewConfig
from loam_gtsam.config.sections import FeatureConfig as FeatureConfig
from loam_gtsam.config.sections import ImuConfig as ImuConfig
from loam_gtsam.config.sections import LoopConfig as LoopConfig
from loam_gtsam.config.sections import MapConfig as MapConfig
from loam_gtsam.config.sections import MatchingConfig as MatchingConfig
from loam_gtsam.config.sections import OdometryConfig as OdometryConfig
from loam_gtsam.config.sections import PoseGraphConfig as PoseGraphConfig
from loam_gtsam.config.sections import RelocalizationConfig as RelocalizationConfig
from loam_gtsam.config.sections import SensorConfig as SensorConfig
from loam_gtsam.config.sections import SolverConfig as SolverConfig
from loam_gtsam.config.tree import PRESETS as PRESETS
from loam_gtsam.config.tree import SMALL as SMALL
from loam_gtsam.config.tree import Config as Config
from loam_gtsam.config.tree import as_config as as_config
from loam_gtsam.config.tree import config_from_dict as config_from_dict
from loam_gtsam.config.tree import config_to_dict as config_to_dict
from loam_gtsam.config.tree import dump_config as dump_config
from loam_gtsam.config.tree import load_config as load_config
from loam_gtsam.config.tree import named_sections as named_sections
from loam_gtsam.config.tree import parse_config as parse_config
from loam_gtsam.config.tree import preset as preset
from loam_gtsam.config.tree import with_implied as with_implied

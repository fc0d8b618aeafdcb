"""Every number of the estimator: named, with unit, meaning and source.

The configuration is a tree of frozen pydantic models. ``Config()`` is the default; :func:`preset`
returns a named one; :meth:`Config.changed` and :meth:`Section.changed` change values;
:func:`load_config` reads YAML (a file may name a preset and override part of it);
:func:`dump_config` writes YAML with the meaning of every key as a comment.
"""

from loam_gtsam.config.additions import BagConfig as BagConfig
from loam_gtsam.config.additions import ImuConfig as ImuConfig
from loam_gtsam.config.additions import LiveConfig as LiveConfig
from loam_gtsam.config.additions import LoopConfig as LoopConfig
from loam_gtsam.config.additions import PoseGraphConfig as PoseGraphConfig
from loam_gtsam.config.base import Section as Section
from loam_gtsam.config.base import meaning as meaning
from loam_gtsam.config.estimator import CovarianceConfig as CovarianceConfig
from loam_gtsam.config.estimator import DeskewConfig as DeskewConfig
from loam_gtsam.config.estimator import FeatureConfig as FeatureConfig
from loam_gtsam.config.estimator import MapConfig as MapConfig
from loam_gtsam.config.estimator import MatchingConfig as MatchingConfig
from loam_gtsam.config.estimator import OdometryConfig as OdometryConfig
from loam_gtsam.config.estimator import RelocalizationConfig as RelocalizationConfig
from loam_gtsam.config.estimator import SensorConfig as SensorConfig
from loam_gtsam.config.estimator import SolverConfig as SolverConfig
from loam_gtsam.config.files import config_from_dict as config_from_dict
from loam_gtsam.config.files import config_to_dict as config_to_dict
from loam_gtsam.config.files import dump_config as dump_config
from loam_gtsam.config.files import load_config as load_config
from loam_gtsam.config.files import parse_config as parse_config
from loam_gtsam.config.tree import PRESETS as PRESETS
from loam_gtsam.config.tree import Config as Config
from loam_gtsam.config.tree import preset as preset

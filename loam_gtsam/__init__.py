"""LOAM's scan-to-map LiDAR estimator as a GTSAM factor graph.

Three ways in, from one call to every step:

* :func:`run` maps a data set, which :func:`open_dataset` opens;
* :class:`Pipeline` takes one sweep at a time;
* :func:`extract_features`, :class:`ConstantVelocity` and :class:`Mapper` are the steps themselves,
  and :mod:`loam_gtsam.factors` has the factors for a graph of your own.

Conventions are in :mod:`loam_gtsam.types`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from loam_gtsam import datasets
from loam_gtsam.config import Config as Config
from loam_gtsam.config import dump_config as dump_config
from loam_gtsam.config import load_config as load_config
from loam_gtsam.config import preset as preset
from loam_gtsam.cubemap import CubeMap as CubeMap
from loam_gtsam.datasets import Dataset as Dataset
from loam_gtsam.datasets import DatasetInfo as DatasetInfo
from loam_gtsam.datasets import open_dataset as open_dataset
from loam_gtsam.datasets.decode.tables import read_tum as read_tum
from loam_gtsam.factors import MatchRows as MatchRows
from loam_gtsam.factors import checked_factor as checked_factor
from loam_gtsam.factors import concatenate_rows as concatenate_rows
from loam_gtsam.factors import line_rows as line_rows
from loam_gtsam.factors import plane_rows as plane_rows
from loam_gtsam.factors import point_to_line_factor as point_to_line_factor
from loam_gtsam.factors import point_to_plane_factor as point_to_plane_factor
from loam_gtsam.factors import scan_match_factor as scan_match_factor
from loam_gtsam.frontend.features import extract_features as extract_features
from loam_gtsam.imu.buffer import ImuBuffer as ImuBuffer
from loam_gtsam.io.checkpoint import Checkpoint as Checkpoint
from loam_gtsam.io.run_files import write_run as write_run
from loam_gtsam.io.state import checkpointed as checkpointed
from loam_gtsam.io.trajectories import write_tum as write_tum
from loam_gtsam.io.version import installed_version
from loam_gtsam.loops.batch import SavedGraph as SavedGraph
from loam_gtsam.loops.batch import optimize_graph as optimize_graph
from loam_gtsam.loops.closure import LoopCloser as LoopCloser
from loam_gtsam.loops.closure import ScanLoopCloser as ScanLoopCloser
from loam_gtsam.loops.files import read_graph as read_graph
from loam_gtsam.loops.files import write_graph as write_graph
from loam_gtsam.loops.keyframes import Keyframe as Keyframe
from loam_gtsam.loops.keyframes import LoopClosure as LoopClosure
from loam_gtsam.loops.map_correction import LoopMapping as LoopMapping
from loam_gtsam.loops.pose_graph import PoseGraph as PoseGraph
from loam_gtsam.mapper import Mapper as Mapper
from loam_gtsam.pipeline import Pipeline as Pipeline
from loam_gtsam.pipeline import RunResult as RunResult
from loam_gtsam.pipeline import run as run
from loam_gtsam.registration.association import associate as associate
from loam_gtsam.registration.matches import ScanMatches as ScanMatches
from loam_gtsam.registration.odometry import ConstantVelocity as ConstantVelocity
from loam_gtsam.registration.odometry import ScanToScan as ScanToScan
from loam_gtsam.registration.pose_errors import relative_covariance as relative_covariance
from loam_gtsam.registration.solvers import POSE_KEY as POSE_KEY
from loam_gtsam.registration.solvers import ALoamSolver as ALoamSolver
from loam_gtsam.registration.solvers import ClassicalSolver as ClassicalSolver
from loam_gtsam.registration.solvers import GtsamSolver as GtsamSolver
from loam_gtsam.registration.solvers import Solution as Solution
from loam_gtsam.registration.solvers import make_solver as make_solver
from loam_gtsam.registration.solvers import match_rows as match_rows
from loam_gtsam.registration.solvers.own_factors import PoseContext as PoseContext
from loam_gtsam.ros.live import LiveMapper as LiveMapper
from loam_gtsam.ros.live import LiveResult as LiveResult
from loam_gtsam.ros.live_report import LiveReport as LiveReport
from loam_gtsam.studies.evaluation import AbsoluteError as AbsoluteError
from loam_gtsam.studies.evaluation import absolute_error as absolute_error
from loam_gtsam.types import BadSweep as BadSweep
from loam_gtsam.types import ConfigError as ConfigError
from loam_gtsam.types import DatasetError as DatasetError
from loam_gtsam.types import Features as Features
from loam_gtsam.types import FeatureSweep as FeatureSweep
from loam_gtsam.types import FrameStatus as FrameStatus
from loam_gtsam.types import ImuSamples as ImuSamples
from loam_gtsam.types import InputError as InputError
from loam_gtsam.types import LoamError as LoamError
from loam_gtsam.types import MapUpdate as MapUpdate
from loam_gtsam.types import OutputError as OutputError
from loam_gtsam.types import Scan as Scan
from loam_gtsam.types import SweepError as SweepError
from loam_gtsam.types import SweepFault as SweepFault
from loam_gtsam.types import SweepMotion as SweepMotion
from loam_gtsam.types import TiltPrior as TiltPrior
from loam_gtsam.types import Trajectory as Trajectory
from loam_gtsam.types import Uncertainty as Uncertainty

if TYPE_CHECKING:
    from loam_gtsam.datasets import ArrayDataset as ArrayDataset
    from loam_gtsam.datasets import BagDataset as BagDataset
    from loam_gtsam.datasets import KittiDataset as KittiDataset
    from loam_gtsam.datasets import LoamTopicsDataset as LoamTopicsDataset
    from loam_gtsam.datasets import SimulatedWorld as SimulatedWorld
    from loam_gtsam.datasets import decode_pointcloud2 as decode_pointcloud2

__version__ = installed_version()

_LOADERS = (
    "ArrayDataset",
    "BagDataset",
    "KittiDataset",
    "LoamTopicsDataset",
    "SimulatedWorld",
    "decode_pointcloud2",
)
"""Imported when first used: no bag reader for a folder, no ray caster for a bag."""

__all__ = [
    "POSE_KEY",
    "ALoamSolver",
    "AbsoluteError",
    "BadSweep",
    "Checkpoint",
    "ClassicalSolver",
    "Config",
    "ConfigError",
    "ConstantVelocity",
    "CubeMap",
    "Dataset",
    "DatasetError",
    "DatasetInfo",
    "FeatureSweep",
    "Features",
    "FrameStatus",
    "GtsamSolver",
    "ImuBuffer",
    "ImuSamples",
    "InputError",
    "Keyframe",
    "LiveMapper",
    "LiveReport",
    "LiveResult",
    "LoamError",
    "LoopCloser",
    "LoopClosure",
    "LoopMapping",
    "MapUpdate",
    "Mapper",
    "MatchRows",
    "OutputError",
    "Pipeline",
    "PoseContext",
    "PoseGraph",
    "RunResult",
    "SavedGraph",
    "Scan",
    "ScanLoopCloser",
    "ScanMatches",
    "ScanToScan",
    "Solution",
    "SweepError",
    "SweepFault",
    "SweepMotion",
    "TiltPrior",
    "Trajectory",
    "Uncertainty",
    "absolute_error",
    "associate",
    "checked_factor",
    "checkpointed",
    "concatenate_rows",
    "dump_config",
    "extract_features",
    "line_rows",
    "load_config",
    "make_solver",
    "match_rows",
    "open_dataset",
    "optimize_graph",
    "plane_rows",
    "point_to_line_factor",
    "point_to_plane_factor",
    "preset",
    "read_graph",
    "read_tum",
    "relative_covariance",
    "run",
    "scan_match_factor",
    "write_graph",
    "write_run",
    "write_tum",
    *_LOADERS,
]


def __getattr__(name: str) -> Any:
    if name in _LOADERS:
        return getattr(datasets, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

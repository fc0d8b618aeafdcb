"""LOAM's scan-to-map LiDAR estimator as a GTSAM factor graph.

Three ways in, from one call to every step:

* :func:`run` maps a data set, which :func:`open_dataset` opens;
* :class:`Pipeline` takes one sweep at a time;
* :func:`extract_features` and :class:`Mapper` are the steps themselves, and
  :mod:`loam_gtsam.factors` has the factors for a graph of your own.

Conventions are in :mod:`loam_gtsam.types`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loam_gtsam.config import Config as Config
    from loam_gtsam.config import load_config as load_config
    from loam_gtsam.config import preset as preset
    from loam_gtsam.datasets import Dataset as Dataset
    from loam_gtsam.datasets import open_dataset as open_dataset
    from loam_gtsam.datasets.arrays import ArrayDataset as ArrayDataset
    from loam_gtsam.datasets.sim.world import SimulatedWorld as SimulatedWorld
    from loam_gtsam.factors import checked_factor as checked_factor
    from loam_gtsam.factors import point_to_line_factor as point_to_line_factor
    from loam_gtsam.factors import point_to_plane_factor as point_to_plane_factor
    from loam_gtsam.factors import scan_match_factor as scan_match_factor
    from loam_gtsam.frontend.features import extract_features as extract_features
    from loam_gtsam.imu.buffer import ImuBuffer as ImuBuffer
    from loam_gtsam.io.checkpoint import Checkpoint as Checkpoint
    from loam_gtsam.io.run_files import write_run as write_run
    from loam_gtsam.loops.batch import optimize_graph as optimize_graph
    from loam_gtsam.loops.closure import ScanLoopCloser as ScanLoopCloser
    from loam_gtsam.loops.files import read_graph as read_graph
    from loam_gtsam.loops.files import write_graph as write_graph
    from loam_gtsam.loops.keyframes import Keyframe as Keyframe
    from loam_gtsam.loops.keyframes import LoopClosure as LoopClosure
    from loam_gtsam.loops.pose_graph import PoseGraph as PoseGraph
    from loam_gtsam.mapper import Mapper as Mapper
    from loam_gtsam.pipeline import Pipeline as Pipeline
    from loam_gtsam.pipeline import RunResult as RunResult
    from loam_gtsam.pipeline import run as run
    from loam_gtsam.registration.alignment import align as align
    from loam_gtsam.registration.association import associate as associate
    from loam_gtsam.registration.solvers import POSE_KEY as POSE_KEY
    from loam_gtsam.registration.solvers import GtsamSolver as GtsamSolver
    from loam_gtsam.registration.solvers import Solution as Solution
    from loam_gtsam.registration.solvers import make_solver as make_solver
    from loam_gtsam.registration.solvers import match_rows as match_rows
    from loam_gtsam.registration.solvers.own_factors import PoseContext as PoseContext
    from loam_gtsam.registration.uncertainty import relative_covariance as relative_covariance
    from loam_gtsam.studies.evaluation import absolute_error as absolute_error
    from loam_gtsam.types import Features as Features
    from loam_gtsam.types import FeatureSweep as FeatureSweep
    from loam_gtsam.types import FrameStatus as FrameStatus
    from loam_gtsam.types import ImuSamples as ImuSamples
    from loam_gtsam.types import InputError as InputError
    from loam_gtsam.types import LoamError as LoamError
    from loam_gtsam.types import MapUpdate as MapUpdate
    from loam_gtsam.types import Scan as Scan
    from loam_gtsam.types import Trajectory as Trajectory

_HOMES = {
    "config": "Config load_config preset",
    "datasets": "Dataset open_dataset",
    "datasets.arrays": "ArrayDataset",
    "datasets.sim.world": "SimulatedWorld",
    "factors": "checked_factor point_to_line_factor point_to_plane_factor scan_match_factor",
    "frontend.features": "extract_features",
    "imu.buffer": "ImuBuffer",
    "io.checkpoint": "Checkpoint",
    "io.run_files": "write_run",
    "loops.batch": "optimize_graph",
    "loops.closure": "ScanLoopCloser",
    "loops.files": "read_graph write_graph",
    "loops.keyframes": "Keyframe LoopClosure",
    "loops.pose_graph": "PoseGraph",
    "mapper": "Mapper",
    "pipeline": "Pipeline RunResult run",
    "registration.alignment": "align",
    "registration.association": "associate",
    "registration.uncertainty": "relative_covariance",
    "registration.solvers": "GtsamSolver POSE_KEY Solution make_solver match_rows",
    "registration.solvers.own_factors": "PoseContext",
    "studies.evaluation": "absolute_error",
    "types": "FeatureSweep Features FrameStatus ImuSamples InputError LoamError MapUpdate Scan "
    "Trajectory",
}
"""The public names by their modules, which are imported when a name is first used."""

_MODULES = {name: module for module, names in _HOMES.items() for name in names.split()}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from loam_gtsam.io.version import installed_version

        return installed_version()
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

"""Solvers of one frame: each turns a guess and an association into a pose.

A solver is any object with the method :meth:`ScanSolver.solve`.
"""

from __future__ import annotations

from loam_gtsam.config import SolverConfig
from loam_gtsam.registration.solvers.base import POSE_KEY as POSE_KEY
from loam_gtsam.registration.solvers.base import Associate as Associate
from loam_gtsam.registration.solvers.base import Matcher as Matcher
from loam_gtsam.registration.solvers.base import MotionPrior as MotionPrior
from loam_gtsam.registration.solvers.base import ScanSolver as ScanSolver
from loam_gtsam.registration.solvers.base import Solution as Solution
from loam_gtsam.registration.solvers.base import check_settings as check_settings
from loam_gtsam.registration.solvers.base import rematch as rematch
from loam_gtsam.registration.solvers.classical import ALoamSolver as ALoamSolver
from loam_gtsam.registration.solvers.classical import ClassicalSolver as ClassicalSolver
from loam_gtsam.registration.solvers.gtsam_solver import GtsamSolver as GtsamSolver
from loam_gtsam.registration.solvers.gtsam_solver import fuse as fuse
from loam_gtsam.registration.solvers.gtsam_solver import match_rows as match_rows
from loam_gtsam.registration.solvers.motion_filter import MotionFilter as MotionFilter


def make_solver(config: SolverConfig) -> ScanSolver:
    """Make the solver that ``config.method`` names; InputError for other than its settings."""
    check_settings(config)
    if config.method == "gtsam":
        return GtsamSolver(config)
    return ClassicalSolver(config) if config.method == "loam" else ALoamSolver(config)


def trial_solver(config: SolverConfig) -> GtsamSolver:
    """The solver that tries a pose quickly: it only has to come near, a registration follows."""
    return GtsamSolver(config.changed(translation_tolerance=0.03, rotation_tolerance_deg=0.2))

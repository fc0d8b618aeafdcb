"""Per-frame solvers: from a guess and a way to associate, to a pose.

A solver is anything with :meth:`ScanSolver.solve`; the mapper does not know which one it has.
"""

from __future__ import annotations

from loam_gtsam.config import SolverConfig
from loam_gtsam.registration.solvers.base import POSE_KEY as POSE_KEY
from loam_gtsam.registration.solvers.base import Associate as Associate
from loam_gtsam.registration.solvers.base import Matcher as Matcher
from loam_gtsam.registration.solvers.base import MotionPrior as MotionPrior
from loam_gtsam.registration.solvers.base import Optimum as Optimum
from loam_gtsam.registration.solvers.base import ScanSolver as ScanSolver
from loam_gtsam.registration.solvers.base import Solution as Solution
from loam_gtsam.registration.solvers.base import rematch as rematch
from loam_gtsam.registration.solvers.classical import ALoamSolver as ALoamSolver
from loam_gtsam.registration.solvers.classical import ClassicalSolver as ClassicalSolver
from loam_gtsam.registration.solvers.gtsam_solver import GtsamSolver as GtsamSolver
from loam_gtsam.registration.solvers.gtsam_solver import fuse as fuse
from loam_gtsam.registration.solvers.gtsam_solver import match_rows as match_rows


def make_solver(config: SolverConfig) -> ScanSolver:
    """Make the solver that ``config.method`` names."""
    solvers: dict[str, type[GtsamSolver | ClassicalSolver | ALoamSolver]] = {
        "gtsam": GtsamSolver,
        "loam": ClassicalSolver,
        "aloam": ALoamSolver,
    }
    return solvers[config.method](config)

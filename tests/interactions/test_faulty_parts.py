"""An exception in a part of a user's own leaves the mapper where it was before the sweep."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from loam_gtsam.config import Config
from loam_gtsam.datasets import open_dataset
from loam_gtsam.factors import checked_factor
from loam_gtsam.pipeline import Pipeline, effective_config, imu_buffer
from loam_gtsam.registration.solvers import make_solver

DATA = open_dataset("sim:room?frames=5&columns=200&imu=mems&speed=3")
CONFIG = effective_config(Config(), DATA)
SWEEPS = list(DATA)
NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 1e3)


class FaultError(Exception):
    """Of the user."""


class Faulty:
    """A solver and factors of a user's own, which fail once in one place."""

    def __init__(self, place: str = "") -> None:
        self.place, self.armed, self.inner = place, False, make_solver(CONFIG.solver)

    def pass_by(self, place: str) -> None:
        if self.armed and place == self.place:
            self.armed = False
            if place == "indeterminate":
                graph = gtsam.GaussianFactorGraph()
                graph.add(0, np.zeros((6, 6)), np.zeros(6), gtsam.noiseModel.Unit.Create(6))
                graph.optimize()
            raise FaultError(place)

    def factors(self, context):
        self.pass_by("factors")

        def residual(values):
            self.pass_by("residual")
            return np.zeros(6), [np.zeros((6, 6))]

        return [checked_factor(NOISE, [context.key], residual)]

    def solve(self, *args):
        self.pass_by("solver")
        self.pass_by("indeterminate")
        return self.inner.solve(*args)


def poses(place: str = "", at: int | None = None) -> list[np.ndarray]:
    """The run, with a sweep tried again after the fault in it."""
    part, found = Faulty(place), []
    pipeline = Pipeline(
        CONFIG, imu=imu_buffer(DATA, CONFIG), solver=part, extra_factors=part.factors
    )
    for number, sweep in enumerate(SWEEPS):
        if number == at:
            part.armed = True
            # Not wrapped in another: what a user's function raises, the user can catch.
            with pytest.raises(RuntimeError if place == "indeterminate" else FaultError):
                pipeline.process(sweep)
        found.append(pipeline.process(sweep).map_T_lidar.matrix())
    return found


@pytest.fixture(scope="module")
def undisturbed() -> list[np.ndarray]:
    return poses()


@pytest.mark.parametrize("place", ["factors", "residual", "solver", "indeterminate"])
def test_a_sweep_can_be_tried_again_after_a_fault_of_the_user(place, undisturbed):
    np.testing.assert_array_equal(poses(place, at=2), undisturbed)

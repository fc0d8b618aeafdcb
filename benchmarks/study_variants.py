"""What the study compares, and how much of it: solvers, changes of the default, levels, results."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from loam_gtsam.config import Config, preset

SCENES = ("street_loop", "room", "corridor", "trees")
METRES = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
DEGREES = (0.5, 1.0, 2.0, 5.0, 10.0)
SHARES = (0.0, 0.1, 0.2, 0.3)
SHARE = 0.2
"""Of outliers, where changes of the default are compared."""
NEAR = (0.05, 0.5)
"""Metres and degrees from the solution found from the truth that count as the same solution."""
GUESS = (0.1, 0.5)
"""Metres and degrees: error of the guess wherever it is not what is studied."""
ALONG = 0.3
"""Metres: error of the guess along the bare corridor."""
SHIFT = 0.5
"""Metres: how far the moving object has moved since it was mapped."""
CAUCHY = 2.385
"""In standard deviations: 95 % efficiency for normal residuals (Holland and Welsch, 1977)."""
SHORT_RANGE = 25.0
"""Metres seen in the bare corridor, ..."""
INSIDE = 60
"""... and sweeps later than in the other scenes: so neither of its ends is seen."""


@dataclass(frozen=True, slots=True)
class Variant:
    """A solver as studied.

    Attributes
    ----------
    kernel : robust weight per match beside the solver's, renewed at each association: "",
        "cauchy", or "scaled cauchy", whose unit is the spread of the residuals where that exceeds
        their sigmas
    """

    name: str
    config: Config
    kernel: str = ""


def _changed(name: str, kernel: str = "", **sections: Mapping[str, Any]) -> Variant:
    """The default with some values of its sections replaced."""
    return Variant(name, Config().changed(sections), kernel)


NO_KERNEL = {"kernel_width": math.inf}
ALL_MATCHES = {"max_edges": 0, "max_planes": 0}

MAIN = (
    Variant("default", Config()),
    Variant("loam", preset("loam")),
    Variant("aloam", preset("aloam")),
)
CHANGES = (
    # As it was before this study was first made.
    _changed(
        "first default",
        features={"range_noise": 0.0},
        matching={**ALL_MATCHES, "plane_ratio": 0.1},
        solver={**NO_KERNEL, "degeneracy": "off"},
    ),
    _changed("no kernel", solver=NO_KERNEL),
    _changed("cauchy", "cauchy", solver=NO_KERNEL),
    _changed("scaled cauchy", "scaled cauchy", solver=NO_KERNEL),
    _changed("all matches", matching=ALL_MATCHES),
    _changed("all planes", features={"range_noise": 0.0}),
    _changed("inner 1", solver={"inner_iterations": 1}),
    _changed("outer 30", solver={"iterations": 30}),
    _changed("no s weight", matching={"weight_slope": 0.0}),
    _changed("one sigma", matching={"fit_uncertainty": False}),
    _changed("reach 2 m", matching={"max_distance": 2.0}),
    _changed("centroid map", map={"insertion": "centroid"}),
)
CORRIDOR = (
    MAIN[0],
    _changed("default, projected", solver={"degeneracy": "project"}),
    _changed("default, scan believed", solver={"degeneracy": "off"}),
    MAIN[1],
    Variant(
        "loam, no projector",
        MAIN[1].config.changed("solver.degeneracy_threshold=0.0"),
    ),
    Variant(
        "loam, published projector",
        MAIN[1].config.changed("solver.degeneracy_projector=published"),
    ),
    MAIN[2],
)


FIRST = CHANGES[0]
"""The change that is drawn beside the main ones."""
COLOURS = {
    "default": "#2b7a9b",
    "loam": "#e4572e",
    "aloam": "#7a5195",
    "first default": "#3a9d5d",
    "default, scan believed": "#8fc1d4",
}
LABELS = {
    "metres": "error of the guess, m",
    "degrees": "error of the guess, degrees",
    "random outliers": "random points, %",
    "moving outliers": "moved by 0.5 m, %",
    "basin": "same solution, %",
    "outliers": "error, m (dotted: 95 %)",
}


@dataclass(frozen=True, slots=True)
class Effort:
    """How much is done: frame of the first target, their number, spacing, starts on each."""

    first: int = 60
    targets: int = 5
    spacing: int = 5
    starts: int = 4
    columns: int | None = None
    mapped: int = 20


FULL = Effort()
QUICK = Effort(first=32, targets=1, starts=2, columns=600, mapped=6)


@dataclass(frozen=True, slots=True)
class Trial:
    """One solve.

    Attributes
    ----------
    level : of what ``study`` varies: metres, degrees, or share of outliers
    success : within :data:`NEAR` of the solution found from the truth
    metres, degrees : from the truth; along, across : the same split by the corridor's axis, metres
    """

    study: str
    scene: str
    solver: str
    level: float
    success: bool
    metres: float
    degrees: float
    along: float
    across: float
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True)
class Measured:
    """A number that is no trial: a cost at an optimum, or an eigenvalue."""

    study: str
    scene: str
    solver: str
    name: str
    value: float


Result = Trial | Measured

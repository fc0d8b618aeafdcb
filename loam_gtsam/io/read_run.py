"""The frames of a finished run, read from the ``run.npz`` that it wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.errors import DAMAGED, as_path
from loam_gtsam.io.run_files import NO_STAMP
from loam_gtsam.types import (
    DatasetError,
    FrameStatus,
    MapUpdate,
    SweepMotion,
    TiltPrior,
    Uncertainty,
)


def read_updates(path: str | Path) -> list[MapUpdate]:
    """The frames of a run, but for their faults and counts of points that are not finite.

    Parameters
    ----------
    path : the folder of the run, or its ``run.npz``

    Raises
    ------
    DatasetError
        If the file cannot be read, or is not one of
        :func:`~loam_gtsam.io.run_files.write_npz`.
    """
    path = as_path(path)
    path = path / "run.npz" if path.is_dir() else path
    try:
        with np.load(path, allow_pickle=False) as file:
            columns = {name: file[name] for name in _NEEDED}
            columns["accelerations"] = file.get("accelerations", np.zeros_like(columns["twists"]))
            columns["in_doubt"] = file.get("in_doubt", np.zeros(len(columns["stamps"]), np.bool_))
            stages = file["stage_names"].tolist()
        return [
            _update({name: column[row] for name, column in columns.items()}, stages)
            for row in range(len(columns["stamps"]))
        ]
    except DAMAGED as error:
        told = str(error)[:200]
        raise DatasetError(f"{path}: expected the run.npz of a finished run: {told}") from error


def _update(at: Mapping[str, Any], stages: Sequence[str]) -> MapUpdate:
    """A frame, of its rows in all columns."""
    status = FrameStatus(str(at["status"]))
    uncertainty = None
    if status.solved and np.isfinite(at["own_covariances"]).all():
        follows = int(at["follows"])
        uncertainty = Uncertainty(
            own=at["own_covariances"],
            shared=at["shared_covariances"],
            follows=None if follows == NO_STAMP else follows,
            drift=at["drift_covariances"],
            residual_variance=float(at["residual_variances"]),
            effective_matches=float(at["effective_matches"]),
            blind=at["blind_drifts"],
            forgotten=at["forgotten"],
            in_doubt=bool(at["in_doubt"]),
        )
    middle = at["map_T_middle"]
    return MapUpdate(
        int(at["stamps"]),
        gtsam.Pose3(at["map_T_lidar"]),
        status,
        str(at["messages"]),
        covariance=at["covariances"],
        twist=at["twists"],
        acceleration=at["accelerations"],
        uncertainty=uncertainty,
        map_T_middle=gtsam.Pose3(middle) if np.isfinite(middle).all() else None,
        middle_stamp=int(at["middle_stamps"]),
        sweep_motion=SweepMotion(str(at["sweep_motions"])),
        tilt_prior=TiltPrior(str(at["tilt_priors"])),
        timings={
            stage: seconds
            for stage, seconds in zip(stages, at["stage_seconds"].tolist(), strict=True)
            if np.isfinite(seconds)
        },
        **{name: at[name] for name in _ARRAYS},
        **{name: at[name].item() for name in _NUMBERS},
    )


_ARRAYS = (
    "information", "localizability", "directions", "direction_information", "axis_localizability",
)  # fmt: skip
_NUMBERS = (
    "n_edges", "n_planes", "n_edge_matches", "n_plane_matches", "iterations", "solver_iterations",
    "error_before", "error_after",
)  # fmt: skip
_NEEDED = (
    "stamps", "map_T_lidar", "status", "messages", "covariances", "twists", "own_covariances",
    "shared_covariances", "drift_covariances", "follows", "residual_variances",
    "effective_matches", "blind_drifts", "forgotten", "map_T_middle", "middle_stamps",
    "sweep_motions", "tilt_priors", "stage_seconds", *_ARRAYS, *_NUMBERS,
)  # fmt: skip

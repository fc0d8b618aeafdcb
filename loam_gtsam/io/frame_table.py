"""The frames of a run as a table of pandas, which is optional (``pandas`` extra)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.types import TANGENT, MapUpdate, OutputError, check_updates, stack_poses

_PLAIN = ("n_edges", "n_planes", "n_edge_matches", "n_plane_matches", "iterations", "error_after")


def to_dataframe(updates: Sequence[MapUpdate]) -> Any:
    """A :class:`pandas.DataFrame` with a row for each frame, and the stamp in nanoseconds as index.

    Columns: ``seconds`` since the first frame; ``x y z qx qy qz qw`` of ``map_T_lidar``;
    ``sigma_rx`` to ``sigma_z``, standard deviations in rad and metres along the axes of the lidar;
    ``matches_rx`` to ``matches_z``, how many matches fix each axis; ``status``, ``message``, the
    counts of :class:`~loam_gtsam.MapUpdate`, and ``seconds_STAGE``.

    Parameters
    ----------
    updates : of a run (``result.updates``), or of a saved one
        (:func:`loam_gtsam.io.read_run.read_updates`)

    Raises
    ------
    OutputError
        If pandas is not installed.

    Examples
    --------
    >>> table = to_dataframe(result.updates)  # doctest: +SKIP
    >>> table[table.status != "ok"].message  # doctest: +SKIP
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise OutputError(
            'a table needs pandas; install it with: pip install "loam_gtsam[pandas]"'
        ) from error
    check_updates(updates)
    stamps = np.array([update.stamp for update in updates], np.int64)
    poses = stack_poses(update.map_T_lidar for update in updates)
    columns: dict[str, Any] = {"seconds": (stamps - stamps[:1]) * 1e-9}
    columns |= dict(zip("xyz", poses[:, :3, 3].T, strict=True))
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat() if len(poses) else np.zeros((0, 4))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), turns.T, strict=True))
    variances = np.array([np.diag(u.covariance) for u in updates]).reshape(-1, 6)
    counts = np.array([u.axis_localizability for u in updates]).reshape(-1, 6)
    columns |= {f"sigma_{axis}": np.sqrt(variances[:, k]) for k, axis in enumerate(TANGENT)}
    columns |= {f"matches_{axis}": counts[:, k] for k, axis in enumerate(TANGENT)}
    columns |= {name: [str(getattr(u, name)) for u in updates] for name in ("status", "message")}
    columns |= {name: [getattr(u, name) for u in updates] for name in _PLAIN}
    stages = dict.fromkeys(stage for u in updates for stage in u.timings)
    columns |= {f"seconds_{s}": [u.timings.get(s, np.nan) for u in updates] for s in stages}
    return pd.DataFrame(columns, index=pd.Index(stamps, name="stamp"))

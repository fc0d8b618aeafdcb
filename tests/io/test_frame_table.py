"""The frames of a run as a table."""

import sys

import numpy as np
import pytest

from loam_gtsam.datasets.sim.world import SimulatedWorld
from loam_gtsam.io.frame_table import to_dataframe
from loam_gtsam.pipeline import run
from loam_gtsam.types import OutputError

pytest.importorskip("pandas")


def test_a_run_is_a_table_with_a_row_for_each_frame():
    updates = run(SimulatedWorld("room", frames=3, columns=300)).updates
    table = to_dataframe(updates)
    assert list(table.index) == [update.stamp for update in updates]
    assert list(table.status) == ["first", "ok", "ok"]
    last = updates[-1]
    np.testing.assert_array_equal(
        table[["x", "y", "z"]].iloc[-1].to_numpy(float), last.map_T_lidar.translation()
    )
    assert table.sigma_x.iloc[-1] == pytest.approx(np.sqrt(last.covariance[3, 3]))
    assert table.seconds.iloc[-1] == pytest.approx(0.2)
    assert table.seconds_solve.iloc[-1] == last.timings["solve"]
    assert len(to_dataframe([])) == 0


def test_without_pandas_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(OutputError, match=r"loam_gtsam\[pandas\]"):
        to_dataframe([])

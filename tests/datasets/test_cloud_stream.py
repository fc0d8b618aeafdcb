"""Clouds that come one by one are read like those of a bag."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.bags import ROS1, cloud

from loam_gtsam.datasets.decode.cloud_stream import CloudStream
from loam_gtsam.types import DatasetError

MS = 1_000_000


def test_times_are_decided_by_the_first_sweeps_and_then_kept() -> None:
    points = np.random.default_rng(0).uniform(-9, 9, (200, 3))

    def absolute(stamp: int) -> Any:
        times = (stamp * 1e-9 + np.linspace(0.0, 0.1, 200)).astype("f8")
        return cloud(ROS1, stamp, points, timestamp=times)

    # At time zero an absolute time looks like an offset; the next sweep tells.
    stream = CloudStream()
    for number in range(15):
        times = stream.decode(absolute(number * 100 * MS)).times
        assert times is not None
        np.testing.assert_allclose(times, np.linspace(0.0, 0.1, 200), atol=1e-9)
    assert stream.decision is not None
    assert stream.decision.clock == "stamp"
    # One with too few points to tell is read as the others.
    one = cloud(ROS1, 1500 * MS, points[:1], timestamp=np.array([1.53], "f8"))
    times = stream.decode(one).times
    assert times is not None
    assert times[0] == pytest.approx(0.03)
    with pytest.raises(DatasetError, match="fit no unit"):
        CloudStream().decode(one)

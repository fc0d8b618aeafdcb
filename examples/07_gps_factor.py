"""Own factors on every sweep: positions of a GPS receiver on a road between bare walls.

``extra_factors`` is called once for every sweep that is solved, and told the key and the moment of
the unknown pose. What it returns are ordinary GTSAM factors on that key.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from loam_gtsam import Config, PoseContext, SimulatedWorld, run

SIGMA = 0.02  # metres: a receiver with corrections
LONGEST = 400_000_000  # nanoseconds between two fixes that are still interpolated

# A short-sighted lidar: no sweep says how far one went.
world = SimulatedWorld("corridor_bare", frames=60, columns=450, max_range=6.0)

# The receiver: a fix in 0.3 s, and none from 2.7 to 3.3 s. Its antenna is at the lidar, and its
# positions are in the frame of the first pose: so is the map, if it is not levelled.
rng = np.random.default_rng(0)
stamps = world.truth.stamps[[*range(0, 28, 3), *range(33, 60, 3)]]
positions = world.truth_at(stamps).positions
positions = positions + rng.normal(0.0, SIGMA, positions.shape)
config = Config().changed("imu.coupling=loose", "imu.level=false")  # no accelerometer
had_one: list[int] = []


def gps(context: PoseContext) -> Sequence[gtsam.NonlinearFactor]:
    """The position at that moment, between two fixes; no factor where they are too far apart."""
    after = int(np.searchsorted(stamps, context.middle_stamp))
    if after in (0, len(stamps)) or stamps[after] - stamps[after - 1] > LONGEST:
        return []
    seconds = (stamps - context.middle_stamp) * 1e-9
    position = np.array([np.interp(0.0, seconds, column) for column in positions.T])
    had_one.append(int(np.searchsorted(world.truth.stamps, context.middle_stamp)) - 1)
    return [gtsam.GPSFactor(context.key, position, gtsam.noiseModel.Isotropic.Sigma(3, SIGMA))]


def off_along(result_positions: np.ndarray) -> np.ndarray:
    """Metres from the truth along the road, of every sweep."""
    return np.abs(result_positions[:, 0] - world.truth.positions[:, 0])


alone = off_along(run(world, config).trajectory.positions)
result = run(world, config, extra_factors=gps)
with_gps = off_along(result.trajectory.positions)
print(f"scans alone: off by {alone.max():.2f} m of {world.truth.path_length:.1f} m")
print(
    f"with GPS: {np.median(with_gps[had_one]):.2f} m in the {len(had_one)} sweeps with a position"
)
print(f"          (median), up to {with_gps.max():.2f} m in the hole and after the last one")

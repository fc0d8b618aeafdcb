"""Sweeps that are already numpy arrays, one by one, as from a driver or another program."""

import numpy as np

from loam_gtsam import Pipeline, Scan, SimulatedWorld

# Any source will do. All that is needed of a sweep:
#   points (N, 3) float, metres, x forward, y left, z up, in the order they were measured
#   stamp  integer nanoseconds
#   times  (N,) float seconds from the stamp, or None: then from the azimuth, see docs/inputs.md
#   rings  (N,) integer beam numbers, or None: then from row order or elevation
arrays = [
    (scan.points, scan.stamp, scan.times, scan.rings)
    for scan in SimulatedWorld("room", sensor="hdl32", frames=10)
]
nothing = np.empty((0, 3), np.float32)
arrays[5] = (nothing, arrays[5][1], None, None)  # a sensor drops out now and then

pipeline = Pipeline()
for points, stamp, times, rings in arrays:
    update = pipeline.process(Scan(points=points, stamp=stamp, times=times, rings=rings))
    x, y, z = update.map_T_lidar.translation()
    print(f"{update.stamp} ns  {x:7.3f} {y:7.3f} {z:7.3f} m  {update.status} {update.message}")

edges, planes = pipeline.mapper.map_points()
print(f"map: edges {edges.shape}, planes {planes.shape}")

"""Draws docs/images/ring_locking.png: matches that hold the pose where it was.

Two sweeps of the built-in woodland, 0.1 s apart, de-skewed with the exact motion. The map holds the
first one only. The second is matched at poses between and beyond the two exact ones, without the
gates of ``registration.association`` and ``registration.planes``; the residuals of the matches that
the gates would keep and of those they would reject are drawn apart.

    python docs/figures/ring_locking.py
"""

from __future__ import annotations

from pathlib import Path

import gtsam
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from loam_gtsam import Config, SimulatedWorld, associate, extract_features
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.geometry import move_points, transform, voxel_filter
from loam_gtsam.registration.matches import ScanMatches

OUTPUT = Path(__file__).resolve().parents[1] / "images" / "ring_locking.png"
FRAME = 40
KEPT, REJECTED, FAINT = "#2b7a9b", "#e4572e", "#b9c2c9"

config = Config()
gates = config.matching
# Without gates, and without weights, which would hide large residuals.
open_gates = gates.changed(max_ring_cosine=1.0, min_incidence_sine=0.0, weight_slope=0.0)
world = SimulatedWorld("trees", frames=FRAME + 3)


def exact_sweep(number: int) -> tuple[gtsam.Pose3, np.ndarray, np.ndarray]:
    """True pose at the middle of a sweep; edges and planes, de-skewed to there by the truth."""
    features = extract_features(world[number], config)
    middle = 0.5 * sum(features.span)
    stamps = features.stamp + np.array([0, round(middle * 1e9), round(2e9 * middle)])
    start, centre, end = map(gtsam.Pose3, world.truth_at(stamps).map_T_lidar)
    twist = gtsam.Pose3.Logmap(start.between(end)) / (2.0 * middle)
    edges, planes = (
        move_points(filtered[:, :3], twist, filtered[:, 3] - middle)
        for filtered in (
            voxel_filter(np.column_stack([features.edges, features.edge_times]), 0.2),
            voxel_filter(np.column_stack([features.planes, features.plane_times]), 0.4),
        )
    )
    return centre, edges, planes


def gate(matches: ScanMatches, map_T_lidar: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which edge and plane matches the gates keep: the conditions of ``matching.py``."""
    up, rotation = map_T_lidar[:3, 2], map_T_lidar[:3, :3]
    rays, lines = matches.edges.points @ rotation.T, matches.edges.directions
    ring, seen = np.cross(up, rays), np.linalg.norm(np.cross(lines, rays), axis=1)
    cosine = np.abs((lines * ring).sum(1)) * np.linalg.norm(rays, axis=1)
    cosine /= seen * np.linalg.norm(ring, axis=1)
    rays = matches.planes.points @ rotation.T
    sine = np.abs((matches.planes.normals * rays).sum(1)) / np.linalg.norm(rays, axis=1)
    return cosine <= gates.max_ring_cosine, sine >= gates.min_incidence_sine


(first, edges, planes), (second, new_edges, new_planes) = map(exact_sweep, (FRAME, FRAME + 1))
edge_map = CubeMap(config.map, config.map.edge_voxel)
plane_map = CubeMap(config.map, config.map.plane_voxel)
edge_map.insert(transform(first.matrix(), edges))
plane_map.insert(transform(first.matrix(), planes))
step = gtsam.Pose3.Logmap(first.between(second))

shares = np.linspace(-0.5, 1.75, 19)
rms = np.empty((2, 2, len(shares)))  # edges, planes; kept, rejected
for column, share in enumerate(shares):
    pose = first.compose(gtsam.Pose3.Expmap(share * step))
    matches = associate(new_edges, new_planes, pose, edge_map, plane_map, open_gates)
    kinds = zip((matches.edges, matches.planes), gate(matches, pose.matrix()), strict=True)
    for row, (kind, keep) in enumerate(kinds):
        for side, which in enumerate((keep, ~keep)):
            rms[row, side, column] = 100.0 * np.sqrt(np.mean(kind.distances[which] ** 2))

mpl.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
figure, axes = plt.subplots(1, 3, figsize=(11.5, 3.7), dpi=110, width_ratios=(1.15, 1, 1))
matches = associate(new_edges, new_planes, first, edge_map, plane_map, open_gates)
keep, _ = gate(matches, first.matrix())
origin = first.translation()[:2]
cloud = edge_map.points()[:, :2] - origin
axes[0].plot(*cloud.T, ".", color=FAINT, markersize=2.0, label="edge points of the map")
for chosen, colour, label in ((keep, KEPT, "line kept"), (~keep, REJECTED, "line along the ring")):
    centres = matches.edges.centres[chosen][:, :2] - origin
    reach = 0.6 * matches.edges.directions[chosen][:, :2]
    ends = np.stack([centres - reach, centres + reach], axis=1)
    axes[0].plot(*ends.transpose(2, 1, 0), color=colour, linewidth=1.4)
    axes[0].plot([], [], color=colour, label=label)
axes[0].plot(0.0, 0.0, "^", color="#22303c", markersize=7)
axes[0].set(xlim=(-17, 17), ylim=(-17, 17), xlabel="x [m]", ylabel="y [m]", aspect="equal")
axes[0].set_title("Line matches about the sensor, from above")
axes[0].legend(loc="upper right", fontsize=7, framealpha=0.9)

for panel, name, pair in zip(axes[1:], ("Edges", "Planes"), rms, strict=True):
    for values, colour, label in zip(pair, (KEPT, REJECTED), ("kept", "rejected"), strict=True):
        panel.plot(shares, values, color=colour, label=label)
        panel.plot(shares[values.argmin()], values.min(), "o", color=colour, markersize=4)
    panel.axvline(1.0, color=FAINT, zorder=0)
    panel.axvline(0.0, color=FAINT, zorder=0, linestyle=":")
    panel.set(xlabel="pose: 0 = last sweep, 1 = truth", ylabel="rms residual [cm]", ylim=(0, None))
    panel.set_title(f"{name}: who pulls where")
    panel.legend(loc="lower left", fontsize=8)
figure.tight_layout()
figure.savefig(OUTPUT)

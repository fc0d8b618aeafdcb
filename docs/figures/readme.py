"""Makes the pictures of the README.

    python docs/figures/readme.py

takes a few minutes. Everything is simulated: nothing is downloaded.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gtsam
import matplotlib
import numpy as np
from PIL import Image

from loam_gtsam import (
    Config,
    Pipeline,
    PoseGraph,
    ScanLoopCloser,
    SimulatedWorld,
    Trajectory,
    absolute_error,
    run,
)
from loam_gtsam.datasets import build_city
from loam_gtsam.frontend.workers import extract
from loam_gtsam.geometry import transform
from loam_gtsam.types import FloatArray, IntArray
from loam_gtsam.view.frame_plot import plot_frame
from loam_gtsam.view.observers import frame_view, map_view
from loam_gtsam.view.plots import plot_loops, plot_map

IMAGES = Path(__file__).resolve().parents[1] / "images"
CORNERS = ((0, 0), (220, 0), (220, 95), (0, 95), (0, 0), (110, 0), (110, 95), (0, 95), (0, 8))
"""Of the streets of a town, metres, as they are driven: some of them twice."""
BEND = 17
"""Metres over which a corner is rounded."""
DRIFT = np.radians(0.012)
"""rad a metre by which the odometry of the town turns too far."""
TURN_WALK_DEG = 0.1
"""What the pose graph is told of that: five times the default."""


SIZE, FOCAL = (640, 320), 400.0
"""Width and height of the moving picture, and the focal length of its camera, pixels."""
EYE, SEEN = np.array([-26.0, 0.0, 17.0]), np.array([14.0, 0.0, -2.0])
"""Metres from the lidar, along its heading: where the camera is, and where it looks."""
HEIGHTS = -5.0, 9.0
"""Metres that the colours of the map span, from the lidar's height at the start."""
SWEEP = np.array([255, 255, 255])


def drive(path: Path, frames: int) -> None:
    """A map being built, seen from behind and above: map by height, the newest sweep in white."""
    world = SimulatedWorld("street_loop", sensor="hdl32", frames=frames)
    pipeline, pictures, heading = Pipeline(), [], 0.0
    for number, sweep in enumerate(world):
        update = pipeline.process(sweep)
        yaw = update.map_T_lidar.rotation().yaw()
        heading += 0.15 * float(np.angle(np.exp(1j * (yaw - heading))))  # the camera is lazy
        if number % 5:
            continue
        points = np.concatenate(pipeline.map_points())
        share = (points[:, 2] - HEIGHTS[0]) / (HEIGHTS[1] - HEIGHTS[0])
        colours = (255 * matplotlib.colormaps["turbo"](share)[:, :3]).astype(np.int64)
        now = transform(update.map_T_lidar.matrix(), sweep.points[::6].astype(np.float64))
        points = np.concatenate([points, now])
        colours = np.concatenate([colours, np.tile(SWEEP, (len(now), 1))])
        pictures.append(seen(points, colours, update.map_T_lidar.translation(), heading))
    first, *others = pictures
    small = {"quality": 25, "method": 6}
    first.save(path, save_all=True, append_images=others, duration=100, loop=0, **small)


def seen(points: FloatArray, colours: IntArray, at: FloatArray, heading: float) -> Image.Image:
    """Points (N, 3) and their colours (N, 3) of 255 through the eye of the camera."""
    turn = gtsam.Rot3.Yaw(heading).matrix()
    eye, forward = at + turn @ EYE, turn @ (SEEN - EYE)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    points = (points - eye) @ axes.T
    ahead = points[:, 2] > 1.0
    points, colours = points[ahead], colours[ahead]
    columns, rows = (FOCAL * points[:, :2] / points[:, 2:]).T.round().astype(np.int64)
    columns, rows = columns + SIZE[0] // 2, rows + SIZE[1] // 2
    nearest_last = np.argsort(-points[:, 2], kind="stable")
    picture = np.full((SIZE[1], SIZE[0], 3), 18, np.uint8)
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):  # two by two pixels a point
        inside = (columns + across >= 0) & (columns + across < SIZE[0])
        inside &= (rows + down >= 0) & (rows + down < SIZE[1])
        order = nearest_last[inside[nearest_last]]
        picture[rows[order] + down, columns[order] + across] = colours[order]
    return Image.fromarray(picture)


def street_map(path: Path, frames: int) -> None:
    """Once round the street, as ``loam-gtsam demo --frames 709`` has it."""
    result = run(SimulatedWorld("street_loop", frames=frames), workers=1 if frames > 200 else 0)
    plot_map(path, result.edge_points, result.plane_points, result.trajectory)


def one_frame(path: Path, frames: int) -> None:
    """A frame, its matches and their residuals."""
    pipeline, way = Pipeline(), []
    for sweep in SimulatedWorld("street_loop", sensor="os1-64", frames=frames):
        update = pipeline.process(sweep)
        way.append(update.map_T_lidar.translation())
    frame = frame_view(frames - 1, sweep, update, pipeline)
    plot_frame(path, frame, map_view(update, pipeline, way))


def town_loops(path: Path, frames: int) -> None:
    """A town before and after its loops are closed, with an odometry that drifts."""
    config = Config()
    config = config.changed({"imu.coupling": "off", "pose_graph.turn_walk_deg": TURN_WALK_DEG})
    world = SimulatedWorld(build_city(streets()), columns=600, speed=20.0, frames=frames)
    pipeline, graph, closer = Pipeline(config), PoseGraph(config), ScanLoopCloser(config)
    last = odometry = gtsam.Pose3()
    updates = []
    for sweep in world:
        extraction = extract(sweep, config)
        update = pipeline.process(sweep, extraction)
        step = last.between(update.map_T_lidar)
        turn = gtsam.Rot3.Yaw(DRIFT * np.linalg.norm(step.translation()))
        odometry = odometry.compose(step).compose(gtsam.Pose3(turn, np.zeros(3)))
        last = update.map_T_lidar
        updates.append(replace(update, map_T_lidar=odometry))
        keyframe = graph.add(updates[-1], extraction.features)
        loop = None if keyframe is None else closer.detect(keyframe, graph)
        if loop is not None:
            graph.add_loop(loop)
    after = graph.trajectory(updates)
    drifting = np.array([update.map_T_lidar.matrix() for update in updates])
    keyframes = np.array([keyframe.odom_T_lidar.matrix() for keyframe in graph.keyframes])
    ends = [graph.poses()[[loop.earlier, loop.later], :3, 3] for loop in graph.loops]
    panels = {}
    for name, trajectory, poses in (
        ("Odometry with a drift", Trajectory(after.stamps, drifting), keyframes),
        (f"After {sum(graph.active)} loops", after, graph.poses()),
    ):
        error = absolute_error(trajectory, world.truth).rmse
        parts = [
            transform(pose, np.concatenate([keyframe.edges, keyframe.planes]))
            for pose, keyframe in zip(poses, graph.keyframes, strict=True)
        ]
        way = trajectory.positions
        panels[f"{name}: {error:.2f} m off"] = np.concatenate(parts), way
    plot_loops(path, panels, np.array(ends).reshape(-1, 2, 3)[list(graph.active)])


def streets() -> FloatArray:
    """(N, 2) the way through the town, a point a metre, round its corners."""
    corners = np.array(CORNERS, np.float64)
    parts = [
        np.linspace(one, two, int(np.abs(two - one).sum()), endpoint=False)
        for one, two in pairwise(corners)
    ]
    way = np.concatenate(parts)
    padded = np.pad(way, ((BEND // 2, BEND // 2), (0, 0)), "edge")
    smooth = [np.convolve(column, np.full(BEND, 1.0 / BEND), "valid") for column in padded.T]
    return np.stack(smooth, axis=-1)


PICTURES: dict[str, tuple[Callable[[Path, int], None], int]] = {
    "drive.webp": (drive, 280),
    "street_loop_map.png": (street_map, 709),
    "frame_matches.png": (one_frame, 90),
    "town_loops.png": (town_loops, 700),
}
"""Name -> how it is made, of how many sweeps."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the pictures; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=IMAGES, help="folder for the pictures")
    parser.add_argument("--frames", type=int, help="sweeps of each, at most, to try it out")
    parser.add_argument("--only", choices=sorted(PICTURES), help="make this one")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    for name, (make, frames) in PICTURES.items():
        if options.only in (None, name):
            make(options.output / name, min(frames, options.frames or frames))
    return 0


if __name__ == "__main__":
    sys.exit(main())

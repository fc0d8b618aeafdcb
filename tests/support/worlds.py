"""Places made of points, features seen in them, and frames of a drive through them."""

import gtsam
import numpy as np

from loam_gtsam.types import Features, FrameStatus, MapUpdate, Uncertainty

OWN = np.diag(np.repeat([2e-4, 3e-3], 3) ** 2)
STEP = np.diag(np.repeat([5e-4, 5e-3], 3) ** 2)


def seen_from_first(world, stamp):
    """True pose at a stamp, nanoseconds, seen from that of the first sweep."""
    first, now = world.truth.map_T_lidar[0], world.truth_at(np.array([stamp])).map_T_lidar[0]
    return gtsam.Pose3(first).between(gtsam.Pose3(now))


def room_features(map_T_lidar, stamp, rng, count=6000, noise=0.0):
    """Features of a 12 x 8 x 4 m room with six poles, seen exactly from a pose."""
    sides = np.array([6.0, 4.0, 2.0])
    walls = rng.uniform(-1, 1, (count, 3)) * sides
    axis = rng.integers(0, 3, count)
    rows = np.arange(count)
    walls[rows, axis] = np.sign(walls[rows, axis]) * sides[axis]
    poles = np.repeat([[x, y, 0.0] for x in (-4.0, 0.5, 3.0) for y in (-2.5, 2.0)], 60, axis=0)
    poles[:, 2] = rng.uniform(-2, 2, len(poles))
    local = gtsam.Pose3(np.linalg.inv(map_T_lidar.matrix()))
    moved = [local.transformFrom(points.T).T for points in (poles, walls)]
    moved = [points + rng.normal(0, noise, points.shape) for points in moved]
    return Features.from_points(stamp, *moved)


class World:
    """Points of walls, posts and the ground, seen without occlusion up to 20 m."""

    def __init__(self, seed, walls=40, posts=80):
        rng = np.random.default_rng(seed)
        x, y = (line.ravel() for line in np.meshgrid(*[np.arange(-25.0, 65.0, 0.5)] * 2))
        planes = [np.column_stack([x, y, np.full(len(x), -1.7)])]
        for _ in range(walls):
            along, up = (line.ravel() for line in np.meshgrid(np.arange(0, 8, 0.5),
                                                              np.arange(-1.5, 4, 0.5)))  # fmt: skip
            turn, foot = rng.uniform(0, np.pi), rng.uniform(-25.0, 65.0, 2)
            planes.append(np.column_stack([foot[0] + along * np.cos(turn),
                                           foot[1] + along * np.sin(turn), up]))  # fmt: skip
        feet = rng.uniform(-25.0, 65.0, (posts, 2))
        heights = np.arange(-1.6, 3.0, 0.25)
        self.planes = np.concatenate(planes)
        self.edges = np.column_stack([np.repeat(feet, len(heights), axis=0),
                                      np.tile(heights, posts)])  # fmt: skip

    def seen(self, map_T_lidar, stamp, rng):
        parts = []
        for points in (self.edges, self.planes):
            local = map_T_lidar.transformTo(points.T).T
            local = local[np.linalg.norm(local, axis=1) < 20.0]
            parts.append(local + rng.normal(0.0, 0.01, local.shape))
        return Features.from_points(stamp, *parts)


def there_and_back(heading, aside=1.0, turn_at=40):
    """On along x and back again, with another heading on the way back."""
    out = [gtsam.Pose3(gtsam.Rot3(), np.array([float(x), 0, 0])) for x in range(0, turn_at, 2)]
    back = [gtsam.Pose3(gtsam.Rot3.Yaw(heading), np.array([float(x), aside, 0.1]))
            for x in range(turn_at, 2, -2)]  # fmt: skip
    return out + back


def updates(poses, drift=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), step=STEP):
    """Solved frames with a drift a step, and covariances that know of it."""
    odometry, known, made = poses[0], 1e-8 * np.eye(6), []
    for number, pose in enumerate(poses):
        if number:
            motion = poses[number - 1].between(pose).retract(np.array(drift))
            odometry = odometry.compose(motion)
            to_map = odometry.AdjointMap()
            known = known + to_map @ step @ to_map.T
        parts = Uncertainty(OWN, np.zeros((6, 6)), None, known, 1.0, 100.0)
        from_map = odometry.inverse().AdjointMap()
        covariance = OWN + from_map @ known @ from_map.T
        made.append(MapUpdate(number * 10**8, odometry, FrameStatus.OK, covariance=covariance,
                              uncertainty=parts))  # fmt: skip
    return made

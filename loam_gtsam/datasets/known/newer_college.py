"""The Newer College data sets of 2020 (OS1-64) and 2021 (OS0-128), hand-held."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Unpack

from scipy.spatial.transform import Rotation

from loam_gtsam.datasets.bags.bag import BagSequence
from loam_gtsam.datasets.base import BagOptions
from loam_gtsam.datasets.decode.extrinsics import Rig, rigid_transform
from loam_gtsam.datasets.decode.packed_points import read_pcd
from loam_gtsam.datasets.decode.tables import pose_matrix
from loam_gtsam.datasets.known import layouts
from loam_gtsam.datasets.known.stamped_files import StampedFiles
from loam_gtsam.geometry import inverse_pose
from loam_gtsam.types import DatasetError

_HALF_TURN = Rotation.from_euler("z", 180.0, degrees=True)
_SENSOR_T_LIDAR = rigid_transform(_HALF_TURN, [0.0, 0.0, 0.03618])
_SENSOR_T_IMU = rigid_transform(Rotation.identity(), [0.006253, -0.011775, 0.007645])
"""Ouster's manual of the OS1, coordinate frames."""

RIG_2020 = Rig(
    kind="Newer College 2020",
    topic="/os1_cloud_node/points",
    imu_topic="/os1_cloud_node/imu",
    body_T_lidar=pose_matrix([-0.084, -0.025, 0.050, 0.0, 0.0, 0.924, 0.383]),
    lidar_T_imu=inverse_pose(_SENSOR_T_LIDAR) @ _SENSOR_T_IMU,
    source="Ouster's manual",
)
"""Points are in the driver's lidar frame, half a turn from the case; reference poses are of the
left camera's mount. ``body_T_lidar`` as pyLiDAR-SLAM and KISS-ICP quote it; it equals the
data set's IMU extrinsics, as evalio quotes them, with Ouster's manual to a millimetre."""
RIG_2021 = Rig(
    kind="Newer College 2021",
    topic="/os_cloud_node/points",
    imu_topic="/os_cloud_node/imu",
    body_T_lidar=pose_matrix([0.001, 0.0, 0.091, 0.0, 0.0, 0.0, 1.0]),
    lidar_T_imu=inverse_pose(
        pose_matrix([0.013801, -0.012207, -0.01514, 0.0032925, -0.004627, -0.0024302, 0.99998])
    ),
    source="the data set's calibration, as evalio quotes it",
)
"""``os_sensor_to_base`` of the data set's ``os_imu_lidar_transforms.yaml``, as ptudes and evalio
quote it. Points are in the frame of the case."""


class NewerCollegeBags(BagSequence):
    """A sequence of the Newer College data sets as bags.

    Parameters
    ----------
    path : one bag, or a folder with the bags of a sequence (also in ``rosbag/``), which are read
        one after the other. Reference poses are looked for there, in ``ground_truth/`` and
        in ``ground_truth/tum_format/``, also one folder up.
    sequence : which, if the folder holds several, e.g. ``quad-easy``
    options : see :class:`~loam_gtsam.datasets.base.BagOptions`

    Raises
    ------
    DatasetError
        If there is none, or there are several sequences and none is named.

    References
    ----------
    Ramezani et al., The Newer College dataset, IROS 2020; Zhang et al., Multi-camera LiDAR inertial
    extension to the Newer College dataset, 2021, https://ori-drs.github.io/newer-college-dataset.
    """

    def __init__(
        self, path: str | Path, *, sequence: str | None = None, **options: Unpack[BagOptions]
    ) -> None:
        root = Path(path)
        name, parts = _choose(root, sequence)
        rig = RIG_2020 if name == "rooster" else RIG_2021
        super().__init__(root, parts, rig, _truth_file(parts[0].parent, name), **options)


class NewerCollegeClouds(StampedFiles):
    """A sequence of 2020 as PCD files.

    Parameters
    ----------
    path : holds ``raw_format/ouster_scan/cloud_SECONDS_NANOSECONDS.pcd``, and
        ``ground_truth/registered_poses.csv``
    time_unit, stamp_is : as for :class:`~loam_gtsam.datasets.BagDataset`

    Notes
    -----
    Files without times of points are taken to be 1024 firings of 64 beams in 0.1 s from the stamp,
    as KISS-ICP reads them; a file of another size then becomes a bad sweep.
    """

    def __init__(
        self, path: str | Path, *, time_unit: str | None = None, stamp_is: str | None = None
    ) -> None:
        root = Path(path)
        super().__init__(
            root,
            replace(RIG_2020, kind=f"{RIG_2020.kind}, PCD files"),
            root / layouts.NEWER_COLLEGE_SCANS,
            "*.pcd",
            read_pcd,
            name="cloud_SECONDS_NANOSECONDS",
            truth=_truth_file(root, "rooster"),
            in_order=True,
            time_unit=time_unit,
            stamp_is=stamp_is,
        )
        self.sensor = {}  # there is no IMU
        self._problems.append("IMU: not read from this layout; the bags have one")


def _choose(root: Path, sequence: str | None) -> tuple[str, list[Path]]:
    if root.is_file():
        if (known := layouts.newer_college_sequence(root)) is None:
            raise DatasetError(f"{root}: not named as a bag of the Newer College data sets")
        return known[0], [root]
    found = layouts.newer_college_sequences(root)
    names = ", ".join(found)
    if not found:
        raise DatasetError(f"{root}: no bags of the Newer College data sets")
    if sequence is None and len(found) > 1:
        raise DatasetError(f"{root}: several sequences ({names}); give sequence, or open one bag")
    name = sequence or next(iter(found))
    if name not in found:
        raise DatasetError(f"{root}: no sequence {sequence!r}; there is {names}")
    return name, found[name]


def _truth_file(folder: Path, name: str) -> Path | None:
    difficulty = name.removeprefix("math-")
    files = ["registered_poses.csv" if name == "rooster" else f"gt-nc-{name}.csv"]
    if name != difficulty:
        files = [f"gt_state_{difficulty}.csv", f"gt_math_{difficulty}.csv"]
    inside = ("", "ground_truth/", "ground_truth/tum_format/")
    places = [f"{up}{inner}" for up in ("", "../") for inner in inside]
    return layouts.first_existing(folder, [place + file for place in places for file in files])

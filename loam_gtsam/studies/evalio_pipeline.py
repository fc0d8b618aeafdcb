"""The pipeline for evalio, which runs this package beside other systems on evalio's data sets.

::

    export EVALIO_CUSTOM=loam_gtsam.studies.evalio_pipeline
    evalio run -p loam_gtsam -d newer_college_2021/quad_easy

With a file of experiments, ``-M loam_gtsam.studies.evalio_pipeline`` does the same (evalio 0.6.1
checks the names after ``-p`` before it looks into the module). No other module imports this one.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any

import gtsam
import numpy as np

from loam_gtsam.config import Config, config_from_dict, config_to_dict, with_implied
from loam_gtsam.datasets.decode.extrinsics import extrinsic_settings
from loam_gtsam.frontend.workers import extract
from loam_gtsam.imu.buffer import ImuBuffer
from loam_gtsam.io.version import installed_version
from loam_gtsam.pipeline import Pipeline
from loam_gtsam.types import FloatArray, ImuSamples, InputError, Scan

try:
    from evalio.pipelines import Pipeline as EvalioPipeline
    from evalio.types import (
        SE3,
        SO3,
        ImuMeasurement,
        ImuParams,
        LidarMeasurement,
        LidarParams,
        Point,
        Stamp,
    )
except ModuleNotFoundError as error:
    raise ImportError(
        f'this module needs evalio ({error}); install it with: pip install "loam_gtsam[evalio]"'
    ) from error

_PRESET = "preset"
_LONGEST_QUEUE = 2  # sweeps that may wait for samples of the IMU


class LoamGtsam(EvalioPipeline):
    """LOAM's scan-to-map estimator as a GTSAM factor graph.

    evalio may hand a sweep out before the IMU samples of the same time. A sweep therefore waits for
    the first sample after its end, but no longer than until two more sweeps have come. evalio does
    not tell a pipeline that a sequence is over: the last two sweeps may stay without a pose.
    """

    def __init__(self) -> None:
        super().__init__()
        self._params: dict[str, Any] = self.default_params()
        self._implied: dict[str, Any] = {}  # what the data set says
        self._lidar_T_imu = gtsam.Pose3()
        self._period = 0.1
        self._samples: list[ImuMeasurement] = []
        self._newest: int | None = None
        self._waiting: list[LidarMeasurement] = []
        self._shows = False
        self._buffer: ImuBuffer | None = None
        self._pipeline: Pipeline | None = None

    @staticmethod
    def name() -> str:
        """Name of the pipeline."""
        return "loam_gtsam"

    @staticmethod
    def version() -> str:
        """Version of this package."""
        return installed_version()

    @staticmethod
    def default_params() -> dict[str, bool | int | float | str]:
        """Scalars of the configuration, ``section.name``, to be set on top of ``preset``."""
        params: dict[str, bool | int | float | str] = {_PRESET: "default"}
        for section, values in config_to_dict(Config()).items():
            for key, value in values.items():
                if isinstance(value, (bool, int, float, str)):
                    params[f"{section}.{key}"] = value
        return params

    def set_params(
        self, params: Mapping[str, bool | int | float | str]
    ) -> dict[str, bool | int | float | str]:
        """Set parameters; returns the parameters that are unknown.

        evalio hands over all of them, those that are not set with their defaults. So only what
        differs from these can be set on top of a preset.
        """
        self._params |= {key: value for key, value in params.items() if key in self._params}
        return {key: value for key, value in params.items() if key not in self._params}

    def set_lidar_params(self, params: LidarParams) -> None:
        """Take the range limits and the duration of a sweep."""
        self._period = 1.0 / params.rate
        limits = {"min_range": params.min_range, "max_range": params.max_range}
        self._implied |= limits | {"period": self._period}

    def set_imu_params(self, params: ImuParams) -> None:
        """Take noise and gravity, which only the tight coupling uses."""
        known = {
            "imu.gravity": float(np.linalg.norm(params.gravity)),
            "imu.gyro_noise": params.gyro,
            "imu.acceleration_noise": params.accel,
            "imu.gyro_bias_walk": params.gyro_bias,
            "imu.acceleration_bias_walk": params.accel_bias,
        }
        self._implied |= {key: value for key, value in known.items() if value > 0.0}

    def set_imu_T_lidar(self, T: SE3) -> None:
        """Take the extrinsic pose of the lidar in the frame of the IMU."""
        self._lidar_T_imu = gtsam.Pose3(T.to_mat()).inverse()
        self._implied |= extrinsic_settings(self._lidar_T_imu.matrix())

    def set_visualizing(self, visualize: Set[Any] | None) -> None:
        """Hand out features from now on if anything is shown."""
        super().set_visualizing(visualize)
        self._shows = bool(visualize)

    def initialize(self) -> None:
        """Build the pipeline from the parameters."""
        default = self.default_params()
        sections: dict[str, Any] = {_PRESET: self._params[_PRESET]}
        for key, value in self._params.items():
            section, _, name = key.partition(".")
            if name and value != default[key]:
                sections.setdefault(section, {})[name] = value
        config = with_implied(config_from_dict(sections, "evalio parameters"), self._implied)
        self._buffer = ImuBuffer(config.imu) if config.imu.coupling != "off" else None
        self._pipeline = Pipeline(config, imu=self._buffer)

    def add_imu(self, mm: ImuMeasurement) -> None:
        """Keep a sample, and map the sweeps that waited for this sample."""
        if self._buffer is None:
            return
        self._samples.append(mm)
        stamp = mm.stamp.to_nsec()
        self._newest = stamp if self._newest is None else max(self._newest, stamp)
        self._map_waiting()

    def add_lidar(self, mm: LidarMeasurement) -> None:
        """Map a sweep, now or as soon as the samples of the IMU reach its end."""
        self._waiting.append(mm)
        self._map_waiting()

    def map(self) -> dict[str, list[Point]]:
        """Edge and plane points of the whole map."""
        if self._pipeline is None:
            return {"edges": [], "planes": []}
        edges, planes = self._pipeline.map_points()
        return {"edges": _as_points(edges), "planes": _as_points(planes)}

    def _map_waiting(self) -> None:
        while self._waiting:
            end = self._waiting[0].stamp.to_nsec() + round(self._period * 1e9)
            waits = self._newest is not None and self._newest < end
            if waits and len(self._waiting) <= _LONGEST_QUEUE:
                break
            self._map(self._waiting.pop(0))

    def _map(self, sweep: LidarMeasurement) -> None:
        if self._pipeline is None:
            raise InputError("add_lidar: initialize() must come first")
        if self._buffer is not None and self._samples:
            stamps = np.array([sample.stamp.to_nsec() for sample in self._samples], np.int64)
            gyro = np.array([sample.gyro for sample in self._samples])
            acceleration = np.array([sample.accel for sample in self._samples])
            self._buffer.add(ImuSamples(stamps, None, gyro, acceleration))
            self._samples.clear()
            self._buffer.forget_old(sweep.stamp.to_nsec())
        scan = _as_scan(sweep)
        extraction = extract(scan, self._pipeline.config)
        update = self._pipeline.process(scan, extraction)
        if not update.status.has_pose:
            return
        stamp = Stamp.from_nsec(update.stamp)
        pose = update.map_T_lidar.compose(self._lidar_T_imu)
        self.save(stamp, SE3(SO3.from_mat(pose.rotation().matrix()), pose.translation()))
        features = extraction.features
        if self._shows and features is not None:
            edges, planes = _as_points(features.edges), _as_points(features.planes)
            self.save(stamp, {"edges": edges, "planes": planes})


def _as_scan(sweep: LidarMeasurement) -> Scan:
    points = sweep.points
    values = (value for point in points for value in (point.x, point.y, point.z, point.row))
    table = np.fromiter(values, np.float64, 4 * len(points)).reshape(-1, 4)
    rings = table[:, 3].astype(np.int64)
    times = np.asarray(sweep.to_vec_stamps(), np.float64)
    return Scan(
        points=np.ascontiguousarray(table[:, :3], dtype=np.float32),
        stamp=sweep.stamp.to_nsec(),
        times=times if (times != times[:1]).any() else None,
        rings=rings if rings.any() else None,
    )


def _as_points(points: FloatArray) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]

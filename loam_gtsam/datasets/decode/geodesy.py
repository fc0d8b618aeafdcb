"""WGS 84: latitudes and longitudes as metres east, north and up of an origin, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loam_gtsam.geometry import as_array
from loam_gtsam.types import FloatArray

_RADIUS, _FLATTENING = 6378137.0, 1.0 / 298.257223563
_SQUARED = _FLATTENING * (2.0 - _FLATTENING)  # of the first eccentricity
_ROUNDS = 8  # each gains two digits or more, anywhere within 100 km of the ground


def earth_centred(geodetic: FloatArray) -> FloatArray:
    """(N, 3) metres in the frame of the earth, of (N, 3) latitudes, longitudes (degrees), heights.

    Heights are above the ellipsoid, metres.
    """
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    normal = _RADIUS / np.sqrt(1.0 - _SQUARED * np.sin(latitude) ** 2)
    across = (normal + geodetic[:, 2]) * np.cos(latitude)
    up = (normal * (1.0 - _SQUARED) + geodetic[:, 2]) * np.sin(latitude)
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), up])


def _axes(origin: FloatArray) -> FloatArray:
    """(3, 3) whose rows are east, north and up at a place, in the frame of the earth."""
    b, l = np.radians(origin[:2])  # noqa: E741 (as in every book)
    return np.array([
        [-np.sin(l), np.cos(l), 0.0],
        [-np.sin(b) * np.cos(l), -np.sin(b) * np.sin(l), np.cos(b)],
        [np.cos(b) * np.cos(l), np.cos(b) * np.sin(l), np.sin(b)],
    ])  # fmt: skip


def east_north_up(geodetic: FloatArray, origin: FloatArray | None = None) -> FloatArray:
    """(N, 3) metres east, north and up of an origin, by default the first of (N, 3) places.

    Places and origin (3,) are latitude, longitude (degrees) and height (metres). Exact: the plane
    touches the ellipsoid at the origin, and the ground falls away from it (8 cm at 1 km).
    """
    geodetic = as_array(geodetic, "geodetic", ("N", 3))
    origin = geodetic[0] if origin is None else as_array(origin, "origin", (3,))
    away = earth_centred(geodetic) - earth_centred(origin[None])
    return np.asarray(away @ _axes(origin).T, np.float64)


def geodetic_of(enu: FloatArray, origin: FloatArray) -> FloatArray:
    """(N, 3) latitudes, longitudes and heights of (N, 3) metres: :func:`east_north_up` reversed."""
    origin = as_array(origin, "origin", (3,))
    earth = as_array(enu, "enu", ("N", 3)) @ _axes(origin) + earth_centred(origin[None])
    across = np.hypot(earth[:, 0], earth[:, 1])
    latitude = np.arctan2(earth[:, 2], across * (1.0 - _SQUARED))
    for _ in range(_ROUNDS):
        normal = _RADIUS / np.sqrt(1.0 - _SQUARED * np.sin(latitude) ** 2)
        latitude = np.arctan2(earth[:, 2] + _SQUARED * normal * np.sin(latitude), across)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    root = np.sqrt(1.0 - _SQUARED * sine**2)
    height = across * cosine + earth[:, 2] * sine - _RADIUS * root
    longitude = np.arctan2(earth[:, 1], earth[:, 0])
    return np.column_stack([np.degrees(latitude), np.degrees(longitude), height])


@dataclass(frozen=True, slots=True, eq=False)
class GeoReference:
    """Where a map is on the earth.

    Attributes
    ----------
    origin : (3,) latitude, longitude (degrees) and height (metres above the ellipsoid of WGS 84)
        of the frame ``enu``, whose axes point east, north and up there
    enu_T_map : (4, 4) pose of the map in that frame
    covariance : (6, 6) of that pose, rotation first, along the axes of the map
    """

    origin: FloatArray
    enu_T_map: FloatArray
    covariance: FloatArray

    def as_dict(self) -> dict[str, Any]:
        """Numbers for a JSON file."""
        return {
            "latitude_deg": float(self.origin[0]),
            "longitude_deg": float(self.origin[1]),
            "height_m": float(self.origin[2]),
            "enu_T_map": self.enu_T_map.tolist(),
            "covariance": self.covariance.tolist(),
        }

    @classmethod
    def of_dict(cls, content: dict[str, Any]) -> GeoReference:
        """What :meth:`as_dict` made; ValueError or KeyError if it is something else."""
        origin = [content[name] for name in ("latitude_deg", "longitude_deg", "height_m")]
        parts = [
            as_array(np.array(value, np.float64), name, shape)
            for name, value, shape in (
                ("origin", origin, (3,)),
                ("enu_T_map", content["enu_T_map"], (4, 4)),
                ("covariance", content["covariance"], (6, 6)),
            )
        ]
        return cls(*parts)

    def geodetic(self, positions: FloatArray) -> FloatArray:
        """(N, 3) latitudes, longitudes and heights of (N, 3) positions in the map."""
        enu = positions @ self.enu_T_map[:3, :3].T + self.enu_T_map[:3, 3]
        return geodetic_of(enu, self.origin)

    @property
    def heading_deg(self) -> float:
        """Angle from east to the x axis of the map, counter-clockwise, degrees."""
        angles = Rotation.from_matrix(self.enu_T_map[:3, :3]).as_euler("ZYX", degrees=True)
        return float(angles[0])

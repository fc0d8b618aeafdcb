"""WGS 84: latitudes, longitudes and heights as metres, and back."""

import json

import numpy as np
import pytest

from loam_gtsam.datasets.decode.geodesy import (
    GeoReference,
    earth_centred,
    east_north_up,
    geodetic_of,
)
from loam_gtsam.types import InputError


def test_the_ellipsoid_has_its_half_axes():
    found = earth_centred(np.array([[0.0, 0.0, 10.0], [90.0, 0.0, 0.0], [0.0, 90.0, 0.0]]))
    expected = [[6378147.0, 0.0, 0.0], [0.0, 0.0, 6356752.314245], [0.0, 6378137.0, 0.0]]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-33.9, 151.2, 60.0), (89.9, 10.0, -300.0)])
def test_there_and_back_is_exact(origin):
    enu = np.random.default_rng(0).uniform(-2e4, 2e4, (50, 3)) * [1.0, 1.0, 0.05]
    there = geodetic_of(enu, np.array(origin))
    np.testing.assert_allclose(east_north_up(there, np.array(origin)), enu, atol=1e-6)


def test_the_ground_falls_away_from_the_plane():
    origin = np.array([48.0, 11.0, 500.0])
    north = geodetic_of(np.array([[0.0, 1000.0, 0.0]]), origin)
    assert north[0, 2] - 500.0 == pytest.approx(1000.0**2 / (2 * 6.37e6), rel=0.01)
    assert north[0, 1] == pytest.approx(11.0, abs=1e-9)


def test_a_reference_is_kept_in_json_and_refused_if_broken():
    made = GeoReference(np.array([48.0, 11.0, 500.0]), np.eye(4), 0.1 * np.eye(6))
    again = GeoReference.of_dict(json.loads(json.dumps(made.as_dict())))
    assert np.array_equal(again.origin, made.origin)
    assert np.array_equal(again.covariance, made.covariance)
    np.testing.assert_allclose(again.geodetic(np.zeros((1, 3))), made.origin[None], atol=1e-9)
    with pytest.raises(InputError, match="enu_T_map"):
        GeoReference.of_dict(made.as_dict() | {"enu_T_map": [1.0]})

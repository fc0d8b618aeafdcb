"""Small text files of numbers, and IMU samples made of them."""

from __future__ import annotations

import numpy as np
import pytest

from loam_gtsam.datasets.decode.tables import clean_imu, read_table, seconds_to_ns, whole_number
from loam_gtsam.datasets.truth import read_truth
from loam_gtsam.types import DatasetError


def test_stamps_keep_every_nanosecond() -> None:
    assert seconds_to_ns("1700000000.123456789") == 1_700_000_000_123_456_789
    assert seconds_to_ns("1e-9") == 1


WRONG = ["9" * 5011, str(2**63), "-9" + "0" * 18, "1e5", "1_0", chr(0x0661), "nan", "", "+", "1 2"]


@pytest.mark.parametrize("text", WRONG, ids=lambda text: text[:9])
def test_what_is_no_stamp_is_refused_shortly(text, tmp_path) -> None:
    with pytest.raises(ValueError, match=r"^(not a whole number|out of range): '") as caught:
        whole_number(text)
    assert len(str(caught.value)) < 80
    table = tmp_path / "some.csv"
    for cells, columns in (
        (text, "ns x"),
        (f"{text},0", "secs nsecs x"),
        (f"1,{text}", "secs nsecs x"),
    ):
        table.write_text(f"{cells},0.5")
        with pytest.raises(DatasetError, match=r"some\.csv:1: "):
            read_table(table, columns, ",")
    table.write_text(f"1700000000000000000,0,0,0,1,0,0,0\n{text},0,0,0,1,0,0,0")
    if text[:1] in tuple("+-0123456789"):  # else it is a headline
        with pytest.raises(DatasetError, match=r"some\.csv: "):
            read_truth(table)


@pytest.mark.parametrize("text", ["nan", "-inf", "1e400", "1e308", "-1e200"])
def test_a_number_of_which_the_square_is_infinite_is_refused(text, tmp_path) -> None:
    table = tmp_path / "some.csv"
    table.write_text(f"1,1e99\n2,{text}")
    with pytest.raises(DatasetError, match=r"some\.csv:2: .*NaN or infinity"):
        read_table(table, "ns x", ",")


def test_whole_numbers_up_to_the_limit() -> None:
    assert whole_number(f" -{2**62} ") == -(2**62)
    assert whole_number("+0012", 1000, 12_000) == 12_000
    with pytest.raises(ValueError, match="out of range"):
        whole_number("13", 1000, 12_000)


@pytest.mark.parametrize("text", ["1" * 5011, "1e400", "-1e30"])
def test_what_is_no_time_in_seconds_is_refused_shortly(text) -> None:
    with pytest.raises(ValueError, match=r"^(not a time in seconds|out of range): '") as caught:
        seconds_to_ns(text)
    assert len(str(caught.value)) < 80


def imu_values(count: int) -> np.ndarray:
    return np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (count, 1))


def test_imu_samples_are_put_in_order() -> None:
    problems: list[str] = []
    values = imu_values(5)
    values[:, 4] = np.arange(5)
    values[4, 5] = np.nan
    samples = clean_imu(np.array([20, 10, 10, 30, 40]), values, problems)
    assert samples.stamps.tolist() == [10, 20, 30]
    assert samples.gyro[:, 0].tolist() == [1.0, 0.0, 3.0]
    assert len(problems) == 2
    clean: list[str] = []
    assert clean_imu(np.arange(5), imu_values(5), clean) is not None
    assert clean == []


@pytest.mark.parametrize("bad", [0, 1, 2, 3, 5])
def test_orientations_of_another_length_cost_no_others(bad: int) -> None:
    problems: list[str] = []
    values = imu_values(5)
    values[:bad, :4] *= np.array([0.0, 0.5, 1.1, 3.0, 2.0])[:bad, None]
    samples = clean_imu(np.arange(5), values, problems)
    assert len(samples.stamps) == 5
    if bad > 2:
        assert samples.orientation is None
        assert problems == ["IMU: no orientation in it (not of unit length)"]
        values[:, :4] = 0.0  # not given, which is no fault
        assert clean_imu(np.arange(5), values, given := []).orientation is None
        assert given == []
        return
    assert np.isnan(samples.orientation[:bad]).all()
    np.testing.assert_array_equal(samples.orientation[bad:], imu_values(5 - bad)[:, :4])
    told = f"IMU: {bad} of 5 orientations are not of unit length, left out"
    assert problems == ([told] if bad else [])


def test_imu_in_g_is_converted_and_an_empty_one_is_none() -> None:
    problems: list[str] = []
    values = imu_values(4)
    values[:, 9] = 1.0
    samples = clean_imu(np.arange(4), values, problems)
    np.testing.assert_allclose(samples.acceleration[:, 2], 9.80665)
    assert "in g" in problems[0]
    assert clean_imu(np.zeros(0, np.int64), np.zeros((0, 10)), problems) is None

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.bags import ROS1, STAMP, N, cloud, make_message, xyz

from loam_gtsam.datasets.decode.point_times import apply_times, decide_times
from loam_gtsam.datasets.decode.pointcloud2 import (
    CloudStream,
    decode_pointcloud2,
    decode_with_times,
)
from loam_gtsam.types import DatasetError


def with_time(name: str, values: np.ndarray) -> Any:
    return make_message({**xyz(len(values)), name: values})


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("gap", "row_padding"), [(0, 0), (3, 0), (1, 13)])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_layouts(big: bool, gap: int, row_padding: int, dtype: str) -> None:
    columns = {**xyz(dtype=dtype), "ring": np.arange(N, dtype="u2") % 16}
    message = make_message(columns, height=4, big=big, gap=gap, row_padding=row_padding)
    scan = decode_pointcloud2(message)
    assert scan.stamp == STAMP
    assert scan.points.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(scan.points, np.stack([columns[c] for c in "xyz"], axis=1))
    np.testing.assert_array_equal(scan.rings, columns["ring"])
    assert scan.rows == 0  # the ring field says it
    scan.points[0] = 0.0  # a copy: the message is read-only


@pytest.mark.parametrize("name", ["ring", "channel", "line"])
@pytest.mark.parametrize("code", ["u1", "i4", "f4"])
def test_ring_fields(name: str, code: str) -> None:
    rings = (np.arange(N) % 64).astype(code)
    scan = decode_pointcloud2(make_message({**xyz(), name: rings}))
    np.testing.assert_array_equal(scan.rings, np.arange(N) % 64)
    assert scan.rings.dtype.kind in "iu"


SWEEP = np.linspace(0.0, 0.1, N)


@pytest.mark.parametrize(
    "name", ["t", "time", "timestamp", "timestamps", "stamps", "time_stamp", "offset_time"]
)
@pytest.mark.parametrize(
    ("values", "unit", "clock"),
    [
        (SWEEP.astype("f4"), "s", "offset"),
        ((SWEEP * 1e3).astype("f4"), "ms", "offset"),
        ((SWEEP * 1e6).astype("u4"), "us", "offset"),
        ((SWEEP * 1e9).astype("u4"), "ns", "offset"),
        (SWEEP + STAMP * 1e-9, "s", "stamp"),
        ((SWEEP + STAMP * 1e-9) * 1e6, "us", "stamp"),
        (SWEEP * 1e9 + 1.7e18 + 123456789, "ns", "stamp"),
        (SWEEP + 991.5, "s", "own"),
        (SWEEP * 1e9 + 991_587_364_520, "ns", "own"),
    ],
)
def test_units(name: str, values: np.ndarray, unit: str, clock: str) -> None:
    decoded = decode_with_times(with_time(name, values))
    decision = decoded.decision
    assert (decision.field, decision.unit, decision.clock) == (name, unit, clock)
    # float64 holds present-day nanoseconds to 256 ns only
    np.testing.assert_allclose(decoded.scan.times, SWEEP, atol=1.5e-6)


def test_integer_nanoseconds_are_exact() -> None:
    offsets = np.arange(N, dtype=np.int64) * 250_003
    for dtype in (np.int64, np.uint64):
        values = (offsets + STAMP).astype(dtype)
        decision = decide_times(values, STAMP, field="t")
        times, _ = apply_times(values, STAMP, decision)
        np.testing.assert_allclose(times, offsets * 1e-9, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("shift", "stamp_is", "first"),
    [
        (0.0, None, 0.0),
        (-0.1, None, -0.1),  # the driver stamps the end of the sweep
        (-0.05, None, -0.05),
        (0.0, "end", -0.1),
        (0.0, "middle", -0.05),
        (-0.1, "start", 0.0),
    ],
)
@pytest.mark.parametrize("absolute", [False, True])
def test_moment_of_the_stamp(
    shift: float, stamp_is: str | None, first: float, absolute: bool
) -> None:
    values = SWEEP + shift + (STAMP * 1e-9 if absolute else 0.0)
    scan = decode_pointcloud2(with_time("time", values), stamp_is=stamp_is)
    np.testing.assert_allclose(scan.times, SWEEP + first, atol=1e-6)


def test_simulated_clock_near_zero() -> None:
    stamp = 300_000_000
    decision = decide_times(SWEEP + 0.3, stamp, field="time")
    assert decision.clock == "stamp"
    assert decide_times(SWEEP, stamp, field="time").clock == "offset"


@pytest.mark.parametrize("wild", [1e6, -3.0, np.nan, np.inf, 2**32 - 1])
def test_one_wild_time(wild: float) -> None:
    values = (SWEEP * 1e9).astype("u4") if wild == 2**32 - 1 else SWEEP.copy()
    values[17] = wild
    decoded = decode_with_times(with_time("time", values))
    assert decoded.outliers == 1
    assert len(decoded.scan.points) == N - 1
    np.testing.assert_allclose(decoded.scan.times, np.delete(SWEEP, 17), atol=1e-9)


def test_clean_times_lose_nothing() -> None:
    # all points in the first tenth but for a few at the end: thin, yet real
    values = np.sort(np.concatenate([np.linspace(0.0, 0.03, N - 20), np.linspace(0.03, 0.1, 20)]))
    assert decode_with_times(with_time("time", values)).outliers == 0


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(N),  # a driver that does not fill the field
        np.linspace(0.0, 5.0, N),  # 5 s, 5 ms, 5 us, 5 ns
        (SWEEP + 1.7e9).astype("f4"),  # absolute seconds do not fit float32
    ],
)
def test_times_that_fit_nothing(values: np.ndarray) -> None:
    message = with_time("time", values)
    with pytest.raises(DatasetError, match=r"(?s)'time'.*tried s, ms, us, ns.*time_unit"):
        decode_pointcloud2(message)
    assert decode_pointcloud2(message, time_field="none").times is None


def test_unit_override_and_earlier_decision() -> None:
    short = np.linspace(0.0, 0.004, N)  # a packet, not a sweep: undecidable alone
    with pytest.raises(DatasetError, match="fit no unit"):
        decode_pointcloud2(with_time("time", short))
    scan = decode_pointcloud2(with_time("time", short), time_unit="s")
    np.testing.assert_allclose(scan.times, short)
    decision = decide_times(SWEEP, STAMP, field="time")
    again = decode_with_times(with_time("time", short), decision=decision).scan
    np.testing.assert_allclose(again.times, short)


def test_sweep_that_breaks_the_decision() -> None:
    decision = decide_times(SWEEP, STAMP, field="time")
    with pytest.raises(DatasetError, match="from its stamp"):
        decode_with_times(with_time("time", SWEEP + 50.0), decision=decision)


def changed(attribute: str, value: Any) -> Any:
    message = make_message(xyz())
    setattr(message.fields[1], attribute, value)
    return message


def stamped(**stamp: Any) -> Any:
    message = make_message(xyz())
    message.header.stamp = SimpleNamespace(**stamp)
    return message


@pytest.mark.parametrize(
    ("message", "match"),
    [
        (make_message({"x": SWEEP, "z": SWEEP}), "no field y; the message has: x, z"),
        (make_message({**xyz(), "x": np.arange(N, dtype="i4")}), "'x': expected float32"),
        (changed("datatype", 11), "unknown datatype 11, expected 1 to 10"),
        (changed("count", 3), "expected count 1, got 3"),
        (stamped(sec="now", nanosec=0), r"header\.stamp"),
        (with_time("time", np.full(N, np.nan)), "NaN"),
        (3, "expected a PointCloud2 message, got int"),
    ],
)
def test_a_message_that_is_no_cloud_says_why(message: Any, match: str) -> None:
    with pytest.raises(DatasetError, match=match):
        decode_pointcloud2(message)


@pytest.mark.parametrize("options", [{"time_unit": "sec"}, {"stamp_is": "begin"}])
def test_unknown_time_options(options: dict[str, str]) -> None:
    with pytest.raises(DatasetError, match="expected one of"):
        decode_pointcloud2(make_message(xyz()), **options)


def test_asked_time_field() -> None:
    columns = {**xyz(), "t": np.zeros(N), "my_time": SWEEP}
    scan = decode_pointcloud2(make_message(columns), time_field="my_time")
    np.testing.assert_allclose(scan.times, SWEEP)
    with pytest.raises(DatasetError, match=r"no time field 'other'.*my_time"):
        decode_pointcloud2(make_message(columns), time_field="other")


def test_nan_points_take_their_columns_along() -> None:
    columns = {**xyz(), "ring": np.arange(N, dtype="u2"), "time": SWEEP.copy()}
    columns["y"] = columns["y"].copy()
    columns["y"][::7] = np.nan
    columns["time"][::7] = 1e9  # whatever the driver leaves there must not count
    decoded = decode_with_times(make_message(columns))
    keep = np.arange(N) % 7 != 0
    assert decoded.outliers == 0
    np.testing.assert_array_equal(decoded.scan.rings, np.flatnonzero(keep))
    np.testing.assert_allclose(decoded.scan.times, SWEEP[keep])
    assert np.isfinite(decoded.scan.points).all()


@pytest.mark.parametrize("fill", [0.0, np.nan])
@pytest.mark.parametrize(
    "times", [SWEEP + STAMP * 1e-9, SWEEP * 1e9 + float(STAMP), SWEEP + 991.5, STAMP + SWEEP * 1e9]
)
def test_missing_returns_at_time_zero_beside_absolute_times(fill: float, times: np.ndarray) -> None:
    columns, gone = {**xyz(), "timestamp": times.copy()}, np.arange(N) % 3 == 0
    measured = decode_with_times(make_message({k: v[~gone] for k, v in columns.items()}))
    for name in columns:
        columns[name][gone] = 0.0 if name == "timestamp" else fill
    decoded = decode_with_times(make_message(columns))
    assert decoded.decision == measured.decision
    kept = decoded.scan.points.any(axis=1)
    np.testing.assert_array_equal(decoded.scan.points[kept], measured.scan.points)
    np.testing.assert_allclose(decoded.scan.times[kept], measured.scan.times, atol=1e-6)
    assert np.ptp(decoded.scan.times) < 0.11
    for name in "xyz":
        columns[name][:] = fill
    columns["timestamp"][:] = 0.0
    nothing = decode_with_times(make_message(columns), decision=measured.decision)
    assert not nothing.scan.points.any()


@pytest.mark.parametrize("stamp_is", [None, "end"])
def test_times_of_missing_returns_count_if_they_are_of_the_sweep(stamp_is: str | None) -> None:
    columns = {**xyz(), "time": SWEEP.astype("f4")}
    usual = decode_with_times(make_message(columns), stamp_is=stamp_is)
    for name in "xyz":
        columns[name][:5] = 0.0  # the first firing is at time zero
    decoded = decode_with_times(make_message(columns), stamp_is=stamp_is)
    assert decoded.decision == usual.decision
    np.testing.assert_array_equal(decoded.scan.times, usual.scan.times)


def test_range_image_keeps_its_rows() -> None:
    columns = {**xyz(), "t": np.tile((np.linspace(0, 0.1, N // 8) * 1e9).astype("u4"), 8)}
    columns["x"] = columns["x"].copy()
    columns["x"][5] = np.nan
    scan = decode_pointcloud2(make_message(columns, height=8))
    assert scan.rows == 8
    assert len(scan.points) == N
    assert np.flatnonzero(np.isnan(scan.points[:, 0])).tolist() == [5]
    assert np.isfinite(scan.times).all()


def test_column_major_range_image_is_turned() -> None:
    columns = {**xyz(), "time": np.repeat(np.linspace(0, 0.1, N // 8), 8)}
    scan = decode_pointcloud2(make_message(columns, height=N // 8))
    assert scan.rows == 8
    np.testing.assert_array_equal(scan.points[: N // 8, 0], columns["x"][::8])
    expected = np.tile(np.linspace(0, 0.1, N // 8), (8, 1))
    np.testing.assert_allclose(scan.times.reshape(8, -1), expected)


def test_empty_and_all_nan_clouds() -> None:
    empty = {name: values[:0] for name, values in {**xyz(), "time": SWEEP}.items()}
    scan = decode_pointcloud2(make_message(empty))
    assert scan.points.shape == (0, 3)
    nothing = {name: np.full(N, np.nan, "f4") for name in "xyz"}
    scan = decode_pointcloud2(make_message({**nothing, "time": SWEEP}))
    assert scan.points.shape == (0, 3)
    assert scan.times.shape == (0,)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"width": 2**31, "row_step": 2**36}, "need .* bytes of data"),
        ({"width": N + 1}, "need .* bytes of data"),
        ({"height": 2, "row_step": 7}, "row_step 7 is below"),
        ({"point_step": 0}, "point_step is 0"),
        ({"point_step": 8, "row_step": 8 * N}, "do not fit into point_step 8"),
        ({"data": b""}, "got 0"),
        ({"height": -3, "width": -3, "row_step": 0}, "expected sizes from 0 on, got -3 x -3"),
        ({"row_step": -48, "height": 2}, "expected sizes from 0 on"),
        ({"height": "two"}, "expected a PointCloud2 message"),
        ({"fields": 7}, "expected a PointCloud2 message"),
        ({"data": [1, 256]}, "expected a PointCloud2 message"),
        ({"data": None}, "expected a PointCloud2 message"),
    ],
)
def test_damaged_layout(change: dict[str, Any], match: str) -> None:
    message = make_message(xyz())
    for key, value in change.items():
        setattr(message, key, value)
    with pytest.raises(DatasetError, match=match):
        decode_pointcloud2(message)


def test_tolerated_oddities() -> None:
    expected = decode_pointcloud2(make_message(xyz())).points
    message = make_message(xyz())
    message.row_step = 0
    message.data = list(message.data)
    for field in message.fields:
        field.count = 0
    np.testing.assert_array_equal(decode_pointcloud2(message).points, expected)


def test_values_that_no_cast_survives_warn_of_nothing() -> None:
    signalling = np.frombuffer(b"\x01\x00\xa0\x7f", "<f4")[0]  # a NaN that is not the usual one
    columns = {**xyz(), "ring": (np.arange(N) % 4).astype("f4"), "t": SWEEP.astype("f4")}
    columns["y"] = columns["y"].astype("f8")
    columns["x"][3] = columns["t"][4] = signalling
    columns["ring"][5], columns["ring"][6] = np.inf, -1e30
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scan = decode_pointcloud2(make_message(columns))
    assert len(scan.points) == N - 2
    assert scan.rings.max() == 2**31 == -scan.rings.min()


def test_times_are_decided_by_the_first_sweeps_and_then_kept() -> None:
    points = np.random.default_rng(0).uniform(-9, 9, (200, 3))

    def absolute(stamp: int) -> Any:
        times = (stamp * 1e-9 + np.linspace(0.0, 0.1, 200)).astype("f8")
        return cloud(ROS1, stamp, points, timestamp=times)

    # At time zero an absolute time looks like an offset; the next sweep tells.
    stream = CloudStream()
    for number in range(15):
        times = stream.decode(absolute(number * 100 * 1_000_000)).times
        assert times is not None
        np.testing.assert_allclose(times, np.linspace(0.0, 0.1, 200), atol=1e-9)
    assert stream.decision is not None
    assert stream.decision.clock == "stamp"
    # One with too few points to tell is read as the others.
    one = cloud(ROS1, 1500 * 1_000_000, points[:1], timestamp=np.array([1.53], "f8"))
    times = stream.decode(one).times
    assert times is not None
    assert times[0] == pytest.approx(0.03)
    with pytest.raises(DatasetError, match="fit no unit"):
        CloudStream().decode(one)

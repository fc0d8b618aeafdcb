"""Files of points packed like a PointCloud2: records of fixed layout, and PCD."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loam_gtsam.datasets.decode.pointcloud2 import DATATYPES
from loam_gtsam.types import DatasetError

XYZI = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
"""Record of a point in the files of KITTI and MulRan."""
XYZI_RING = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "intensity", "ring"))])
"""Record of a point in the files of nuScenes: the fifth column is the beam."""
_CODES = {code: number for number, code in DATATYPES.items()}
_PCD_KEYS = ("FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "POINTS", "DATA")


@dataclass(frozen=True, slots=True)
class Field:
    """Description of a field, as ``sensor_msgs/PointField``."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class PackedCloud:
    """Cloud with what :func:`~loam_gtsam.datasets.decode.pointcloud2.decode_with_times` needs."""

    header: Any
    height: int
    width: int
    fields: tuple[Field, ...]
    point_step: int
    row_step: int
    data: NDArray[np.uint8]
    is_bigendian: bool = False


def read_records(path: Path, stamp: int, record: np.dtype[Any]) -> PackedCloud:
    """A file that is nothing but records of little-endian fields; ``stamp`` in nanoseconds."""
    data = _read_bytes(path)
    step = record.itemsize
    if len(data) % step:
        raise DatasetError(
            f"{path}: {len(data)} bytes is not a multiple of {step} "
            f"({', '.join(record.names or ())}); the file is truncated or in another format"
        )
    return packed(stamp, record, 1, len(data) // step, data)


def read_pcd(path: Path, stamp: int) -> PackedCloud:
    """A PCD file, ``DATA`` ascii, binary or binary_compressed; ``stamp`` in nanoseconds.

    https://pointclouds.org/documentation/tutorials/pcd_file_format.html; fields named ``_`` are
    padding. DatasetError if it is not understood, cut off, or needs a missing package.
    """
    data = _read_bytes(path)
    header, start = _pcd_header(path, data)
    try:
        record = _pcd_record(header)
        width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
        kind = header["DATA"][0]
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise DatasetError(f"{path}: the PCD header cannot be understood: {error!r}") from error
    body = data[start:]
    if kind == "ascii":
        body = _from_text(path, body, record)
    elif kind == "binary_compressed":
        body = _decompressed(path, body, record, width * height)
    elif kind != "binary":
        kinds = "ascii, binary or binary_compressed"
        raise DatasetError(f"{path}: PCD with DATA {kind}; expected {kinds}")
    needed = width * height * record.itemsize
    if len(body) < needed:
        raise DatasetError(
            f"{path}: {width} x {height} points of {record.itemsize} bytes need {needed} bytes, "
            f"got {len(body)}; the file is cut off"
        )
    return packed(stamp, record, height, width, body[:needed])


def read_ply(path: Path, stamp: int) -> PackedCloud:
    """The vertices of a PLY file; ``stamp`` in nanoseconds.

    DatasetError if it is not understood, cut off, or plyfile is not installed.
    """
    try:
        from plyfile import PlyData
    except ImportError as error:
        raise DatasetError(
            f'{path}: PLY needs plyfile: pip install "loam_gtsam[ply]" ({error})'
        ) from error
    try:
        vertices = np.asarray(PlyData.read(str(path), mmap=False)["vertex"].data)
    except Exception as error:  # of plyfile, or of whatever a damaged file makes it stumble over
        raise DatasetError(f"{path}: the PLY file cannot be read: {error}") from error
    return _of_structure(path, stamp, vertices)


def read_npy(path: Path, stamp: int) -> PackedCloud:
    """An array: (N, 3) or (N, 4), x y z intensity, or (N,) with named fields; ``stamp`` in ns."""
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # numpy parses the header as Python, and believes its sizes
        raise DatasetError(f"{path}: the array cannot be read: {error}") from error
    if array.dtype.names:
        return _of_structure(path, stamp, array.reshape(-1))
    if array.ndim != 2 or array.shape[1] not in (3, 4) or array.dtype.kind not in "fiu":
        raise DatasetError(
            f"{path}: expected an array of shape (N, 3) or (N, 4), or with named fields x, y, z; "
            f"got {array.dtype} of shape {array.shape}"
        )
    columns = {name: array[:, n] for n, name in enumerate(XYZI.names or ()) if n < array.shape[1]}
    records = np.zeros(len(array), XYZI)
    for name, column in columns.items():
        records[name] = column
    return _of_structure(path, stamp, records)


def _of_structure(path: Path, stamp: int, points: NDArray[Any]) -> PackedCloud:
    little = points.astype(points.dtype.newbyteorder("<"), copy=False)
    names = little.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise DatasetError(f"{path}: expected fields x, y, z; got {', '.join(names)}")
    data = np.ascontiguousarray(little).view(np.uint8).reshape(-1)
    return packed(stamp, little.dtype, 1, len(little), data)


def firing_by_firing(cloud: PackedCloud, beams: int, columns: int, source: str) -> PackedCloud:
    """Cloud as a range image, for ``beams`` x ``columns`` points that come firing by firing."""
    count = cloud.width * cloud.height
    if count != beams * columns:
        raise DatasetError(
            f"{source}: {count} points, expected {columns} firings of {beams} = {beams * columns}; "
            "times and beams follow from the order of a complete sweep"
        )
    return replace(cloud, height=columns, width=beams, row_step=beams * cloud.point_step)


def _read_bytes(path: Path) -> NDArray[np.uint8]:
    try:
        return np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise DatasetError(f"{path}: cannot read the sweep: {error}") from error


def packed(
    stamp: int, record: np.dtype[Any], height: int, width: int, data: NDArray[np.uint8]
) -> PackedCloud:
    """Cloud of ``height`` x ``width`` records of little-endian fields; ``stamp`` in nanoseconds."""
    assert record.fields is not None
    header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9))
    fields = tuple(
        Field(name, offset, _CODES[kind.str[1:]])
        for name, (kind, offset, *_) in record.fields.items()
        if kind.str[1:] in _CODES
    )
    step = record.itemsize
    return PackedCloud(header, height, width, fields, step, width * step, data)


def _pcd_header(path: Path, data: NDArray[np.uint8]) -> tuple[dict[str, list[str]], int]:
    """Lines of the header by their first word, and the byte at which the points begin."""
    header: dict[str, list[str]] = {}
    start = 0
    text = data[:4096].tobytes()
    while "DATA" not in header:
        end = text.find(b"\n", start)
        if end < 0:
            raise DatasetError(f"{path}: no PCD file: expected a line DATA in its header")
        words = text[start:end].decode("ascii", errors="replace").split()
        start = end + 1
        if words and words[0] in _PCD_KEYS:
            header[words[0]] = words[1:]
    return header, start


def _pcd_record(header: dict[str, list[str]]) -> np.dtype[Any]:
    names, kinds, sizes = header["FIELDS"], header["TYPE"], header["SIZE"]
    counts = header.get("COUNT", ["1"] * len(names))
    layout: list[tuple[Any, ...]] = []
    columns = zip(names, kinds, sizes, counts, strict=True)
    for number, (name, kind, size, count) in enumerate(columns):
        base = f"<{ {'F': 'f', 'I': 'i', 'U': 'u'}[kind] }{int(size)}"
        padding = name == "_" or int(count) != 1
        layout.append((f"_{number}", base, (int(count),)) if padding else (name, base))
    return np.dtype(layout)


def _from_text(path: Path, data: NDArray[np.uint8], record: np.dtype[Any]) -> NDArray[np.uint8]:
    try:
        rows = np.loadtxt(data.tobytes().decode("ascii").splitlines(), dtype=record, ndmin=1)
    except ValueError as error:
        raise DatasetError(f"{path}: the points cannot be read: {error}") from error
    return rows.view(np.uint8).reshape(-1)


def _decompressed(
    path: Path, data: NDArray[np.uint8], record: np.dtype[Any], count: int
) -> NDArray[np.uint8]:
    """``count`` records from a compressed body, in which each field's values lie together."""
    try:
        import lzf
    except ImportError as error:
        needs = 'DATA binary_compressed needs python-neo-lzf: pip install "loam_gtsam[pcd]"'
        raise DatasetError(f"{path}: PCD with {needs}") from error
    needed = count * record.itemsize
    compressed, size = np.frombuffer(data[:8].tobytes().ljust(8, b"\0"), "<u4").tolist()
    columns = b""
    if size == needed:
        with suppress(ValueError, MemoryError):
            columns = lzf.decompress(data[8 : 8 + compressed].tobytes(), size) or b""
    if len(columns) != needed:
        raise DatasetError(
            f"{path}: {count} points of {record.itemsize} bytes cannot be unpacked from "
            f"{len(data)} bytes; the file is cut off or damaged"
        )
    rows = np.empty(count, record)
    start = 0
    for name in record.names or ():
        rows[name] = np.frombuffer(columns, record[name], count, start)
        start += count * record[name].itemsize
    return rows.view(np.uint8).reshape(-1)

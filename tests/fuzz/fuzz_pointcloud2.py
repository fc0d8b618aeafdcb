"""Coverage-guided fuzzing of the PointCloud2 decoder, and of what a sweep goes through next.

python tests/fuzz/fuzz_pointcloud2.py -max_total_time=300 -max_len=4096 corpus_pointcloud2
python tests/fuzz/fuzz_pointcloud2.py --show findings/0123456789ab
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import atheris

with atheris.instrument_imports(include=["loam_gtsam"]):
    from harness import fuzz

    from loam_gtsam.config import Config
    from loam_gtsam.datasets.decode.pointcloud2 import (
        RING_FIELDS,
        TIME_FIELDS,
        decode_with_times,
        describe_fields,
    )
    from loam_gtsam.frontend.features import extract_features
    from loam_gtsam.types import DatasetError, LoamError

import numpy as np

NAMES = ["x", "y", "z", *RING_FIELDS, *TIME_FIELDS, "intensity", ""]
CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
SPANS = {"s": 0.1, "ms": 100.0, "us": 1e5, "ns": 1e8}
CONFIG = Config()


def number(provider: Any, usual: int) -> int:
    """The usual value, a near one, or any that a message can hold."""
    kind = provider.ConsumeIntInRange(0, 15)
    if kind == 0:
        return int(provider.ConsumeUInt(4))
    return usual + (provider.ConsumeIntInRange(-3, 3) if kind == 1 else 0)


def message(provider: Any) -> Any:
    """A message that is sound in most of its parts."""
    stamp = SimpleNamespace(
        sec=provider.ConsumeIntInRange(-(2**31), 2**32 - 1), nanosec=provider.ConsumeUInt(4)
    )
    fields, columns, step = [], {}, 0
    count = provider.ConsumeIntInRange(0, 200)
    names = ["x", "y", "z"] if provider.ConsumeIntInRange(0, 15) else []
    names += [provider.PickValueInList(NAMES) for _ in range(provider.ConsumeIntInRange(0, 3))]
    for name in names:
        usual = 7 if name in ("x", "y", "z") else provider.ConsumeIntInRange(1, 8)
        datatype = number(provider, usual)
        fields.append(
            SimpleNamespace(
                name=name, offset=number(provider, step), datatype=datatype,
                count=number(provider, 1),
            )
        )  # fmt: skip
        columns[f"{len(fields)}"] = CODES.get(datatype, "f4")
        step += np.dtype(columns[f"{len(fields)}"]).itemsize
    layout = np.dtype({"names": list(columns), "formats": list(columns.values())})
    rows = np.zeros(count, layout)
    angles = np.linspace(0.0, 2.0 * np.pi, count)
    for field, key in zip(fields, columns, strict=True):
        values: Any = np.arange(count) % 16
        if field.name in ("x", "y", "z"):
            values = {"x": 10 * np.cos(angles), "y": 10 * np.sin(angles)}.get(field.name, 0.1)
        elif field.name in TIME_FIELDS:
            span = SPANS[provider.PickValueInList(list(SPANS))]
            base = provider.PickValueInList([0.0, -span, 10.0 * span, 1.7e10 * span])
            values = base + np.linspace(0.0, span, count)
        with np.errstate(all="ignore"):
            rows[key] = values if layout[key].kind == "f" else np.int64(values).astype(layout[key])
    height = provider.PickValueInList([1, 1, 2, 4, 16])
    big = provider.ConsumeBool()
    width = number(provider, count // height)
    point_step, row_step = number(provider, layout.itemsize), 0
    if provider.ConsumeBool():
        row_step = number(provider, layout.itemsize * (count // height))
    data = bytearray(rows.tobytes())
    for _ in range(provider.ConsumeIntInRange(0, 8)):
        if data:
            at = provider.ConsumeIntInRange(0, len(data) - 1)
            new = provider.ConsumeBytes(8)
            data[at : at + len(new)] = new
    if not provider.ConsumeIntInRange(0, 7):
        data = bytearray(provider.ConsumeBytes(4096))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="lidar"),
        height=number(provider, height),
        width=width,
        fields=fields,
        is_bigendian=big,
        point_step=point_step,
        row_step=row_step,
        data=np.frombuffer(bytes(data), np.uint8),
        is_dense=True,
    )


def decode(data: bytes) -> None:
    """Decode twice, the second time as a loader does with the decision of the first sweep."""
    provider = atheris.FuzzedDataProvider(data)
    options = {
        "time_field": provider.PickValueInList([None, None, None, "none", "t", "time"]),
        "time_unit": provider.PickValueInList([None, None, "s", "ms", "us", "ns"]),
        "stamp_is": provider.PickValueInList([None, None, "start", "middle", "end"]),
    }
    decision = None
    for _ in range(2):
        sweep = message(provider)
        describe_fields(sweep)
        try:
            decoded = decode_with_times(sweep, decision=decision, **options)
        except DatasetError:
            continue
        decision = decoded.decision
        if decision is not None:
            str(decision)
        try:
            extract_features(decoded.scan, CONFIG)
        except LoamError:
            continue


if __name__ == "__main__":
    fuzz(decode)

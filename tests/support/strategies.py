"""Hypothesis strategies for what enters the package: sweeps, IMU streams, configurations, bytes."""

from __future__ import annotations

from typing import Annotated, Any, get_args

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from pydantic.fields import FieldInfo

from loam_gtsam.config import Config, Section
from loam_gtsam.types import ImuSamples, Scan

WILD = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-30, 1e30, 3e38, -3e38, 121.0, 1e6]
"""Coordinates that no lidar measured."""
FEW = settings(max_examples=max(settings.default.max_examples // 4, 1))
"""For tests that take long."""
START = 1_700_000_000_000_000_000


def generators() -> st.SearchStrategy[np.random.Generator]:
    """Random generators that hypothesis can repeat and shrink to seed 0."""
    return st.integers(0, 2**32 - 1).map(np.random.default_rng)


def stamps(near: int = START) -> st.SearchStrategy[int]:
    """Nanoseconds: before a moment, at the ends of what a message can say, and beyond."""
    absurd = st.sampled_from([0, 1, -1, 2**31, 2**32 * 10**9, -(2**61), 2**61, 2**62])
    return st.integers(near - 10**9, near - 1) | absurd


@st.composite
def scans(draw: st.DrawFn, near: int = START) -> Scan:
    """Sweeps of a turning lidar in a box, some of whose values were replaced by hostile ones."""
    rng = draw(generators())
    beams = draw(st.sampled_from([1, 2, 16, 300]))
    columns = draw(st.sampled_from([0, 1, 12, 60]))
    count = beams * columns if beams < 300 else columns
    azimuth = -2.0 * np.pi * np.repeat(np.arange(columns), beams)[:count] / max(columns, 1)
    elevation = np.radians(np.tile(np.linspace(-15.0, 15.0, beams), columns)[:count])
    rays = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
         np.sin(elevation)], axis=1
    )  # fmt: skip
    scale = np.min(np.array([8.0, 5.0, 1.5]) / np.maximum(np.abs(rays), 1e-9), axis=1)
    points = (rays * scale[:, None]).astype(draw(st.sampled_from([np.float32, np.float64])))
    for _ in range(draw(st.integers(0, 3))):
        if count == 0:
            break
        rows = rng.random(count) < draw(st.sampled_from([0.01, 0.3, 1.0]))
        kind = draw(st.sampled_from(["wild", "axis", "same", "noise"]))
        if kind == "wild":
            points[rows] = draw(st.sampled_from(WILD))
        elif kind == "axis":
            points[rows, draw(st.integers(0, 2))] = draw(st.sampled_from(WILD))
        elif kind == "same":
            points[rows] = points[0]
        else:
            points[rows] += rng.normal(0.0, draw(st.sampled_from([0.01, 5.0])), (rows.sum(), 3))
    return Scan(
        points=points,
        stamp=draw(stamps(near)),
        times=draw(_times(count, rng)),
        rings=draw(_rings(count, beams)),
        span=draw(st.sampled_from([None, None, (0.0, 0.1), (0.1, 0.0), (0.0, 0.0), (-1e9, 1e9)])),
        rows=beams if count and count % beams == 0 and draw(st.booleans()) else 0,
    )


@st.composite
def _times(draw: st.DrawFn, count: int, rng: np.random.Generator) -> Any:
    """None, seconds as they should be, or not."""
    kind = draw(st.sampled_from(["none", "good", "good", "zero", "back", "huge", "nan", "some"]))
    if kind == "none":
        return None
    times = np.linspace(0.0, 0.1, count)
    if kind == "zero":
        times[:] = 0.0
    elif kind == "back":
        times = times[::-1].copy()
    elif kind == "huge":
        times *= draw(st.sampled_from([1e3, 1e9, 1e300]))
    elif kind == "nan":
        times[:] = np.nan
    elif kind == "some":
        times[rng.random(count) < 0.02] = draw(st.sampled_from(WILD))
    with np.errstate(over="ignore"):
        return times.astype(draw(st.sampled_from([np.float32, np.float64])))


@st.composite
def _rings(draw: st.DrawFn, count: int, beams: int) -> Any:
    """None, beam numbers in either order, constant, or no beam numbers at all."""
    kind = draw(st.sampled_from(["none", "good", "good", "down", "same", "many", "wild"]))
    if kind == "none":
        return None
    rings = np.arange(count) % beams
    if kind == "down":
        rings = beams - 1 - rings
    elif kind == "same":
        rings[:] = 0
    elif kind == "many":
        rings = np.arange(count)
    dtype = np.dtype(draw(st.sampled_from(["u1", "i1", "u2", "i4", "u4", "i8", "u8"])))
    rings = rings.astype(dtype)
    if kind == "wild" and count:
        rings[:: draw(st.sampled_from([1, 7]))] = draw(
            st.sampled_from([np.iinfo(dtype).min, np.iinfo(dtype).max])
        )
    return rings


@st.composite
def imu_streams(draw: st.DrawFn, start: int = START) -> ImuSamples:
    """A still IMU with gaps, repeats, disorder, quaternions of any length, and hostile values."""
    rng = draw(generators())
    count = draw(st.sampled_from([0, 1, 2, 30, 400]))
    moments = start - 10**8 + np.round(np.linspace(0.0, 2e9, count)).astype(np.int64)
    orientation = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    orientation *= draw(st.sampled_from([1.0, 1.0, 3.0, 1e-9, 1e200]))
    gyro = rng.normal(0.0, draw(st.sampled_from([1e-3, 5.0])), (count, 3))
    acceleration = rng.normal(0.0, 0.01, (count, 3)) + np.array([0.0, 0.0, 9.81])
    for _ in range(draw(st.integers(0, 3))):
        kind = draw(st.sampled_from(["gap", "repeat", "shuffle", "quaternion", "values", "stamps"]))
        rows = rng.random(count) < draw(st.sampled_from([0.02, 0.5, 1.0]))
        value = draw(st.sampled_from([*WILD, 1e300]))
        if kind == "gap":
            moments[count // 2 :] += draw(st.sampled_from([10**9, 2**61]))
        elif kind == "repeat":
            moments[rows] = moments[0] if count else 0
        elif kind == "shuffle":
            moments = rng.permutation(moments)
        elif kind == "quaternion":
            orientation[rows] = value
        elif kind == "values":
            gyro[rows, 0] = acceleration[rows, 2] = value
        else:
            moments[rows] = draw(st.sampled_from([0, -(2**62), 2**62, 2**63 - 1, -(2**63)]))
    return ImuSamples(moments, orientation if draw(st.booleans()) else None, gyro, acceleration)


def configs(**fixed: Any) -> st.SearchStrategy[Config]:
    """Valid configurations: every number within its bounds, every choice; read off the classes.

    Sections in ``fixed`` are taken as they are.
    """
    sections = {
        name: st.just(fixed[name]) if name in fixed else _section(type(item.default))
        for name, item in Config.model_fields.items()
    }
    return st.fixed_dictionaries(sections).map(_config)


def _config(sections: dict[str, Any]) -> Config:
    matching, solver = sections["matching"], sections["solver"]
    if 0 < matching.max_edges + matching.max_planes < solver.min_matches:
        sections["matching"] = matching.changed(max_planes=0)  # no limit
    return Config(**sections)


def _section(section: type[Section]) -> st.SearchStrategy[Section]:
    values = {
        name: st.just(field.default) | _value(field) for name, field in section.model_fields.items()
    }
    return st.fixed_dictionaries(values).map(lambda found: section(**_in_order(section, found)))


def _in_order(section: type[Section], values: dict[str, Any]) -> dict[str, Any]:
    return values | {one: min(values[one], values[two]) for one, two in section.in_order}


def _value(field: FieldInfo) -> st.SearchStrategy[Any]:
    if isinstance(field.default, tuple):
        entries = get_args(field.annotation)
        if Ellipsis in entries:  # rows, any number of them
            row = st.tuples(*map(st.from_type, get_args(get_args(entries[0])[0])))
            return st.lists(row, max_size=3).map(tuple)
        return st.tuples(*map(st.from_type, entries))
    kinds = get_args(field.annotation) if field.default is None else ()
    one = next((kind for kind in kinds if kind is not type(None)), field.annotation)
    return st.from_type(Annotated[one, *field.metadata, ""])  # type: ignore[misc]


Step = tuple[str, float, int, int]
"""What goes wrong with the bytes of a file: kind, place (share of the length), size, number."""


STEP_KINDS = ["cut", "flip", "number", "remove", "repeat", "noise", "zero"]
STEP_SIZES = [1, 2, 4, 8, 100, 5000]
STEP_NUMBERS = [0, 1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63]
TOKENS = ["nan", "inf", "-1", "1e400", "1e9999999", "-1e30", "1e18", "9" * 40, "9" * 5011, "", "x",
          str(2**63), "\x00", "#", "0001-01-01 00:00:00.1", "9999-12-31 23:59:60"]  # fmt: skip
"""Words that take the place of others in texts."""


def mutations() -> st.SearchStrategy[list[Step]]:
    """What :func:`mutated` does to a file."""
    step = st.tuples(
        st.sampled_from(STEP_KINDS),
        st.floats(0.0, 1.0, exclude_max=True),
        st.sampled_from(STEP_SIZES),
        st.sampled_from(STEP_NUMBERS) | st.integers(0, 255),
    )
    return st.lists(step, min_size=1, max_size=4)


def replaced(text: str, replacements: list[tuple[float, str]]) -> bytes:
    """A text in which words, at shares of their number, were replaced."""
    words = text.replace(",", " , ").replace("\n", " \n ").split(" ")
    for place, token in replacements:
        words[int(place * len(words))] = token
    return " ".join(words).replace(" , ", ",").replace(" \n ", "\n").encode("latin1")


def mutated(data: bytes, steps: list[Step]) -> bytes:
    """The bytes of a file after something has gone wrong with them."""
    mutant = bytearray(data)
    for kind, place, size, number in steps:
        at = int(place * len(mutant))
        if kind == "cut":
            del mutant[at:]
        elif kind == "flip" and mutant:
            mutant[at] ^= 1 << number % 8
        elif kind == "number":
            raw = number.to_bytes(8, "little")[:size]
            mutant[at : at + len(raw)] = raw
        elif kind == "remove":
            del mutant[at : at + size]
        elif kind == "repeat":
            mutant[at:at] = mutant[at : at + size]
        elif kind == "noise":
            mutant[at : at + size] = np.random.default_rng(number).bytes(size)
        elif kind == "zero":
            mutant[at : at + size] = bytes(size)
    return bytes(mutant)

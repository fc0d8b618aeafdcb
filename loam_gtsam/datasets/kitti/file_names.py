"""Which files of a folder are its sweeps, in which order, and what the numbers in names say."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from loam_gtsam.datasets.decode import tables
from loam_gtsam.types import IntArray

_NUMBER = re.compile(r"(\d+(?:\.\d+)?)")
_STRAYS = 0.25
"""Share of the files, at most, that are no sweeps if they alone are named otherwise."""
_UNITS = {13: ("ms", 10**6), 16: ("us", 10**3), 19: ("ns", 1)}
"""Digits of a whole number that is a time since 1970, until 2286: its unit, and that in ns."""
_SECONDS_DIGITS = 10
"""Digits before the point of a time since 1970 in seconds, likewise."""
_STEPS_NS = 20_000_000, 2_000_000_000
"""Nanoseconds from a sweep to the next, half of the times, for numbers to be stamps."""
_SLOWEST = _STEPS_NS[1] // tables.DEFAULT_PERIOD_NS  # numbers from a sweep to the next, likewise
_ASSUMED = "no times.txt: 10 Hz assumed"


def in_order(files: Sequence[Path]) -> list[Path]:
    """By the numbers in the names where all else in these is the same (``scan_9, scan_10``)."""
    parts = {file: _NUMBER.split(file.stem) for file in files}
    if len({tuple(part[::2]) for part in parts.values()}) == 1:
        return sorted(files, key=lambda file: ([Decimal(n) for n in parts[file][1::2]], file.name))
    return sorted(files, key=_by_name)


def without_strays(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """The files named alike but for numbers, if they are the great majority, and the others.

    A map beside numbered sweeps is none of them. All and none without such a majority.
    """
    patterns = {file: tuple(_NUMBER.split(file.stem)[::2]) for file in files}
    usual, count = Counter(patterns.values()).most_common(1)[0]
    if len(files) - count > _STRAYS * len(files):
        return list(files), []
    others = [file for file in files if patterns[file] != usual]
    return [file for file in files if patterns[file] == usual], others


def stamps_of_names(files: Sequence[Path], facts: dict[str, str], problems: list[str]) -> IntArray:
    """Nanoseconds of sweeps without a file of stamps: their names are times, count, or are neither.

    ``facts`` or ``problems`` say which.
    """
    columns = list(zip(*(_NUMBER.split(file.stem)[1::2] for file in files), strict=False))
    for words in reversed(columns):
        if (found := _as_times(words)) is not None:
            facts["stamps from"] = f"the names of the files, {found[1]}"
            return found[0]
    counting = [words for words in columns if len(set(words)) > 1]
    if len(counting) == 1 and (numbers := _as_count(counting[0])) is not None:
        steps = np.diff(numbers)
        if (steps > 1).any():
            missing = int((steps - 1).sum())
            problems.append(
                f"{_ASSUMED}, and the names count the sweeps: stamps are their numbers, "
                f"{counting[0][0]} to {counting[0][-1]}, times 0.1 s, for {missing} of which there "
                "is no file; if that is not so, a times.txt with a line for each file tells"
            )
            return numbers * tables.DEFAULT_PERIOD_NS
        problems.append(_ASSUMED)
    elif counting:
        problems.append(
            f"{_ASSUMED}; the numbers in the names of the files ({files[0].name} to "
            f"{files[-1].name}) neither count the sweeps nor are times since 1970 that ascend by "
            "0.02 to 2 s: if they tell when the sweeps were measured, write it to times.txt"
        )
    else:
        problems.append(_ASSUMED)
    return np.arange(len(files), dtype=np.int64) * tables.DEFAULT_PERIOD_NS


def _as_times(words: Sequence[str]) -> tuple[IntArray, str] | None:
    """Numbers in the names as times since 1970 (ns), and their unit; None if they are not."""
    before = {len(word.partition(".")[0]) for word in words}
    (digits,) = before if len(before) == 1 else (0,)
    if any(word.startswith("0") for word in words):
        return None
    try:
        if digits == _SECONDS_DIGITS and any("." in word for word in words):
            listed, unit = [tables.seconds_to_ns(word) for word in words], "s"
        elif digits in _UNITS:
            unit, nanoseconds = _UNITS[digits]
            listed = [tables.whole_number(word, nanoseconds) for word in words]
        else:
            return None
    except ValueError:
        return None
    stamps = np.array(listed, np.int64)
    steps = np.diff(stamps)
    ascend = len(steps) > 0 and steps.min() > 0
    usual = ascend and _STEPS_NS[0] <= np.median(steps) <= _STEPS_NS[1]
    return (stamps, unit) if usual else None


def _as_count(words: Sequence[str]) -> IntArray | None:
    """Numbers in the names as those of sweeps, of which some may have no file; None if not."""
    try:
        listed = [tables.whole_number(word) for word in words]
        tables.whole_number(words[-1], tables.DEFAULT_PERIOD_NS)
    except ValueError:
        return None
    numbers = np.array(listed, np.int64)
    steps = np.diff(numbers)
    return numbers if steps.min() > 0 and np.median(steps) <= _SLOWEST else None


def _by_name(file: Path) -> tuple[int, str]:
    return (int(file.stem) if file.stem.isdecimal() else -1, file.name)

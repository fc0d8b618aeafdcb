"""The errors of the package; :mod:`loam_gtsam.types` hands them on."""

from __future__ import annotations

import copyreg
import difflib
import logging
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_log = logging.getLogger(__name__)
DAMAGED: tuple[type[Exception], ...] = (
    OSError, EOFError, ValueError, LookupError, TypeError, ArithmeticError, MemoryError,
    RuntimeError, SyntaxError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What numpy and zipfile raise at a file of arrays that is damaged, or holds something else."""
_LONGEST = 80  # characters of a name that is looked for among others
_INDETERMINATE = "Indeterminate linear system"  # how a RuntimeError of GTSAM begins


class LoamError(Exception):
    """Base of every error this package raises on purpose; processes can hand one to another."""

    def __reduce__(self) -> tuple[Any, ...]:
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class ConfigError(LoamError, ValueError):
    """A configuration has an unknown key, a wrong type or a value out of range."""


class InputError(LoamError, ValueError):
    """An array handed to the library has the wrong shape, dtype or content."""


class DatasetError(LoamError):
    """A file, folder, topic or field could not be read or understood."""


class OutputError(LoamError):
    """A file or a picture could not be written."""


def check_kind(value: object, kind: type, name: str, how: str) -> None:
    """InputError for a value that is not of a class; ``how`` says what makes one."""
    if not isinstance(value, kind):
        wanted = ("gtsam." if kind.__module__.startswith("gtsam.") else "") + kind.__name__
        wanted = f"an {wanted}" if wanted[0] in "AEIOU" else f"a {wanted}"
        raise InputError(f"{name}: expected {wanted}, got {type(value).__name__}; {how}")


def check_all(values: object, kind: type, name: str, how: str) -> None:
    """InputError for anything but a sequence of values of a class; ``how`` says what makes one."""
    check_kind(values, Sequence, name, how)
    assert isinstance(values, Sequence)  # for the type checker
    for number, value in enumerate(values):
        check_kind(value, kind, f"{name}[{number}]", how)


def is_number(value: object) -> bool:
    """Whether it is a real number, infinite at most."""
    return isinstance(value, Real) and not math.isnan(value)


def is_whole(value: object) -> bool:
    """Whether it is a whole number, and no flag."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def as_path(value: object, name: str = "path") -> Path:
    """A path; InputError for anything but a text or a path."""
    if not isinstance(value, (str, os.PathLike)):
        raise InputError(f"{name}: expected a path, got {type(value).__name__}")
    return Path(value)


def check_count(value: object, name: str, *, optional: bool = False) -> None:
    """InputError for anything but a whole number, not negative; None is one if it is optional."""
    counted = is_whole(value) and value >= 0  # type: ignore[operator]
    if not (counted or (optional and value is None)):
        wanted = "a whole number, 0 or more" + (", or None" if optional else "")
        raise InputError(f"{name}: expected {wanted}, got {value!r}")


def check_nanoseconds(value: object, name: str = "stamp") -> None:
    """InputError for anything but a whole number."""
    if not is_whole(value):
        raise InputError(f"{name}: expected integer nanoseconds, got {value!r}")


def check_number(value: object, name: str) -> None:
    """InputError for anything but a finite number."""
    if not (is_number(value) and math.isfinite(value)):  # type: ignore[arg-type]
        raise InputError(f"{name}: expected a finite number, got {value!r}")


def check_part(part: object, name: str, wanted: str, *methods: str) -> None:
    """InputError for a part of a user's own that is a class, or lacks methods; None is no part."""
    if isinstance(part, type):
        raise InputError(f"{name}: expected {wanted}, got the class {part.__name__}")
    missing = [method for method in methods if not callable(getattr(part, method, None))]
    if part is not None and missing:
        lacks = "" if "__call__" in missing else f" without {' and '.join(missing)}"
        raise InputError(f"{name}: expected {wanted}, got {type(part).__name__}{lacks}")


def are_two_numbers(value: object) -> bool:
    """Whether it is a pair of numbers that numpy understands."""
    try:
        numbers = np.asarray(value)
    except ValueError:
        return False
    return numbers.shape == (2,) and numbers.dtype.kind in "iuf"


def _check_unmasked(value: object, name: str) -> None:
    """InputError for an array of ``numpy.ma``, whose mask would be lost."""
    if isinstance(value, np.ma.MaskedArray):
        raise InputError(
            f"{name}: expected an array without a mask, got a numpy.ma.MaskedArray; leave out what "
            "is masked, or give .filled(np.nan) where NaN is allowed"
        )


def check_array(
    value: object, name: str, shape: tuple[int | str, ...], numbers: str = "floats"
) -> None:
    """Raise InputError, ``name: expected (N, 3) floats, got ...``, unless an array has a shape.

    A letter in ``shape`` stands for any length, as in ``("N", 3)``. If the text ``numbers`` names
    integers, floats or flags, the array must hold these.
    """
    _check_unmasked(value, name)
    named = {"integer": "iu", "float": "f", "flag": "b"}
    kinds = next((kind for word, kind in named.items() if word in numbers), "fiu")
    got = type(value).__name__
    if isinstance(value, np.ndarray):
        same = [n == m for n, m in zip(shape, value.shape, strict=False) if not isinstance(n, str)]
        if value.dtype.kind in kinds and value.ndim == len(shape) and all(same):
            return
        got = f"shape {value.shape} of {value.dtype}"
        if shape[1:] == (3,) and value.ndim == 2 and value.shape[1] > 3:
            got += "; [:, :3] takes the first three columns"
    wanted = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    raise InputError(f"{name}: expected ({wanted}) {numbers}, got {got}")


def as_one_array(value: ArrayLike, name: str) -> NDArray[Any]:
    """What numpy makes of it; InputError if that is no array, or one with a mask."""
    _check_unmasked(value, name)
    try:
        return np.asarray(value)
    except ValueError as error:
        raise InputError(f"{name}: expected an array, got {error}") from error


def as_stamps(value: ArrayLike, name: str) -> NDArray[np.int64]:
    """(N,) int64 nanoseconds; InputError for anything but integers."""
    stamps = as_one_array(value, name)
    if not stamps.size:
        stamps = stamps.astype(np.int64)
    elif stamps.dtype == np.uint64 and stamps.max() > np.iinfo(np.int64).max:
        raise InputError(f"{name}: expected nanoseconds of 63 bits, got {stamps.max()}")
    try:
        check_array(stamps, name, ("N",), "integer nanoseconds")
    except InputError as error:
        raise InputError(
            f"{error}; np.round(seconds * 1e9).astype(np.int64) makes them of seconds"
        ) from None
    return stamps.astype(np.int64, copy=False)


def nearest(name: object, known: Iterable[str], listing: bool = True) -> str:
    """The end of a message about an unknown name: which one may be meant, and all there are."""
    asked, names = name[:_LONGEST] if isinstance(name, str) else "", list(known)
    close = difflib.get_close_matches(asked, names, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return hint + (f" (known: {', '.join(sorted(names)) or 'none'})" if listing else "")


class PartError(LoamError):
    """A part of a user's own raised an exception, which is the ``__cause__``.

    Attributes
    ----------
    part : the name of the part: ``solver``, ``extra_factors``, ``priors`` of a sweep,
        ``loop_closer``, ``odometry``, ``features``, ``observe``, ``on_frame``, ``graph`` for
        factors in the pose graph, or ``factors`` for those of ``refine``
    indeterminate : whether GTSAM found a linear system that does not determine its variables
    """

    def __init__(self, part: str, code: object, error: Exception) -> None:
        self.part, text = part, str(error).strip()
        self.indeterminate = isinstance(error, RuntimeError) and text.startswith(_INDETERMINATE)
        if self.indeterminate:
            text = (
                f"{text.splitlines()[0]} of GTSAM: the factors do not determine a variable; give "
                "it a prior, or check the noise models"
            )
        kind = type(error).__name__
        super().__init__(f"{part} of your own ({_name(code)}) raised {kind}: {text}")


@contextmanager
def own_code(part: str, code: object) -> Iterator[None]:
    """A block in which a user's code runs: what it raises becomes a :class:`PartError`.

    An error of this package keeps its type and gets a note that names the part. ``code`` is the
    user's object or function, or says in words what it is; with one of this package, or None,
    errors stay as they are.
    """
    try:
        yield
    except PartError:
        raise
    except Exception as error:
        if not is_own(code):
            raise
        if isinstance(error, LoamError):
            error.add_note(f"raised in {part} of your own ({_name(code)})")
            raise
        raise PartError(part, code, error) from error


def is_own(code: object) -> bool:
    """Whether an object or a function is a user's own, and none of this package."""
    while isinstance(code, partial):
        code = code.func
    of = code if hasattr(code, "__qualname__") else type(code)
    package = __name__.partition(".")[0]
    return code is not None and str(of.__module__).partition(".")[0] != package


class PartFaults:
    """What is done about exceptions in parts of a user's own, by ``parts.on_error``.

    With ``stop`` they are raised; with ``continue`` the log has the first one of each part.
    """

    def __init__(self, on_error: str) -> None:
        self._stop = on_error == "stop"
        self._told: set[str] = set()

    def reset(self) -> None:
        """Begin another run: the log has the first exception of each part again."""
        self._told.clear()

    def take(self, error: LoamError) -> None:
        """Raise an exception, or log it if it is the first of its part."""
        if self._stop:
            raise error
        part = error.part if isinstance(error, PartError) else type(error).__name__
        if part not in self._told:
            self._told.add(part)
            _log.warning("%s; the run goes on, and does not say so again", error)

    @contextmanager
    def forgiven(self) -> Iterator[None]:
        """A block without which a frame is complete."""
        try:
            yield
        except LoamError as error:
            self.take(error)


def _name(code: object) -> str:
    if isinstance(code, str):
        return code
    while isinstance(code, partial):
        code = code.func
    return str(getattr(code, "__qualname__", type(code).__qualname__))


class SweepFault(StrEnum):
    """What was wrong with a sweep that was not used."""

    UNREADABLE = "unreadable"
    """The file or message could not be read."""
    EMPTY = "empty"
    """The sweep has no points at all."""
    NOT_FINITE = "not_finite"
    """Too few points are finite numbers, or some features are not."""
    TOO_FEW_POINTS = "too_few_points"
    """Too few points, or too few within range."""
    BAD_TIMES = "bad_times"
    """The times of the points are missing, or no seconds within one sweep."""
    BAD_RINGS = "bad_rings"
    """The beams cannot be told apart."""
    NO_FEATURES = "no_features"
    REPEATED = "repeated"
    """The points are those of the sweep before, though the lidar moves."""
    TOO_SOON = "too_soon"
    """The stamp follows the one before within a quarter of the usual interval, or of a sweep."""
    DUPLICATE_STAMP = "duplicate_stamp"
    """The stamp is that of the sweep before (:mod:`loam_gtsam.frontend.stamp_check`)."""
    LATE = "late"
    """A later sweep was used already."""
    STAMP_BACK = "stamp_back"
    """The stamp is so much earlier than that of the last sweep used that it must be wrong."""
    STAMP_AHEAD = "stamp_ahead"
    """The stamp is so much later than that of the last sweep used that it is doubted."""
    CLOCK_SET_BACK = "clock_set_back"
    """Several sweeps in a row are earlier than the last one used; only a reset helps."""
    PART_FAILED = "part_failed"
    """A part of a user's own raised an exception, and ``parts.on_error`` is ``continue``."""
    CLOCK_SET_AHEAD = "clock_set_ahead"
    """Several sweeps in a row are far ahead; from the next one on their clock is followed."""


class SweepError(LoamError):
    """One sweep cannot be used; the mapper turns it into a frame status and goes on.

    ``fault`` says what is wrong with the sweep; None if something else is.
    """

    def __init__(self, message: str, fault: SweepFault | None = None) -> None:
        super().__init__(message)
        self.fault = fault

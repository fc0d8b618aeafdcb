"""The errors of the package; :mod:`loam_gtsam.types` hands them on."""

from __future__ import annotations

from enum import StrEnum


class LoamError(Exception):
    """Base of every error this package raises on purpose."""


class ConfigError(LoamError, ValueError):
    """A configuration has an unknown key, a wrong type or a value out of range."""


class InputError(LoamError, ValueError):
    """An array handed to the library has the wrong shape, dtype or content."""


class DatasetError(LoamError):
    """A file, folder, topic or field could not be read or understood."""


class OutputError(LoamError):
    """A file or a picture could not be written."""


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
    CLOCK_SET_AHEAD = "clock_set_ahead"
    """Several sweeps in a row are far ahead; from the next one on their clock is followed."""


class SweepError(LoamError):
    """One sweep cannot be used; the mapper turns it into a frame status and goes on.

    ``fault`` says what is wrong with the sweep; None if something else is.
    """

    def __init__(self, message: str, fault: SweepFault | None = None) -> None:
        super().__init__(message)
        self.fault = fault

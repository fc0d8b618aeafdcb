"""Clouds that come one by one: what their times mean is decided from those that have come."""

from __future__ import annotations

from typing import Any, Unpack

from loam_gtsam.datasets.decode.point_times import TimeDecision, check_time_options
from loam_gtsam.datasets.decode.pointcloud2 import TimeOptions, decode_with_times
from loam_gtsam.types import LoamError, Scan

_OPEN = 10
"""Sweeps that decide for themselves: near time zero an absolute time can still look like an
offset. A bag decides once, on the last of as many."""


class CloudStream:
    """Decodes PointCloud2 messages in the order in which they come.

    Parameters
    ----------
    options : ``time_field``, ``time_unit``, ``stamp_is``: see
        :func:`loam_gtsam.datasets.decode.pointcloud2.decode_pointcloud2`

    Attributes
    ----------
    decision : how the times are read, None before the first that could be

    Raises
    ------
    DatasetError
        If an option is unknown.
    """

    def __init__(self, **options: Unpack[TimeOptions]) -> None:
        check_time_options(options.get("time_unit"), options.get("stamp_is"))
        self._options = options
        self.decision: TimeDecision | None = None
        self._decided = 0

    def decode(self, message: Any) -> Scan:
        """The next sweep.

        Raises
        ------
        DatasetError
            If its layout, a field or its times cannot be understood.
        """
        if self._decided >= _OPEN:
            return decode_with_times(message, decision=self.decision, **self._options).scan
        try:
            decoded = decode_with_times(message, **self._options)
        except LoamError:
            if self.decision is None:
                raise
            return decode_with_times(message, decision=self.decision, **self._options).scan
        if decoded.decision is not None:
            self.decision = decoded.decision
            self._decided += 1
        return decoded.scan

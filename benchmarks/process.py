"""What a run costs the process it runs in."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

_PEAK_UNIT = 1.0 if sys.platform == "darwin" else 1024.0
"""Bytes, of ``ru_maxrss`` (getrusage(2))."""


@contextmanager
def processor_clock() -> Iterator[None]:
    """The package's timings in processor time, to which the work of others does not add."""
    with mock.patch.object(time, "perf_counter", time.process_time):
        yield


def memory() -> tuple[float, float]:
    """Resident memory of this process in MB: now, and at most so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _PEAK_UNIT / 1e6
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:  # no Linux: the largest so far stands in
        return peak, peak
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, peak

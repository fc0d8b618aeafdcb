"""Fixtures shared by the tests."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path

# Before numpy is imported: the threads of workers that share two cores get in each other's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings
from support.quick import begin_quickly

# The same few examples every time; `pytest --hypothesis-profile=thorough` looks for new ones.
_slow = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
settings.register_profile(
    "default", max_examples=25, derandomize=True, deadline=None, suppress_health_check=_slow
)
settings.register_profile(
    "thorough", max_examples=2000, deadline=None, suppress_health_check=_slow, print_blob=True
)
settings.load_profile("default")


@pytest.fixture(autouse=True)
def speaking_loggers() -> None:
    """A tool that some test calls disables the loggers that exist, which other tests listen to."""
    for name, logger in logging.Logger.manager.loggerDict.items():
        if name.startswith("loam_gtsam") and isinstance(logger, logging.Logger):
            logger.disabled = False


@pytest.fixture(scope="module")
def quick_start() -> Iterator[None]:
    """For all runs of a module, also of its fixtures: see support/quick.py."""
    with pytest.MonkeyPatch.context() as patch:
        begin_quickly(patch)
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the large real and recorded data sets; tests that need it skip without it."""
    root = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get("LOAM_GTSAM_DATA", root.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no data in {folder}; set LOAM_GTSAM_DATA")
    return folder

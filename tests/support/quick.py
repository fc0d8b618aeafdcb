"""Runs that begin quickly, for tests to which the start of a run does not matter.

The first sweeps are not mapped anew with each that follows, which takes most of a short run.
"""

import pytest

from loam_gtsam.config import Config
from loam_gtsam.registration.start import Start

PREDICTED = "deskew.model=predicted"
QUICK = Config().changed(PREDICTED)
QUICK_START = ("--set", PREDICTED)
"""For the command line."""


def begin_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of any configuration, as if there was a map already: where a test gives them none."""
    monkeypatch.setattr(Start, "of_map", lambda *_: None)

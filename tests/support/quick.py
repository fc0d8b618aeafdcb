"""Runs that begin quickly, for tests to which the start of a run does not matter.

The first sweeps are not mapped anew with each that follows, which takes most of a short run.
"""

from loam_gtsam.config import Config

PREDICTED = "deskew.model=predicted"
QUICK = Config().changed(PREDICTED)
QUICK_START = ("--set", PREDICTED)
"""For the command line."""

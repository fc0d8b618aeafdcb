"""The section of the configuration on parts of a user's own."""

from __future__ import annotations

from typing import Literal

from loam_gtsam.config.base import Section, parameter


class PartsConfig(Section):
    """Parts of a user's own: solver, factors, loop closer, odometry, front end, observer."""

    on_error: Literal["stop", "continue"] = parameter("stop")
    """An exception in a part stops the run, or the log says it once and the run goes on: a sweep
    whose solver, factors or features failed is not used."""

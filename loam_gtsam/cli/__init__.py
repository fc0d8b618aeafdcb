"""The command line: the only place that prints, catches ``LoamError`` or exits."""

from __future__ import annotations


def main() -> None:
    """Entry point of ``loam-gtsam``."""
    from loam_gtsam.cli.app import app

    app(prog_name="loam-gtsam")

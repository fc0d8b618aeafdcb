"""``python -m loam_gtsam.cli`` is ``loam-gtsam``."""

from loam_gtsam.cli import main

main()

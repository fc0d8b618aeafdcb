"""LOAM's scan-to-map stage as a GTSAM factor graph."""

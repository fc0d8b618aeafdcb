"""Adjustment of all planes of the map together with the poses."""

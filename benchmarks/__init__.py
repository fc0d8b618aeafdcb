"""Accuracy and speed on known data, beside other systems: ``python -m benchmarks``."""

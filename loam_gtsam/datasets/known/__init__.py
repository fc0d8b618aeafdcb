"""Loaders of published data sets by the names of their files."""

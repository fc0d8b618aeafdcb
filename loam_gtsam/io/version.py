"""Versions of installed packages, for the records in the results."""

from importlib import metadata


def installed_version(package: str = "loam_gtsam") -> str:
    """Version of a package, ``"not installed"`` without its metadata."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"

"""What may follow on the command line: names of values, and keys of parameters."""

from __future__ import annotations

from typing import Literal, get_args, get_origin

from loam_gtsam.config.base import Section
from loam_gtsam.config.sections import SensorConfig, SolverConfig
from loam_gtsam.config.tree import PRESETS, Config

Kind = Literal["sensor", "preset", "solver", "set"]


def completions(kind: Kind, incomplete: str) -> list[str]:
    """Names that begin like this: sensors, presets, solvers, or ``SECTION.KEY=VALUE`` of ``--set``.

    A key without ``=`` is completed first, then its value if there are only a few.
    """
    if kind == "preset":
        known = list(PRESETS)
    elif kind == "set":
        known = _assignments(incomplete)
    else:
        section, key = (SensorConfig, "model") if kind == "sensor" else (SolverConfig, "method")
        known = _choices(section, key)
    return [name for name in known if name.startswith(incomplete)]


def _assignments(incomplete: str) -> list[str]:
    key, given, _ = incomplete.partition("=")
    sections = {name: type(section) for name, section in Config() if isinstance(section, Section)}
    if given:
        section, _, name = key.partition(".")
        if section not in sections or name not in sections[section].model_fields:
            return []
        return [f"{key}={value}" for value in _choices(sections[section], name)]
    return [f"{name}.{key}=" for name, section in sections.items() for key in section.model_fields]


def _choices(section: type[Section], key: str) -> list[str]:
    kind = section.model_fields[key].annotation
    if kind is bool:
        return ["true", "false"]
    return [str(value) for value in get_args(kind)] if get_origin(kind) is Literal else []

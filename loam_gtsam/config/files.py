"""Configurations as YAML and as dictionaries."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from loam_gtsam.config.base import Section, meaning, nearest, override, shown
from loam_gtsam.config.tree import PRESETS, Config
from loam_gtsam.types import ConfigError

_WIDTH = 100


def config_from_dict(data: Mapping[str, Any], source: str = "config") -> Config:
    """Build a configuration from nested mappings; absent keys keep the preset's value.

    Parameters
    ----------
    data : as in the YAML file; the optional key ``preset`` names what is overridden
    source : what to call the input in error messages

    Raises
    ------
    ConfigError
        Naming the key, its line if known, what was expected and what came.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(f"{source}: expected a mapping of sections, got {type(data).__name__}")

    def where(path: tuple[Any, ...]) -> str:
        """``file:line`` of a key if the parser kept it."""
        located: Any = data
        try:
            for key in path[:-1]:
                located = located[key]
            return f"{source}:{located.lc.key(path[-1])[0] + 1}: "
        except (AttributeError, KeyError, TypeError):
            return f"{source}: "

    name = data.get("preset", "default")
    if not isinstance(name, str) or name not in PRESETS:
        near = nearest(name, PRESETS)
        raise ConfigError(f"{where(('preset',))}unknown preset {shown(name)}{near}")
    rest = {key: value for key, value in data.items() if key != "preset"}
    return override(PRESETS[name], rest, where)


def config_to_dict(config: Config) -> dict[str, Any]:
    """Nested plain dictionaries; the inverse of :func:`config_from_dict`."""
    return config.model_dump()


def load_config(path: str | Path) -> Config:
    """Read a YAML file.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or does not fit.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error  # without the path again
        raise ConfigError(f"{path}: cannot read the configuration: {reason}") from error
    return parse_config(text, str(path))


def parse_config(text: str, source: str = "config") -> Config:
    """As :func:`load_config`, from text."""
    try:
        data = YAML(typ="rt").load(text)
    # A day 32, an endless number and deep nesting surface as whatever the parser stumbles over.
    except Exception as error:
        raise ConfigError(f"{source}: not valid YAML: {error}") from error
    return config_from_dict({} if data is None else data, source)


def dump_config(config: Config) -> str:
    """YAML text in which every key is explained by a comment."""
    yaml = YAML()
    yaml.width = _WIDTH
    out = io.StringIO()
    yaml.dump(_commented(config, 0), out)
    return out.getvalue()


def _commented(section: Section, indent: int) -> CommentedMap:
    result = CommentedMap()
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section):
            value = _commented(value, indent + 2)
        elif isinstance(value, tuple):
            value = CommentedSeq(value)
            value.fa.set_flow_style()
        result[name] = value
        text = meaning(field).replace(": ", ":\xa0")  # a label stays with what it labels
        text = textwrap.fill(text, _WIDTH - indent - 2, break_on_hyphens=False).replace("\xa0", " ")
        result.yaml_set_comment_before_after_key(name, before=text, indent=indent)
    return result

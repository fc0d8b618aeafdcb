"""Values of nested mappings, or of dotted keys, in place of those of a section."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from ruamel.yaml import YAML
from ruamel.yaml.scalarbool import ScalarBoolean

from loam_gtsam.config.base import RefusedError, Section, nearest, shown
from loam_gtsam.types import ConfigError

AnySection = TypeVar("AnySection", bound=Section)
Where = Callable[[tuple[Any, ...]], str]
"""The place of a key, given its path from the top: what an error message about it begins with."""


def override(
    section: AnySection, data: Mapping[Any, Any], where: Where, above: tuple[str, ...] = ()
) -> AnySection:
    """A section with the values of nested mappings in place of its own.

    Parameters
    ----------
    section : the section to change
    data : values by key; those of a section within it are a mapping again
    where : names the place of a key in an error message
    above : path of the section from the top

    Raises
    ------
    ConfigError
        Naming the key, its place, what was expected and what came.
    """
    known = type(section).model_fields
    values: dict[str, Any] = {}
    for key, value in data.items():
        path = (*above, key)
        if key not in known:
            name = ".".join(path) if isinstance(key, str) else shown(key)
            raise ConfigError(f"{where(path)}unknown key {shown(name)}{nearest(key, known)}")
        current = getattr(section, key)
        if not isinstance(current, Section):
            values[key] = _plain(value)
        elif isinstance(value, Mapping):
            values[key] = override(current, value, where, path)
        else:
            raise ConfigError(
                f"{where(path)}{'.'.join(path)} is a section, expected a mapping, "
                f"got {shown(value)}"
            )
    try:
        return section.changed(**values)
    except RefusedError as error:
        path = (*above, next(key for key in error.keys if key in data))
        raise ConfigError(f"{where(path)}{'.'.join(path)}: {error.reason}") from None


def _plain(value: Any) -> Any:
    """A value without what the parser keeps of the looks of a boolean, which is no bool then."""
    if isinstance(value, list):
        return [_plain(entry) if isinstance(entry, ScalarBoolean) else entry for entry in value]
    return bool(value) if isinstance(value, ScalarBoolean) else value


def with_changes(
    section: AnySection, changes: Iterable[str | Mapping[str, Any]], source: str
) -> AnySection:
    """A section with changes, all made at once and then checked.

    Parameters
    ----------
    section : the section to change
    changes : texts as ``"solver.iterations=5"``, or mappings of dotted keys to values
    source : where the changes come from, for error messages

    Raises
    ------
    ConfigError
        If a text is no key with a YAML value, or as from :func:`override`.
    """
    tree: dict[str, Any] = {}
    texts: dict[tuple[Any, ...], str] = {}
    for change in changes:
        if isinstance(change, str):
            key, value = _assignment(change, source)
            texts[tuple(key.split("."))] = change
            change = {key: value}
        _merge(tree, change)

    def where(path: tuple[Any, ...]) -> str:
        place = f"{source} {texts.get(path, '')}".strip()
        return f"{place}: " if place else ""

    return override(section, tree, where)


def _merge(tree: dict[str, Any], change: Mapping[str, Any]) -> None:
    """Put values of dotted keys into nested dictionaries."""
    for key, value in change.items():
        name, dot, rest = key.partition(".")
        if dot:
            value = {rest: value}
        if isinstance(value, Mapping):
            below = tree.get(name)
            tree[name] = below if isinstance(below, dict) else {}
            _merge(tree[name], value)
        else:
            tree[name] = value


def _assignment(text: str, source: str) -> tuple[str, Any]:
    key, separator, value = text.partition("=")
    where = f"{source} {text}".strip()
    if not separator or not key.strip():
        raise ConfigError(f"{where}: expected SECTION.KEY=VALUE")
    try:
        return key.strip(), YAML(typ="safe", pure=True).load(value)
    except Exception as error:  # a day 32 is a ValueError, deep nesting a RecursionError
        raise ConfigError(f"{where}: {value!r} is not a YAML value") from error

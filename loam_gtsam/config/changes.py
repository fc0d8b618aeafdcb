"""Values of nested mappings, or of dotted keys, in place of those of a section."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from ruamel.yaml import YAML
from ruamel.yaml.scalarbool import ScalarBoolean

from loam_gtsam.config.base import RefusedError, Section, shown
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
    values: dict[str, Any] = {}
    keys: dict[str, Any] = {}
    for key, value in data.items():
        name = key if isinstance(key, str) else shown(key)
        current = vars(section).get(name)
        if isinstance(current, Section) and isinstance(value, Mapping):
            values[name] = override(current, value, where, (*above, name))
        else:
            values[name] = _plain(value)
        keys[name] = key
    try:
        return Section.changed(section, **values)
    except RefusedError as error:
        name = next((key for key in error.keys if key in keys), error.keys[0])
        full = ".".join((*above, name))
        raise ConfigError(
            f"{where((*above, keys.get(name, name)))}{full}: {error.reason}"
        ) from None


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
    where = f"{source}: " if source else ""
    for change in changes:
        _merge(tree, _assignment(change, where) if isinstance(change, str) else change)
    return override(section, tree, lambda _: where)


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


def _assignment(text: str, where: str) -> dict[str, Any]:
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"{where}expected SECTION.KEY=VALUE, got {text!r}")
    try:
        return {key.strip(): YAML(typ="safe", pure=True).load(value)}
    except Exception as error:  # a day 32 is a ValueError, deep nesting a RecursionError
        raise ConfigError(f"{where}{text}: {value!r} is not a YAML value") from error

"""Parts of a user's own by name: ``package.module:factory``, for commands and specifications."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from os import getcwd
from typing import Any, cast

from loam_gtsam.config import Config
from loam_gtsam.pipeline import Parts
from loam_gtsam.types import ConfigError

_METHODS = {"solver": "solve", "odometry": "guess", "loop_closer": "detect"}
"""What an object must have to be this part; the others are functions."""
PARTS = tuple(Parts.__annotations__)
"""Names of the parts that can be a user's own."""


def make_parts(names: Mapping[str, str | None], config: Config) -> Parts:
    """Call the factories of parts with a configuration; names that are None are left out.

    Modules of the current folder can be imported as well. Raises ConfigError if there is no such
    factory, or it does not make such a part.
    """
    made = {part: _made(part, name, config) for part, name in names.items() if name is not None}
    return cast(Parts, made)


def is_factory(name: str) -> bool:
    """Whether a name is that of a factory: it has a colon, as names of no solver have."""
    return ":" in name


def _made(part: str, name: str, config: Config) -> Any:
    where = f"{part} {name}"
    module, _, attribute = name.partition(":")
    if not module or not attribute.isidentifier():
        raise ConfigError(f"{where}: expected PACKAGE.MODULE:FACTORY")
    here = getcwd()
    try:
        sys.path.insert(0, here)
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{where}: cannot be imported: {error}") from error
    finally:
        if here in sys.path:
            sys.path.remove(here)
    try:
        made = found(config)
    except Exception as error:
        raise ConfigError(
            f"{where}: expected a function that makes the {part} from a Config; called with one, "
            f"it raised {type(error).__name__}: {error}"
        ) from error
    method = _METHODS.get(part, "__call__")
    if not callable(getattr(made, method, None)):
        needed = "a function" if method == "__call__" else f"an object with the method {method}()"
        raise ConfigError(f"{where}: expected it to make {needed}, got {type(made).__name__}")
    return made

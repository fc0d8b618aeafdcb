"""The page "From LOAM and A-LOAM to here": every name, line and number on it is so."""

from __future__ import annotations

import csv
import importlib
import importlib.util
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from loam_gtsam import Config, preset

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/from_loam.md"
LINK = re.compile(r'\[`([\w.]+)`\]\((\S+\.py)(?: "([^"]+)")?\)')
SECTIONS = set(Config.__annotations__)


def rows(table: str) -> list[list[str]]:
    """The cells of a table beside the page."""
    with (PAGE.with_suffix("") / f"{table}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))[1:]


def shown(value: Any) -> str:
    """A value as the page writes it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return " x ".join(map(shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def value_of(name: str, config: Config) -> Any:
    """Of a key of the configuration, or of a constant of a module."""
    module, _, key = name.partition(".")
    if module in SECTIONS and hasattr(getattr(config, module), key):
        return getattr(getattr(config, module), key)
    (path,) = (ROOT / "loam_gtsam").rglob(f"{module}.py")
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return getattr(importlib.import_module(name), key)


@pytest.fixture(scope="module")
def line_of() -> Callable[..., int]:
    """What the site finds a line with."""
    spec = importlib.util.spec_from_file_location("links", ROOT / "docs/theme/links.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Callable[..., int] = module.line_of
    return found


CONSTANTS, ADDITIONS = rows("constants"), rows("additions")
LINKS = LINK.findall("\n".join([PAGE.read_text("utf-8"), *(row[5] for row in CONSTANTS)]))


@pytest.mark.parametrize(("name", "path", "words"), sorted(set(LINKS)))
def test_every_link_leads_to_a_line(
    name: str, path: str, words: str, line_of: Callable[..., int]
) -> None:
    source = (PAGE.parent / path).read_text("utf-8")
    module = Path(path).parent.name if path.endswith("__init__.py") else Path(path).stem
    assert module == name.partition(".")[0]
    line = source.splitlines()[line_of(source, name, words) - 1]
    assert (words or name.rpartition(".")[2]) in line


def test_a_line_that_is_not_there_is_an_error(line_of: Callable[..., int]) -> None:
    source = "ONE = 1\n\n\nclass Two:\n    def three(self):\n        return ONE\n"
    assert line_of(source, "module.ONE") == 1
    assert line_of(source, "module.Two.three", "ONE") == 6
    for name, words in (("module.Four", ""), ("module.Two.four", ""), ("module.Two", "four")):
        with pytest.raises(LookupError):
            line_of(source, name, words)


@pytest.mark.parametrize("row", CONSTANTS, ids=lambda row: row[3].strip("`"))
def test_every_constant_has_this_value_by_default_and_in_the_presets(row: list[str]) -> None:
    name = row[3].strip("`")
    assert row[4] == shown(value_of(name, Config()))
    for cell, system in zip(row[1:3], ("loam", "aloam"), strict=True):
        value, ours = cell.partition(" (")[0], shown(value_of(name, preset(system)))
        if value.startswith("*"):
            assert value.strip("*") != ours, f"{system}: no longer a difference"
        elif value != "—":
            assert value == ours, system


@pytest.mark.parametrize("row", CONSTANTS, ids=lambda row: row[3].strip("`"))
def test_the_line_of_a_constant_is_where_it_is_used(row: list[str]) -> None:
    name, _, words = LINK.findall(row[5])[0]
    assert words.endswith(row[3].strip("`").rpartition(".")[2]) or name == "solvers.make_solver"


@pytest.mark.parametrize("row", ADDITIONS, ids=lambda row: row[1])
def test_every_addition_has_these_values(row: list[str]) -> None:
    configs = (Config(), preset("loam"), preset("aloam"))
    assert row[2:] == [shown(value_of(row[1].strip("`"), config)) for config in configs]


def test_no_parameter_is_missing_that_comes_from_the_originals_or_differs_in_a_preset() -> None:
    named = {row[3] for row in CONSTANTS} | {row[1] for row in ADDITIONS}
    missing = []
    for section in SECTIONS:
        default = getattr(Config(), section)
        for name, field in type(default).model_fields.items():
            key = f"{section}.{name}"
            own = value_of(key, Config())
            theirs = [value_of(key, preset(name)) for name in ("loam", "aloam")]
            concerns = "LOAM" in field.json_schema_extra["source"] or any(
                value != own for value in theirs
            )
            if concerns and f"`{key}`" not in named:
                missing.append(key)
    assert missing == []

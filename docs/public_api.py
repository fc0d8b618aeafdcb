"""Every public name with its signature, in one file: ``python docs/public_api.py``.

Compares the package with ``public_api.txt`` and writes the file anew, unless a change is not told
in the topmost section of the changelog. What counts as public: ``api_stability.md``.
"""

from __future__ import annotations

import ast
import enum
import importlib
import inspect
import json
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import typer

import loam_gtsam
from loam_gtsam import config
from loam_gtsam.cli.app import app
from loam_gtsam.cli.run import RUN_OUTPUTS, RunOptions, execute
from loam_gtsam.datasets import SimulatedWorld

DOCS = Path(__file__).resolve().parent
LIST = DOCS / "public_api.txt"
CHANGELOG = DOCS.parent / "CHANGELOG.md"

MODULES = (
    "types",
    "config",
    "datasets",
    "datasets.simulation",
    "datasets.disturbances",
    "datasets.kidnapping",
    "factors",
    "imu",
    "odometry",
    "evaluation",
    "export_bag",
    "recording",
    "visualization",
    "viewer",
    "watching",
    "comparison",
)
"""Whose public names are public besides those of the package itself."""
PARTS = {
    "export": ("summarise", "write_covariances", "write_kitti", "write_npz", "write_ply"),
    "sweep": ("organise",),
}
"""Of other modules, the names that are."""

_COUNTED = ("status_counts", "faults", "map_stats", "localizability", "input", "accuracy",
            "sweep_motions", "tilt_priors")  # fmt: skip
"""Keys of ``summary.json`` whose own keys depend on the run."""


def public_api() -> list[str]:
    """One line for every name: what it is called, and what it takes."""
    lines = [*_names(), *_config_keys(), *_commands(), *_files()]
    assert len(lines) == len(set(lines))
    return lines


# -- Python ----------------------------------------------------------------------------------------


def _names() -> Iterator[str]:
    """The names of the package, then those of the modules that it does not have."""
    listed: list[Any] = []
    for name in sorted(loam_gtsam.__all__):
        thing = getattr(loam_gtsam, name)
        listed.append(thing)
        yield from _thing(f"loam_gtsam.{name}", thing)
    for module_name in (*MODULES, *PARTS):
        module = importlib.import_module(f"loam_gtsam.{module_name}")
        names = PARTS.get(module_name) or getattr(module, "__all__", None) or _defined(module)
        for name in sorted(names):
            thing = getattr(module, name)
            if hasattr(thing, "__module__") and any(thing is other for other in listed):
                continue
            listed.append(thing)
            yield from _thing(f"{module.__name__}.{name}", thing)


def _defined(module: ModuleType) -> set[str]:
    """Public names that a module defines, as opposed to those it imports."""
    names = set()
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {part.id for target in targets for part in ast.walk(target)
                      if isinstance(part, ast.Name)}  # fmt: skip
    return {name for name in names if not name.startswith("_")}


def _thing(name: str, thing: Any) -> Iterator[str]:
    if not inspect.isclass(thing):
        yield f"{name}{_signature(thing)}" if inspect.isroutine(thing) else name
        return
    if issubclass(thing, enum.Enum):
        yield name
        yield from (f"{name}.{member.name} = {member.value!r}" for member in thing)
    elif issubclass(thing, config._Section):
        yield name  # its fields are configuration keys
    else:
        own = "__init__" in vars(thing) and not getattr(thing, "_is_protocol", False)
        yield name + (_signature(thing) if own else "")
    members = {key for base in _ours(thing) for key in vars(base)}
    if not is_dataclass(thing):  # whose fields are in the signature
        yield from (f"{name}.{attribute}" for attribute in sorted(_attributes(thing) - members))
    for member in sorted(members):
        value = inspect.getattr_static(thing, member)
        if member.startswith("_") or isinstance(value, enum.Enum):
            continue
        if isinstance(value, (property, cached_property)):
            yield f"{name}.{member}"
        elif isinstance(value, (staticmethod, classmethod)) or inspect.isroutine(value):
            yield f"{name}.{member}{_signature(getattr(thing, member))}"


def _attributes(thing: type) -> set[str]:
    """What an object has, by the docstring of its class; of a protocol, by its annotations."""
    if getattr(thing, "_is_protocol", False):
        return set(inspect.get_annotations(thing))
    section = re.search(r"\nAttributes\n-+\n(.*?)(\n\n|\Z)", inspect.getdoc(thing) or "", re.DOTALL)
    found = re.findall(r"^(\w[\w, ]*) :", section[1], re.MULTILINE) if section else []
    return {name for names in found for name in names.split(", ")}


def _ours(thing: type) -> list[type]:
    return [base for base in thing.__mro__ if base.__module__.startswith("loam_gtsam")]


def _signature(thing: Any) -> str:
    signature = inspect.signature(thing)
    parameters = [
        parameter.replace(annotation=_Bare(parameter.annotation))
        if isinstance(parameter.annotation, str)
        else parameter
        for parameter in signature.parameters.values()
    ]
    returned = signature.return_annotation
    if inspect.isclass(thing):  # what a generated __init__ says here depends on the interpreter
        returned = inspect.Signature.empty
    elif isinstance(returned, str):
        returned = _Bare(returned)
    text = str(signature.replace(parameters=parameters, return_annotation=returned))
    if " at 0x" in text:
        raise ValueError(f"{thing}: a default without a name of its own: {text}")
    return text


class _Bare(str):
    """An annotation, which is written without quotes."""

    __repr__ = str.__str__


# -- configuration, command line, files ------------------------------------------------------------


def _config_keys() -> Iterator[str]:
    for section, keys in config.config_to_dict(config.Config()).items():
        if not isinstance(keys, Mapping):
            yield f"config {section} = {keys!r}"
            continue
        yield from (f"config {section}.{key} = {value!r}" for key, value in keys.items())
    yield from (f"preset {name}" for name in sorted(config.PRESETS))


def _commands() -> Iterator[str]:
    group: Any = typer.main.get_command(app)
    for name, command in sorted(group.commands.items()):
        yield f"loam-gtsam {name}"
        for parameter in command.params:
            spelt = "/".join([*parameter.opts, *parameter.secondary_opts])
            yield f"loam-gtsam {name} {spelt if spelt.startswith('-') else spelt.upper()}"


def _files() -> Iterator[str]:
    """Names of the files of a run, and the keys in two of them."""
    with tempfile.TemporaryDirectory() as folder:
        world = SimulatedWorld("room", frames=3, columns=200)
        options = RunOptions(3, Path(folder), True, False, False, True)
        execute(world, config.Config(), options)
        summary = json.loads((Path(folder) / "summary.json").read_text(encoding="utf-8"))
        with np.load(Path(folder) / "run.npz") as run:
            arrays = sorted(run)
    yield from (f"file {name}" for name in sorted(RUN_OUTPUTS))
    yield from (f"file summary.json {key}" for key in sorted(_keys(summary)))
    yield from (f"file run.npz {key}" for key in arrays)


def _keys(part: Mapping[str, Any], path: str = "") -> Iterator[str]:
    for key, value in part.items():
        yield path + key
        if isinstance(value, Mapping) and key not in _COUNTED:
            yield from _keys(value, f"{path}{key}.")


# -- the changelog ---------------------------------------------------------------------------------


def untold(before: Iterable[str], after: Iterable[str], changelog: str) -> list[str]:
    """Changes that the topmost section of a changelog does not name, a sentence each.

    What changed or is gone must be named itself. For a new member its class will do, for what
    belongs to something new, that.
    """
    section = re.split(r"^## ", changelog, flags=re.MULTILINE)[1]
    old, new = ({_name(line): line for line in lines} for lines in (before, after))
    sentences = []
    for name in sorted(old.keys() | new.keys()):
        owner = re.split(r"[ .][^ .]+$", name)[0]
        if old.get(name) == new.get(name) or owner in new.keys() - old.keys() - {name}:
            continue
        what = "new" if name not in old else "gone" if name not in new else "changed"
        parts = re.split(r"[ .](?=\w|-)", name)
        of_a_class = name.startswith("loam_gtsam.") and parts[-2][0].isupper()
        words = [*(parts[-2:-1] if what == "new" and of_a_class else []), *parts[-1].split("/")]
        if not any(re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", section) for word in words):
            sentences.append(f"{what}: {name}; CHANGELOG.md must name {' or '.join(words)}")
    return sentences


def _name(line: str) -> str:
    """Of a line: without signature and default."""
    return re.split(r"\(| = ", line, maxsplit=1)[0]


def main() -> None:
    """Write the list; an exit code of 1 and the reasons if the changelog is not up to it."""
    now = public_api()
    missing = []
    if LIST.exists():
        before = LIST.read_text(encoding="utf-8").splitlines()
        missing = untold(before, now, CHANGELOG.read_text(encoding="utf-8"))
    if missing:
        sys.exit("\n".join(["Tell it in the topmost section of the changelog first:", *missing]))
    LIST.write_text("\n".join(now) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

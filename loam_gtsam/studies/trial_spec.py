"""The specification of a parameter study: sequences x configurations x seeds, read from YAML."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from ruamel.yaml import YAML

from loam_gtsam.config import Config, load_config, preset
from loam_gtsam.config.base import shown
from loam_gtsam.errors import nearest
from loam_gtsam.studies.contenders import METHODS, with_solver
from loam_gtsam.studies.factories import PARTS, is_factory
from loam_gtsam.studies.peers import PEERS
from loam_gtsam.studies.trials import METRICS, Trial
from loam_gtsam.types import ConfigError

_SPEC = ("sequences", "configs", "seeds", "frames", "metrics")
_SEQUENCE = ("path", "options", "frames", "set")
_CONFIG = ("base", "peer", "set", *PARTS)


@dataclass(frozen=True, slots=True)
class Spec:
    """A parameter study: name and content of its file, trials, and the columns to show.

    The trials are sequences x configurations x seeds, in this order.
    """

    name: str
    text: str
    trials: tuple[Trial, ...]
    metrics: tuple[str, ...]

    @property
    def config_names(self) -> list[str]:
        """Names of the configurations, in their order."""
        return list(dict.fromkeys(trial.config_name for trial in self.trials))


@dataclass(frozen=True, slots=True)
class _System:
    """What runs: a configuration and parts of a user's own by name, or a peer."""

    config: Config
    parts: Mapping[str, str] = field(default_factory=dict)
    peer: str | None = None


@dataclass(frozen=True, slots=True)
class _Sequence:
    path: str
    options: Mapping[str, Any]
    frames: int | None
    changes: Mapping[str, Any]
    where: str

    @property
    def is_world(self) -> bool:
        return self.path.startswith("sim:")

    @property
    def own_seed(self) -> int | None:
        seed = self.options.get("seed", dict(parse_qsl(self.path.partition("?")[2])).get("seed"))
        try:
            return None if seed is None else int(seed)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"{self.where}: seed: expected an integer, got {shown(seed)}"
            ) from error

    def seeds(self, given: list[int]) -> list[int | None]:
        return [*(given or [self.own_seed or 0])] if self.is_world else [None]


def load_spec(path: str | Path) -> Spec:
    """Read a specification; the paths in the file are relative to the folder of the file.

    Raises ConfigError if the file cannot be read, is not YAML, or does not fit, naming the key.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        data = YAML(typ="safe", pure=True).load(text)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error  # without the path again
        raise ConfigError(f"{path}: cannot read the specification: {reason}") from error
    except Exception as error:  # not only YAMLError: see config.parse_config
        raise ConfigError(f"{path}: not valid YAML: {error}") from error
    name = str(path)
    entries = _mapping(name, data, _SPEC)
    folder = path.parent
    frames = _count(f"{name}: frames", entries.get("frames"))
    named = _named(name, "sequences", entries)
    sequences = {k: _sequence(f"{name}: sequences.{k}", v, folder, frames) for k, v in named}
    named = _named(name, "configs", entries)
    configs = {key: _config(f"{name}: configs.{key}", value, folder) for key, value in named}
    seeds = _seeds(f"{name}: seeds", entries.get("seeds"), sequences)
    trials = tuple(
        Trial(
            sequence=label,
            config_name=config_name,
            path=sequence.path,
            options=sequence.options,
            frames=sequence.frames,
            seed=seed,
            config=_changed(entry.config, f"{sequence.where}.set", sequence.changes),
            peer=entry.peer,
            parts=entry.parts,
        )
        for label, sequence in sequences.items()
        for config_name, entry in configs.items()
        for seed in sequence.seeds(seeds)
    )
    return Spec(path.stem, text, trials, _metrics(f"{name}: metrics", entries.get("metrics")))


def _sequence(where: str, value: Any, folder: Path, frames: int | None) -> _Sequence:
    entries = {"path": value} if isinstance(value, str) else _mapping(where, value, _SEQUENCE)
    path = entries.get("path")
    if not isinstance(path, str) or not path:
        raise ConfigError(f"{where}: expected a path, or a mapping with the key 'path'")
    if not path.startswith("sim:"):
        # Absolute: the same relative path under another folder is other data. Symbolic links stay:
        # on another machine they may lead to another place.
        path = os.path.abspath(folder / Path(os.path.expandvars(path)).expanduser())
    options = _mapping(f"{where}.options", entries.get("options", {}))
    frames = _count(f"{where}.frames", entries.get("frames", frames))
    return _Sequence(path, options, frames, _mapping(f"{where}.set", entries.get("set", {})), where)


def _config(where: str, value: Any, folder: Path) -> _System:
    entries = {_kind(value): value} if isinstance(value, str) else _mapping(where, value, _CONFIG)
    for key in (*PARTS, "base", "peer"):
        if not isinstance(entries.get(key, ""), str):
            raise ConfigError(f"{where}.{key}: expected a name, got {entries[key]!r}")
    changes = _mapping(f"{where}.set", entries.get("set", {}))
    if peer := entries.get("peer"):
        if len(entries) > 1:
            raise ConfigError(f"{where}: {peer} is a peer, beside which nothing can be set")
        if peer.partition("?")[0] not in PEERS:
            raise ConfigError(f"{where}.peer: unknown peer {peer!r}{nearest(peer, PEERS)}")
        return _System(Config(), peer=peer)
    base = entries.get("base", "default")
    if Path(base).suffix in (".yaml", ".yml"):
        config = load_config(folder / Path(base).expanduser())
    else:
        config = preset(base, f"{where}.base: ")
    parts = {key: entries[key] for key in PARTS if key in entries}
    solver = parts.get("solver", "")
    if solver and not is_factory(solver):
        if solver not in METHODS:
            raise ConfigError(
                f"{where}.solver: unknown solver {solver!r}{nearest(solver, METHODS, False)}; "
                f"expected {', '.join(METHODS)}, or PACKAGE.MODULE:FACTORY; a preset or "
                "a configuration file (.yaml) is a 'base'"
            )
        config = with_solver(config, parts.pop("solver"))
    return _System(_changed(config, f"{where}.set", changes), parts)


def _kind(name: str) -> str:
    """What a name alone stands for: a configuration file, a peer, or else a solver."""
    if Path(name).suffix in (".yaml", ".yml"):
        return "base"
    return "peer" if name.partition("?")[0] in PEERS else "solver"


def _changed(config: Config, where: str, changes: Mapping[str, Any]) -> Config:
    for key in changes:
        if "." not in key:
            raise ConfigError(f"{where}: expected SECTION.KEY: VALUE, got {shown(key)}")
    return config.changed(changes, source=where)


def _seeds(where: str, value: Any, sequences: Mapping[str, _Sequence]) -> list[int]:
    if value is None:
        return []
    numbers = isinstance(value, list) and all(type(seed) is int and seed >= 0 for seed in value)
    if not numbers or not value or len(set(value)) < len(value):
        raise ConfigError(
            f"{where}: expected a list of different integers from 0, got {shown(value)}"
        )
    worlds = [sequence for sequence in sequences.values() if sequence.is_world]
    if not worlds:
        raise ConfigError(
            f"{where}: only built-in worlds (sim:NAME) have a seed, and none is among the "
            "sequences; recorded data runs once per configuration"
        )
    for world in worlds:
        if world.own_seed is not None:
            raise ConfigError(f"{world.where}: has a seed of its own; remove it, or remove 'seeds'")
    return list(value)


def _metrics(where: str, value: Any) -> tuple[str, ...]:
    if value is None:
        return ("ate_m",)
    if not isinstance(value, list) or not value or any(name not in METRICS for name in value):
        raise ConfigError(f"{where}: expected a list of {', '.join(METRICS)}; got {shown(value)}")
    return tuple(value)


def _count(where: str, value: Any) -> int | None:
    if value is not None and (type(value) is not int or value < 1):
        raise ConfigError(f"{where}: expected a number of sweeps, at least 1, got {shown(value)}")
    return value


def _named(name: str, key: str, entries: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    if not entries.get(key):
        raise ConfigError(f"{name}: {key}: expected at least one, as NAME: VALUE")
    return _mapping(f"{name}: {key}", entries[key]).items()


def _mapping(where: str, value: Any, known: tuple[str, ...] = ()) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: expected a mapping, got {shown(value)}")
    for key in value:
        if not isinstance(key, str):
            raise ConfigError(
                f"{where}: expected names as keys, got {shown(key)}; put it in quotes"
            )
        if known and key not in known:
            raise ConfigError(f"{where}: unknown key {key!r}{nearest(key, known)}")
    return value

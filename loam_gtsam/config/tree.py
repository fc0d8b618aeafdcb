"""The whole configuration: its presets, and how one is changed, read and written as YAML."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from pydantic import model_validator
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.constructor import DuplicateKeyError

from loam_gtsam.config import sections
from loam_gtsam.config.aiding import AidingConfig
from loam_gtsam.config.base import (
    Section,
    clipped,
    meaning,
    nested,
    out_of_order,
    override,
    shown,
)
from loam_gtsam.config.output import BagConfig, LiveConfig
from loam_gtsam.config.own_parts import PartsConfig
from loam_gtsam.errors import as_path, check_kind, nearest
from loam_gtsam.types import ConfigError, InputError


class Config(Section):
    """The whole configuration."""

    sensor: sections.SensorConfig = sections.SensorConfig()
    features: sections.FeatureConfig = sections.FeatureConfig()
    deskew: sections.DeskewConfig = sections.DeskewConfig()
    odometry: sections.OdometryConfig = sections.OdometryConfig()
    map: sections.MapConfig = sections.MapConfig()
    matching: sections.MatchingConfig = sections.MatchingConfig()
    solver: sections.SolverConfig = sections.SolverConfig()
    imu: sections.ImuConfig = sections.ImuConfig()
    relocalization: sections.RelocalizationConfig = sections.RelocalizationConfig()
    covariance: sections.CovarianceConfig = sections.CovarianceConfig()
    aiding: AidingConfig = AidingConfig()
    pose_graph: sections.PoseGraphConfig = sections.PoseGraphConfig()
    loops: sections.LoopConfig = sections.LoopConfig()
    bag: BagConfig = BagConfig()
    live: LiveConfig = LiveConfig()
    parts: PartsConfig = PartsConfig()

    @model_validator(mode="after")
    def _check_matches(self) -> Self:
        most, least = self.matching.max_edges + self.matching.max_planes, self.solver.min_matches
        if most < least and self.matching.max_edges and self.matching.max_planes:
            sought = "matching.max_edges + matching.max_planes"
            raise out_of_order(("matching", "solver"), "solver.min_matches", sought, least, most)
        return self

    def changed(
        self, /, *changes: str | Mapping[str, Any], source: str = "", **sections: Any
    ) -> Self:
        """A copy with other values: all are changed at once, then checked.

        Parameters
        ----------
        changes : texts as ``"solver.iterations=5"``, with a value as YAML writes it, or mappings
            of such keys to values, as ``{"solver.iterations": 5}``
        source : where the changes come from, for error messages
        sections : whole sections, as ``imu=ImuConfig(coupling="off")``

        Raises
        ------
        ConfigError
            If there is no such parameter, or a value does not fit.

        Examples
        --------
        >>> Config().changed("solver.iterations=5", "imu.coupling=off").solver.iterations
        5
        """
        where = f"{source}: " if source else ""
        return override(self.model_copy(update=sections), nested(changes, where), lambda _: where)

    def of_small_places(self) -> Self:
        """The configuration where a place is small, see ``map.small_below``.

        Steps, door frames and furniture are smaller than the voxels of a street. With half of
        the spacing, twice as many neighbours fix a normal as well as before.
        """
        return self.model_copy(
            update={
                "features": _scaled(self.features, SMALL, "plane_voxel"),
                "map": _scaled(self.map, SMALL, "edge_voxel", "plane_voxel"),
                "matching": _scaled(self.matching, 1.0 / SMALL, "neighbours"),
                "covariance": _scaled(self.covariance, SMALL, "ground_cell"),
            }
        )


def with_implied(config: Config, implied: Mapping[str, Any]) -> Config:
    """The configuration with fields of ``sensor``, and of ``imu`` as ``imu.NAME``, where unset.

    InputError if what a data set implies is no mapping, ConfigError if there is no such field.
    """
    check_kind(implied, Mapping, _IMPLIED, '{"min_range": 2.0} is one, {} if nothing is known')
    imu = {k[4:]: v for k, v in implied.items() if str(k).startswith("imu.")}
    sensor = {k: v for k, v in implied.items() if not str(k).startswith("imu.")}
    return config.changed(sensor=_filled(config.sensor, sensor), imu=_filled(config.imu, imu))


def named_sections(name: str, section: Section) -> dict[str, Section]:
    """A section of that name and those in it, by dotted name."""
    found = {name: section}
    for key, value in section:
        if isinstance(value, Section):
            found |= named_sections(f"{name}.{key}", value)
    return found


def _filled(section: Section, implied: Mapping[str, Any]) -> Section:
    default = type(section)()
    now, unset = vars(section), vars(default)
    values = {k: v for k, v in implied.items() if now.get(k) == unset.get(k)}
    return override(section, values, lambda _: f"{_IMPLIED}: ")


def _scaled(section: Section, factor: float, *names: str) -> Section:
    """The section with these parameters times a factor, as far as their bounds let them."""
    values = {name: getattr(section, name) for name in names}
    return section.model_copy(
        update={
            name: type(value)(clipped(section, name, factor * value))
            for name, value in values.items()
        }
    )


SMALL = 0.5
"""Size of voxels and cells in small places over that in the open."""
_IMPLIED = "sensor of the data set"
_WIDTH = 100
_CLASSICAL = {
    "features": {"beam_width": 1.0, "range_noise": 0.0, "post_depth": 0.0, "thinning": "voxels"},
    "deskew": {"model": "predicted", "rotation": "constant_velocity"},
    "odometry.method": "scan_to_scan",
    "map": {"insertion": "centroid", "small_below": 0.0, "insert_unmatched": True},
    "matching": {
        "max_edges": 0,
        "max_planes": 0,
        "wide_search": 1.0,
        "line_ratio": 3.0,
        "plane_fit": "unit_offset",
        "plane_tolerance": 0.2,
        "plane_ratio": 0.0,
        "max_ring_cosine": 1.0,
        "min_incidence_sine": 0.0,
        "fit_uncertainty": False,
        "weight_range": "map",
        "keep_translation": 0.0,
    },
    "solver": {"step_sigmas": 0.0, "min_map_edges": 11, "shorten_steps": False},
    "relocalization.enabled": False,
    # Fitted (docs/classical.md): lines through points of a feature's own ring go along with it.
    "covariance.drift": 300.0,
}

PRESETS: dict[str, Config] = {
    "default": Config(),
    # Zhang and Singh, LOAM (RSS 2014), constants of the published laserMapping.
    "loam": Config().changed(
        _CLASSICAL,
        {"solver": {"method": "loam", "iterations": 10, "min_map_planes": 101}},
        {"solver.degeneracy_threshold": 100.0},
        {"imu": {"coupling": "loose", "prior": "blend", "weight": 0.002, "average_seconds": 0.0}},
    ),
    # A-LOAM's laserMapping with the voxel sizes of its VLP-16 settings. It has no minimum of
    # matches; fewer than 6 cannot fix a pose.
    "aloam": Config().changed(
        _CLASSICAL,
        {"map": {"neighbourhood": [5, 5, 3], "field_of_view": False}, "imu.coupling": "off"},
        {"solver": {"method": "aloam", "iterations": 2, "inner_iterations": 4, "min_matches": 6}},
        {"solver.min_map_planes": 51, "matching.weight_slope": 0.0, "solver.degeneracy": "off"},
    ),
}


def preset(name: str, where: str = "") -> Config:
    """The configuration called ``name``; the error that there is none begins with ``where``."""
    if not isinstance(name, str) or name not in PRESETS:
        raise ConfigError(f"{where}unknown preset {shown(name)}{nearest(name, PRESETS)}")
    return PRESETS[name]


def as_config(config: Config | None) -> Config:
    """The configuration, or the default one if None; InputError for anything else."""
    if config is None:
        return Config()
    if isinstance(config, Config):
        return config
    raise InputError(
        f"config: expected a Config, got {type(config).__name__} {shown(config)}; preset(name), "
        "load_config(path), config_from_dict(data) and Config().changed(...) make one"
    )


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
        got = "a list" if isinstance(data, (list, tuple)) else type(data).__name__
        raise ConfigError(f"{source}: expected a mapping of sections, got {got}")

    def where(path: tuple[Any, ...]) -> str:
        """``file:line`` of a key if the parser kept it."""
        located: Any = data
        try:
            for key in path[:-1]:
                located = located[key]
            return f"{source}:{located.lc.key(path[-1])[0] + 1}: "
        except (AttributeError, KeyError, TypeError):
            return f"{source}: "

    for key in data:
        section, dot, name = (key if isinstance(key, str) else "").partition(".")
        if dot and section in Config.model_fields:
            problem = f"{key}: expected a section, as {section}: {{{name}: {shown(data[key])}}}"
            raise ConfigError(f"{where((key,))}{problem}")
    base = preset(data.get("preset", "default"), where(("preset",)))
    return override(base, {k: v for k, v in data.items() if k != "preset"}, where)


def config_to_dict(config: Config) -> dict[str, Any]:
    """Nested plain dictionaries; the inverse of :func:`config_from_dict`."""
    return as_config(config).model_dump()


def load_config(path: str | Path) -> Config:
    """Read a YAML file.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or does not fit.
    """
    path = as_path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error  # without the path again
        raise ConfigError(f"{path}: cannot read the configuration: {reason}") from error
    return parse_config(text, str(path))


def parse_config(text: str, source: str = "config") -> Config:
    """As :func:`load_config`, from text."""
    try:
        data = YAML(typ="rt").load(text)
    except DuplicateKeyError as error:
        place, problem = error.problem_mark.line + 1, error.problem.partition(" with value")[0]
        raise ConfigError(f"{source}:{place}: not valid YAML: {problem}, keep one") from error
    # A day 32, an endless number and deep nesting surface as whatever the parser stumbles over.
    except Exception as error:
        raise ConfigError(f"{source}: not valid YAML: {error}") from error
    return config_from_dict({} if data is None else data, source)


def dump_config(config: Config) -> str:
    """YAML text in which every key is explained by a comment."""
    yaml = YAML()
    yaml.width = _WIDTH
    out = io.StringIO()
    yaml.dump(_commented(as_config(config), 0), out)
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

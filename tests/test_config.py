"""Configuration: YAML there and back, and every way in which a file can be wrong."""

import math
import re
import typing

import numpy as np
import pytest
from pydantic.fields import FieldInfo
from ruamel.yaml import YAML

from loam_gtsam.config import (
    PRESETS,
    Config,
    ImuConfig,
    MapConfig,
    MatchingConfig,
    SensorConfig,
    SolverConfig,
    config_from_dict,
    config_to_dict,
    dump_config,
    load_config,
    meaning,
    parse_config,
    preset,
)
from loam_gtsam.config.completion import completions
from loam_gtsam.types import ConfigError

FIELDS = [
    (type(section.default), name, field)
    for section in Config.model_fields.values()
    for name, field in type(section.default).model_fields.items()
]


def bounds(field):
    """(low, high) of a number, or of the entries of a tuple; None where it has none."""
    metadata = field.metadata
    if typing.get_origin(field.annotation) is tuple:
        metadata = typing.get_args(field.annotation)[0].__metadata__
    low = next((item.ge for item in metadata if hasattr(item, "ge")), None)
    high = next((item.le for item in metadata if hasattr(item, "le")), None)
    return low, high


def name_of(value):
    return getattr(value, "__name__", "" if isinstance(value, FieldInfo) else value)


BOUNDS = [
    (owner, name, limit, beyond)
    for owner, name, field in FIELDS
    for limit, beyond in zip(bounds(field), (-1, 1), strict=True)
    if limit is not None
]


# -- there and back --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_survives_yaml_and_dictionaries(name):
    config = preset(name)
    assert parse_config(dump_config(config)) == config
    assert config_from_dict(config_to_dict(config)) == config
    assert parse_config(f"preset: {name}") == config


def test_values_other_than_the_default_survive_too():
    config = Config(
        imu=ImuConfig(lidar_R_imu_deg=(180.0, 0.0, 90.0)),
        sensor=SensorConfig(model="hdl64", spin="clockwise", min_range=1.25),
        map=MapConfig(window=(7, 9, 3), field_of_view=False, archive_dir="/somewhere: odd #name"),
        solver=SolverConfig(translation_tolerance=1e-5),
    )
    assert parse_config(dump_config(config)) == config != Config()
    assert dump_config(parse_config(dump_config(config))) == dump_config(config)


def test_every_key_is_dumped_below_a_comment_with_its_unit_and_source():
    found, comment = [], []
    for line in dump_config(Config()).splitlines():
        assert len(line) <= 100
        start, _, rest = line.partition("#")
        if start.strip():
            found.append((line.split(":")[0].strip(), " ".join(comment)))
        comment = [] if start.strip() else [*comment, rest.strip()]
    for _, name, field in FIELDS:
        assert (name, meaning(field)) in found
        for label, text in field.json_schema_extra.items():
            assert f"{label.capitalize()}: {text}." in meaning(field) or not text


FRAGMENT = re.compile(r"^(and|or|of|its|it|that|so many|the same|also|too|as|by)\b", re.IGNORECASE)


@pytest.mark.parametrize(("owner", "name", "field"), FIELDS, ids=name_of)
def test_the_description_of_every_parameter_is_made_of_whole_sentences(owner, name, field):
    text = field.description
    assert text[0].isupper()
    assert text.endswith(".")
    assert not FRAGMENT.match(text)
    for sentence in re.split(r"(?<=[.;:]) ", " ".join(text.split())):
        assert len(sentence.split()) > 2
        assert sentence.split()[-1].strip(".,;") not in ("and", "or", "of", "the", "than", "to")


def test_absent_keys_keep_the_default_an_integer_serves_as_a_float_and_null_as_none(tmp_path):
    assert parse_config("") == parse_config("# only a comment\n") == Config()
    file = tmp_path / "some.yaml"
    file.write_text("solver: {iterations: 3}\nmap: {cube_size: 40, archive_dir: null}")
    config = load_config(file)
    assert config == Config(solver=SolverConfig(iterations=3), map=MapConfig(cube_size=40.0))
    assert isinstance(config.map.cube_size, float)


def test_the_tree_is_frozen():
    for section, name in ((Config(), "solver"), (Config().solver, "iterations")):
        with pytest.raises(ConfigError, match=rf"{name}: .* is frozen, got .*; config.changed\("):
            setattr(section, name, getattr(section, name))


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("solver:\n  iterationz: 3", ("here.yaml:2", "solver.iterationz", "'iterations'")),
        ("\nsolvr: {}", ("here.yaml:2: solvr: unknown key", "'solver'", "known:", "matching")),
        ("map:\n  cube_size: wide", ("here.yaml:2", "map.cube_size", "expected float", "'wide'")),
        ("solver:\n\n  iterations: 2.5", ("here.yaml:3", "expected int", "2.5")),
        ("solver: {iterations: &a true}", ("expected int", "True")),
        ("map: {field_of_view: 1}", ("expected bool", "1")),
        ("map: {archive_dir: 3}", ("map.archive_dir", "expected str", "3")),
        ("map: {cube_size: .nan}", ("map.cube_size", "at most 1000000.0", "nan")),
        ("map: {window: [9, 9]}", ("map.window", "expected 3 values")),
        ("map: {window: [9, 9, 0]}", ("map.window", "at least 1", "0")),
        ("sensor: {model: vlp17}", ("sensor.model", "expected one of", "did you mean 'vlp16'")),
        ("sensor: {model: [vlp16]}", ("sensor.model", "expected one of")),
        ("solver: 3", ("here.yaml:1: solver: expected a mapping", "3")),
        ("preset: defualt", ("here.yaml:1", "preset 'defualt'; did you mean 'default'")),
        ("preset: [default]", ("unknown preset",)),
        ("- solver", ("expected a mapping", "here.yaml")),
        (
            "solver: {}\nsolver: {}",
            ("here.yaml:2: not valid YAML: found duplicate key", "keep one"),
        ),
        ("loops: {enabled: yes}", ("expected true or false", "yes, are text", "'yes'")),
        ("- sensor", ("expected a mapping of sections, got a list",)),
        ("sensor.min_range: 2", ("here.yaml:1", "expected a section, as sensor: {min_range: 2}")),
        ("a: \0", ("here.yaml", "not valid YAML")),
        ("imu: {gravity: 2001-12-00}", ("here.yaml", "not valid YAML", "day is out of range")),
        (f"imu: {{lag: {'9' * 9000}}}", ("here.yaml", "not valid YAML")),
        (f"imu: {{lag: 0x{'f' * 9000}}}", ("here.yaml:1", "imu.lag", "at most 1000", "too long")),
        ("imu: " + "[" * 1000, ("here.yaml", "not valid YAML")),
        ("imu: &a [*a]", ("here.yaml:1: imu: expected a mapping",)),
        ("? [a, b]\n: 3", ("here.yaml:1", "unknown key")),
        ("deskew: {rotation: gyro}", ("deskew.rotation", "auto, orientation, constant_velocity")),
        (
            "sensor:\n  rings: auto\n  min_range: 50\n  max_range: 1",
            ("here.yaml:3: sensor.min_range: ", "50.0 and 1.0"),
        ),
        ("sensor:\n  max_range: 0.1", ("here.yaml:2: sensor.max_range: ", "0.5 and 0.1")),
    ],
)
def test_a_wrong_file_is_refused_with_key_and_line(text, words):
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "here.yaml")
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("place", ["map: {0}", "map: {{archive_dir: {0}}}", "preset: {0}"])
def test_aliases_that_multiply_do_not_make_an_endless_message(place):
    laughs = "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 60))
    data = YAML().load(f"a0: &a0 [x, x]\n{laughs}{place.format('&z [*a59]')}\n")
    with pytest.raises(ConfigError) as caught:
        config_from_dict({key: data[key] for key in ("map", "preset") if key in data})
    assert len(str(caught.value)) < 1000


def test_anchors_and_other_looks_of_a_value_do_not_matter():
    plain = parse_config("imu: {level: true, lag: 16, gravity: 10.0}\nbag: {map_frame: map}")
    text = "imu: {level: &a true, lag: &b 0x10, gravity: &c 1.0e+1}\nbag: {map_frame: &d 'map'}"
    dressed = parse_config(text)
    assert dressed == plain
    types = [[type(value) for value in vars(config.imu).values()] for config in (dressed, plain)]
    assert types[0] == types[1]
    assert parse_config(dump_config(dressed)) == plain


@pytest.mark.parametrize(("owner", "name", "limit", "sign"), BOUNDS, ids=name_of)
def test_every_bound_accepts_itself_and_refuses_what_lies_beyond(owner, name, limit, sign):
    default = owner.model_fields[name].default
    whole = type(default[0] if isinstance(default, tuple) else default) is int
    at = int(limit) if whole else float(limit)
    beyond = at + sign if whole else math.nextafter(at, sign * math.inf)
    if isinstance(default, tuple):
        at, beyond = (at,) * 3, (at, at, beyond)
    others = {key: at for pair in owner.in_order if pair[sign < 0] == name for key in pair}
    assert getattr(owner(**{**others, name: at}), name) == at
    with pytest.raises(ConfigError, match=rf"{owner.__name__}\.{name}: expected at"):
        owner(**{name: beyond})


EXTREMES = (
    *(
        sign * value
        for value in (0, 1, 10**9, 10**19, 10**400, 0.5, 5e-324, 1e300)
        for sign in (1, -1)
    ),
    *(math.inf, -math.inf, math.nan, True, None, "9" * 5000, [], [1, 2, 3], [0.1] * 10**4, {}, 1j),
)


@pytest.mark.parametrize(("owner", "name", "field"), FIELDS, ids=name_of)
def test_an_extreme_value_is_refused_with_what_was_expected_or_within_bounds(owner, name, field):
    low, high = bounds(field)
    numeric = isinstance(field.default, (int, float, tuple)) and type(field.default) is not bool
    numeric |= low is not None
    limited = low is not None and high is not None
    assert not numeric or limited or name in ("kernel_width", "beams")  # each column has its own
    partners = {key: field.default for pair in owner.in_order if name in pair for key in pair}
    for value in (*EXTREMES, *([entry] * 3 for entry in EXTREMES)):
        text = ""
        try:
            taken = getattr(owner(**{**partners, name: value}), name)
        except ConfigError as error:
            taken, text = None, str(error)
        if taken is None:
            assert (value is None and not text) or re.match(
                rf"{owner.__name__}\.\w+: expected \S", text
            )
            assert len(text) < 500
        elif numeric:
            entries = taken if isinstance(taken, tuple) else (taken,)
            assert all(low <= entry <= (high or math.inf) for entry in entries)
        else:
            assert taken is value


def test_in_small_places_values_are_scaled_only_as_far_as_their_bounds():
    least = {"map": {"edge_voxel": 0.01, "plane_voxel": 0.015}, "matching.neighbours": 99}
    small = Config().changed(least, "features.plane_voxel=0.0").of_small_places()
    assert small.map.edge_voxel == small.map.plane_voxel == 0.01
    assert small.matching.neighbours == 100
    assert config_from_dict(config_to_dict(small)) == small
    usual = Config().of_small_places()
    assert (usual.map.edge_voxel, usual.matching.neighbours) == (0.1, 10)


@pytest.mark.parametrize(
    ("section", "values", "message"),
    [
        (SolverConfig, {"iterations": True}, r"SolverConfig\.iterations: expected int"),
        (MapConfig, {"window": (1, 2)}, r"MapConfig\.window: expected 3 values"),
        (Config, {"solver": {"iterations": 2.5}}, r"Config\.solver: SolverConfig\.iterations: exp"),
        (SolverConfig, {"iteration": 5}, r"SolverConfig\.iteration: unknown key; did you mean"),
    ],
)
def test_a_constructor_refuses_too(section, values, message):
    with pytest.raises(ConfigError, match=message):
        section(**values)


def test_numbers_of_numpy_are_numbers():
    config = Config().changed({"solver.iterations": np.int64(5), "imu.level": np.bool_(False)})
    assert (config.solver.iterations, config.imu.level) == (5, False)
    assert config.solver.changed(iterations=np.int32(4)).iterations == 4
    assert config.imu.changed(lidar_t_imu=np.array([1.0, 2.0, 3.0])).lidar_t_imu == (1.0, 2.0, 3.0)
    with pytest.raises(ConfigError, match=r"expected int, got 5\.0"):
        Config().changed({"solver.iterations": np.float32(5.0)})


PAIRS = [(owner, *pair) for owner in dict.fromkeys(f[0] for f in FIELDS) for pair in owner.in_order]


@pytest.mark.parametrize(("owner", "lower", "upper"), PAIRS, ids=name_of)
def test_a_lower_limit_may_not_exceed_the_upper_one(owner, lower, upper):
    same = owner.model_fields[upper].default
    assert getattr(owner(**{lower: same, upper: same}), lower) == same
    above = same + (1 if type(same) is int else 0.01)
    with pytest.raises(ConfigError, match=rf"{lower}: expected {lower} <= {upper}, got"):
        owner(**{lower: above, upper: same})


def test_a_solve_may_not_need_more_matches_than_are_sought():
    text = "matching: {max_edges: 10, max_planes: 20}\nsolver: {min_matches: 30}"
    assert parse_config(text).solver.min_matches == 30
    assert parse_config("matching: {max_edges: 10, max_planes: 0}").matching.max_planes == 0
    for wrong in (text.replace(": 30", ": 31"), "\nmatching: {max_edges: 10, max_planes: 39}"):
        with pytest.raises(ConfigError, match=r"matching: expected solver\.min_matches <= "):
            parse_config(wrong)


# -- one value changed -----------------------------------------------------------------------------


def test_values_change_by_text_mapping_or_section_all_at_once():
    config = Config().changed(
        "sensor.min_range=200",
        {"sensor.max_range": 300.0, "solver.iterations": 5, "map": {"window": [9, 9, 5]}},
        imu=ImuConfig(coupling="off"),
    )
    assert (config.sensor.min_range, config.sensor.max_range) == (200.0, 300.0)
    assert (config.solver.iterations, config.map.window) == (5, (9, 9, 5))
    assert config.imu == ImuConfig().changed(coupling="off")
    assert Config().changed() == Config()
    most = Config().changed("solver.min_matches=2600", matching=MatchingConfig(max_planes=2100))
    assert most.solver.min_matches == 500 + most.matching.max_planes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("solver.iterations=2.5", ("test: solver.iterations: expected int, got 2.5",)),
        ("solver.kernel.width=5", ("solver.kernel: expected one of",)),
        ("solver.iterations", ("test: expected SECTION.KEY=VALUE, got 'solver.iterations'",)),
        ("solver.iterations=[", ("'[' is not a YAML value",)),
        ({"solver": SolverConfig, "imu": 3}, ("solver: expected a mapping",)),
    ],
)
def test_a_wrong_change_is_refused_as_a_wrong_file_is(change, words):
    with pytest.raises(ConfigError) as caught:
        Config().changed(change, source="test")
    for word in ("test", *words):
        assert word in str(caught.value)


def test_an_unreadable_file_is_a_config_error(tmp_path):
    latin = tmp_path / "latin.yaml"
    latin.write_bytes(b"map: {archive_dir: \xe9\xe8}")
    for path in (tmp_path / "absent.yaml", tmp_path, latin):
        with pytest.raises(ConfigError, match="cannot read the configuration") as caught:
            load_config(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "begun", "offered"),
    [
        ("sensor", "os1-1", ["os1-16", "os1-128"]),
        ("preset", "a", ["aloam"]),
        ("solver", "", ["gtsam", "loam", "aloam"]),
        ("set", "solver.iter", ["solver.iterations="]),
        ("set", "solver.method=l", ["solver.method=loam"]),
        ("set", "loops.enabled=", ["loops.enabled=true", "loops.enabled=false"]),
        ("set", "solver.iterations=", []),
        ("set", "solvr.method=", []),
    ],
)
def test_the_shell_completes_names_and_values(kind, begun, offered):
    assert completions(kind, begun) == offered

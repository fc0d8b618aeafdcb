"""Sections of the configuration: pydantic models, changes of them, errors that name the key."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args, get_origin

import numpy as np
from annotated_types import Ge, Le
from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError
from ruamel.yaml import YAML
from ruamel.yaml.scalarbool import ScalarBoolean

from loam_gtsam.errors import nearest
from loam_gtsam.types import ConfigError

_LONGEST = 200  # characters of a value in an error message
_PAIR = "pair"
_HIGHEST = {"m": 1e6, "degrees": 360.0, "m/s": 1e4, "rad/s": 1e4, "m/s^2": 1e4} | dict.fromkeys(
    ("rad/s/sqrt(Hz)", "m/s^2/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)"), 1e3
)
"""Upper bounds by unit: 1000 km, where single precision still resolves 6 cm; one turn; more than
any vehicle does (a kilometre from sweep to sweep); and noise beyond the range of any IMU, which
says as little as twice as much. Variances this far apart still fit into one matrix."""
_NO_LIMIT = 1_000_000_000
"""Upper bound of all else, which stands for "no limit": it fits into 32 bits as a count, into 63
as nanoseconds of so many seconds, and its powers are far from infinity."""
_EXPECTED = {
    "bool_type": "bool",
    "int_type": "int",
    "float_type": "float",
    "string_type": "str",
    "greater_than_equal": "at least {ge}",
    "less_than_equal": "at most {le}",
    "model_type": "a mapping, for it is a section",
}

Count = Annotated[int, Ge(1), Le(10_000)]
"""An entry of a tuple: a number of cubes, few enough that indices of cubes stay exact."""
Angle = Annotated[float, Ge(-360.0), Le(360.0)]
"""An entry of a tuple: degrees."""
Offset = Annotated[float, Ge(-1000.0), Le(1000.0)]
"""An entry of a tuple: metres on one vehicle."""
BeamRow = Annotated[tuple[Angle, Offset, Angle, Angle], Strict(False)]
"""An entry of a tuple: errors of a beam, see ``sensor.beams``."""


def parameter(
    default: Any,
    *,
    unit: str = "",
    source: str = "",
    low: float | None = None,
    high: float | None = None,
) -> Any:
    """A field of a section, which the string below it describes; its bounds are inclusive.

    A number without an upper bound of its own has that of its unit. Its own one is the size up to
    which time and memory were measured to stay within reason.
    """
    if high is None and low is not None:
        high = _HIGHEST.get(unit, _NO_LIMIT)
    return Field(
        default,
        ge=low,
        le=None if high == math.inf else high,
        strict=False if isinstance(default, tuple) else None,  # which takes lists, too
        json_schema_extra={"unit": unit, "source": source},
    )


def meaning(field: FieldInfo) -> str:
    """The description of a parameter, with its unit, source and choices, or that of a section."""
    extra: Any = field.json_schema_extra or {}
    section = isinstance(field.default, Section)
    text = " ".join(((field.default.__doc__ if section else field.description) or "").split())
    if extra.get("unit"):
        text += f" Unit: {extra['unit']}."
    if extra.get("source"):
        text += f" Source: {extra['source']}."
    if get_origin(field.annotation) is Literal:
        text += f" One of: {', '.join(get_args(field.annotation))}."
    return text


class RefusedError(ConfigError):
    """A section that was refused: ``keys`` of it are wrong, for a ``reason``."""

    def __init__(self, section: str, keys: tuple[str, ...], reason: str) -> None:
        super().__init__(f"{section}.{keys[0]}: {reason}")
        self.keys, self.reason = keys, reason


class Section(BaseModel):
    """A group of parameters, immutable; every value is checked when one is made."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )

    in_order: ClassVar[tuple[tuple[str, str], ...]] = ()
    """Pairs of parameters of which the first must not be above the second."""

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**{name: _plain(value) for name, value in values.items()})
        except ValidationError as error:
            keys, reason = self._refusal(error.errors()[0])
            raise RefusedError(type(self).__name__, keys, reason) from None

    @classmethod
    def _refusal(cls, error: ErrorDetails) -> tuple[tuple[str, ...], str]:
        """Keys that are wrong, and the reason."""
        kind, given = error["type"], shown(error["input"])
        if kind == _PAIR:
            return error["ctx"]["keys"], error["msg"]
        key = str(error["loc"][0])
        if kind == "extra_forbidden":
            return (key,), f"unknown key{nearest(key, cls.model_fields)}"
        if kind == "value_error":  # from a section in it
            return (key,), str(error["ctx"]["error"])
        field = cls.model_fields[key]
        choices = get_args(field.annotation)
        if kind == "literal_error":
            near = nearest(error["input"], choices, listing=False)
            return (key,), f"expected one of {', '.join(choices)}; got {given}{near}"
        if Ellipsis in choices and kind in ("tuple_type", "missing", "too_long"):
            entry = get_args(get_args(choices[0])[0])
            return (key,), f"expected rows of {len(entry)} values, got {given}"
        if isinstance(field.default, tuple) and (len(error["loc"]) == 1 or kind == "missing"):
            return (key,), f"expected {len(choices)} values, got {given}"
        expected = _EXPECTED.get(kind, "a valid value").format(**error.get("ctx", {}))
        if kind == "bool_type" and isinstance(error["input"], str):
            expected = "true or false (other words, as yes, are text in YAML 1.2)"
        return (key,), f"expected {expected}, got {given}"

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for keys in self.in_order:
            low, high = (getattr(self, key) for key in keys)
            if low > high:
                raise out_of_order(keys, *keys, low, high)
        return self

    def __setattr__(self, name: str, value: Any) -> None:
        raise ConfigError(
            f"{type(self).__name__}.{name}: expected no assignment, for a configuration is frozen, "
            f"got {shown(value)}; config.changed('sensor.min_range=3.0') makes a changed copy"
        )

    def changed(self, /, **values: Any) -> Self:
        """A copy with other values, as ``config.solver.changed(iterations=5)``."""
        return type(self)(**{**vars(self), **values})


def clipped(section: Section, name: str, value: float) -> float:
    """The value if it is within the bounds of that parameter, else the nearer bound."""
    bounds: Any
    for bounds in type(section).model_fields[name].metadata:
        value = max(value, getattr(bounds, "ge", value))
        value = min(value, getattr(bounds, "le", value))
    return value


def out_of_order(
    keys: tuple[str, ...], lower: str, upper: str, low: float, high: float
) -> PydanticCustomError:
    """The error for two parameters, or sums of them, of which the first is above the second."""
    text = f"expected {lower} <= {upper}, got {low} and {high}"
    return PydanticCustomError(_PAIR, text, {"keys": keys})


def shown(value: Any) -> str:
    """A value in an error message: short, for aliases in YAML can make one of any length."""
    if isinstance(value, Mapping):
        return f"a mapping of {len(value)} keys"
    nests = (list, tuple, Mapping)
    if isinstance(value, (list, tuple)) and any(isinstance(entry, nests) for entry in value):
        return f"a list of {len(value)} lists or mappings"
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number that is too long"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


AnySection = TypeVar("AnySection", bound=Section)


def override(
    section: AnySection,
    data: Mapping[Any, Any],
    where: Callable[[tuple[Any, ...]], str],
    above: tuple[str, ...] = (),
) -> AnySection:
    """A section with the values of nested mappings in place of its own.

    An error names the key, its place by ``where`` of its path from the top, what was expected and
    what came; ``above`` is the path of the section.
    """
    values: dict[str, Any] = {}
    keys: dict[str, Any] = {}
    for key, value in data.items():
        name = key if isinstance(key, str) else shown(key)
        current = vars(section).get(name)
        if isinstance(current, Section) and isinstance(value, Mapping):
            values[name] = override(current, value, where, (*above, name))
        else:
            values[name] = value
        keys[name] = key
    try:
        return Section.changed(section, **values)
    except RefusedError as error:
        name = next((key for key in error.keys if key in keys), error.keys[0])
        place = where((*above, keys.get(name, name)))
        raise ConfigError(f"{place}{'.'.join((*above, name))}: {error.reason}") from None


def _plain(value: Any) -> Any:
    """A value of Python: no array or number of numpy, no bool that keeps the looks of its file."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, list):
        return [_plain(entry) if isinstance(entry, ScalarBoolean) else entry for entry in value]
    return bool(value) if isinstance(value, ScalarBoolean) else value


def nested(changes: Iterable[str | Mapping[str, Any]], where: str) -> dict[str, Any]:
    """Changes as :meth:`Config.changed` takes them, as mappings within mappings for `override`."""
    tree: dict[str, Any] = {}
    for change in changes:
        if not isinstance(change, (str, Mapping)):
            wanted = '"section.key=value" or {"section.key": value}'
            raise ConfigError(f"{where}expected {wanted}, got {type(change).__name__}")
        _merge(tree, assignment(change, where) if isinstance(change, str) else change)
    return tree


def _merge(tree: dict[str, Any], change: Mapping[str, Any]) -> None:
    for key, value in change.items():
        name, dot, rest = str(key).partition(".")
        if dot:
            value = {rest: value}
        if isinstance(value, Mapping):
            below = tree.get(name)
            tree[name] = below if isinstance(below, dict) else {}
            _merge(tree[name], value)
        else:
            tree[name] = value


def assignment(text: str, where: str, form: str = "SECTION.KEY=VALUE") -> dict[str, Any]:
    """A text in this form as a mapping of the key to the value, read as YAML."""
    key, separator, value = text.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"{where}expected {form}, got {text!r}")
    try:
        return {key.strip(): YAML(typ="safe", pure=True).load(value)}
    except Exception as error:  # a day 32 is a ValueError, deep nesting a RecursionError
        raise ConfigError(f"{where}{text}: {value!r} is not a YAML value") from error

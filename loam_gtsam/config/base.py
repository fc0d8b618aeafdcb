"""Sections of the configuration: pydantic models, and errors that name the key."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from loam_gtsam.types import ConfigError

_LONGEST = 200
"""Characters of a value in an error message."""
_LARGEST = (1 << 63) - 1
_PAIR = "pair"

Count = Annotated[int, Field(ge=1, le=_LARGEST)]
"""An entry of a tuple: a whole number of at least 1."""
Finite = Annotated[float, Field(allow_inf_nan=False)]
"""An entry of a tuple: a finite number."""


def parameter(
    default: Any,
    description: str,
    *,
    unit: str = "",
    source: str = "",
    low: float | None = None,
    high: float | None = None,
) -> Any:
    """A field of a section; ``low`` and ``high`` bound a number (inclusive)."""
    if type(default) is int and high is None:
        high = _LARGEST
    return Field(
        default,
        description=description,
        ge=low,
        le=high,
        strict=False if isinstance(default, tuple) else None,  # which takes lists, too
        json_schema_extra={"unit": unit, "source": source},
    )


@dataclass(frozen=True, slots=True)
class Parameter:
    """What is known about a parameter of the configuration.

    Attributes
    ----------
    name : its key within the section
    default : value in the default configuration
    description : its meaning, whole sentences
    unit, source : empty if there is none
    kind : type of the value, or of the entries of a tuple
    size : number of entries of a tuple, else 0
    choices : texts it may take; empty unless it is a choice
    optional : None is allowed as well
    low, high : inclusive bounds of a number, or of the entries of a tuple; None: unbounded
    """

    name: str
    default: Any
    description: str
    unit: str
    source: str
    kind: type
    size: int
    choices: tuple[str, ...]
    optional: bool
    low: float | None
    high: float | None

    @classmethod
    def of(cls, name: str, field: FieldInfo) -> Parameter:
        """What a field of a section says."""
        hint: Any = field.annotation
        constraints, args = field.metadata, get_args(hint)
        size, optional = 0, False
        choices: tuple[str, ...] = ()
        if get_origin(hint) is Literal:
            hint, choices = str, args
        elif get_origin(hint) is tuple:
            entry, size = FieldInfo.from_annotation(args[0]), len(args)
            hint, constraints = entry.annotation, entry.metadata
        elif type(None) in args:
            hint, optional = args[0], True
        low = next((c.ge for c in constraints if hasattr(c, "ge")), None)
        high = next((c.le for c in constraints if hasattr(c, "le")), None)
        extra: Any = field.json_schema_extra or {}
        return cls(
            name=name,
            default=field.default,
            description=field.description or "",
            unit=extra.get("unit", ""),
            source=extra.get("source", ""),
            kind=hint,
            size=size,
            choices=choices,
            optional=optional,
            low=low,
            high=None if high == _LARGEST else high,
        )

    @property
    def meaning(self) -> str:
        """Description with unit and source."""
        unit = f" [{self.unit}]" if self.unit else ""
        source = f" ({self.source})" if self.source else ""
        return f"{self.description}{unit}{source}"

    def expected(self, error: ErrorDetails) -> str:
        """What a value should have been instead of the one that pydantic refused."""
        given, reason = error["input"], error["type"]
        if self.choices:
            near = nearest(given, self.choices, listing=False)
            return f"expected one of {', '.join(self.choices)}; got {shown(given)}{near}"
        if self.size and (len(error["loc"]) == 1 or reason == "missing"):
            return f"expected {self.size} values, got {shown(given)}"
        if reason == "less_than_equal" and self.high is None:
            return "the number is too large"
        if reason in ("greater_than_equal", "less_than_equal", "finite_number"):
            bounds = [f"at least {self.low}"] * (self.low is not None)
            bounds += [f"at most {self.high}"] * (self.high is not None)
            return f"expected {' and '.join(bounds) or 'a finite number'}, got {shown(given)}"
        if self.kind is float and type(given) is int:
            return "the number is too large"
        return f"expected {self.kind.__name__}, got {shown(given)}"


class RefusedError(ConfigError):
    """A section that was refused: ``keys`` of it are wrong, for a ``reason``."""

    def __init__(self, section: str, keys: tuple[str, ...], reason: str) -> None:
        super().__init__(section, keys, reason)
        self.section, self.keys, self.reason = section, keys, reason

    def __str__(self) -> str:
        return f"{self.section}.{self.keys[0]}: {self.reason}"


def out_of_order(
    keys: tuple[str, ...], lower: str, upper: str, low: float, high: float
) -> PydanticCustomError:
    """The error for two parameters, or sums of them, of which the first is above the second."""
    text = f"expected {lower} <= {upper}, got {low} and {high}"
    return PydanticCustomError(_PAIR, text, {"keys": keys})


class Section(BaseModel):
    """A group of parameters, immutable; every value is checked when one is made."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    in_order: ClassVar[tuple[tuple[str, str], ...]] = ()
    """Pairs of parameters of which the first must not be above the second."""

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise self._refused(error.errors()[0]) from None

    @classmethod
    def _refused(cls, error: ErrorDetails) -> RefusedError:
        if error["type"] == _PAIR:
            return RefusedError(cls.__name__, error["ctx"]["keys"], error["msg"])
        key = str(error["loc"][0])
        if error["type"] == "extra_forbidden":
            reason = f"unknown key{nearest(key, cls.model_fields)}"
        elif error["type"] == "value_error":  # from a section in it
            reason = str(error["ctx"]["error"])
        else:
            reason = cls.parameters()[key].expected(error)
        return RefusedError(cls.__name__, (key,), reason)

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for pair in self.in_order:
            lower, upper = (getattr(self, key) for key in pair)
            if lower > upper:
                raise out_of_order(pair, *pair, lower, upper)
        return self

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """Every parameter of the section by its key, in order."""
        return {name: Parameter.of(name, field) for name, field in cls.model_fields.items()}

    def changed(self, **values: Any) -> Self:
        """A copy with other values, as ``config.solver.changed(iterations=5)``.

        Raises
        ------
        ConfigError
            If there is no such parameter, or a value does not fit.
        """
        return type(self)(**{**vars(self), **values})


def shown(value: Any) -> str:
    """A value in an error message: short, for aliases in YAML can make one of any length."""
    if isinstance(value, Mapping):
        return f"a mapping of {len(value)} keys"
    if isinstance(value, (list, tuple)) and any(
        isinstance(entry, (list, tuple, Mapping)) for entry in value
    ):
        return f"a list of {len(value)} lists or mappings"
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write integers of thousands of digits
        return "a number that is too long"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def nearest(name: object, known: Iterable[str], listing: bool = True) -> str:
    """The end of a message about an unknown name: which one may be meant, and all there are."""
    asked = name[:_LONGEST] if isinstance(name, str) else ""
    close = difflib.get_close_matches(asked, list(known), n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return hint + (f" (known: {', '.join(sorted(known))})" if listing else "")

"""Types of values: each states its valid values once, for Python, tables, files and the window.

Pydantic converts and checks a value by its type: a field of a `checked` dataclass, a cell of a
table, an option of the shell, or a value in a file. Text is converted, so that "0.45" is a
Poisson's ratio in Python as in a table.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, TypeVar, dataclass_transform, get_args

import pydantic
from pydantic import BeforeValidator, ConfigDict, Field, PlainSerializer, WrapValidator
from pydantic_core import CoreSchema, core_schema

from napari_hmrf.arguments import shown
from napari_hmrf.errors import ArgumentError

Kind = TypeVar("Kind")
_CONFIG = ConfigDict(extra="forbid", arbitrary_types_allowed=True)

#: Range of Poisson's ratio in which tissue is stable and compressible.
POISSON_RANGE = (0.0, 0.499)
#: Range of penalties for which products of forces do not overflow or underflow.
PENALTY_RANGE = (1e-30, 1e30)
#: Largest stiffness, the largest number in single precision; above, it would become infinite.
LARGEST_STIFFNESS = 3.4028234663852886e38
#: Largest growth, as a strain; larger values were probably given in per cent.
LARGEST_GROWTH = 10.0
_RIGID = "rigid"
#: Kind of the errors with `Words`.
_INVALID = "invalid_value"


class Words(NamedTuple):
    """Annotation of a type with a description of its valid values, which follows "must be"."""

    text: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: pydantic.GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.custom_error_schema(
            handler(source), _INVALID, custom_error_message=self.text
        )


class Choice:
    """Annotation of a `Literal` of words, which may be given in any case."""

    def __get_pydantic_core_schema__(
        self, source: Any, handler: pydantic.GetCoreSchemaHandler
    ) -> CoreSchema:
        any_case = core_schema.no_info_before_validator_function(_lower, handler(source))
        *others, last = get_args(source)
        words = f"{', '.join(others)} or {last}"
        return core_schema.custom_error_schema(any_case, _INVALID, custom_error_message=words)


def _plain(value: Any) -> Any:
    """Convert NumPy's arrays and scalars to Python's types, and lists to tuples."""
    plain = value.tolist() if hasattr(value, "tolist") else value
    return tuple(plain) if isinstance(plain, list) else plain


def _number(value: Any) -> Any:
    if isinstance(value, bool | bytes):
        raise ValueError("it is not a number")
    return value


def _lower(value: Any) -> Any:
    return value.strip().casefold() if isinstance(value, str) else value


def _stiffness(value: Any, read: pydantic.ValidatorFunctionWrapHandler) -> Any:
    is_rigid = value == math.inf or _lower(value) in (_RIGID, "inf")
    return math.inf if is_rigid else read(value)


def _stiffness_in_json(value: float) -> float | str:
    return _RIGID if value == math.inf else value  # JSON has no infinity


def _fraction(value: Any) -> Any:
    """Convert a percentage, such as "20%", to a fraction."""
    is_percentage = isinstance(value, str) and value.rstrip().endswith("%")
    return float(value.rstrip().removesuffix("%")) / 100 if is_percentage else value


def _along_axes(value: Any) -> Any:
    """Split text with a number for each axis, such as "0.1/0"."""
    return tuple(value.split("/")) if isinstance(value, str) and "/" in value else _plain(value)


_BOUNDED = Annotated[float, BeforeValidator(_number), Field(allow_inf_nan=False)]
#: Number of components; `strict` refuses sets, which have no order.
_AXES = Field(min_length=2, max_length=3, strict=True)

Text = Annotated[str, Words("text")]
Flag = Annotated[bool, BeforeValidator(_plain), Words("True or False (in a table: yes or no)")]
Whole = Annotated[int, Words("a whole number, such as 1")]
#: Label of painted pixels.
Painted = Annotated[int, Field(ge=1), Words("a whole number above 0, such as 1")]
Number = Annotated[_BOUNDED, Words("a number")]
Positive = Annotated[_BOUNDED, Field(gt=0), Words("a number above 0")]
NotNegative = Annotated[_BOUNDED, Field(ge=0), Words("a number of at least 0")]
#: Standard deviation of a position.
Spread = Annotated[
    _BOUNDED,
    Field(ge=0),
    BeforeValidator(lambda value: 0.0 if value is None else value),
    Words("a length above 0, or 0 for an exact position"),
]
#: Confidence of an observation, which would have no effect at 0.
PositiveShare = Annotated[_BOUNDED, Field(gt=0, le=1), Words("a number above 0, up to 1")]
#: Strength of observations, or unit of a quantity that is multiplied with forces.
Penalty = Annotated[
    _BOUNDED,
    Field(ge=PENALTY_RANGE[0], le=PENALTY_RANGE[1]),
    Words("a number from {:g} to {:g}".format(*PENALTY_RANGE)),
]
#: Standard deviation of the strain of tissue.
TypicalStrain = Annotated[
    _BOUNDED, Field(ge=1e-9, le=1e6), Words("a number from 1e-09 to 1e+06, such as 0.1")
]
#: Count of samples or iterations.
Count = Annotated[int, Field(ge=1), Words("a whole number of at least 1")]
#: Count from which a spread is estimated, or an interval is divided.
Samples = Annotated[int, Field(ge=2), Words("a whole number of at least 2")]
#: Seed of random numbers.
Seed = Annotated[int, Field(ge=0), Words("a whole number of at least 0")]
#: Step sizes.
Steps = Annotated[
    tuple[Annotated[_BOUNDED, Field(gt=0)], ...],
    Field(min_length=1, strict=True),
    BeforeValidator(_plain),
    Words("positive numbers, such as (1, 0.1)"),
]
#: Amount of work, which may be unlimited.
Budget = Annotated[float, Field(gt=0), Words("a number above 0, or inf")]
#: Confidence or share.
Share = Annotated[_BOUNDED, Field(ge=0, le=1), Words("a number from 0 to 1")]
Poisson = Annotated[
    _BOUNDED,
    Field(ge=POISSON_RANGE[0], le=POISSON_RANGE[1]),
    Words("a number from {:g} to {:g}".format(*POISSON_RANGE)),
]
#: Young's modulus; 0 in void, infinite in rigid tissue.
Stiffness = Annotated[
    _BOUNDED,
    Field(ge=0, le=LARGEST_STIFFNESS),
    WrapValidator(_stiffness),
    PlainSerializer(_stiffness_in_json, when_used="json"),
    Words(f'a number from 0 to {LARGEST_STIFFNESS:.2g}, or "{_RIGID}"'),
]
_Strain = Annotated[_BOUNDED, Field(gt=-1, le=LARGEST_GROWTH), BeforeValidator(_fraction)]
#: Growth strain: one number for all directions, or one number for each axis.
Growth = Annotated[
    _Strain | Annotated[tuple[_Strain, ...], _AXES],
    BeforeValidator(_along_axes),
    Words(
        f"above -1 (-100%) and up to {LARGEST_GROWTH:g} ({LARGEST_GROWTH:.0%}), such as 0.2 or 20% "
        "(a fifth longer), or one for each axis"
    ),
]
#: Position or displacement, (row, col) or (plane, row, col).
Vector = Annotated[
    tuple[_BOUNDED, ...],
    _AXES,
    BeforeValidator(_plain),
    Words("finite numbers: (row, col), or (plane, row, col) in a volume"),
]
#: One number for each axis; in text, with slashes.
PerAxis = Annotated[
    tuple[_BOUNDED, ...],
    _AXES,
    BeforeValidator(_along_axes),
    Words("a number for each axis, such as 0.01/0"),
]
_CurvePoint = Annotated[
    tuple[_BOUNDED, Annotated[_BOUNDED, Field(gt=0, le=LARGEST_STIFFNESS)]], BeforeValidator(_plain)
]
#: Points of a stiffness curve.
CurvePoints = Annotated[
    tuple[_CurvePoint, ...],
    Field(min_length=2),
    BeforeValidator(_plain),
    Words(
        "two or more pairs of an intensity and a stiffness, above 0 and no larger than "
        f"{LARGEST_STIFFNESS:.2g}"
    ),
]
#: Paths of a brush, each with one or more positions. A path has many positions, so that only lists
#: that contain arrays are converted by Python.
Paths = Annotated[
    tuple[
        Annotated[
            tuple[Annotated[tuple[_BOUNDED, ...], Field(min_length=2, max_length=3)], ...],
            Field(min_length=1),
        ],
        ...,
    ],
    Field(min_length=1),
    BeforeValidator(_plain),
    Words("the paths of a brush, as points (row, col) or (plane, row, col)"),
]
#: Confidence of each component of a displacement.
Shares = Annotated[
    tuple[Annotated[_BOUNDED, Field(ge=0, le=1)], ...],
    _AXES,
    BeforeValidator(_plain),
    Words("numbers from 0 to 1: (row, col), or (plane, row, col) in a volume"),
]


@dataclass_transform(frozen_default=True)
def checked(kind: type[Kind]) -> type[Kind]:
    """Make an immutable dataclass that converts and checks its values by the types of its fields.

    Invalid values raise an `ArgumentError`. Inside other data, such as a file, they raise the
    `ValidationError` of pydantic, which states their place; see `explain`.
    """
    made: Any = pydantic.dataclasses.dataclass(frozen=True, config=_CONFIG)(kind)
    build = made.__init__

    @functools.wraps(build)
    def init(self: Any, *values: Any, **named: Any) -> None:
        try:
            build(self, *values, **named)
        except pydantic.ValidationError as error:
            raise ArgumentError(explain(error, tuple(made.__dataclass_fields__))) from None

    made.__init__ = init
    return made  # type: ignore[no-any-return]


def convert(kind: Any, value: Any, name: str = "") -> Any:
    """Convert a value to a type of this module.

    Raises
    ------
    ArgumentError
        If the value is invalid; the message begins with the name.
    """
    try:
        return adapter_of(kind).validate_python(value)
    except pydantic.ValidationError as error:
        raise ArgumentError(f"{name} {explain(error)}".lstrip()) from None


#: Validator of a type, which takes about a millisecond to make.
adapter_of = functools.cache(pydantic.TypeAdapter)


def explain(error: pydantic.ValidationError, names: Sequence[str] = ()) -> str:
    """Describe the first invalid value of an error and its valid values, without a full stop.

    Parameters
    ----------
    error : pydantic.ValidationError
    names : sequence of str
        Names of positional arguments.
    """
    first = error.errors(include_url=False)[0]
    name = first["loc"][-1] if first["loc"] else ""
    if isinstance(name, int):
        name = names[name] if name < len(names) else ""
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    if first["type"] == _INVALID:
        return f"{name} must be {first['msg']}, not {shown(first['input'])}".lstrip()
    if first["type"] in ("missing", "missing_argument"):
        return f"{name} is missing"
    return f"{name}: {first['msg'].lower()}".lstrip(": ")

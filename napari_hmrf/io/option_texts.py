"""Options of the shell and cells of tables: texts, converted by the types of a dataclass."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from pydantic import BeforeValidator, Field, PlainValidator

from napari_hmrf.arguments import did_you_mean
from napari_hmrf.checks import Budget as Budget
from napari_hmrf.checks import Count as Count
from napari_hmrf.checks import Flag as Flag
from napari_hmrf.checks import Number as Number
from napari_hmrf.checks import PerAxis as PerAxis
from napari_hmrf.checks import Poisson as Poisson
from napari_hmrf.checks import Positive as Positive
from napari_hmrf.checks import Samples as Samples
from napari_hmrf.checks import Seed as Seed
from napari_hmrf.checks import Words, convert
from napari_hmrf.errors import ArgumentError
from napari_hmrf.field.units import UNKNOWN_UNITS, is_length
from napari_hmrf.io.images import length_unit
from napari_hmrf.solver.model_names import as_word
from napari_hmrf.tissue.cavity import Cavity


def _lengths(text: str) -> float | tuple[float, float]:
    low, hyphen, high = text.partition("-")
    return (float(low), float(high)) if hyphen and low else float(text)


def _pixel_size(value: Any) -> Any:
    """Split text into the sizes of a pixel and their unit."""
    if not isinstance(value, str):
        return value
    sizes = "/".join(re.findall(r"[\d.]+", value))
    unit = length_unit(value.removeprefix(sizes).strip())
    if unit in UNKNOWN_UNITS or not is_length(unit):
        raise ValueError("it has no unit of length")
    return sizes.split("/"), unit


Index = Annotated[int, Field(ge=0), Words("the index of a slice (in a table also 3-7, or all)")]
PixelSize = Annotated[
    tuple[Annotated[tuple[Positive, ...], Field(min_length=2, max_length=3)], str],
    BeforeValidator(_pixel_size),
    Words("a size along each axis and a unit, such as 2.5/0.5/0.5um"),
]
CavityLoad = Annotated[
    Cavity,
    PlainValidator(lambda text: Cavity(*map(float, text.split("/", 2)))),
    Words("pressure/fluid/level, such as 0/0.00981/0.5"),
]
#: Length, or range of lengths.
Lengths = Annotated[
    Any, PlainValidator(_lengths), Words("a length such as 3, or a range such as 1-4")
]


def values_of(
    kind: type, texts: Mapping[str, Any], title: Callable[[str], str] = str
) -> dict[str, Any]:
    """Convert texts to values of the fields of a dataclass.

    Parameters
    ----------
    kind : type
        Dataclass; the names in its annotations are those of this module and of its own.
    texts : mapping
        Text, texts or True for each field.
    title : callable
        Function that returns the name of a field for messages.

    Raises
    ------
    ArgumentError
        If a text is invalid; the message names the field and describes valid text.
    """
    types = _types_of(kind)
    return {name: _value_of(types[name], text, title(name)) for name, text in texts.items()}


@cache
def _types_of(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, localns=globals(), include_extras=True)


def words_of(kind: Any) -> dict[str, str]:
    """Return the values of a literal type, optional or not, by the word that users type."""
    kinds = [each for each in get_args(kind) if each is not NoneType]
    kind = kinds[0] if len(kinds) == 1 and NoneType in get_args(kind) else kind
    values = get_args(kind) if get_origin(kind) is Literal else ()
    return {as_word(value): value for value in values}


def _value_of(kind: Any, text: Any, title: str) -> Any:
    words = words_of(kind)
    if not words:
        return convert(kind, text, title)
    word = as_word(text)
    if word not in words:
        raise ArgumentError(
            f"{title}: there is no {text!r}.{did_you_mean(word, words)} Choose from "
            f"{', '.join(words)}"
        )
    return words[word]

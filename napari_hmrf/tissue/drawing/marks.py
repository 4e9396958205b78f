"""The marks a drawing is made of.

Places are (row, col) in pixels of the image, (plane, row, col) of a volume, and need not be whole;
lengths (displacements, radii) are in the unit of the pixel spacing. Displacements are material:
what is drawn at X moves to X + by.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np

from napari_hmrf.arguments import is_one_of, is_whole, real, reals, shown
from napari_hmrf.errors import ProblemError

Point = tuple[float, ...]
#: Which components of a displacement a mark speaks of; of a volume "both" is all three.
Components = Literal["both", "row", "col"]
#: Where these are among the axes, counted from the last, as a volume has one before them.
COMPONENTS = {"both": slice(None), "row": slice(-2, -1), "col": slice(-1, None)}
#: What the tissue under a brush does, or is.
Action = Literal["pin", "free", "move", "expand", "confidence", "tissue"]


def between(start: Point, end: Point, spacing: Iterable[float]) -> Point:
    """How far it is from one place to another along each axis, in lengths."""
    return tuple((b - a) * size for a, b, size in zip(start, end, spacing, strict=True))


def _number(least: float, most: float) -> Callable[[Any], float | None]:
    return lambda value: number if least <= (number := real(value)) <= most else None


def _place(value: Any) -> Point | None:
    axes = 3 if np.shape(value) == (3,) else 2
    along = tuple(reals(value, axes))
    return along if all(map(math.isfinite, along)) else None


def _lines(values: Any) -> tuple[tuple[Point, ...], ...] | None:
    try:  # a stroke has many places
        lines = [np.asarray(line, dtype=float) for line in values]
    except (TypeError, ValueError):
        return None
    right = (line.ndim == 2 and np.isfinite(line).all() for line in lines)
    plain = tuple(tuple(map(tuple, line.tolist())) for line in lines)
    places = {line.shape[-1] for line in lines} in ({2}, {3})
    return plain if plain and all(plain) and places and all(right) else None


def _one_of(words: tuple[str, ...]) -> tuple[Callable[[Any], str | None], str]:
    return lambda value: value if is_one_of(value, words) else None, " or ".join(words)


_LARGEST = sys.float_info.max
_SHARE = (_number(0, 1), "a value from 0 to 1")
_PLACE = (_place, "(row, col), or (plane, row, col) of a volume")
#: By its name how a value is made plain, None if it means nothing, and what to give.
_VALUES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "at": _PLACE,
    "by": _PLACE,
    "source": _PLACE,
    "target": _PLACE,
    "lines": (_lines, "the places of a brush, (row, col) each, or (plane, row, col)"),
    "radius": (_number(sys.float_info.min, _LARGEST), "a length above 0"),
    "amount": (_number(-_LARGEST, _LARGEST), "a number"),
    "confidence": _SHARE,
    "softness": _SHARE,
    "label": (lambda value: int(value) if is_whole(value) else None, "a whole number"),
    "action": _one_of(get_args(Action)),
    "components": _one_of(get_args(Components)),
}


def _checked(name: str, value: Any) -> Any:
    """A value in its plain type, so that equal marks are equal and go into files."""
    make_plain, give = _VALUES[name]
    plain = make_plain(value)
    if plain is None:
        field = "confidence" if name in ("confidence", "softness") else "observed"
        raise ProblemError(field, f"has a mark with {name} {shown(value)}. Give {give}.")
    return plain


class _Checked:
    """Refuses values that mean nothing."""

    #: Whether a confidence of 0 says something: a stroke takes away what is beneath it.
    _may_doubt = False
    confidence: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, _checked(name, value))
        if not (self.confidence or self._may_doubt):
            raise ProblemError("confidence", "has a mark with a confidence of 0. Remove the mark.")
        if len({len(place) for place in self._places}) > 1:
            raise ProblemError(
                "observed",
                "has a mark with places of two and of three axes. Give (row, col) in an image, "
                "(plane, row, col) in a volume.",
            )

    @property
    def _places(self) -> tuple[Point, ...]:
        """Places and steps, all of as many axes."""
        return tuple(value for name, value in vars(self).items() if _VALUES[name] is _PLACE)


@dataclass(frozen=True)
class Arrow(_Checked):
    """A patch of tissue that is prescribed to move.

    Attributes
    ----------
    at : tuple of float
        Middle of the patch, (row, col) or (plane, row, col) in pixels.
    by : tuple of float
        How far it moves along each axis, in the unit of the pixel spacing.
    radius : float
        Of the patch, in a volume a ball, in the unit of the pixel spacing. However small, the
        nearest pixel counts.
    confidence : float
        How sure that is, from above 0 to 1 (certain).
    components : {"both", "row", "col"}
        Of the displacement; what a mark does not speak of stays as it is beneath.

    Raises
    ------
    ProblemError
        If a value is not a number, or out of range.
    """

    at: Point
    by: Point
    radius: float
    confidence: float = 1.0
    components: Components = "both"

    @property
    def lines(self) -> tuple[tuple[Point, ...], ...]:
        """Where it lies, as a stroke that touched in one place."""
        return ((self.at,),)

    def head(self, spacing: Iterable[float]) -> Point:
        """Where the middle of the patch goes, in pixels."""
        steps = zip(self.at, self.by, spacing, strict=True)
        return tuple(at + by / size for at, by, size in steps)


@dataclass(frozen=True)
class Landmark(_Checked):
    """A place that was found again elsewhere.

    Attributes
    ----------
    source, target : tuple of float
        Where it is and where it should be, (row, col) or (plane, row, col) in pixels.
    radius, confidence
        As of an `Arrow`.

    Raises
    ------
    ProblemError
        If a value is not a number, or out of range.
    """

    source: Point
    target: Point
    radius: float
    confidence: float = 1.0

    @property
    def lines(self) -> tuple[tuple[Point, ...], ...]:
        """Where it lies, as a stroke that touched in one place."""
        return ((self.source,),)

    def arrow(self, spacing: Iterable[float]) -> Arrow:
        """The same as an arrow, whose length depends on the size of a pixel."""
        by = between(self.source, self.target, spacing)
        return Arrow(self.source, by, self.radius, self.confidence)


@dataclass(frozen=True)
class Stroke(_Checked):
    """What was painted with a round brush, in a volume with a ball.

    Attributes
    ----------
    action : {"pin", "free", "move", "expand", "confidence", "tissue"}
        The tissue under the brush stays where it is; is not observed, whatever is beneath; moves
        by `by`; moves by `amount` along the outward normal of the painted region (all of a ring,
        but only the rim of a patch, whose inside is not observed); is observed as it is beneath,
        with another confidence; or becomes tissue of `label`.
    lines : tuple of tuple of tuple of float
        The ways of the brush, (row, col) or (plane, row, col) in pixels; of one point, where it
        touched only. All of them are one painted region.
    radius : float
        Of the brush, in the unit of the pixel spacing.
    by : tuple of float
        Of "move": along each axis, in the unit of the pixel spacing.
    amount : float
        Of "expand": in the unit of the pixel spacing; below 0 the region shrinks.
    confidence : float
        From 0 (not observed) to 1 (certain).
    softness : float
        Of "confidence": the part of the radius, 0 to 1, across which it fades into what is beneath.
    label : int
        Of "tissue".
    components : {"both", "row", "col"}
        Of the displacement; what a mark does not speak of stays as it is beneath.

    Raises
    ------
    ProblemError
        If a value is not a number, or out of range.
    """

    _may_doubt = True
    action: Action
    lines: tuple[tuple[Point, ...], ...]
    radius: float
    by: Point = (0.0, 0.0)
    amount: float = 0.0
    confidence: float = 1.0
    softness: float = 0.0
    label: int = 0
    components: Components = "both"

    @property
    def _places(self) -> tuple[Point, ...]:
        place = self.lines[0][0]
        return (place, self.by) if self.action == "move" else (place,)

    @property
    def moves_nowhere(self) -> bool:
        """Whether it says that tissue moves, by nothing."""
        by = {"move": self.by, "expand": (self.amount,)}.get(self.action, (1.0,))
        return not any(by)

    def onward(self, point: Point) -> Stroke:
        """The stroke, with the brush moved on to another place."""
        *before, line = self.lines
        return _with_lines(self, (*before, (*line, _checked("at", point))))

    def again(self, point: Point) -> Stroke:
        """The stroke, with the brush put down once more, at another place."""
        return _with_lines(self, (*self.lines, (_checked("at", point),)))

    def added_to(self, earlier: Stroke) -> Stroke | None:
        """What the brush did since it was `earlier`; None if this is not a continuation of it."""
        count, last = len(earlier.lines), len(earlier.lines[-1])
        if _with_lines(self, earlier.lines) != earlier or len(self.lines) < count:
            return None
        line = self.lines[count - 1]
        if self.lines[: count - 1] != earlier.lines[:-1] or line[:last] != earlier.lines[-1]:
            return None
        return _with_lines(self, (line[last - 1 :], *self.lines[count:]))


Mark = Arrow | Landmark | Stroke
_KINDS: dict[str, type[Mark]] = {"arrow": Arrow, "landmark": Landmark, "stroke": Stroke}


def mark_as_dict(mark: Mark) -> dict[str, Any]:
    """Plain JSON types."""
    return {"kind": type(mark).__name__.lower(), **asdict(mark)}


def mark_from_dict(values: Mapping[str, Any]) -> Mark:
    """The inverse of `mark_as_dict`.

    Raises
    ------
    ValueError
        If it is not what that made.
    """
    try:
        rest = dict(values)
        return _KINDS[rest.pop("kind")](**rest)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a mark: {error}") from error


def _with_lines(stroke: Stroke, lines: tuple[tuple[Point, ...], ...]) -> Stroke:
    """As `dataclasses.replace`, without checking every point of a long stroke again."""
    other = object.__new__(Stroke)
    other.__dict__.update(stroke.__dict__, lines=lines)
    return other

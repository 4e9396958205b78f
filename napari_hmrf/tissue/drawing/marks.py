"""The marks a drawing is made of.

Places are (row, col) in pixels of the image, and need not be whole; lengths (displacements, radii)
are in the unit of the pixel spacing. Displacements are material: what is drawn at X moves to
X + by.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np

from napari_hmrf.errors import ProblemError

Point = tuple[float, float]
#: Which components of a displacement a mark speaks of.
Components = Literal["both", "row", "col"]
#: What the tissue under a brush does, or is.
Action = Literal["pin", "free", "move", "expand", "confidence", "tissue"]


@dataclass(frozen=True)
class Arrow:
    """A patch of tissue that is prescribed to move.

    Attributes
    ----------
    at : (float, float)
        Middle of the patch, (row, col) in pixels.
    by : (float, float)
        How far it moves in (row, col) direction, in the unit of the pixel spacing.
    radius : float
        Of the patch, in the unit of the pixel spacing. However small, the nearest pixel counts.
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

    def __post_init__(self) -> None:
        _set(self, at=_point(self.at), by=_point(self.by, "observed"), radius=_radius(self.radius))
        _set(self, confidence=_confidence(self.confidence))
        _one_of("components", self.components, get_args(Components))

    def head(self, spacing: Iterable[float]) -> Point:
        """Where the middle of the patch goes, in pixels."""
        row, col = (at + by / size for at, by, size in zip(self.at, self.by, spacing, strict=True))
        return row, col


@dataclass(frozen=True)
class Landmark:
    """A place that was found again elsewhere.

    Attributes
    ----------
    source, target : (float, float)
        Where it is and where it should be, (row, col) in pixels.
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

    def __post_init__(self) -> None:
        _set(self, source=_point(self.source), target=_point(self.target))
        _set(self, radius=_radius(self.radius), confidence=_confidence(self.confidence))

    def arrow(self, spacing: Iterable[float]) -> Arrow:
        """The same as an arrow, whose length depends on the size of a pixel."""
        row, col = (
            (to - start) * size
            for start, to, size in zip(self.source, self.target, spacing, strict=True)
        )
        return Arrow(self.source, (row, col), self.radius, self.confidence)


@dataclass(frozen=True)
class Stroke:
    """What was painted with a round brush.

    Attributes
    ----------
    action : {"pin", "free", "move", "expand", "confidence", "tissue"}
        The tissue under the brush stays where it is; is not observed, whatever is beneath; moves
        by `by`; moves by `amount` along the outward normal of the painted region; is observed as
        it is beneath, with another confidence; or becomes tissue of `label`.
    lines : tuple of tuple of (float, float)
        The ways of the brush, (row, col) in pixels; of one point, where it touched only. All of
        them are one painted region.
    radius : float
        Of the brush, in the unit of the pixel spacing.
    by : (float, float)
        Of "move": in (row, col) direction, in the unit of the pixel spacing.
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

    action: Action
    lines: tuple[tuple[Point, ...], ...]
    radius: float
    by: Point = (0.0, 0.0)
    amount: float = 0.0
    confidence: float = 1.0
    softness: float = 0.0
    label: int = 0
    components: Components = "both"

    def __post_init__(self) -> None:
        _one_of("action", self.action, get_args(Action))
        _one_of("components", self.components, get_args(Components))
        lines = tuple(tuple(_point(point) for point in line) for line in self.lines)
        if not lines or not all(lines):
            raise ProblemError(
                "observed", "has a stroke of the brush without a place. Give it one."
            )
        _set(self, lines=lines, by=_point(self.by, "observed"), radius=_radius(self.radius))
        _set(self, amount=_number("observed", "an amount", self.amount))
        _set(self, confidence=_share("a confidence", self.confidence))
        _set(self, softness=_share("a softness", self.softness), label=int(self.label))

    @property
    def moves_nowhere(self) -> bool:
        """Whether it says that tissue moves, by nothing."""
        by = {"move": self.by, "expand": (self.amount,)}.get(self.action, (1.0,))
        return not any(by)

    def onward(self, point: Point) -> Stroke:
        """The stroke, with the brush moved on to another place."""
        *before, line = self.lines
        return _with_lines(self, (*before, (*line, _point(point))))

    def again(self, point: Point) -> Stroke:
        """The stroke, with the brush put down once more, at another place."""
        return _with_lines(self, (*self.lines, (_point(point),)))

    def distance(self, point: Point, spacing: Iterable[float]) -> float:
        """How far a place is from the way of the brush, in the unit of the pixel spacing."""
        size = np.array(tuple(spacing))
        to, nearest = np.array(point) * size, math.inf
        for line in self.lines:
            points = np.array(line) * size
            starts, ends = (points[:-1], points[1:]) if len(points) > 1 else (points, points)
            steps = ends - starts
            squares = np.maximum((steps**2).sum(axis=1), 1e-300)
            along = np.clip(((to - starts) * steps).sum(axis=1) / squares, 0, 1)
            away = np.linalg.norm(starts + along[:, None] * steps - to, axis=1)
            nearest = min(nearest, float(away.min()))
        return nearest

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
    except KeyError as error:
        raise ValueError(f"not a mark: no kind {error}") from error
    except (TypeError, ValueError) as error:
        raise ValueError(f"not a mark: {error}") from error


def _with_lines(stroke: Stroke, lines: tuple[tuple[Point, ...], ...]) -> Stroke:
    """As `dataclasses.replace`, without checking every point of a long stroke again."""
    other = object.__new__(Stroke)
    other.__dict__.update(stroke.__dict__, lines=lines)
    return other


def _set(mark: Mark, **values: Any) -> None:
    """Store values in their plain types: equal marks are equal, and go into files."""
    for name, value in values.items():
        object.__setattr__(mark, name, value)


def _number(field: str, what: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ProblemError(field, f"has a mark with {what} of {value!r}. Give a number.")
    return number


def _point(value: Any, field: str = "") -> Point:
    what = "a displacement" if field else "a place"
    try:
        row, col = value
    except (TypeError, ValueError):
        raise ProblemError(
            "observed", f"has a mark with {what} {value!r}. Give (row, col)."
        ) from None
    return _number("observed", what, row), _number("observed", what, col)


def _radius(value: Any) -> float:
    radius = _number("observed", "a radius", value)
    if radius <= 0:
        raise ProblemError(
            "observed", f"has a mark with a radius of {radius:g}. Give a length above 0."
        )
    return radius


def _share(what: str, value: Any) -> float:
    share = _number("confidence", what, value)
    if not 0 <= share <= 1:
        raise ProblemError(
            "confidence", f"has a mark with {what} of {share:g}. Give a value from 0 to 1."
        )
    return share


def _confidence(value: Any) -> float:
    confidence = _share("a confidence", value)
    if confidence == 0:
        raise ProblemError(
            "confidence", "has a mark with a confidence of 0, which says nothing. Remove the mark."
        )
    return confidence


def _one_of(what: str, value: Any, known: tuple[str, ...]) -> None:
    if value not in known:
        listed = ", ".join(f'"{each}"' for each in known)
        raise ProblemError(
            "observed", f"has a mark with the {what} {value!r}. Take one of {listed}."
        )

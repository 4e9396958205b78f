"""Marks of a drawing: arrows, landmarks and brush strokes.

Positions are (row, col) in pixels of the image, or (plane, row, col) in a volume, and may be
fractional. Lengths, such as displacements and radii, are in the unit of the pixel spacing.
Displacements are material: tissue at X moves to X + by.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from napari_hmrf.arguments import is_one_of, is_whole, real, reals, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion

Point = tuple[float, ...]
#: Components of a displacement that a mark prescribes; in a volume, "both" means all three.
Components = Literal["both", "row", "col"]
#: Index slice that selects the prescribed components, counted from the last axis.
COMPONENTS = {"both": slice(None), "row": slice(-2, -1), "col": slice(-1, None)}
#: Effects of a brush on the tissue under it.
Action = Literal["pin", "free", "move", "expand", "confidence", "tissue", "slide", "remove"]


def between(start: Point, end: Point, spacing: Iterable[float]) -> Point:
    """Return the displacement from one position in pixels to another, in the unit of `spacing`."""
    return tuple((b - a) * size for a, b, size in zip(start, end, spacing, strict=True))


def _number(least: float, most: float) -> Callable[[Any], float | None]:
    return lambda value: number if least <= (number := real(value)) <= most else None


def _place(value: Any) -> Point | None:
    axes = 3 if np.shape(value) == (3,) else 2
    along = tuple(reals(value, axes))
    return along if all(map(math.isfinite, along)) else None


def _lines(values: Any) -> tuple[tuple[Point, ...], ...] | None:
    try:  # a stroke has many points, so they are checked as arrays
        lines = [np.asarray(line, dtype=float) for line in values]
    except (TypeError, ValueError):
        return None
    right = (line.ndim == 2 and np.isfinite(line).all() for line in lines)
    plain = tuple(tuple(map(tuple, line.tolist())) for line in lines)
    places = {line.shape[-1] for line in lines} in ({2}, {3})
    return plain if plain and all(plain) and places and all(right) else None


def _one_of(words: tuple[str, ...]) -> tuple[Callable[[Any], str | None], str]:
    return lambda value: value if is_one_of(value, words) else None, " or ".join(words)


def _spread(value: Any) -> float | None:
    return 0.0 if value is None else _number(0, _LARGEST)(value)


def _motion(value: Any) -> PatchMotion | None:
    if isinstance(value, Mapping):
        return PatchMotion.from_dict(value)
    return value if isinstance(value, PatchMotion) else None


_LARGEST = sys.float_info.max
_SHARE = (_number(0, 1), "a value from 0 to 1")
_PLACE = (_place, "finite numbers: (row, col), or (plane, row, col) in a volume")
#: For each field: function that converts a value to a plain type, or to None if the value is
#: invalid; and valid values, for the error message.
_VALUES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "at": _PLACE,
    "by": _PLACE,
    "source": _PLACE,
    "target": _PLACE,
    "lines": (_lines, "the paths of a brush, as points (row, col) or (plane, row, col)"),
    "radius": (_number(sys.float_info.min, _LARGEST), "a length above 0"),
    "amount": (_number(-_LARGEST, _LARGEST), "a number"),
    "sd": (_spread, "a length above 0, or 0 for an exact position"),
    "confidence": _SHARE,
    "softness": _SHARE,
    "label": (lambda value: int(value) if is_whole(value) else None, "a whole number"),
    "action": _one_of(get_args(Action)),
    "components": _one_of(get_args(Components)),
    "motion": (_motion, "a PatchMotion"),
}


def _checked(name: str, value: Any) -> Any:
    """Convert a value to a plain type, or raise an error if it is invalid.

    Marks with plain types can be compared and saved.
    """
    make_plain, give = _VALUES[name]
    plain = make_plain(value)
    if plain is None:
        raise ProblemError("drawing", f"has a mark with {name} {shown(value)}. Use {give}.")
    return plain


class _Checked:
    """Base class of marks, which converts values to plain types and rejects invalid values."""

    #: True if a confidence of 0 is allowed, because a stroke can erase earlier marks.
    _may_doubt = False
    confidence: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None or name != "motion":
                object.__setattr__(self, name, _checked(name, value))
        if not (self.confidence or self._may_doubt):
            raise ProblemError("drawing", "has a mark with a confidence of 0. Remove the mark.")
        if len({len(place) for place in self._places}) > 1:
            raise ProblemError(
                "drawing",
                "has a mark that mixes positions in two and in three axes. Use (row, col) in an "
                "image, or (plane, row, col) in a volume.",
            )

    @property
    def _places(self) -> tuple[Point, ...]:
        """Positions and displacements, which must all have the same number of axes."""
        motion = getattr(self, "motion", None)
        starts = () if motion is None else (motion.start,)
        places = (value for name, value in vars(self).items() if _VALUES[name] is _PLACE)
        return (*places, *starts)


@dataclass(frozen=True)
class Arrow(_Checked):
    """Prescribed displacement of a round patch of tissue.

    Attributes
    ----------
    at : tuple of float
        Centre of the patch, (row, col) or (plane, row, col) in pixels.
    by : tuple of float
        Displacement along each axis, in the unit of the pixel spacing.
    radius : float
        Radius of the patch, which is a ball in a volume, in the unit of the pixel spacing. The
        patch always includes the nearest pixel.
    confidence : float
        Confidence in the displacement, above 0 and up to 1 (certain).
    components : {"both", "row", "col"}
        Components that the mark prescribes; earlier marks determine the other components.
    amount : float
        Growth of the patch: distance by which its outline also moves outward, in the unit of the
        pixel spacing; a negative value shrinks the patch. The centre moves by `by`, and the tissue
        between the centre and the rim is not observed.
    motion : PatchMotion, optional
        Displacement of each pixel of the patch, in place of `by`, which is then the displacement of
        the centre. A click with the tool *Pull* holds displaced tissue in this way. By default, the
        whole patch moves by `by`.

    Raises
    ------
    ProblemError
        If a value is not a number or is out of range.
    """

    at: Point
    by: Point
    radius: float
    confidence: float = 1.0
    components: Components = "both"
    amount: float = 0.0
    motion: PatchMotion | None = None

    @property
    def lines(self) -> tuple[tuple[Point, ...], ...]:
        """Position of the mark, as a single path with one point; see `Stroke.lines`."""
        return ((self.at,),)

    def head(self, spacing: Iterable[float]) -> Point:
        """Return the centre of the patch after the motion, in pixels."""
        steps = zip(self.at, self.by, spacing, strict=True)
        return tuple(at + by / size for at, by, size in steps)


@dataclass(frozen=True)
class Landmark(_Checked):
    """Point of the tissue, with its positions before and after the motion.

    Attributes
    ----------
    source, target : tuple of float
        Position before and after the motion, (row, col) or (plane, row, col) in pixels.
    radius, confidence, amount, motion
        As for an `Arrow`; without effect if `sd` is above 0.
    sd : float
        Standard deviation of the difference between target and source, in the unit of the pixel
        spacing, for the elastic model only. At 0 (or None), the landmark is exact: the patch moves
        with it. Above 0, there is no patch: the displacement of the point, which may be between
        pixels, is weighed against the strain of the tissue. Values below a thousandth of a pixel
        have the effect of a thousandth of a pixel.

    Raises
    ------
    ProblemError
        If a value is not a number or is out of range.
    """

    source: Point
    target: Point
    radius: float
    confidence: float = 1.0
    amount: float = 0.0
    sd: float = 0.0
    motion: PatchMotion | None = None

    @property
    def lines(self) -> tuple[tuple[Point, ...], ...]:
        """Position of the mark, as a single path with one point; see `Stroke.lines`."""
        return ((self.source,),)

    def arrow(self, spacing: Iterable[float]) -> Arrow:
        """Return the landmark as an arrow, with its displacement in the unit of `spacing`."""
        by = between(self.source, self.target, spacing)
        size, sure = self.radius, self.confidence
        return Arrow(self.source, by, size, sure, amount=self.amount, motion=self.motion)


@dataclass(frozen=True)
class Stroke(_Checked):
    """Stroke of a round brush; in a volume the brush is a ball.

    Attributes
    ----------
    action : {"pin", "free", "move", "expand", "confidence", "tissue", "slide", "remove"}
        Effect on the tissue under the brush. "pin": the tissue does not move. "free": the motion
        is not observed, even under earlier marks. "move": the tissue moves by `by`. "expand": the
        tissue moves by `amount` along the outward normal of the painted region. A ring moves as a
        whole; a filled patch moves only at its rim, and its interior is not observed.
        "confidence": the confidence of earlier marks changes. "tissue": the label changes to
        `label`. "slide": the tissue moves freely along the painted surface, and by `amount` along
        its outward normal; see `BoundaryRule`. "remove": the tissue is removed, whatever else
        holds or moves it; a later stroke with the action "tissue" fills the cavity with new tissue.
    lines : tuple of tuple of tuple of float
        Points of each path of the brush, (row, col) or (plane, row, col) in pixels. A path with
        one point is a spot. All paths together paint one region.
    radius : float
        Radius of the brush, in the unit of the pixel spacing.
    by : tuple of float
        For "move": displacement along each axis, in the unit of the pixel spacing.
    amount : float
        For "expand": displacement in the unit of the pixel spacing. A negative value shrinks the
        region. For "move": growth of the region, in addition to `by`. For "slide":
        displacement along the outward normal of the surface.
    confidence : float
        Confidence of the displacement, from 0 (not observed) to 1 (certain).
    softness : float
        For "confidence": fraction of the radius, from 0 to 1, over which the confidence of the
        stroke fades into the confidence of earlier marks.
    label : int
        For "tissue": label of the tissue in the table or, without a table, in the preset.
    components : {"both", "row", "col"}
        Components that the mark prescribes; earlier marks determine the other components.
    motion : PatchMotion, optional
        For "move": displacement of each pixel, instead of `by`.

    Raises
    ------
    ProblemError
        If a value is not a number or is out of range.
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
    motion: PatchMotion | None = None

    @property
    def _places(self) -> tuple[Point, ...]:
        place = self.lines[0][0]
        starts = () if self.motion is None else (self.motion.start,)
        return (place, self.by, *starts) if self.action == "move" else (place, *starts)

    @property
    def moves_nowhere(self) -> bool:
        """True if the action is "move" or "expand" with a distance of 0."""
        by = {"move": (*self.by, self.amount), "expand": (self.amount,)}.get(self.action, (1.0,))
        return not any(by)

    def onward(self, point: Point) -> Stroke:
        """Return the stroke with a point, in pixels, added to its last path."""
        *before, line = self.lines
        return _with_lines(self, (*before, (*line, _checked("at", point))))

    def again(self, point: Point) -> Stroke:
        """Return the stroke with a new path that begins at a point, in pixels."""
        return _with_lines(self, (*self.lines, (_checked("at", point),)))

    def added_to(self, earlier: Stroke) -> Stroke | None:
        """Return the part added to an earlier stroke; None if the stroke does not extend it."""
        count, last = len(earlier.lines), len(earlier.lines[-1])
        if _with_lines(self, earlier.lines) != earlier or len(self.lines) < count:
            return None
        line = self.lines[count - 1]
        if self.lines[: count - 1] != earlier.lines[:-1] or line[:last] != earlier.lines[-1]:
            return None
        return _with_lines(self, (line[last - 1 :], *self.lines[count:]))


Mark = Arrow | Landmark | Stroke
_KINDS: dict[str, type[Mark]] = {"arrow": Arrow, "landmark": Landmark, "stroke": Stroke}


def is_painted(mark: Mark) -> bool:
    """Return whether a mark changes pixels; a landmark with a standard deviation does not."""
    return not (isinstance(mark, Landmark) and mark.sd > 0)


def grows(mark: Mark) -> bool:
    """Return whether the outline of a mark moves outward or inward."""
    if isinstance(mark, Stroke) and mark.action != "move":
        return mark.action == "expand"
    return mark.amount != 0


def mark_as_dict(mark: Mark, motion: bool = True) -> dict[str, Any]:
    """Return a mark as a dictionary of JSON types.

    Parameters
    ----------
    mark : Mark
    motion : bool
        False to omit the displacements of the pixels of a held patch.
    """
    stored = {"kind": type(mark).__name__.lower(), **vars(mark)}
    if mark.motion is not None:
        stored["motion"] = mark.motion.as_dict(values=motion)
    return stored


def mark_from_dict(values: Mapping[str, Any]) -> Mark:
    """Create a mark from a dictionary that `mark_as_dict` returned.

    Raises
    ------
    ValueError
        If the dictionary is not from `mark_as_dict`.
    """
    try:
        rest = dict(values)
        return _KINDS[rest.pop("kind")](**rest)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a mark: {error}") from error


def _with_lines(stroke: Stroke, lines: tuple[tuple[Point, ...], ...]) -> Stroke:
    """Return a copy of a stroke with its lines replaced, without validation."""
    other = object.__new__(Stroke)
    other.__dict__.update(stroke.__dict__, lines=lines)
    return other

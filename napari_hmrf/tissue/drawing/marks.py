"""Marks of a drawing: arrows, landmarks and brush strokes.

Positions are (row, col) in pixels of the image, or (plane, row, col) in a volume, and may be
fractional. Lengths, such as displacements and radii, are in the unit of the pixel spacing.
Displacements are material: tissue at X moves to X + by.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Annotated, Literal

from napari_hmrf.checks import (
    Choice,
    NotNegative,
    Number,
    Paths,
    Positive,
    PositiveShare,
    Share,
    Spread,
    Vector,
    Whole,
    checked,
    convert,
)
from napari_hmrf.errors import ArgumentError
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


class _Mark:
    """Base class of marks: all positions and displacements have the same number of axes."""

    def __post_init__(self) -> None:
        if len(set(map(len, self._places))) > 1:
            raise ArgumentError(
                "the positions and displacements of a mark must all be (row, col) in an image, or "
                "(plane, row, col) in a volume"
            )

    @property
    def _places(self) -> list[Point]:
        raise NotImplementedError


@checked
class Arrow(_Mark):
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
    slack : float
        Distance beyond the patch, as a multiple of the radius, up to which the outer edge of the
        tissue is free if it is held (`Motion.hold_edge`) and the patch takes part of it along. At
        0, the edge is held up to the patch, so that tissue tears between them.

    Raises
    ------
    ArgumentError
        If a value is invalid; the message states valid values.
    """

    at: Vector
    by: Vector
    radius: Positive
    confidence: PositiveShare = 1.0
    components: Annotated[Components, Choice()] = "both"
    amount: Number = 0.0
    motion: PatchMotion | None = None
    slack: NotNegative = 0.0

    @property
    def _places(self) -> list[Point]:
        return [self.at, self.by, *_starts(self)]

    @property
    def lines(self) -> tuple[tuple[Point, ...], ...]:
        """Position of the mark, as a single path with one point; see `Stroke.lines`."""
        return ((self.at,),)

    def head(self, spacing: Iterable[float]) -> Point:
        """Return the centre of the patch after the motion, in pixels."""
        steps = zip(self.at, self.by, spacing, strict=True)
        return tuple(at + by / size for at, by, size in steps)


@checked
class Landmark(_Mark):
    """Point of the tissue, with its positions before and after the motion.

    Attributes
    ----------
    source, target : tuple of float
        Position before and after the motion, (row, col) or (plane, row, col) in pixels.
    radius, confidence, amount, motion
        As for an `Arrow`; without effect if `sd` is above 0.
    sd : float
        Standard deviation of the difference between target and source, in the unit of the pixel
        spacing, for the elastic model and large motion. At 0 (or None), the landmark is exact: the
        patch moves with it, and so do the pixels around the source that no earlier mark holds.
        Above 0, there is no patch: the displacement of the point, which may be between pixels, is
        weighed against the strain of the tissue. Values below a thousandth of a pixel have the
        effect of a thousandth of a pixel.

    Raises
    ------
    ArgumentError
        If a value is invalid; the message states valid values.
    """

    source: Vector
    target: Vector
    radius: Positive
    confidence: PositiveShare = 1.0
    amount: Number = 0.0
    sd: Spread = 0.0
    motion: PatchMotion | None = None

    @property
    def _places(self) -> list[Point]:
        return [self.source, self.target, *_starts(self)]

    @property
    def lines(self) -> tuple[tuple[Point, ...], ...]:
        """Position of the mark, as a single path with one point; see `Stroke.lines`."""
        return ((self.source,),)

    def arrow(self, spacing: Iterable[float]) -> Arrow:
        """Return the landmark as an arrow, with its displacement in the unit of `spacing`."""
        by = between(self.source, self.target, spacing)
        size, sure = self.radius, self.confidence
        return Arrow(self.source, by, size, sure, amount=self.amount, motion=self.motion)


@checked
class Stroke(_Mark):
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
    ArgumentError
        If a value is invalid; the message states valid values.
    """

    action: Annotated[Action, Choice()]
    lines: Paths
    radius: Positive
    by: Vector = (0.0, 0.0)
    amount: Number = 0.0
    confidence: Share = 1.0
    softness: Share = 0.0
    label: Whole = 0
    components: Annotated[Components, Choice()] = "both"
    motion: PatchMotion | None = None

    @property
    def _places(self) -> list[Point]:
        by = [self.by] if self.action == "move" else []
        return [*chain.from_iterable(self.lines), *by, *_starts(self)]

    @property
    def moves_nowhere(self) -> bool:
        """True if the action is "move" or "expand" with a distance of 0."""
        by = {"move": (*self.by, self.amount), "expand": (self.amount,)}.get(self.action, (1.0,))
        return not any(by)

    def onward(self, point: Point) -> Stroke:
        """Return the stroke with a point, in pixels, added to its last path."""
        *before, line = self.lines
        return _with_lines(self, (*before, (*line, convert(Vector, point, "point"))))

    def again(self, point: Point) -> Stroke:
        """Return the stroke with a new path that begins at a point, in pixels."""
        return _with_lines(self, (*self.lines, (convert(Vector, point, "point"),)))

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


def is_painted(mark: Mark) -> bool:
    """Return whether a mark changes pixels; a landmark with a standard deviation does not."""
    return not (isinstance(mark, Landmark) and mark.sd > 0)


def grows(mark: Mark) -> bool:
    """Return whether the outline of a mark moves outward or inward."""
    if isinstance(mark, Stroke) and mark.action != "move":
        return mark.action == "expand"
    return mark.amount != 0


def _starts(mark: Mark) -> list[Point]:
    return [] if mark.motion is None else [mark.motion.start]


def _with_lines(stroke: Stroke, lines: tuple[tuple[Point, ...], ...]) -> Stroke:
    """Return a copy of a stroke with its lines replaced, without validation."""
    other = object.__new__(Stroke)
    other.__dict__.update(stroke.__dict__, lines=lines)
    return other

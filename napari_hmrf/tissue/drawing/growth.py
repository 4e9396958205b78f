"""Patches that grow: where a patch of a drawing can grow without undoing a pull."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from napari_hmrf.tissue.drawing.canvas import Box, box_of, covered, covers, is_empty, rim_of
from napari_hmrf.tissue.drawing.drawing import Drawing
from napari_hmrf.tissue.drawing.marks import Mark, Stroke, grows, is_painted

Point = tuple[float, ...]


def is_pull(mark: Mark) -> bool:
    """Return whether a mark moves its patch by one vector: an arrow, a landmark or a push."""
    return is_painted(mark) and (not isinstance(mark, Stroke) or mark.action == "move")


def patch_at(drawing: Drawing, point: Point, spacing: Sequence[float]) -> int | None:
    """Find the pulled or growing patch that determines the motion at a position.

    Parameters
    ----------
    drawing : Drawing
    point : tuple of float
        Undeformed position, (row, col) or (plane, row, col) in pixels.
    spacing : sequence of float
        Size of a pixel along each axis.

    Returns
    -------
    int or None
        Index of the mark of the patch; None if the tissue there is held, released or not drawn on.
    """
    for number in reversed(range(len(drawing.marks))):
        mark = drawing.marks[number]
        if _moves_tissue(mark) and covers(mark, point, spacing):
            return number if grows(mark) or is_pull(mark) else None
    return None


def with_patch(
    drawing: Drawing, patch: Stroke, spacing: tuple[float, ...], shape: tuple[int, ...]
) -> tuple[Drawing, int] | Mark:
    """Add a growing patch to a drawing without changing the tissue that other marks pull.

    The patch is added below pulls in its interior, so that they take precedence.

    Parameters
    ----------
    drawing : Drawing
    patch : Stroke
        Stroke that expands.
    spacing : tuple of float
        Size of a pixel along each axis.
    shape : tuple of int
        Shape of the image.

    Returns
    -------
    (Drawing, int) or Mark
        Drawing with the patch, and the index of the patch. If the outline of the patch passes
        through or ends at tissue of another mark, this mark.

    Raises
    ------
    ProblemError
        If the patch is an open line, which has no interior.
    """
    whole = tuple(slice(0, size) for size in shape)
    area, marks = box_of(patch, spacing, whole), drawing.marks
    number = len(marks)
    for index in reversed(range(len(marks))):
        if not is_pull(marks[index]) or is_empty(box_of(marks[index], spacing, area)):
            continue
        box = box_of(marks[index], spacing, whole)
        pulled, inside = _visible(drawing, index, spacing, box), covered(patch, spacing, box)
        if not (pulled & inside).any():
            continue
        if (pulled & (~inside | _rim(patch, spacing, shape, box))).any():
            return marks[index]
        number = index
    for mark in marks[number:]:
        box = box_of(mark, spacing, area)
        if not _moves_tissue(mark) or is_empty(box):
            continue
        if (covered(mark, spacing, box) & _rim(patch, spacing, shape, box)).any():
            return mark
    return Drawing((*marks[:number], patch, *marks[number:])), number


def _moves_tissue(mark: Mark) -> bool:
    """Return whether a mark prescribes or releases the motion of tissue."""
    if isinstance(mark, Stroke):
        return mark.action not in ("confidence", "tissue", "remove")
    return is_painted(mark)


def _visible(
    drawing: Drawing, number: int, spacing: Sequence[float], box: Box
) -> npt.NDArray[np.bool_]:
    """Return the pixels of a box that a mark covers, and that no later mark determines."""
    visible = covered(drawing.marks[number], spacing, box)
    for mark in drawing.marks[number + 1 :]:
        hides = _moves_tissue(mark) and getattr(mark, "components", "both") == "both"
        if hides and not is_empty(box_of(mark, spacing, box)):
            visible &= ~covered(mark, spacing, box)
    return visible


def _rim(
    patch: Stroke, spacing: tuple[float, ...], shape: tuple[int, ...], box: Box
) -> npt.NDArray[np.bool_]:
    """Return the pixels of a box that move outward with the outline of a patch."""
    rim, region = rim_of(patch, spacing, shape)
    inside = np.zeros([side.stop - side.start for side in box], dtype=bool)
    shared = [
        (max(side.start, of.start), min(side.stop, of.stop))
        for side, of in zip(box, region, strict=True)
    ]
    if all(start < stop for start, stop in shared):
        pairs = list(zip(shared, box, region, strict=True))
        to = tuple(slice(a - side.start, b - side.start) for (a, b), side, _ in pairs)
        inside[to] = rim[tuple(slice(a - of.start, b - of.start) for (a, b), _, of in pairs)]
    return inside

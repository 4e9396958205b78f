"""Inputs without effect: marks outside tissue, and rules and growth of labels without pixels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.notes import Note
from napari_hmrf.solver.problem import Problem
from napari_hmrf.study.landmark_data import points_in_tissue
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Canvas, Drawing, Landmark, Stroke
from napari_hmrf.tissue.drawing.canvas import box_of, covered, is_empty
from napari_hmrf.tissue.drawing.marks import Mark, Point, is_painted
from napari_hmrf.tissue.sliding import is_inner

# Largest number of marks whose positions a clause lists.
_LISTED = 4
#: Actions of strokes that have no effect outside tissue; other strokes can change earlier marks.
_HOLD_OR_MOVE = ("pin", "move", "expand", "slide", "remove")
#: For each attribute of a rule, its value without effect and the actions that use it.
_USES = {
    "vector": (0.0, ("move", "pull")),
    "amount": (0.0, ("expand", "press", "slide")),
    "confidence": (1.0, ("fixed", "move", "expand")),
}


def asks_motion(problem: Problem) -> bool:
    """Return whether a problem has a nonzero observed displacement, growth or force."""
    loads, landmarks = problem.loads, problem.landmarks
    if landmarks is not None and (landmarks.points != landmarks.targets).any():
        return True
    given = () if loads is None else (loads.growth, loads.force)
    moved = problem.known & (problem.observed != 0)
    if problem.precision is not None:
        moved |= problem.precision.any(axis=-1) & (problem.observed != 0)
    return bool(moved.any()) or any(part is not None and part.any() for part in given)


def marks_without_effect(
    drawing: Drawing, tissue: npt.NDArray[np.bool_], base: Canvas
) -> Iterator[str]:
    """Yield a clause for each kind of mark that has no effect.

    Such marks are outside the image or outside tissue, or they paint the confidence of tissue that
    is neither held nor moved.

    Parameters
    ----------
    drawing : Drawing
    tissue : ndarray of bool, shape ([D,] H, W)
    base : Canvas
        Observations without the drawing.

    Yields
    ------
    str
    """
    idle: dict[tuple[str, str], list[Point]] = defaultdict(list)
    whole, spacing = base.whole, base.spacing
    for number, mark in enumerate(drawing.marks):
        kind, place = _named(mark)
        box = box_of(mark, spacing, whole)
        if is_empty(box):
            idle[kind, "outside the image"].append(place)
        elif isinstance(mark, Landmark) and not is_painted(mark):
            if not points_in_tissue([mark], tissue)[1].any():
                idle[kind, "outside tissue"].append(place)
        elif _needs_tissue(mark) and not (covered(mark, spacing, box) & tissue[box]).any():
            idle[kind, "outside tissue"].append(place)
        elif lacks_motion(drawing, number, base):
            idle[kind, "over tissue that is neither held nor moved"].append(place)
    for (kind, where), places in idle.items():
        *others, last = ("(" + ", ".join(f"{at:.4g}" for at in place) + ")" for place in places)
        if not others:
            yield Note(
                f"the {kind} at {last} is {where} and has no effect", f"the {kind} has no effect"
            )
            continue
        listed = f"at {', '.join(others)} and {last}"
        if len(places) > _LISTED:
            listed = f"the first at {others[0]}"
        yield Note(
            f"{len(places)} {kind}s are {where} and have no effect, {listed}",
            f"{len(places)} {kind}s have no effect",
        )


def lacks_motion(drawing: Drawing, number: int, base: Canvas) -> bool:
    """Return whether a mark paints the confidence of tissue that is neither held nor moved.

    Parameters
    ----------
    drawing : Drawing
    number : int
        Number of the mark.
    base : Canvas
        Observations without the drawing.
    """
    mark, spacing = drawing.marks[number], base.spacing
    if not isinstance(mark, Stroke) or mark.action != "confidence":
        return False
    box = box_of(mark, spacing, base.whole)
    if is_empty(box):
        return True
    under = covered(mark, spacing, box)
    if (base.confidence[box][under] > 0).any():
        return False
    earlier = (each for each in drawing.marks[:number] if _needs_tissue(each))
    return not any(
        not is_empty(box_of(each, spacing, box)) and (covered(each, spacing, box) & under).any()
        for each in earlier
    )


def slides_inside(
    drawing: Drawing, number: int, tissue: npt.NDArray[np.bool_], base: Canvas
) -> bool:
    """Return whether a mark paints a sliding surface with tissue on both sides.

    Parameters
    ----------
    drawing : Drawing
    number : int
        Number of the mark.
    tissue : ndarray of bool, shape ([D,] H, W)
    base : Canvas
        Observations without the drawing.
    """
    mark, spacing = drawing.marks[number], base.spacing
    if not isinstance(mark, Stroke) or mark.action != "slide":
        return False
    box = box_of(mark, spacing, base.whole)
    if is_empty(box):
        return False
    wide = tuple(
        slice(max(side.start - 2, 0), min(side.stop + 2, size))
        for side, size in zip(box, tissue.shape, strict=True)
    )
    whole = [
        (side.start == 0, side.stop == size) for side, size in zip(wide, tissue.shape, strict=True)
    ]
    return is_inner(covered(mark, spacing, wide), tissue[wide], whole)


def rows_without_effect(
    study: Study, labels: npt.NDArray[Any] | None, tissue: npt.NDArray[np.bool_]
) -> Iterator[str]:
    """Yield clauses about rules, growth, sliding and cavities without effect.

    Parameters
    ----------
    study : Study
    labels : ndarray of int, optional
        Tissue labels of the problem, including brush strokes that paint tissue.
    tissue : ndarray of bool, shape ([D,] H, W)
        Mask of the tissue of the problem.

    Yields
    ------
    str
    """
    motion = study.motion
    rules = _absent(motion.rules, motion.labels)
    if rules:
        where = "there are no painted labels"
        if motion.labels is not None:
            where = f"'{study.named('boundary')}' has no such label"
        yield f"{_rows('rule', rules)} no effect: {where}"
    for name, (usual, actions) in _USES.items():
        for rule in motion.rules:
            if rule.action not in actions and np.any(np.not_equal(getattr(rule, name), usual)):
                noun = f"the {name} of label {rule.label}"
                yield f"{noun} has no effect: its action is '{rule.action}'"
    growing = _absent([row for row in study.tissue.materials if row.grows], labels)
    if growing:
        where = "there are no tissue labels"
        if labels is not None:
            where = f"'{study.named('tissue', 'image')}' has no such label"
        yield f"{_rows('growth', growing)} no effect: {where}"
    if sliding := [row for row in study.tissue.materials if row.slides]:
        here = None if labels is None else np.where(tissue, labels, 0)
        absent = _absent(sliding, here)
        if absent:
            yield f"{_rows('sliding', absent)} no effect: no tissue has such a label"
        alone = [row for row in sliding if row not in absent and _is_alone(row, here, tissue)]
        if alone:
            yield f"{_rows('sliding', alone)} no effect: no other tissue is next to it"
    if motion.cavity.acts and not study.removes:
        yield "the load on the cavity has no effect: no tissue is removed"


def _needs_tissue(mark: Mark) -> bool:
    """Return whether a mark is painted to hold or move tissue."""
    if isinstance(mark, Stroke):
        return mark.action in _HOLD_OR_MOVE
    return is_painted(mark)


def _absent(
    rows: Iterable[BoundaryRule | Material], labels: npt.NDArray[Any] | None
) -> list[BoundaryRule | Material]:
    present = set() if labels is None else set(np.unique(labels).tolist())
    return [row for row in rows if row.label not in present and row.label != 0]


def _is_alone(
    row: Material, labels: npt.NDArray[Any] | None, tissue: npt.NDArray[np.bool_]
) -> bool:
    """Return whether no other tissue touches the tissue of a label."""
    own = tissue & (labels == row.label)
    near = scipy.ndimage.binary_dilation(own, np.ones((3,) * own.ndim, bool))
    return not (near & tissue & ~own).any()


def _rows(noun: str, rows: Sequence[BoundaryRule | Material]) -> str:
    names = ", ".join(
        f"{row.label} ('{row.name}')" if getattr(row, "name", "") else f"{row.label}"
        for row in rows
    )
    if len(rows) == 1:
        return f"the {noun} of label {names} has"
    return f"the {noun}{'' if noun in ('growth', 'sliding') else 's'} of labels {names} have"


def _named(mark: Mark) -> tuple[str, Point]:
    if isinstance(mark, Arrow):
        return "arrow", mark.at
    if isinstance(mark, Landmark):
        return "landmark", mark.source
    return "stroke", mark.lines[0][0]

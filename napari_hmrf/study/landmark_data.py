"""Landmarks of a drawing with standard deviations, as the data term of a problem."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import product

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.neighbours import in_elements
from napari_hmrf.notes import Note
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.uncertain_landmarks import (
    SD_RANGE,
    Landmarks,
    StrainScale,
    corners_of,
    typical_stiffness,
)
from napari_hmrf.study.study import Motion
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.tissue.normals import outer_rim

Points = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
FloatArray = npt.NDArray[np.float32]

#: Largest distance of a landmark from tissue, in pixels. Such a landmark observes the nearest
#: tissue.
NEAR = 1.0
#: Beginning of the note that a held edge hinders a drift.
#: Kind of the note about a held edge that hinders the drift.
HELD_EDGE = "held edge"
# Share of the outer edge above which held tissue hinders a drift.
_HELD_SHARE = 0.5
# Factor that keeps a clipped standard deviation within the range after rounding.
_INSIDE = 1 + 1e-9


def uncertain_landmarks(drawing: Drawing) -> tuple[Landmark, ...]:
    """Return the landmarks of a drawing with a standard deviation above 0."""
    return tuple(mark for mark in drawing.marks if isinstance(mark, Landmark) and mark.sd > 0)


def points_in_tissue(marks: Iterable[Landmark], tissue: Mask) -> tuple[Points, Mask]:
    """Return the point of the tissue that each landmark observes, and a mask of usable landmarks.

    Parameters
    ----------
    marks : iterable of Landmark
    tissue : ndarray of bool, shape ([D,] H, W)

    Returns
    -------
    points : ndarray, shape (N, n)
        Source of each landmark in pixels, moved by at most `NEAR` pixels into tissue.
    near : ndarray of bool, shape (N,)
        False for landmarks that are farther from tissue; these points are not in tissue.
    """
    points = np.array([mark.source for mark in marks], np.float64).reshape(-1, tissue.ndim)
    elements = in_elements(tissue)
    if not elements.size:
        return points, np.zeros(len(points), np.bool_)
    last = np.array(elements.shape) - 1
    nearest, distance = points.copy(), np.full(len(points), np.inf)
    # An int64 would overflow for points that are extremely far away.
    around = np.floor(np.clip(points, -2, last + 2)).astype(np.intp)
    for step in product((0, -1, 1), repeat=tissue.ndim):
        first = np.clip(around + step, 0, last)
        inside = np.clip(points, first, first + 1)
        away = np.linalg.norm(points - inside, axis=1)
        better = elements[tuple(first.T)] & (away < distance)
        nearest[better], distance[better] = inside[better], away[better]
    return nearest, distance <= NEAR


def landmarks_hold(drawing: Drawing, problem: Problem) -> bool:
    """Return whether exact landmarks alone determine the position and orientation of tissue.

    These are two landmarks in an image, or three that are not on one line in a volume.

    Parameters
    ----------
    drawing : Drawing
    problem : Problem
        Problem with this drawing; landmarks whose pixel it does not hold do not count.
    """
    marks = (mark for mark in drawing.marks if isinstance(mark, Landmark) and not mark.sd)
    last = np.array(problem.shape) - 1
    places = np.array([mark.source for mark in marks], np.float64).reshape(-1, len(last))
    pixels = np.unique(np.rint(np.clip(places, 0, last)).astype(np.intp), axis=0)
    held = pixels[problem.known[tuple(pixels.T)].all(axis=-1)]
    needed = len(last) - 1
    return len(held) > needed and bool(np.linalg.matrix_rank(held - held[0]) >= needed)


def landmark_caveats(motion: Motion, problem: Problem) -> Iterator[str]:
    """Yield clauses about targets outside the image, and about a drift of tissue that is held.

    Parameters
    ----------
    motion : Motion
    problem : Problem
        Problem with this motion.

    Yields
    ------
    str
    """
    last, spacing = np.array(problem.shape) - 1, np.array(problem.spacing)
    far: list[tuple[float, Landmark]] = []
    for mark in motion.drawing.marks:
        if isinstance(mark, Landmark):
            target = np.array(mark.target)
            beyond = target - np.clip(target, 0, last)
            if np.abs(beyond).max() > NEAR:
                far.append((float(np.linalg.norm(beyond * spacing)), mark))
    if far:
        away, mark = max(far, key=lambda each: each[0])
        at = ", ".join(f"{part:.4g}" for part in mark.source)
        is_one = len(far) == 1
        subject = "the target of a landmark is" if is_one else f"{len(far)} targets are"
        yield Note(
            f"{subject} outside the image, by up to {away:.3g} (landmark at ({at})): check the "
            "target, or remove the landmark",
            short=f"{'a target is' if is_one else subject} outside the image",
        )
    if problem.landmarks is None or not problem.landmarks.drift:
        return
    rim = outer_rim(problem.tissue)
    still = (problem.known & (problem.observed == 0)).all(axis=-1)
    if rim.any() and still[rim].mean() > _HELD_SHARE:
        setting = " (`hold_edge=False`)" if motion.hold_edge else ""
        yield Note(
            "most of the outer edge of the tissue is held in place, so that the drift can hardly "
            "stretch or shrink the tissue: if the landmarks should move it, release the edge"
            f"{setting}",
            short="the held edge hinders the drift",
            kind=HELD_EDGE,
        )


def sites_of(points: Points, shape: tuple[int, ...]) -> Mask:
    """Return a mask of the pixels nearest to points, shape ([D,] H, W, n), for all components."""
    sites = np.zeros((*shape, len(shape)), np.bool_)
    sites[tuple(np.rint(points).astype(np.intp).T)] = True
    return sites


def landmark_data(
    marks: Sequence[Landmark],
    points: Points,
    stiffness: FloatArray,
    body: Mask,
    spacing: tuple[float, ...],
    strain: float,
    drift: bool,
) -> Landmarks | None:
    """Return landmarks as data of a problem; None if no landmark is in tissue.

    Parameters
    ----------
    marks : sequence of Landmark
    points : ndarray, shape (N, n)
        Points in tissue, as returned by `points_in_tissue`. Points in tissue that is excluded from
        the problem are ignored.
    stiffness : ndarray, shape ([D,] H, W)
        Stiffness of the problem.
    body : ndarray of bool, shape ([D,] H, W)
        Tissue that determines the typical stiffness.
    spacing : tuple of float
    strain : float
        Typical strain of the tissue.
    drift : bool
        True to estimate an affine drift together with the landmarks.
    """
    if not len(points):
        return None
    corner, _ = corners_of(points, stiffness.shape)
    used = in_elements(stiffness > 0)[tuple(corner.T)]
    if not used.any():
        return None
    steps = np.array([np.subtract(mark.target, mark.source) for mark in marks])[used]
    low, high = SD_RANGE[0] * max(spacing) * _INSIDE, SD_RANGE[1] * min(spacing) / _INSIDE
    sd = np.clip([mark.sd for mark in marks], low, high)[used]
    scale = StrainScale(strain, stiffness=typical_stiffness(stiffness[body]))
    return Landmarks(points[used], points[used] + steps, sd=sd, scale=scale, drift=drift)

"""A study beside the tissue that has moved as it says: what is seen, and where it came from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.inverse_point import farthest_of, inverse_point
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.ground import Ground, Statement
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing.marks import Point

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Deformation:
    """A study, and how its tissue moves.

    Attributes
    ----------
    study : Study
    ground : Ground, optional
        The study as it was understood; None if it could not be.
    stated : Statement, optional
        What was solved; None if it could not be stated.
    solution : Solution, optional
        None if nothing is held or moved, or if there is an error.
    image : ndarray, optional
        The study's image, moved with the tissue.
    overlay : tuple of ndarray
        What was drawn over it, moved likewise.
    error : Exception, optional
        Why there is no solution, in words of the study.
    settled : bool
        Whether it was solved from nothing, as `solve_study` does.
    """

    study: Study
    ground: Ground | None = None
    stated: Statement | None = None
    solution: Solution | None = None
    image: Array | None = None
    overlay: tuple[Array, ...] = ()
    error: Exception | None = None
    settled: bool = False

    @property
    def moves(self) -> bool:
        """Whether anything is drawn, or has moved."""
        drawn = bool(self.study.motion.drawing.marks)
        return drawn or (self.solution is not None and bool(self.solution.displacement.any()))

    def came_from(self, point: Point) -> Point | None:
        """Where the tissue seen at a point, in pixels, was before it moved; None if none is."""
        before: Point | None = point
        if self.solution is not None:
            solution = self.solution
            field = (solution.displacement, solution.spacing, solution.tissue, self._farthest)
            before = inverse_point(point, *field)
            # What nobody held anywhere stayed out of it, and where it was.
            before = before or (None if self._holds(point, solution.tissue) else point)
        body = None if self.ground is None else self.ground.body
        return before if before is not None and self._holds(before, body) else None

    def goes_to(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Where tissue that was at points, (N, 2) in pixels, is seen."""
        if self.solution is None or not len(points):
            return points
        field, size = self.solution.displacement, self.study.grid.spacing
        interpolated = scipy.ndimage.map_coordinates
        steps = [
            interpolated(field[..., axis], points.T, order=1, mode="nearest") / size[axis]
            for axis in (0, 1)
        ]
        seen: npt.NDArray[np.float64] = points + np.stack(steps, axis=-1)
        return seen

    def is_inside(self, point: Point) -> bool:
        """Whether a point is one of the grid."""
        along = zip(point, self.study.grid.shape, strict=True)
        return all(-0.5 <= at <= size - 0.5 for at, size in along)

    @cached_property
    def _farthest(self) -> npt.NDArray[np.float32]:
        assert self.solution is not None
        return farthest_of(self.solution.displacement)

    def _holds(self, point: Point, image: Array | None) -> bool:
        """Whether an image is above 0 at a point."""
        row, col = (round(along) for along in point)
        rows, cols = self.study.grid.shape
        inside = 0 <= row < rows and 0 <= col < cols
        return image is not None and inside and bool(image[row, col] > 0)

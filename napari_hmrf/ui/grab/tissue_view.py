"""The tissue as it is seen while it is pulled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf.field.inverse_point import farthest_of, inverse_point
from napari_hmrf.layers.result_layers import Outputs
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.drawing.marks import Point


class Painted(NamedTuple):
    """What brushes have painted, and how it looks.

    Attributes
    ----------
    picture : ndarray of uint8, shape (H, W)
        Moved with the tissue.
    lines, colours : ndarray
        As `painted_marks` returns them.
    """

    picture: npt.NDArray[np.uint8]
    lines: npt.NDArray[np.float32]
    colours: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Seen:
    """The tissue as a drawing has moved it.

    Attributes
    ----------
    ground : Ground
    drawing : Drawing
    picture : ndarray, shape (H, W) or (H, W, 3 or 4)
        The image, moved with the tissue.
    solution : Solution, optional
    error : Exception, optional
        Why there is no solution; the picture is then the one before.
    outputs : Outputs, optional
        The arrows of the displacement, and the folds; only once a drawing has come to rest.
    painted : Painted, optional
        What brushes have painted; None if nothing.
    note : str
        What to know about the tissue, in sentences; of a drawing that has come to rest.
    """

    ground: Ground
    drawing: Drawing
    picture: npt.NDArray[Any]
    solution: Solution | None = None
    error: Exception | None = None
    outputs: Outputs | None = None
    painted: Painted | None = None
    note: str = ""

    @classmethod
    def still(cls, ground: Ground, drawing: Drawing | None = None) -> Seen:
        """Nothing has moved."""
        picture = ground.study.pictures.image
        assert picture is not None
        return cls(ground, drawing or Drawing(), picture)

    @property
    def is_still(self) -> bool:
        """Whether nothing is drawn, and nothing has moved."""
        moved = self.solution is not None and self.solution.displacement.any()
        return not self.drawing.marks and not moved

    def came_from(self, point: Point) -> Point | None:
        """Where the tissue seen at a point was before it moved; None if there is none."""
        before: Point | None = point
        if self.solution is not None:
            solution = self.solution
            field = (solution.displacement, solution.spacing, solution.tissue, self._farthest)
            before = inverse_point(point, *field)
            # What nobody held anywhere stayed out of it, and where it was.
            before = before or (None if self._tissue_at(point, solution.tissue) else point)
        return before if before is not None and self._tissue_at(before, self.ground.body) else None

    @cached_property
    def _farthest(self) -> npt.NDArray[np.float32]:
        assert self.solution is not None
        return farthest_of(self.solution.displacement)

    def goes_to(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Where tissue that was at points, (N, 2) in pixels, is seen."""
        if self.solution is None or not len(points):
            return points
        field, size = self.solution.displacement, self.ground.study.grid.spacing
        steps = [
            ndimage.map_coordinates(field[..., axis], points.T, order=1, mode="nearest")
            / size[axis]
            for axis in (0, 1)
        ]
        seen: npt.NDArray[np.float64] = points + np.stack(steps, axis=-1)
        return seen

    def is_inside(self, point: Point) -> bool:
        """Whether a point is one of the image."""
        return all(
            -0.5 <= at <= size - 0.5 for at, size in zip(point, self.ground.shape, strict=True)
        )

    def _tissue_at(self, point: Point, image: npt.NDArray[Any]) -> bool:
        row, col = (round(along) for along in point)
        rows, cols = self.ground.shape
        return 0 <= row < rows and 0 <= col < cols and bool(image[row, col] > 0)

"""A volume on fewer voxels: quick enough to follow a hand, and near enough to be looked at."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.study.study import Pictures, Study
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Mark
from napari_hmrf.tissue.drawing.marks import Point

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class CoarseGrid:
    """The first site of a volume, and every so many-th along each axis after it.

    Attributes
    ----------
    step : int
        1: the grid itself.
    """

    step: int = 1

    @classmethod
    def of_at_most(cls, sites: int, shape: tuple[int, ...]) -> CoarseGrid:
        """The finest grid of at most so many sites."""
        step = math.ceil((math.prod(shape) / sites) ** (1 / len(shape)))
        while math.prod(-(-size // step) for size in shape) > sites:
            step += 1
        return cls(max(step, 1))

    def down(self, point: Point) -> Point:
        """A place in pixels of this grid."""
        return tuple(at / self.step for at in point)

    def up(self, point: Point) -> Point:
        """The inverse of `down`."""
        return tuple(at * self.step for at in point)

    def study(self, study: Study) -> Study:
        """The same tissue, motion and drawing on this grid.

        Parameters
        ----------
        study : Study
            It keeps its place, which is of the fine grid.
        """
        if self.step == 1:
            return study
        grid, tissue, motion, seen = study.grid, study.tissue, study.motion, study.pictures
        every = (slice(None, None, self.step),) * len(grid.shape)

        def sampled(array: Array | None) -> Array | None:
            return None if array is None else np.ascontiguousarray(array[every])

        painted = motion.labels
        if painted is not None:  # however thin, so that a closed shell stays closed
            painted = sampled(scipy.ndimage.maximum_filter(painted, self.step))
        return replace(
            study,
            grid=replace(
                grid,
                shape=tuple(-(-size // self.step) for size in grid.shape),
                spacing=tuple(size * self.step for size in grid.spacing),
            ),
            tissue=replace(
                tissue, labels=sampled(tissue.labels), stiffness=sampled(tissue.stiffness)
            ),
            motion=replace(
                motion,
                labels=painted,
                observed=sampled(motion.observed),
                confidence=sampled(motion.confidence),
                drawing=self.drawing(motion.drawing),
            ),
            pictures=Pictures(image=sampled(seen.image), name=seen.name),
        )

    def drawing(self, drawing: Drawing) -> Drawing:
        """The same marks in pixels of this grid; lengths stay as they are."""
        if self.step == 1:
            return drawing
        return Drawing(tuple(map(self._mark, drawing.marks)))

    def _mark(self, mark: Mark) -> Mark:
        if isinstance(mark, Arrow):
            return replace(mark, at=self.down(mark.at))
        if isinstance(mark, Landmark):
            return replace(mark, source=self.down(mark.source), target=self.down(mark.target))
        lines = tuple(tuple(map(self.down, line)) for line in mark.lines)
        return replace(mark, lines=lines)


@dataclass(frozen=True)
class Plane:
    """A slice of a volume that is looked at while a hand moves the volume.

    Attributes
    ----------
    axis, number : int
        Across which axis of the volume it lies, and where.
    grid : CoarseGrid
        What the volume is solved on meanwhile.
    """

    axis: int
    number: int
    grid: CoarseGrid

    @property
    def pixels(self) -> tuple[int | slice, ...]:
        """What picks it out of the volume."""
        return (*(slice(None) for _ in range(self.axis)), self.number)

    @property
    def order(self) -> tuple[int, ...]:
        """The axes of the volume, with that across the plane first."""
        return self.axis, *(axis for axis in range(3) if axis != self.axis)

"""Tissue on fewer sites: quick enough to follow a hand, and near enough to be looked at."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Mark
from napari_hmrf.tissue.drawing.marks import Point


@dataclass(frozen=True)
class CoarseGrid:
    """The first site of an image or a volume, and every so many-th along each axis after it.

    Attributes
    ----------
    step : int
        1: the grid itself.
    """

    step: int = 1

    @classmethod
    def of_at_most(cls, sites: int, shape: tuple[int, ...]) -> CoarseGrid:
        """The finest grid of at most so many sites."""
        step = 1
        while math.prod(-(-size // step) for size in shape) > sites:
            step += 1
        return cls(step)

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
        grid, motion = study.grid, study.motion
        shape = tuple(-(-size // self.step) for size in grid.shape)
        spacing = tuple(size * self.step for size in grid.spacing)
        if motion.labels is not None:  # however thin, so that a closed shell stays closed
            painted = scipy.ndimage.maximum_filter(motion.labels, self.step)
            motion = replace(motion, labels=painted)
        return replace(
            study,
            grid=replace(grid, shape=shape, spacing=spacing),
            tissue=self._sampled(study.tissue, len(shape)),
            motion=self._sampled(replace(motion, drawing=self.drawing(motion.drawing)), len(shape)),
            pictures=self._sampled(study.pictures, len(shape)),
        )

    def _sampled(self, part: Any, axes: int) -> Any:
        """A part of a study with those sites of its images."""
        images = {name: each for name, each in vars(part).items() if isinstance(each, np.ndarray)}
        every = (slice(None, None, self.step),) * axes
        return replace(
            part, **{name: np.ascontiguousarray(each[every]) for name, each in images.items()}
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
class Glance:
    """What is looked at while a hand moves tissue that would not follow it on all its sites.

    Attributes
    ----------
    grid : CoarseGrid
        What tissue is solved on meanwhile.
    axis, number : int, optional
        Of a volume one slice is seen: across which axis it lies, and where.
    """

    grid: CoarseGrid
    axis: int | None = None
    number: int = 0

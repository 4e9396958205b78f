"""Coarse grid for a fast preview of the deformation during a drag."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from napari_hmrf.field.frame import Frame, as_tuples
from napari_hmrf.field.volume_preview import CutPlane
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Arrow, Drawing, Mark, Stroke
from napari_hmrf.tissue.drawing.marks import Point


@dataclass(frozen=True)
class CoarseGrid:
    """Grid of every `step`-th site of an image or a volume along each axis, from the first site.

    Attributes
    ----------
    step : int
        Distance between neighbouring sites, in pixels; 1 is the full grid.
    """

    step: int = 1

    @classmethod
    def of_at_most(cls, sites: int, shape: tuple[int, ...]) -> CoarseGrid:
        """Return the finest grid with at most `sites` sites, given the shape of the full grid."""
        step = 1
        while math.prod(-(-size // step) for size in shape) > sites:
            step += 1
        return cls(step)

    def down(self, point: Point) -> Point:
        """Convert a point from pixels of the full grid to pixels of this grid."""
        return tuple(at / self.step for at in point)

    def up(self, point: Point) -> Point:
        """Convert a point from pixels of this grid to pixels of the full grid."""
        return tuple(at * self.step for at in point)

    def study(self, study: Study) -> Study:
        """Return the study with its tissue, motion and drawing converted to this grid.

        Parameters
        ----------
        study : Study
            Study on the full grid.

        Returns
        -------
        Study
            Study on this grid.
        """
        if self.step == 1:
            return study
        grid, motion = study.grid, study.motion
        shape = tuple(-(-size // self.step) for size in grid.shape)
        spacing = tuple(size * self.step for size in grid.spacing)
        if motion.labels is not None:  # the filter preserves thin labels, so shells stay closed
            painted = scipy.ndimage.maximum_filter(motion.labels, self.step)
            motion = replace(motion, labels=painted)
        if motion.measured is not None:
            motion = replace(motion, measured=self._measured(motion.measured))
        return replace(
            study,
            grid=replace(grid, shape=shape, spacing=spacing, place=self._place(grid.place)),
            tissue=self._sampled(study.tissue, len(shape)),
            motion=self._sampled(replace(motion, drawing=self.drawing(motion.drawing)), len(shape)),
            pictures=self._sampled(study.pictures, len(shape)),
        )

    def _measured(self, measured: MeasuredMotion) -> MeasuredMotion:
        """Return measured motion on this grid; a site counts as much as the pixels around it."""
        axes = measured.displacement.ndim - 1
        every = (slice(None, None, self.step),) * axes
        precision = np.float32(self.step**axes) * measured.precision[every]
        missing = None if measured.missing is None else measured.missing[every]
        displacement = measured.displacement[every]
        return replace(measured, displacement=displacement, precision=precision, missing=missing)

    def _place(self, place: Frame | None) -> Frame | None:
        """Return the place of this grid, given the place of the full grid."""
        if place is None:
            return None
        scale, matrix = np.array(place.scale), np.array(place.matrix)
        scale[list(place.plane)] *= self.step
        matrix[:, list(place.plane)] *= self.step
        return replace(place, scale=as_tuples(scale), matrix=as_tuples(matrix))

    def _sampled(self, part: Any, axes: int) -> Any:
        """Return a part of a study with its images sampled at the sites of this grid."""
        images = {name: each for name, each in vars(part).items() if isinstance(each, np.ndarray)}
        every = (slice(None, None, self.step),) * axes
        return replace(
            part, **{name: np.ascontiguousarray(each[every]) for name, each in images.items()}
        )

    def drawing(self, drawing: Drawing) -> Drawing:
        """Convert a drawing to pixels of this grid; lengths remain in the unit of the spacing."""
        if self.step == 1:
            return drawing
        return Drawing(tuple(map(self._mark, drawing.marks)))

    def _mark(self, mark: Mark) -> Mark:
        if not isinstance(mark, Stroke):
            motion = mark.motion and mark.motion.scaled(1 / self.step)
            if isinstance(mark, Arrow):
                return replace(mark, at=self.down(mark.at), motion=motion)
            source, target = self.down(mark.source), self.down(mark.target)
            return replace(mark, source=source, target=target, motion=motion)
        lines = tuple(tuple(map(self.down, line)) for line in mark.lines)
        return replace(mark, lines=lines)


@dataclass(frozen=True)
class Preview:
    """Settings of a preview during a drag, for tissue that is too slow to solve on the full grid.

    Attributes
    ----------
    grid : CoarseGrid
        Grid on which the tissue is solved.
    axis, number : int, optional
        For a volume in a slice view: axis perpendicular to the visible slice, and index of the
        slice.
    cut : CutPlane, optional
        For a volume in a 3-D view: visible plane. Without `axis` and `cut`, the whole volume is
        shown on the coarse grid.
    pixel : int
        For an image: distance between neighbouring pixels of the picture, in pixels of the image;
        a divisor of the step of the grid.
    """

    grid: CoarseGrid
    axis: int | None = None
    number: int = 0
    cut: CutPlane | None = None
    pixel: int = 1

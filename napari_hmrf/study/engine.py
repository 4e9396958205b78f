"""Solving the newest study of those that come, and moving its image: away from any window.

Everything is computed on the compute thread. Of several studies that come while one is solved only
the newest is looked at; each solve begins with what the last ones found, and what two studies
share is made once.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import Cancelled, HmrfError
from napari_hmrf.field.live_warp import Picture
from napari_hmrf.field.moved_pictures import MovedPictures
from napari_hmrf.field.resample import on_finer_grid
from napari_hmrf.field.tissue_point import Points, holds
from napari_hmrf.solver.live_solver import LiveSolver, Update
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.coarse_grid import CoarseGrid, Glance
from napari_hmrf.study.ground import Ground, Statement
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Canvas, Drawing, Rendering
from napari_hmrf.tissue.drawing.canvas import Box
from napari_hmrf.tissue.drawing.marks import Point

_log = logging.getLogger("napari_hmrf")
Array = npt.NDArray[Any]
#: Pictures that move with the tissue.
Pictures = tuple[Picture, ...]
#: Keeps pictures that a drawing changes: called with the ground, the images with the drawing on
#: top, the pixels that may have changed (None if none did), and the pictures as they were; writes
#: to them, and returns them, or others.
Overlay = Callable[[Ground, Drawing, Canvas, Box | None, Pictures], Pictures]


class Engine:
    """Answers the newest study by a `Deformation`.

    All methods may be called from any thread, and return at once. A study in which nothing is held
    or moved is answered by its image as it is.

    Parameters
    ----------
    deliver : callable
        Called with a `Deformation` on the compute thread; it should hand over and return.
    doing : str
        What others who wait for it are told: what it is, and how to stop it, as a clause.
    overlay : callable, optional
        An `Overlay`, called on the compute thread.
    """

    def __init__(
        self,
        deliver: Callable[[Deformation], object],
        doing: str,
        overlay: Overlay | None = None,
    ) -> None:
        self._tell = deliver
        self._overlay = overlay
        self._live = LiveSolver(self._deliver, progress=self.report, doing=doing)
        self._reached = Monitor("starting", 0.0)
        #: Set once everything was dropped, for good.
        self.closed = threading.Event()
        self._dropped = threading.Event()
        #: The newest answer; only for the compute thread, as is what follows.
        self.latest: Deformation | None = None
        self._asked: Deformation | None = None
        # With the study that each was made of.
        self._grounds: dict[CoarseGrid, tuple[Study, Ground]] = {}
        self._rendering: Rendering | None = None
        self._over: Pictures = ()
        self._pictures = MovedPictures()

    # From any thread

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        return self._live.busy

    @property
    def monitor(self) -> Monitor:
        """What is going on, or waited for."""
        waits = self._live.delay
        return Monitor(waits, 0.0) if waits else self._reached

    def submit(
        self,
        study: Study,
        backend: str = "auto",
        settle: bool = False,
        glance: Glance | None = None,
    ) -> None:
        """Have this answered instead of what waits.

        Parameters
        ----------
        study : Study
        backend : str
            As for `solve`.
        settle : bool
            Whether to solve it from nothing, bit by bit as `solve_study` does; then it is an error
            that nothing is held or moved.
        glance : Glance, optional
            All that is looked at while a hand moves tissue, which is solved on its coarse grid.
        """
        if settle:
            self.forget()
            self._reached = Monitor("reading what is painted", 0.0)
        self._live.optimizer, self._live.backend = study.optimizer, backend
        dropped = self._dropped

        def checkpoint() -> None:
            if dropped.is_set():
                raise Cancelled

        state = partial(self._state, study, checkpoint, settle, glance)
        patience = None if settle else patience_for(study, glance)
        # A glance at what has no time takes longer than it is worth.
        self._live.submit(state, glance=bool(patience), patience=patience)

    def forget(self) -> None:
        """Drop what waits, what is being solved, and what was found."""
        self._dropped.set()
        self._dropped = threading.Event()
        self._live.forget()

    def close(self) -> None:
        """Drop everything, for good."""
        self.closed.set()
        self.forget()
        self._live.close()

    def report(self, monitor: Monitor) -> None:
        """Say how far something is."""
        self._reached = monitor

    # On the compute thread

    def _state(
        self, study: Study, checkpoint: Callable[[], None], settle: bool, glance: Glance | None
    ) -> tuple[Problem, Prior]:
        """State the problem of a study, making anew only what differs from the one before."""
        self._asked = Deformation(study, settled=settle, glance=glance)
        grid = self._asked.grid
        fine = self._ground_of(study, CoarseGrid(), checkpoint)
        ground = fine if grid.step == 1 else self._ground_of(study, grid, checkpoint)
        self._asked = replace(self._asked, ground=fine)
        if self._rendering is None or self._rendering.base is not ground.base:
            self._rendering, self._over = Rendering(ground.base), ()
        drawing, canvas = grid.drawing(study.motion.drawing), self._rendering.canvas
        window = self._rendering.show(drawing)
        if self._overlay is not None and grid.step == 1:
            self._over = self._overlay(ground, drawing, canvas, window, self._over)
        moves = drawing.marks or study.bears_loads or canvas.observed.any()
        if not (settle or moves):
            raise _StillError
        stated = replace(ground.statement(canvas), optimizer=study.optimizer)
        self._asked = replace(self._asked, stated=stated)
        return stated.problem, stated.prior

    def _ground_of(self, study: Study, grid: CoarseGrid, checkpoint: Callable[[], None]) -> Ground:
        """What a study's drawing lies on, made anew only where that differs from the one before."""
        known = self._grounds.get(grid)
        if known is None or not known[0].lies_as(study):
            known = self._grounds[grid] = study, Ground.of(grid.study(study), checkpoint)
        return known[1]

    def _deliver(self, update: Update) -> None:
        asked, error, latest = self._asked, update.error, self.latest
        assert asked is not None
        if update.solution is not None or isinstance(error, _StillError):
            try:
                image, over = self._moved(asked, update.solution)
                answer = replace(asked, solution=update.solution, image=image, overlay=over)
                self.latest = answer
                self._tell(answer)
                return
            except Cancelled:
                raise
            except Exception as failure:  # noqa: BLE001 - an answer is waited for, whatever it is
                _log.exception("the image could not be moved")
                error = failure
        known = latest is not None and latest.ground is asked.ground and asked.ground is not None
        over = self._moved(asked, latest.solution if known and latest else None)[1]
        error = asked.study.in_words(error or RuntimeError("there is no solution"))
        self._tell(replace(asked, error=error, overlay=over))

    def _moved(
        self, asked: Deformation, solution: Solution | None
    ) -> tuple[Array | None, tuple[Array, ...]]:
        """The image, and what lies over it, where a solution takes them."""
        image, glance = asked.study.pictures.image, asked.glance
        if glance is None or glance.axis is None:
            if solution is not None and asked.ground is not None and asked.grid.step > 1:
                solution = on_finer_grid(solution, asked.ground.stiffness > 0, asked.grid.step)
            return self._pictures.whole(image, self._over, solution)
        if image is None:
            return None, ()
        if solution is None or asked.ground is None:
            return np.asarray(image.take(glance.number, glance.axis)), ()
        where = glance.axis, glance.number, solution.displacement, asked.ground.stiffness > 0
        spacing, every = asked.study.grid.spacing, glance.grid.step
        return self._pictures.plane(image, *where, spacing, every), ()


def patience_for(study: Study, glance: Glance | None) -> float:
    """How long a study is solved on though there is a newer one, in seconds.

    Tissue is to follow a hand that never rests. What takes longer is outdated before it is seen.
    """
    return 0.0 if glance is None and len(study.grid.shape) == 3 else 3.0


class _StillError(HmrfError):
    """Nothing moves."""


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
    glance : Glance, optional
        If that is all it is: `image` is one slice of a volume, (H, W), or all of an image.
    """

    study: Study
    ground: Ground | None = None
    stated: Statement | None = None
    solution: Solution | None = None
    image: Array | None = None
    overlay: tuple[Array, ...] = ()
    error: Exception | None = None
    settled: bool = False
    glance: Glance | None = None

    @property
    def grid(self) -> CoarseGrid:
        """What it was solved on."""
        return CoarseGrid() if self.glance is None else self.glance.grid

    @property
    def moves(self) -> bool:
        """Whether anything is drawn, or has moved."""
        drawn = bool(self.study.motion.drawing.marks)
        return drawn or (self.solution is not None and bool(self.solution.displacement.any()))

    def came_from(self, point: Point) -> Point | None:
        """Where the tissue seen at a point, in pixels, was before it moved; None if none is."""
        if self.solution is not None:
            site = self.grid.down(point)
            before = self._points.before(site)
            if before is not None:
                point = self.grid.up(before)
            elif holds(self.solution.tissue, _pixel(site)):
                return None
            # Else nobody held it anywhere: it stayed out of it, and where it was.
        there = self.ground is not None and holds(self.ground.body, _pixel(point))
        return point if there else None

    def goes_to(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Where tissue that was at points, (N, n) in pixels, is seen."""
        if self.solution is None or not len(points):
            return points
        return self._points.after(points / self.grid.step) * self.grid.step

    def is_inside(self, point: Point) -> bool:
        """Whether a point is one of the grid."""
        along = zip(point, self.study.grid.shape, strict=True)
        return all(-0.5 <= at <= size - 0.5 for at, size in along)

    @cached_property
    def _points(self) -> Points:
        assert self.solution is not None
        return Points(self.solution)


def _pixel(point: Point) -> tuple[int, ...]:
    """The pixel that a point lies on."""
    return tuple(map(round, point))

"""Live solver of studies, which also warps their images; independent of the window.

All computation is on the compute thread. While a study is solved, only the latest request remains
pending. Each solve is a warm start unless a cold start is requested. Parts that are common to two
consecutive studies are computed only once. A study that was solved before, as after an undo, has
the same result again.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import Cancelled, HmrfError
from napari_hmrf.field.live_warp import Picture
from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.results.finer_grid import on_finer_grid
from napari_hmrf.results.moved_pictures import MovedPictures
from napari_hmrf.results.tissue_point import Points, first_tissue, holds
from napari_hmrf.solver.live_solver import Input, Known, LiveSolver, Update, has_stopped
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.coarse_grid import CoarseGrid, Preview
from napari_hmrf.study.drag_preview import drag_preview
from napari_hmrf.study.ground import Ground, Statement
from napari_hmrf.study.study import Study
from napari_hmrf.study.study_results import StudyResults
from napari_hmrf.tissue.drawing import Canvas, Drawing, Rendering
from napari_hmrf.tissue.drawing.canvas import Box
from napari_hmrf.tissue.drawing.marks import Point

_log = logging.getLogger("napari_hmrf")
Array = npt.NDArray[Any]
#: Progress while a solution is drawn, once the solve has ended.
DRAWING = Monitor("drawing the result", 1.0)
#: Pictures that are warped with the tissue.
Pictures = tuple[Picture, ...]
#: Callback that updates the pictures of the drawing. Its arguments are the ground, the drawing, the
#: images with the drawing, the box of pixels that may have changed (None if there are none), and
#: the earlier pictures. It returns new pictures, or the earlier pictures, possibly modified, and
#: lines to display over them.
Overlay = Callable[[Ground, Drawing, Canvas, Box | None, Pictures], tuple[Pictures, Lines | None]]


class Engine:
    """Solver of the newest submitted study; delivers each result as a `Deformation`.

    All methods return immediately. `submit` and `cancel` must be called from a single thread, other
    methods from any thread. For a study without boundary conditions or loads, the undeformed image
    is delivered.

    Parameters
    ----------
    deliver : callable
        Called with a `Deformation` on the compute thread; it should only forward its argument.
    doing : str
        Clause that describes the solve and how to stop it, for messages of jobs that are queued
        behind the solve.
    overlay : callable, optional
        Callback of type `Overlay`, called on the compute thread.

    Attributes
    ----------
    live : LiveSolver
        Solver of the problems of the studies; its `hold` postpones the pending study.
    """

    def __init__(
        self,
        deliver: Callable[[Deformation], object],
        doing: str,
        overlay: Overlay | None = None,
    ) -> None:
        self._forward = deliver
        self._overlay = overlay
        self.live = LiveSolver(self._deliver, progress=self.report, doing=doing)
        self._reached = Monitor("starting", 0.0)
        #: Event that is set when the engine is closed.
        self.closed = threading.Event()
        # Generation numbers of the last study, and of the last cancelled study.
        self._generation = self._dropped = 0
        self._latest_deformation: Deformation | None = None
        #: Latest result without an error. Use this and the attributes below on the compute thread
        #: only.
        self.latest: Deformation | None = None
        self._request: Deformation | None = None
        self._counts_folds = False
        # Ground for each grid, with the study from which the ground was computed.
        self._grounds: dict[CoarseGrid, tuple[Study, Ground]] = {}
        self._rendering: Rendering | None = None
        self._over: Pictures = ()
        self._lines: Lines | None = None
        self._pictures = MovedPictures()
        self._results = StudyResults()
        # Results from files that are not in `_results` yet. A study may be solved before a job that
        # is submitted before it, because it replaces a pending study.
        self._given: deque[tuple[Study, Solution]] = deque()

    # Methods for any thread

    @property
    def busy(self) -> bool:
        """True while a study is pending, being solved, or held."""
        return self.live.busy or self.live.is_held

    @property
    def monitor(self) -> Monitor:
        """Progress of the solve, or the name of the job that delays it."""
        waits = self.live.delay
        return Monitor(waits, 0.0) if waits else self._reached

    def submit(
        self,
        study: Study,
        backend: str = "auto",
        cold_start: bool = False,
        preview: Preview | None = None,
        counts_folds: bool = False,
    ) -> None:
        """Submit a study, which replaces any pending study.

        Parameters
        ----------
        study : Study
        backend : str
            As for `solve`.
        cold_start : bool
            If True, solve from a cold start. The result is then identical to that of `solve_study`,
            and a study without boundary conditions or loads is an error. If the budget of the
            optimizer ends the solve, an earlier result of the study is delivered instead, unless it
            is farther from its targets.
        preview : Preview, optional
            Settings of a preview during a drag; the study is solved only on the coarse grid.
        counts_folds : bool
            True to count the folds of a solution on the full grid; see `Deformation`.
        """
        if cold_start:
            self.cancel()
        if not self.live.busy:
            self._reached = Monitor("reading the layers", 0.0)
        self.live.optimizer, self.live.backend = study.optimizer, backend
        request = Deformation(study, settled=cold_start, preview=preview)
        counts_folds = counts_folds and request.grid.step == 1
        state = partial(self._state, request, counts_folds)
        patience = None if cold_start else patience_for(study, preview)
        # If the patience is 0, a preview would cost more time than it saves, except that large
        # motion shows how far it got.
        shows = bool(patience) or (study.model_name == "large motion" and not cold_start)
        self._generation = self.live.submit(state, preview=shows, patience=patience)

    def start_from(self, solution: Solution) -> None:
        """Use a solution from a file as the warm start of the next solve on its grid."""
        self.live.start_from(solution)

    def deliver_again(self, study: Study, solution: Solution) -> None:
        """Deliver a solution from a file when its study is submitted, if the inputs are equal."""
        self._given.append((study, solution))

    def is_current(self, answer: Deformation) -> bool:
        """Return whether a result is the latest and its study has not been cancelled."""
        return answer is self._latest_deformation and answer.generation > self._dropped

    def cancel(self) -> None:
        """Cancel the pending and the running solve; the next solve is a cold start."""
        self._dropped = self._generation
        self.live.cancel()

    def close(self) -> None:
        """Cancel all solves, and stop the engine."""
        self.closed.set()
        self.cancel()
        self.live.close()

    def report(self, monitor: Monitor) -> None:
        """Record the progress of the solve."""
        self._reached = monitor

    # Methods for the compute thread

    def keep(self, result: Deformation) -> None:
        """Store a result, which is delivered again when its study is submitted again."""
        if result.solution is not None and result.preview is None:
            self._results.add(result.study, result.solution)

    def _state(self, request: Deformation, counts_folds: bool) -> Input:
        """Build the problem of a study; recompute only the parts that have changed."""
        self._request, self._counts_folds = request, counts_folds
        study, cold_start, preview = request.study, request.settled, request.preview
        grid = request.grid
        fine = self._ground_of(study, CoarseGrid())
        ground = fine if grid.step == 1 else self._ground_of(study, grid)
        self._request = replace(self._request, ground=fine)
        if self._rendering is None or self._rendering.base is not ground.base:
            self._rendering, self._over = Rendering(ground.base), ()
        drawing, canvas = grid.drawing(study.motion.drawing), self._rendering.canvas
        window = self._rendering.show(drawing)
        if self._overlay is not None and grid.step == 1:
            over = self._overlay(ground, drawing, canvas, window, self._over)
            self._over, self._lines = over
        measured = study.motion.measured is not None
        moves = drawing.marks or study.bears_loads or canvas.observed.any() or study.removes
        if not (cold_start or moves or measured):
            raise _StillError
        stated = replace(ground.statement(canvas, drawing), optimizer=study.optimizer)
        self._request = replace(self._request, stated=stated)
        while self._given:
            self._results.add(*self._given.popleft())
        known = self._results.find(study) if preview is None else None
        if known is not None and not _is_of(known, stated):
            known = None
        if known is None:
            return stated.problem, stated.prior
        same_budget = known.provenance.parameters["optimizer"] == study.optimizer.parameters
        is_answer = not cold_start and (same_budget or not has_stopped(known))
        return Known(stated.problem, stated.prior, known, is_answer)

    def _ground_of(self, study: Study, grid: CoarseGrid) -> Ground:
        """Return the ground of a study; reuse the last ground if only the drawing differs."""
        known = self._grounds.get(grid)
        if known is None or not known[0].has_same_ground(study):
            known = self._grounds[grid] = (
                study,
                Ground.of(grid.study(study), compute_thread.check_cancelled),
            )
        return known[1]

    def _deliver(self, update: Update) -> None:
        assert self._request is not None
        request = replace(self._request, generation=update.number, is_earlier=update.is_earlier)
        solution, error, latest = update.solution, update.error, self.latest
        removed = None if request.stated is None else request.stated.removed
        if solution is not None and solution.removed is not removed:
            solution = replace(solution, removed=removed)
        if update.final and error is None:
            self.report(DRAWING)
        if solution is not None or isinstance(error, _StillError):
            # A preview may fold where the solution does not.
            counts = self._counts_folds and update.final
            if solution is not None and request.ground is not None and counts:
                folds = request.ground.without_air(solution).count_folds()
                request = replace(request, folds=folds)
            answer = self._moved_by(solution, request)
            if answer.error is None:
                self.latest = answer
                self._answer(answer)
                return
            error = answer.error
        ground = request.ground
        known = latest is not None and latest.ground is ground and ground is not None
        over = self._moved_by(latest.solution if known and latest else None, request)
        error = request.study.in_words(error or RuntimeError("there is no solution"))
        self._answer(replace(request, error=error, overlay=over.overlay, lines=over.lines))

    def _answer(self, answer: Deformation) -> None:
        self._latest_deformation = answer
        self._forward(answer)

    def _moved_by(self, solution: Solution | None, request: Deformation) -> Deformation:
        """Return the answer with a solution, or with the error if warping failed."""
        try:
            image, over = self._moved(request, solution)
        except Cancelled:
            raise
        except Exception as error:  # noqa: BLE001 - the error is delivered with the result
            _log.exception("the image could not be deformed")
            return replace(request, error=error)
        lines = self._lines if over else None
        return replace(request, solution=solution, image=image, overlay=over, lines=lines)

    def _moved(
        self, request: Deformation, solution: Solution | None
    ) -> tuple[Array | None, tuple[Array, ...]]:
        """Return the image and its overlays, warped by a solution."""
        image, preview, ground = request.study.pictures.image, request.preview, request.ground
        spacing, every = request.study.grid.spacing, request.grid.step
        if preview is None or len(spacing) == 2:
            pixel = 1 if preview is None else preview.pixel
            if solution is not None and ground is not None and every > 1:
                tissue = ground.stiffness[::pixel, ::pixel] > 0
                solution = on_finer_grid(solution, tissue, every // pixel)
            if pixel > 1:  # a preview does not change the paint
                return self._pictures.whole(self._pictures.every(image, pixel), (), solution)
            return self._pictures.whole(image, self._over, solution)
        if image is None:
            return None, ()
        if preview.axis is None:
            return self._pictures.volume(image, solution, spacing, every, preview.cut), ()
        if solution is None or ground is None:
            return np.asarray(image.take(preview.number, preview.axis)), ()
        where, tissue = (preview.axis, preview.number), ground.stiffness > 0
        return self._pictures.plane(image, *where, solution, tissue, spacing, every), ()


def _is_of(solution: Solution, stated: Statement) -> bool:
    """Return whether a solution, perhaps from a file, has the inputs and the tissue of a problem.

    A file omits the motion of air.
    """
    problem = stated.problem
    same_tissue = np.array_equal(solution.tissue, problem.tissue)
    return same_tissue and dict(solution.provenance.inputs) == dict(problem.digests)


def patience_for(study: Study, preview: Preview | None) -> float:
    """Return how long a solve continues while a newer study is pending, in seconds.

    If each solve were cancelled immediately, tissue would not move until the user pauses the drag.
    The time is 0 for a volume or a large image on its full grid, because the solution would be
    stale before it is displayed, and the next drag would wait for it.
    """
    return 0.0 if preview is None and drag_preview(study) is not None else 3.0


class _StillError(HmrfError):
    """Signal for a study without boundary conditions or loads."""


@dataclass(frozen=True, eq=False)
class Deformation:
    """Result for a submitted study: the motion of its tissue, or an error.

    Attributes
    ----------
    study : Study
    ground : Ground, optional
        Interpretation of the study; None if interpretation failed.
    stated : Statement, optional
        Problem that was solved; None if it could not be built.
    solution : Solution, optional
        None if the study has no boundary conditions or loads, or if there is an error.
    image : ndarray, optional
        Image of the study, warped with the tissue.
    overlay : tuple of ndarray
        Warped pictures to display over the image.
    lines : Lines, optional
        Lines to display over the overlay.
    error : Exception, optional
        Error that prevented a solution, with the names used in the study.
    settled : bool
        True if the study was solved from a cold start, as by `solve_study`.
    preview : Preview, optional
        Settings of a preview. The `image` of a preview is one slice, (H, W), of a volume, or every
        `Preview.pixel`-th pixel of the image. In a 3-D view it is a volume on the coarse grid, or
        the values, (N,), at the voxels of a cut.
    is_earlier : bool
        True for an earlier result of the study, which is delivered again. If also `settled` is
        True, the budget ended the solve from a cold start.
    folds : int
        Number of sites at which tissue folds; 0 if they were not counted.
    generation : int
        Number of the submission, greater than the numbers of all earlier submissions.
    """

    study: Study
    ground: Ground | None = None
    stated: Statement | None = None
    solution: Solution | None = None
    image: Array | None = None
    overlay: tuple[Array, ...] = ()
    lines: Lines | None = None
    error: Exception | None = None
    settled: bool = False
    preview: Preview | None = None
    is_earlier: bool = False
    folds: int = 0
    generation: int = 0

    @property
    def grid(self) -> CoarseGrid:
        """Grid on which the study was solved."""
        return CoarseGrid() if self.preview is None else self.preview.grid

    @property
    def moves(self) -> bool:
        """True if there is a drawing, or any tissue has moved."""
        drawn = bool(self.study.motion.drawing.marks)
        return drawn or (self.solution is not None and bool(self.solution.displacement.any()))

    def origin_of(self, point: Point) -> Point | None:
        """Return the origin of the tissue at a point, in pixels; None if no tissue is there."""
        if self.solution is not None:
            site = self.grid.down(point)
            before = self._points.before(site)
            if before is not None:
                point = self.grid.up(before)
            elif holds(self.solution.tissue, _pixel(site)):
                return None
            # Otherwise the tissue is unconstrained: it was excluded and has not moved.
        is_tissue = self.ground is not None and holds(self.ground.body, _pixel(point))
        return point if is_tissue else None

    def first_tissue(self, points: npt.NDArray[np.float64]) -> Point | None:
        """Return the first visible point that has tissue, or None; points are (N, n) in pixels."""
        if self.ground is None:
            return None
        body = self.ground.body
        reach: npt.NDArray[np.floating] = np.ones(points.shape[-1])
        if self.solution is not None:
            reach = 1 + self._points.farthest / self.study.grid.spacing
        return first_tissue(points, body, reach, lambda point: self.origin_of(point) is not None)

    def moved_positions(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the moved positions of tissue points, both of shape (N, n) in pixels."""
        if self.solution is None or not len(points):
            return points
        return self._points.after(points / self.grid.step) * self.grid.step

    def motion_of(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the displacements of undeformed points, (N, n) in pixels; NaN outside tissue."""
        moved = (self.moved_positions(points) - points) * self.study.grid.spacing
        if self.solution is not None:
            tissue = self.solution.tissue
            sites = np.rint(points / self.grid.step).astype(int)
            sites = np.clip(sites, 0, np.array(tissue.shape) - 1)
            moved[~tissue[tuple(sites.T)]] = np.nan
        return moved

    @cached_property
    def _points(self) -> Points:
        assert self.solution is not None
        return Points(self.solution)


def _pixel(point: Point) -> tuple[int, ...]:
    """Return the pixel nearest to a point."""
    return tuple(map(round, point))

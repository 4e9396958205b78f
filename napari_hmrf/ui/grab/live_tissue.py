"""Tissue that follows a drawing: solved and warped away from the window, the newest shown."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import emptiness
from napari_hmrf.layers.background import air_that_is_tissue
from napari_hmrf.layers.ground import Ground
from napari_hmrf.layers.paint_layer import painted_marks, show_painted
from napari_hmrf.layers.result_layers import result_layers
from napari_hmrf.solver.backends.thread import STOPPED, compute_thread
from napari_hmrf.solver.live_solver import LiveSolver, Update
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.unconnected import left_at_rest
from napari_hmrf.tissue.drawing import Drawing, Rendering, Stroke
from napari_hmrf.ui.grab.grab_messages import EDGE_MOVED
from napari_hmrf.ui.grab.rehearsal import rehearse, rehearse_the_rest
from napari_hmrf.ui.grab.repaint import Repainted
from napari_hmrf.ui.grab.tissue_view import Painted, Seen
from napari_hmrf.ui.messages import sentence_of
from napari_hmrf.ui.newest_result import Newest

_log = logging.getLogger("napari_hmrf")
# What those who wait for it are told.
_FOLLOWING = "tissue that 'Grab and pull' moves, which letting go of it stops"
_PREPARING = "what 'Grab and pull' gets ready, which closing that dock stops"


class Follower:
    """Has the tissue of a ground follow a drawing.

    A drawing is solved for once the answer to the one before is painted, and then only the newest:
    where the processor paints, too, the two would take its cores from each other, and what is shown
    would be older for it.

    Parameters
    ----------
    show : callable
        Called with what is to be `Seen`, by the event loop of the thread this was made on.
    """

    def __init__(self, show: Callable[[Seen], None]) -> None:
        self._show = show
        self._newest = Newest(self._on_newest)
        self._repainted = Repainted(self._on_repainted)
        self._scene: _Scene | None = None
        # Whether what was submitted is not painted yet, and the newest drawing that waits for that.
        self._behind = False
        self._next: Drawing | None = None
        #: What is to be seen instead of all that is still on its way.
        self._still: Seen | None = None

    @property
    def ground(self) -> Ground | None:
        """What is drawn on."""
        return None if self._scene is None else self._scene.ground

    def stand_on(self, ground: Ground | None) -> None:
        """Follow drawings on another ground, or none; nothing of the one before is shown."""
        if self._scene is not None:
            self._scene.leave()
        self._newest.forget()
        self._behind, self._next, self._still = False, None, None
        self._scene = None
        if ground is not None:
            self._scene = _Scene(ground, self._newest)
            self._scene.rehearse()

    def follow(self, drawing: Drawing) -> None:
        """Have the tissue move as a drawing says; returns at once."""
        scene = self._scene
        if scene is None:
            return
        if not drawing.marks and not scene.ground.base.c.any():
            scene.live.forget()
            self._next, self._still = None, Seen.still(scene.ground)
            # With a rehearsal going on it is shown after that.
            if not scene.rehearsing:
                self._newest.put(self._still)
        elif self._behind:
            self._next = drawing
        else:
            self._submit(scene, drawing)

    def complete(self) -> None:
        """Have what takes longer made of the latest result, unless there is a newer one then."""
        scene = self._scene
        if scene is not None:
            scene.ask(scene.complete)

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        scene = self._scene
        if scene is None:
            return False
        return self._behind or scene.live.busy or scene.done < scene.asked

    @property
    def monitor(self) -> Monitor:
        """What is going on, or waited for."""
        scene = self._scene
        return Monitor("starting", 0.0) if scene is None else scene.monitor

    def release(self) -> None:
        """Follow nothing any more."""
        self.stand_on(None)
        self._newest.release()
        self._repainted.release()

    def _submit(self, scene: _Scene, drawing: Drawing) -> None:
        self._behind, self._next, self._still = True, None, None
        scene.live.submit(lambda: scene.problem(drawing))

    def _on_newest(self, seen: Seen | None) -> None:
        # A delivery that had begun may come after all was taken back.
        seen = seen if self._still is None else self._still
        if seen is None:  # what had to be compiled is
            return
        # What was wrong with an edit that has been replaced is put right by now, or said again.
        if seen.error is None or self._next is None:
            self._show(seen)
        if seen.outputs is None:
            self._repainted.ask()

    def _on_repainted(self) -> None:
        self._behind = False
        if self._next is not None and self._scene is not None:
            self._submit(self._scene, self._next)


class _Scene:
    """A ground with what was found on it; but for `live`, only the compute thread looks at it."""

    def __init__(self, ground: Ground, newest: Newest) -> None:
        self.ground = ground
        self.live = LiveSolver(
            self._deliver, ground.prior, progress=self._on_progress, doing=_FOLLOWING
        )
        self._left = threading.Event()
        self._reached = Monitor("starting", 0.0)
        self._first: Future[None] | None = None
        #: Jobs beside solving: those that the window's thread asked for, and those done here.
        self.asked = self.done = 0
        self._newest = newest
        self._rendering: Rendering | None = None
        self._warper: Warper | None = None
        self._seen = Seen.still(ground)
        # What was painted where, at rest; moved with the picture, once there is anything.
        self._painted: npt.NDArray[np.uint8] | None = None

    @property
    def rehearsing(self) -> bool:
        """Whether what is to be compiled may not be yet."""
        return self.done == 0

    @property
    def monitor(self) -> Monitor:
        """What is going on, or waited for."""
        delay = compute_thread.delays(self._first) if self._first is not None else ""
        delay = delay or self.live.delay
        return Monitor(delay, 0.0) if delay else self._reached

    def leave(self) -> None:
        """Follow nothing more, and get nothing more ready."""
        self._left.set()
        self.live.close()

    def ask(self, job: Callable[[], None], then: Callable[[], None] = lambda: None) -> Future[None]:
        """Have a job done beside solving, in its turn."""
        self.asked += 1

        def run() -> None:
            try:
                job()
            finally:
                self.done += 1
                then()

        return compute_thread.submit(run, self._doing)

    def _doing(self) -> str:
        return STOPPED if self._left.is_set() else _PREPARING

    def _on_progress(self, monitor: Monitor) -> None:
        self._reached = monitor

    def rehearse(self) -> None:
        """Compile what the first drawing will need, and then what others may."""
        # Nothing is solved before this, so its answer, None, replaces nothing.
        self._first = self.ask(
            lambda: rehearse(self.ground, self._on_progress, self._left),
            lambda: self._newest.put(None),
        )
        compute_thread.submit(lambda: rehearse_the_rest(self.ground, self._left), self._doing)

    def problem(self, drawing: Drawing) -> tuple[Problem, Prior]:
        if self._rendering is None:
            self._rendering = Rendering(self.ground.base)
        canvas = self._rendering.canvas
        window = self._rendering.show(drawing)
        strokes = [mark for mark in drawing.marks if isinstance(mark, Stroke)]
        if strokes and self._painted is None:
            self._painted, self._warper = np.zeros(canvas.shape, np.uint8), None
            window = canvas.whole
        if self._painted is not None and window is not None:
            show_painted(canvas, self.ground.base, window, self._painted)
        return self.ground.problem(canvas, any(stroke.action == "tissue" for stroke in strokes))

    def _deliver(self, update: Update) -> None:
        error = update.error
        if update.solution is not None:
            try:
                self._newest.put(self._next_seen(update.solution))
                return
            except Exception as failure:  # noqa: BLE001 - an answer is waited for, whatever it is
                _log.exception("the picture could not be moved")
                error = failure
        painted = self._moved(self._seen.solution)[1]
        error = self.ground.in_words(error)
        self._newest.put(replace(self._seen, error=error, outputs=None, painted=painted))

    def _next_seen(self, solution: Solution) -> Seen:
        drawing = self._seen.drawing if self._rendering is None else self._rendering.drawing
        moved, painted = self._moved(solution)
        assert moved is not None
        self._seen = Seen(self.ground, drawing, moved, solution, painted=painted)
        return self._seen

    def _moved(self, solution: Solution | None) -> tuple[npt.NDArray[Any] | None, Painted | None]:
        """The picture, and what is painted, where a solution takes them."""
        picture = self.ground.pictures.image
        assert picture is not None
        paint = self._painted
        if solution is None:
            moved = [picture, *([] if paint is None else [paint.copy()])]
        else:
            if self._warper is None:
                shown = [Picture(picture, fill=emptiness(picture))]
                if paint is not None:
                    shown.append(Picture(paint, order=0))
                self._warper = Warper(shown, solution.spacing)
            moved = self._warper(solution.displacement, solution.tissue)
        if paint is None or self._rendering is None or not paint.any():
            return moved[0], None
        return moved[0], Painted(moved[1], *painted_marks(self._rendering.canvas))

    def complete(self) -> None:
        """Have the displacement drawn, and folds counted."""
        seen = self._seen
        if seen.solution is None or not seen.drawing.marks or self.live.busy:
            return
        try:
            # A drawing is kept in the file of the solution it belongs to; of air nobody asks.
            body = seen.solution.tissue & self.ground.body
            solution = replace(
                seen.solution,
                displacement=np.where(body[..., None], seen.solution.displacement, np.float32(0)),
                tissue=body,
                frame={"drawing": seen.drawing.as_dict()},
            )
            pictures = replace(self.ground.pictures, image=None)
            outputs = result_layers(solution, self.ground.frame, pictures, moved=seen.picture)
        except Exception:  # noqa: BLE001 - nobody waits for this job who could be told
            _log.exception("the displacement could not be drawn")
            return
        marks = seen.drawing.marks
        note = ""
        if not any(isinstance(mark, Stroke) and mark.action == "tissue" for mark in marks):
            note = left_at_rest((self.ground.m > 0) & ~seen.solution.tissue)
        notes = [sentence_of(each) for each in (note, *self._air_that_is_tissue) if each]
        if self._moves_edge():
            notes.append(EDGE_MOVED)
        if not self.live.busy:
            self._newest.put(replace(seen, outputs=outputs, note=" ".join(notes)))

    @cached_property
    def _air_that_is_tissue(self) -> tuple[str, ...]:
        picture = self.ground.pictures.image
        assert picture is not None
        return air_that_is_tissue(picture, self.ground.body)

    def _moves_edge(self) -> bool:
        """Whether a patch that was taken hold of lies over what is held without it."""
        if self._rendering is None:
            return False
        base, canvas = self.ground.base, self._rendering.canvas
        moved = (base.c > 0) & (canvas.c > 0) & (base.y == 0) & (canvas.y != 0)
        # What was painted was meant, and air has no edge that is seen.
        return bool((moved.any(axis=-1) & (canvas.kinds == 0) & self.ground.body).any())

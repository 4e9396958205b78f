"""Tissue that follows a study: solved and warped away from the window, the newest shown."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import Cancelled
from napari_hmrf.field.held_forces import held_forces
from napari_hmrf.field.live_warp import Picture
from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.field.rehearsal import rehearse
from napari_hmrf.layers.paint_layer import painted_marks, show_painted
from napari_hmrf.layers.result_layers import Outputs, result_layers
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import Elastic
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.coarse_grid import Glance
from napari_hmrf.study.engine import Deformation, Engine, Pictures, patience_for
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.shortcomings import shortcomings
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Canvas, Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import Box
from napari_hmrf.ui.handover import Errands, Newest, Repainted

_log = logging.getLogger("napari_hmrf")
# Description of the work for other callers that wait for the compute thread.
_FOLLOWING = "tissue that 'Soft tissue' deforms, which its Cancel stops"


class Seen(NamedTuple):
    """A deformation as it is shown.

    Attributes
    ----------
    moved : Deformation
    marks : Lines, optional
        Of what brushes have painted, as of `painted_marks`; None if nothing is.
    """

    moved: Deformation
    marks: Lines | None = None

    @property
    def confidence(self) -> npt.NDArray[np.float32] | None:
        """Painted confidence of what is held or moved, 0 to 1; None if none was painted."""
        return self.moved.overlay[1] if len(self.moved.overlay) > 1 else None


class Done(NamedTuple):
    """A deformation at rest: the layers to show, and what people should know, as clauses."""

    moved: Deformation
    outputs: Outputs
    notes: tuple[str, ...]


class Follower:
    """Has the tissue follow a study.

    A study is solved once the answer to the one before is painted, and then only the newest: where
    the processor paints, too, the two would take its cores from each other, and what is shown would
    be older for it.

    Parameters
    ----------
    show : callable
        Called with what is to be `Seen`, by the event loop of the thread this was made on.
    finish : callable
        Called likewise with what is `Done`, some time after `complete`.
    """

    def __init__(self, show: Callable[[Seen], None], finish: Callable[[Done], None]) -> None:
        self._show, self._finish = show, finish
        self._newest = Newest(self._on_seen)
        self._repainted = Repainted(self._on_repainted)
        self._engine = Engine(self._deliver, _FOLLOWING, self._overlay)
        # True while the submitted study is not painted yet; time until which a newer study waits
        # for that; and the newest study that waits.
        self._behind, self._due = False, 0.0
        self._next: tuple[Study, str, Glance | None] | None = None
        self._beside = Errands(lambda _: None)  # a drag says itself what went wrong
        self._rehearsed = False
        # Paint on the undeformed image; used on the compute thread only.
        self._canvas: Canvas | None = None

    def follow(self, study: Study, backend: str = "auto", glance: Glance | None = None) -> None:
        """Submit a study that the tissue is to follow, and return at once.

        Parameters
        ----------
        study, backend, glance
            As `Engine.submit` takes them.
        """
        self._next = study, backend, glance
        self.go_on()

    def go_on(self) -> None:
        """Submit the waiting study, unless the one before it is about to be painted."""
        if self._next is not None and (not self._behind or time.monotonic() > self._due):
            self._submit(*self._next)

    def settle(self, study: Study, backend: str = "auto") -> None:
        """Submit a study for a cold solve, drop all that waits, and return at once."""
        self.forget()
        self._submit(study, backend, settle=True)

    def complete(self) -> None:
        """Draw the layers of the latest result in the background, unless there is a newer one."""
        self._beside.send("layers", self._drawn, self._on_drawn)

    def forget(self) -> None:
        """Drop all results that are still to come."""
        self._engine.forget()
        self._newest.forget()
        self._beside.forget("layers")
        self._behind, self._next = False, None

    @property
    def busy(self) -> bool:
        """True if a submitted study is not answered, or not painted yet."""
        return self._behind or self._engine.busy

    @property
    def at_work(self) -> bool:
        """True if anything is being computed, or will be."""
        return self.busy or self._beside.busy() or self._newest.waits

    @property
    def monitor(self) -> Monitor:
        """Progress of the work, or what it waits for."""
        return self._engine.monitor

    def release(self) -> None:
        """Stop for good."""
        self.forget()
        self._engine.close()
        self._newest.release()
        self._beside.release()
        self._repainted.release()

    def rehearse(self, study: Study) -> None:
        """Load or compile in the background what the first pull and the first stroke need."""
        image, engine = study.pictures.image, self._engine
        if not self._rehearsed and image is not None:
            self._rehearsed = True
            what = study.prior, image, study.grid.spacing, engine.report, engine.closed
            for kind, more in (("first pull", False), ("first brush", True)):
                self._beside.send(kind, partial(rehearse, *what, more), lambda _: None)

    # In the window's thread

    def _submit(
        self, study: Study, backend: str, glance: Glance | None = None, settle: bool = False
    ) -> None:
        self._behind, self._next = True, None
        self._due = time.monotonic() + patience_for(study, glance)
        self._engine.submit(study, backend, settle, glance)

    def _on_seen(self, seen: Seen) -> None:
        # An error of a replaced edit is corrected by now, or will be reported again.
        if seen.moved.error is None or self._next is None:
            self._show(seen)
        self._repainted.ask()

    def _on_drawn(self, drawn: Done | Seen | None) -> None:
        if isinstance(drawn, Seen):
            self._on_seen(drawn)
        elif drawn is not None and not self.busy:
            self._finish(drawn)

    def _on_repainted(self) -> None:
        self._behind = False
        self.go_on()

    # On the compute thread

    def _drawn(self) -> Done | Seen | None:
        """The latest result, drawn, or why it cannot be; None if there is a newer one to come."""
        latest = self._engine.latest
        if latest is None or latest.solution is None:
            return None
        try:
            with compute_thread.unless(lambda: self._engine.busy):
                return drawn(latest, compute_thread.look)
        except Cancelled:
            return None
        except Exception as error:  # noqa: BLE001 - whatever it is, the user is told
            _log.exception("a result could not be drawn")
            return Seen(replace(latest, error=error))

    def _overlay(
        self, ground: Ground, drawing: Drawing, canvas: Canvas, window: Box | None, over: Pictures
    ) -> Pictures:
        """Keep what was painted where, at rest; it moves with the picture once there is any."""
        self._canvas = canvas
        actions = {mark.action for mark in drawing.marks if isinstance(mark, Stroke)}
        if not over and actions:
            over, window = (Picture(np.zeros(canvas.shape, np.uint8), order=0),), canvas.whole
        if "confidence" not in actions:
            over = over if len(over) < 2 else over[:1]
        elif len(over) < 2:
            # Never interpolated: no site is half sure beside one without any confidence.
            confidence = Picture(np.zeros(canvas.shape, np.float32), order=0)
            over, window = (*over, confidence), canvas.whole
        if over and window is not None:
            show_painted(canvas, ground.base, window, *(np.asarray(each.image) for each in over))
        return over

    def _deliver(self, moved: Deformation) -> None:
        canvas = self._canvas if moved.overlay and moved.overlay[0].any() else None
        self._newest.put(Seen(moved, None if canvas is None else painted_marks(canvas)))


def drawn(moved: Deformation, checkpoint: Callable[[], None] = lambda: None) -> Done:
    """Draw the layers of a deformation, and find what there is to say of it.

    Parameters
    ----------
    moved : Deformation
        With a solution.
    checkpoint : callable
        Called between the parts; raises to stop the work.
    """
    study, ground, stated = moved.study, moved.ground, moved.stated
    assert ground is not None
    assert stated is not None
    kept = _to_be_kept(moved, ground)
    place, pictures = study.grid.place, study.pictures
    if stated.labels is not None:
        pictures = replace(pictures, labels=stated.labels)
    solved, forces = moved.solution, None
    assert solved is not None
    if isinstance(stated.prior, Elastic):
        forces = partial(held_forces, stated.problem, solved, stated.prior)
    outputs = result_layers(kept, place, pictures, checkpoint, stated.problem, forces)
    short = shortcomings(solved, study.grid.unit, folds=0)  # the warning chip counts folds
    return Done(moved, outputs, tuple(filter(None, (*short, *ground.notes_on(stated)))))


def _to_be_kept(moved: Deformation, ground: Ground) -> Solution:
    """Return the solution to keep: without air, and with the drawing and the tissue's record."""
    study, solution = moved.study, moved.solution
    assert solution is not None
    body = solution.tissue & ground.body
    if not np.array_equal(body, solution.tissue):
        field = np.where(body[..., None], solution.displacement, np.float32(0))
        solution = replace(solution, displacement=field, tissue=body)
    if study.motion.drawing.marks:
        solution = replace(solution, frame={"drawing": study.motion.drawing.as_dict()})
    if study.tissue.record:
        parameters = {**solution.provenance.parameters, "tissue": dict(study.tissue.record)}
        solution = replace(solution, provenance=replace(solution.provenance, parameters=parameters))
    return solution

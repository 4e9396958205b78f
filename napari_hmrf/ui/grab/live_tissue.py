"""Tissue that follows a drawing: solved and warped away from the window, the newest shown."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.paint_layer import painted_marks, show_painted
from napari_hmrf.layers.result_layers import result_layers
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.study.engine import Deformation, Engine
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.drawing import Canvas, Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import Box
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
            self._scene.engine.close()
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
        if not drawing.marks and not scene.ground.base.confidence.any():
            scene.engine.forget()
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
        return self._behind or scene.busy

    @property
    def monitor(self) -> Monitor:
        """What is going on, or waited for."""
        scene = self._scene
        return Monitor("starting", 0.0) if scene is None else scene.engine.monitor

    def release(self) -> None:
        """Follow nothing any more."""
        self.stand_on(None)
        self._newest.release()
        self._repainted.release()

    def _submit(self, scene: _Scene, drawing: Drawing) -> None:
        self._behind, self._next, self._still = True, None, None
        scene.submit(drawing)

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
    """A ground, and what the compute thread finds on it."""

    def __init__(self, ground: Ground, newest: Newest) -> None:
        self.ground = ground
        self.engine = Engine(self._deliver, _FOLLOWING, self._overlay)
        #: Jobs beside solving: those that the window's thread asked for, and those done here.
        self.asked = self.done = 0
        self._newest = newest
        # What follows only the compute thread looks at.
        self._seen = Seen.still(ground)
        self._canvas: Canvas | None = None

    @property
    def rehearsing(self) -> bool:
        """Whether what is to be compiled may not be yet."""
        return self.done == 0

    @property
    def busy(self) -> bool:
        """Whether something is computed, or will be."""
        return self.engine.busy or self.done < self.asked

    def submit(self, drawing: Drawing) -> None:
        """Have the tissue move as a drawing says."""
        study = self.ground.study
        motion = replace(study.motion, drawing=drawing)
        self.engine.submit(replace(study, motion=motion), self.ground)

    def ask(
        self,
        job: Callable[[Deformation | None], None],
        then: Callable[[], None] = lambda: None,
    ) -> None:
        """Have a job done beside solving, in its turn."""
        self.asked += 1

        def run(latest: Deformation | None) -> None:
            try:
                job(latest)
            finally:
                self.done += 1
                then()

        self.engine.beside(run, _PREPARING)

    def rehearse(self) -> None:
        """Compile what the first drawing will need, and then what others may."""
        engine = self.engine
        # Nothing is solved before this, so its answer, None, replaces nothing.
        self.ask(
            lambda _: rehearse(self.ground, engine.report, engine.closed),
            lambda: self._newest.put(None),
        )
        engine.beside(lambda _: rehearse_the_rest(self.ground, engine.closed), _PREPARING)

    def _overlay(
        self,
        ground: Ground,
        drawing: Drawing,
        canvas: Canvas,
        window: Box | None,
        paint: npt.NDArray[Any] | None,
    ) -> npt.NDArray[Any] | None:
        """Keep what was painted where, at rest; it moves with the picture once there is any."""
        self._canvas = canvas
        if paint is None and any(isinstance(mark, Stroke) for mark in drawing.marks):
            paint, window = np.zeros(canvas.shape, np.uint8), canvas.whole
        if paint is not None and window is not None:
            show_painted(canvas, ground.base, window, paint)
        return paint

    def _deliver(self, moved: Deformation) -> None:
        painted = None
        if moved.overlay is not None and moved.overlay.any() and self._canvas is not None:
            painted = Painted(moved.overlay, *painted_marks(self._canvas))
        if moved.error is None:
            assert moved.image is not None
            drawing = moved.study.motion.drawing
            self._seen = Seen(self.ground, drawing, moved.image, moved.solution, painted=painted)
            self._newest.put(self._seen)
        else:
            seen = replace(self._seen, error=moved.error, outputs=None, painted=painted)
            self._newest.put(seen)

    def complete(self, latest: Deformation | None) -> None:
        """Have the displacement drawn, and folds counted."""
        seen, ground = self._seen, self.ground
        if latest is None or seen.solution is None or self.engine.busy:
            return
        if not seen.drawing.marks:
            return
        try:
            # A drawing is kept in the file of the solution it belongs to; of air nobody asks.
            body = seen.solution.tissue & ground.body
            solution = replace(
                seen.solution,
                displacement=np.where(body[..., None], seen.solution.displacement, np.float32(0)),
                tissue=body,
                frame={"drawing": seen.drawing.as_dict()},
            )
            pictures = replace(ground.study.pictures, image=None)
            place = ground.study.grid.place
            outputs = result_layers(solution, place, pictures, moved=seen.picture)
        except Exception:  # noqa: BLE001 - nobody waits for this job who could be told
            _log.exception("the displacement could not be drawn")
            return
        found = () if latest.stated is None else ground.notes_on(latest.stated)
        notes = [sentence_of(each) for each in found]
        if self._moves_edge():
            notes.append(EDGE_MOVED)
        if not self.engine.busy:
            self._newest.put(replace(seen, outputs=outputs, note=" ".join(notes)))

    def _moves_edge(self) -> bool:
        """Whether a patch that was taken hold of lies over what is held without it."""
        if self._canvas is None:
            return False
        base, canvas = self.ground.base, self._canvas
        moved = (
            (base.confidence > 0)
            & (canvas.confidence > 0)
            & (base.observed == 0)
            & (canvas.observed != 0)
        )
        # What was painted was meant, and air has no edge that is seen.
        return bool((moved.any(axis=-1) & (canvas.kinds == 0) & self.ground.body).any())

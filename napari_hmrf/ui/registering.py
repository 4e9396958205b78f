"""Registration of the image to the second image, in the window."""

from __future__ import annotations

import threading
from functools import partial
from typing import Any

import numpy as np

from napari_hmrf.field.resample import on_finer_grid
from napari_hmrf.layers.painted_overlay import ShownDeformation
from napari_hmrf.layers.second_picture import align_layer
from napari_hmrf.registration.alignment import Kind
from napari_hmrf.registration.matching import Step
from napari_hmrf.registration.study_registration import (
    RegisteredStudy,
    SecondPicture,
    register_study,
)
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.session import Part, Session
from napari_hmrf.study.study import Study
from napari_hmrf.study.support import supports
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.jobs import GuiThread
from napari_hmrf.ui.pair_job import JobWords, PairJob
from napari_hmrf.ui.registration_form import RegistrationForm

_WORDS = JobWords(
    "Registering",
    "The registration was cancelled; nothing was changed.",
    "The images were not registered.",
)
#: Message after a registration of a study whose edge was fixed.
_EDGE = (
    "The outer edge is no longer fixed, because the images show how it moves. To fix it, tick 'Fix "
    "outer edge'."
)
#: Message after the second image has been aligned.
_MOVED = "'{}' was moved to fit; Undo does not move it back."


class Registering:
    """Registration of the chosen image to the second image, as one undo step.

    The registration runs on the compute thread. The image follows after each level. Edits during
    the registration have their effect when it has ended.

    Parameters
    ----------
    controller : Controller
    session : Session
        Model that receives the measured motion.
    """

    def __init__(self, controller: Controller, session: Session) -> None:
        self._controller, self._session = controller, session
        self._form: RegistrationForm = controller.form.result.registration
        #: Job that registers the images.
        self.job = PairJob(controller, _WORDS, self._show)
        self._gui = GuiThread()
        self._form.register.changed.connect(self._start)
        self._form.remove.changed.connect(self._remove)
        self._connections = EventConnections(
            (session.changed, self._on_changed),
            (controller.slice_changed, self._show),
            (controller.form.result.second.changed, self._show),
            (controller.form.model.changed, self._show),
        )
        self._show()

    def release(self) -> None:
        """Stop all work, and disconnect from all events."""
        self.job.release()
        self._gui.release()
        self._connections.release()

    def _start(self, *_: Any) -> None:
        """Read the study and the second image, and register them in the background."""
        pair = None if self.job.busy else self.job.read_pair()
        if pair is None:
            return
        second = self._controller.form.result.second.value
        work = partial(self._run, *pair, self._form.alignment.value)
        self.job.start(work, partial(self._finish, self._session.measured_part, second))
        self._show()

    def _run(
        self, study: Study, second: SecondPicture, alignment: Kind | None, cancel: threading.Event
    ) -> RegisteredStudy:
        """Register the study on the compute thread."""

        def show(solution: Solution, step: Step) -> None:
            self._gui.submit(partial(self._follow, self._followed(study, solution), cancel))

        return register_study(
            study,
            second,
            alignment=alignment,
            progress=self._controller.engine.report,
            cancel=cancel,
            checkpoint=compute_thread.check_cancelled,
            show=show,
        )

    def _followed(self, study: Study, solution: Solution) -> Deformation:
        """Return the image of a study as moved by the solution of a level."""
        size = round(solution.spacing[0] / study.grid.spacing[0])
        tissue = np.ones(study.grid.shape, np.bool_)
        finer = solution if size == 1 else on_finer_grid(solution, tissue, size)
        image = study.pictures.image
        moved = None if image is None else finer.warp(image)
        return Deformation(study, solution=finer, image=moved)

    def _follow(self, moved: Deformation, cancel: threading.Event) -> None:
        """Show the image as the registration has moved it so far."""
        if self.job.busy and not cancel.is_set() and self._session.is_here(moved.study):
            self._controller.pointer.show(ShownDeformation(moved))

    def _finish(self, part: Part, second: Any, found: RegisteredStudy) -> None:
        """Store the measured motion of a slice, as one step, and deliver the result."""
        measured = found.study.motion.measured
        if measured is not None and part.layer in self._controller.form.image.offered:
            # Delivered only if nothing was edited since: the inputs are compared.
            self._controller.engine.deliver_again(found.study, found.registration.solution)
            self._session.register(part, measured)
            parts = ["Registered.", _EDGE if found.edge_was_fixed else ""]
            matrix = found.registration.matrix
            if not np.array_equal(matrix, np.eye(len(matrix))):
                place = found.study.grid.known_place
                if align_layer(second, place, matrix, self._controller.view):
                    self._form.alignment.value = None
                    parts.append(_MOVED.format(second.name))
            self.job.message.emit(" ".join(filter(None, parts)))
        self._show()

    def _remove(self, *_: Any) -> None:
        self._session.set_measured(None, "removed the registration")

    def _on_changed(self, part: Part, *_: Any) -> None:
        if part == self._session.measured_part:
            self._controller.follow_edit()
            self._show()

    def _show(self, *_: Any) -> None:
        """Enable the buttons, and describe the registration of the visible slice."""
        form = self._controller.form
        measured: MeasuredMotion | None = self._session.get(self._session.measured_part)
        second = form.result.second.value
        self._form.show(
            measured,
            second_name="" if second is None else str(second.name),
            is_elastic=supports(self._session.model.name, "registration"),
            is_busy=self.job.busy,
        )

"""Registration of the image to the second image, in the window."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from napari.layers import Layer

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.layers.missing_layer import missing_in, missing_layer, missing_layer_of
from napari_hmrf.layers.second_picture import align_layer
from napari_hmrf.layers.viewer_layers import layers_of
from napari_hmrf.registration.matching import Step
from napari_hmrf.registration.study_registration import RegisteredStudy, register_study
from napari_hmrf.results.finer_grid import on_finer_grid
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.session import Part, Session
from napari_hmrf.study.study import Study
from napari_hmrf.study.support import supports
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.pair_job import REMOVED, PairJob
from napari_hmrf.ui.registration_form import described

#: Message after a registration of a study whose edge was fixed.
_EDGE = (
    "The outer edge is no longer fixed, because the images show how it moves. To fix it, tick 'Fix "
    "outer edge'."
)
#: Message after the second image has been aligned.
_MOVED = "'{}' was moved to fit; Undo does not move it back."


class Registering(PairJob):
    """Registration of the chosen image to the second image, as one undo step.

    The image follows after each level.
    """

    name, doing = "registration", "Registering"
    failed = "The images were not registered."

    def __init__(self, controller: Controller, session: Session) -> None:
        super().__init__(controller, session)
        # Study that is being registered.
        self._study: Study | None = None
        self._form.register.changed.connect(self._start)
        self._form.remove.changed.connect(self._remove)

    def _start(self, *_: Any) -> None:
        """Read the study and the second image, and register them in the background."""
        pair = None if self.busy else self._read_pair()
        if pair is None:
            return
        # Where an earlier result folded, large motion has taken the place of the elastic model.
        model = self._session.model.before_unfolding
        self._study = study = replace(pair[0], prior=model.prior, optimizer=model.optimizer)
        painted = self._missing_layer(study)
        missing = None if painted is None else missing_in(painted, study.grid.shape)
        work = partial(
            register_study,
            study,
            pair[1],
            alignment=self._form.alignment.value,
            missing=missing,
            progress=self._controller.engine.report,
            checkpoint=compute_thread.check_cancelled,
            show=partial(self._on_level, study),
        )
        self._run(work, partial(self._store, self._session.measured_part, self._second.value))

    def _on_level(self, study: Study, solution: Solution, _: Step) -> None:
        """Move the image of a study by the solution of a level, on the compute thread."""
        size = round(solution.spacing[0] / study.grid.spacing[0])
        tissue = np.ones(study.grid.shape, np.bool_)
        finer = solution if size == 1 else on_finer_grid(solution, tissue, size)
        image = study.pictures.image
        moved = None if image is None else finer.warp(image)
        followed = Deformation(study, solution=finer, image=moved)
        self._controller.jobs.gui.submit(partial(self._follow, followed))

    def _follow(self, moved: Deformation) -> None:
        """Show the image as the registration has moved it so far."""
        if self.busy and moved.study is self._study and self._session.is_here(moved.study):
            self._controller.pointer.show(moved)

    def _store(self, part: Part, second: Any, found: RegisteredStudy) -> None:
        """Store the measured motion of a slice, as one step, and deliver the result."""
        measured = found.study.motion.measured
        if measured is None or part.layer not in self._controller.form.image.offered:
            return  # the layer was removed
        # Delivered only if nothing was edited since: the inputs are compared.
        self._controller.engine.deliver_again(found.study, found.registration.solution)
        self._session.register(part, measured)
        self._show_missing(found)
        parts = [described(measured), _EDGE if measured.frees_edge else ""]
        matrix = found.registration.matrix
        if not np.array_equal(matrix, np.eye(len(matrix))):
            place = found.study.grid.known_place
            if align_layer(second, place, matrix, self._controller.view):
                self._form.alignment.value = None
                parts.append(_MOVED.format(second.name))
        self.message.emit(" ".join(filter(None, parts)))

    def _missing_layer(self, study: Study) -> Any:
        """Return the layer with the tissue without counterpart of a study, or None."""
        frame, image = study.grid.known_place, study.pictures.name
        return missing_layer_of(self._controller.viewer.layers, frame, image)

    def _show_missing(self, found: RegisteredStudy) -> None:
        """Show the tissue without counterpart in a layer, unless the user has given it."""
        missing, study = found.registration.missing, found.study
        if missing is None or self._missing_layer(study) is not None:
            return
        made = missing_layer(missing, study.grid.known_place, study.pictures.name)
        layers_of(self._controller.viewer).add(Layer.create(*made))

    def _remove(self, *_: Any) -> None:
        self._session.unregister(self._session.measured_part, "removed the registration")
        self.message.emit(REMOVED)

    def _on_changed(self, part: Part, *_: Any) -> None:
        if part == self._session.measured_part:
            self._controller.follow_edit()
            self._refresh()
        elif part.kind == "model":
            self._refresh()

    def _refresh(self, *_: Any) -> None:
        """Enable the buttons, and describe the registration of the visible slice."""
        measured: MeasuredMotion | None = self._session.get(self._session.measured_part)
        second = self._second.value
        self._form.show(
            measured,
            second_name="" if second is None else str(second.name),
            is_elastic=supports(self._session.model.before_unfolding.name, "registration"),
            is_busy=self.busy,
        )

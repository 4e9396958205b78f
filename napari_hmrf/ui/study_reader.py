"""Reader of the study defined by the layers and choices of a dock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from napari_hmrf.field.frame import SlicePlace
from napari_hmrf.layers.pixel_copy import LayerCopies
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.slice_view import frame_of
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.study.study import Study
from napari_hmrf.study.study_model import Part, StudyModel
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve, first_curve
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.form_binding import FormBinding


class StudyReader:
    """Reader of the study defined by the layers and choices of a dock.

    Layers are read again only if they have changed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    form : DockForm
    binding : FormBinding
    model : StudyModel
    """

    def __init__(
        self, viewer: Any, form: DockForm, binding: FormBinding, model: StudyModel
    ) -> None:
        self._form, self._binding, self._model = form, binding, model
        self._copies: LayerCopies = shared(viewer, LayerCopies)

    def request(self) -> Request:
        """Return the current choices, with the visible slice and its drawing.

        Raises
        ------
        HmrfError
            If neither an image nor tissue labels are chosen.
        """
        request = self._binding.request()
        layer = request.layers[0]
        place = SlicePlace.of(frame_of(layer, request.view))
        drawing = self._model.get(Part("drawing", layer, place), Drawing())
        return replace(request, drawing=drawing)

    def read(self, request: Request) -> Study:
        """Read the study of a request, with the chosen model and solver settings.

        Raises
        ------
        HmrfError
            If a layer cannot be read.
        """
        model = self._model.model
        study = study_from_layers(request, self._copies)
        place = SlicePlace.of(study.grid.known_place)
        motion = replace(
            study.motion,
            typical_strain=model.strain,
            drift=model.drift,
            measured=self._model.get(Part("measured", request.layers[0], place)),
        )
        return replace(study, motion=motion, prior=model.prior, optimizer=model.optimizer)

    def first_curve(self) -> StiffnessCurve:
        """Return a first guess of the curve that maps the brightness of the slice to stiffness.

        Raises
        ------
        HmrfError
            If the slice cannot be read, or if all its pixels have the same value.
        """
        image = self._form.image.value
        study = self.read(Request(image=image, view=self._form.view(), drawing=Drawing()))
        assert study.intensities is not None
        return first_curve(study.intensities)

    def invalidate(self) -> None:
        """Discard all layer copies, because a script may have changed an array in place."""
        self._copies.invalidate()

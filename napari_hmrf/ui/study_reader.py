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

#: Attributes of a `Request` that define each part of a study.
_FIELDS: dict[str, tuple[str, ...]] = {
    "motion": ("boundary", "rules", "confidence"),
    "tissue": ("tissue", "materials", "curve"),
}


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
        return replace(request, drawing=self._model.get(_slice_of(request), Drawing()))

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

    def read_partly(self, last: Study | None) -> Study | None:
        """Read the selected slice, and take the parts that cannot be read from an earlier study.

        Parameters
        ----------
        last : Study or None
            Last study that was read, with the current drawing of the selected slice.

        Returns
        -------
        Study or None
            None if the image cannot be read, and there is no earlier study.
        """
        try:
            request = self.request()
            if _slice_of(request) != self._model.slice:
                return last  # a slice is displayed that could not be selected
        except Exception:  # noqa: BLE001 - a layer may raise anything
            return last
        for without in ((), ("motion",), ("tissue",), ("motion", "tissue")):
            left: dict[str, Any] = {name: None for part in without for name in _FIELDS[part]}
            some = replace(request, **left)
            if not some.layers:
                continue
            try:
                study = self.read(some)
            except Exception:  # noqa: BLE001 - a layer may raise anything
                continue
            if without and last is not None and last.grid == study.grid:
                if "tissue" in without:
                    study = replace(study, tissue=last.tissue, pictures=last.pictures)
                if "motion" in without:
                    study = replace(study, motion=last.motion)
                study = replace(study, names={**last.names, **study.names})
            return study
        return last

    def first_curve(self) -> StiffnessCurve:
        """Return a first guess of the curve that maps the brightness of the slice to stiffness.

        Raises
        ------
        HmrfError
            If the slice cannot be read, or if all its pixels have the same value.
        """
        image = self._model.image
        study = self.read(Request(image=image, view=self._form.view(), drawing=Drawing()))
        assert study.intensities is not None
        return first_curve(study.intensities)

    def invalidate(self) -> None:
        """Discard all layer copies, because a script may have changed an array in place."""
        self._copies.invalidate()


def _slice_of(request: Request) -> Part:
    """Return the key of the drawing of a request."""
    layer = request.layers[0]
    return Part("drawing", layer, SlicePlace.of(frame_of(layer, request.view)))

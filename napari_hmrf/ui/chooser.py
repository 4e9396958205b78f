"""What a deformation is made from, as the user chose it or a script set it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from napari.layers import Labels, Vectors

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.background import background_filling
from napari_hmrf.layers.image_choice import image_in_front, painted_on
from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, TISSUE, role_of
from napari_hmrf.layers.read import Request
from napari_hmrf.layers.result_layers import Kind
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.viewer_shared import shared
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.material_presets import Preset
from napari_hmrf.tissue.material_tables import load_materials, save_materials
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.deform_form import Face
from napari_hmrf.ui.forms import Part
from napari_hmrf.ui.material_menu import materials_of
from napari_hmrf.ui.messages import UNPAINTED, WELCOME
from napari_hmrf.ui.model import TissueModel
from napari_hmrf.ui.new_layers import add_missing
from napari_hmrf.ui.settings import SolverSettings
from napari_hmrf.ui.table_steps import FillingSteps
from napari_hmrf.ui.viewer_dock import Dock


class Chooser(Dock):
    """Choices of layers, tables, settings and outputs; what is done with them comes on top.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    image : napari.layers.Image or None
        What to deform; without, the motion alone is seen.
    tissue : napari.layers.Labels or Image
        Labels of tissues, or an image of stiffness.
    boundary : napari.layers.Labels or Vectors
        Labels of boundaries, or observed displacements.
    confidence : napari.layers.Image or None
        Of Vectors as boundary; without, 1 everywhere.
    landmarks : LandmarkLayers or None
        Two Points layers, or a Shapes layer of lines, which count on top of the boundary. To be set
        to a pair of layers, or one, too.
    landmark_layers : tuple of napari.layers.Layer
        Those that are chosen, be they complete or not yet.
    materials : tuple of Material
        How stiff each tissue label is.
    rules : tuple of BoundaryRule
        What each boundary label does.
    curve : StiffnessCurve or None
        From intensity to stiffness, if the tissue is made by one.
    outputs : tuple of Kind
        The layers a result makes.
    model : TissueModel
        What tissue is taken to be, and how far that is solved.
    settings : SolverSettings
        How to solve, in detail.
    """

    image = Part[Any]("_face.image.value")
    tissue = Part[Any]("_face.tissue.choice.value")
    boundary = Part[Any]("_face.boundary.choice.value")
    confidence = Part[Any]("_face.boundary.confidence.value")
    landmarks = Part[Any]("_face.boundary.landmarks.chosen")
    landmark_layers = Part[tuple[Any, ...]]("_face.boundary.landmarks.layers")
    materials = Part[tuple[Material, ...]]("_face.tissue.table.rows")
    rules = Part[tuple[BoundaryRule, ...]]("_face.boundary.table.rows")
    curve = Part[StiffnessCurve | None]("_face.tissue.curve.curve")
    outputs = Part[tuple[Kind, ...]]("_face.outputs")
    model = Part[TissueModel]("_face.model")
    settings = Part[SolverSettings]("_face.settings")

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self._face = Face(self, self._layers, self._view)
        #: Whether somebody chose an image, or no image: from then on that is nobody else's to do.
        self._image_chosen = False
        self._face.image.changed.connect(self._on_image_chosen)

    def take_materials(self, materials: Preset | Any) -> None:
        """Take over a table with its unit: a preset, another Labels layer's, or a file's.

        Parameters
        ----------
        materials : Preset, napari.layers.Labels, str or Path

        Raises
        ------
        HmrfError
            If there is no table to be had, or none to put it into.
        OSError
            If a file cannot be read.
        """
        if not isinstance(self.tissue, Labels):
            raise HmrfError("No Labels layer is chosen as tissue, so there is no table to fill.")
        if isinstance(materials, str | Path):
            materials = load_materials(materials)
        elif not isinstance(materials, Preset):
            layer, materials = materials, materials_of(materials)
            if materials is None:
                raise LayerError(layer, "has no table of materials. Choose another layer.")
        self._face.tissue.menu.take(materials)

    def save_materials(self, path: str | Path) -> Path:
        """Save the table of tissues to a file; as `material_tables.save_materials`."""
        return save_materials(path, self._face.tissue.table.contents)

    def add_layers(self) -> None:
        """Add a tissue and a boundary layer on the pixels of the image, and choose them.

        What is chosen there already stays; so does tissue that comes from the image's intensity.

        Raises
        ------
        HmrfError
            If no image is chosen, or it is not where the viewer looks.
        """
        if self.image is None:
            raise HmrfError(WELCOME)
        chosen = (self.tissue, self.boundary)
        self.tissue, self.boundary = add_missing(self._viewer, self.image, *chosen, self._view())

    def tissue_from_intensity(self, curve: StiffnessCurve | None = None) -> Any:
        """Add a layer of stiffness made from the image's intensity, and choose it as tissue.

        Parameters
        ----------
        curve : StiffnessCurve, optional
            By default the one that there is for this image, or else a first guess.

        Returns
        -------
        napari.layers.Image

        Raises
        ------
        HmrfError
            If no image is chosen, or no curve can be made for it.
        """
        image, made = self.image, self._face.tissue.curve
        if image is None:
            raise HmrfError(WELCOME)
        layer = made.made(image)
        if layer is None:
            layer = made.make(image, curve)
            self._viewer.layers.insert(self._viewer.layers.index(image) + 1, layer)
        self.tissue = layer
        if curve is not None:
            made.curve = curve
        return layer

    def fill_background(self) -> int:
        """Paint the dark surroundings of the image as no tissue, where nothing is painted yet.

        Returns
        -------
        int
            How many pixels that are now; `undo` takes them back, with the row of their label.

        Raises
        ------
        HmrfError
            If there is no image, or no layer of tissue labels in its place.
        """
        image, tissue = self.image, self.tissue
        if image is None:
            raise HmrfError(WELCOME)
        if not isinstance(tissue, Labels):
            raise HmrfError("No tissue layer to paint on: press 'Make layers to paint on'.")
        filling = background_filling(image, tissue, self._view())
        # What is painted is to be seen; and on a hidden layer napari may paint nothing, for want of
        # a slice that it has looked at.
        tissue.visible = True
        shared(self._viewer, FillingSteps).fill(tissue, filling)
        return len(filling.pixels[0])

    def reset_choices(self, *_: Any) -> None:
        """Look again at which layers there are."""
        for choice in self._face.choices:
            choice.reset_choices()
        self._face.boundary.landmarks.look()
        self._face.tissue.curve.look()

    def request(self) -> Request:
        """All that is chosen, with the slice that is shown.

        Raises
        ------
        HmrfError
            If a layer is missing.
        """
        if not self._layers():
            raise HmrfError(WELCOME)
        landmarks = self.landmarks
        for what, layer in (("tissue", self.tissue), ("boundary", self.boundary or landmarks)):
            if layer is None:
                more = f" {UNPAINTED}" if landmarks is not None else ""
                raise HmrfError(
                    f"No {what} layer is chosen: choose one, or press 'Make layers to paint on'."
                    f"{more}"
                )
        return Request(
            tissue=self.tissue,
            boundary=self.boundary,
            image=self.image,
            materials=self.materials,
            rules=self.rules,
            confidence=self.confidence if isinstance(self.boundary, Vectors) else None,
            view=self._view(),
            landmarks=landmarks,
        )

    def _view(self) -> View:
        return View.of(self._viewer.dims)

    def choose_another(self) -> None:
        """Choose an image there is, or else the next that comes, in place of one that is gone."""
        others = (self.tissue, self.confidence)
        images = [layer for layer in self._face.image.offered if layer not in others]
        if images:
            self.image = images[0]
        else:
            self._image_chosen = False

    def choose_by_role(self, layers: list[Any]) -> None:
        """Choose a sample's layers as they come; if none ever was chosen, the image in front."""
        if not self._image_chosen:
            offered = [layer for layer in self._face.image.offered if layer in layers]
            image = image_in_front(self._viewer, offered, self._worked_on)
            if image is not None:
                self.image = image
                layers = painted_on(image, layers, self._view())
        for layer in layers:
            role = role_of(layer)
            if role == TISSUE:
                self.tissue = layer
            elif role == BOUNDARY:
                self.boundary = layer
            elif role == IMAGE:
                self.image = layer

    def _on_image_chosen(self, _: Any) -> None:
        self._image_chosen = True

    @property
    def _worked_on(self) -> tuple[Any, ...]:
        """What a dock like this was used for before."""
        return ()

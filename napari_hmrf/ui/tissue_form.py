"""Dock sections for the tissue and the boundary."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from magicgui.widgets import CheckBox, Container
from napari.layers import Image, Labels, Vectors
from psygnal import Signal
from qtpy.QtWidgets import QHBoxLayout, QPushButton, QVBoxLayout, QWidget

from napari_hmrf.layers.image_result import CONFIDENCE
from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.layers.read import EDGES
from napari_hmrf.layers.slice_view import View
from napari_hmrf.study.session import BRIGHTNESS
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.curve.editor import CurveEditor
from napari_hmrf.ui.layer_choice import LayerChoice
from napari_hmrf.ui.tissue_tables import BoundaryTable, MaterialMenu, MaterialTable

Layers = Callable[[], list[Any]]
Shown = Callable[[], View]
Table = TypeVar("Table", bound=MaterialTable | BoundaryTable)
#: Curve that the editor shows until the image has a curve.
_UNKNOWN = StiffnessCurve(((0, 1), (1, 1)))


class _PaintedSection(Container, Generic[Table]):
    """Layer menu; for a Labels layer, also its table and a row of buttons."""

    edited = Signal()

    def __init__(
        self, choice: LayerChoice, others: list[LayerChoice], table: Table, *buttons: QPushButton
    ) -> None:
        super().__init__(widgets=[choice, *others])
        self.choice, self.table = choice, table
        self._below = QWidget()
        add = QPushButton(f"Add {table.role}")
        add.setToolTip("Add a label to paint with")
        add.clicked.connect(lambda: table.add())
        rows, row = QVBoxLayout(self._below), QHBoxLayout()
        rows.setContentsMargins(0, 0, 0, 0)
        for button in (add, *buttons):
            row.addWidget(button)
        row.addStretch()
        rows.addWidget(table)
        rows.addLayout(row)
        self.native.layout().addWidget(self._below)
        choice.changed.connect(self._on_choice)
        table.changed.connect(lambda _: self.edited.emit())
        self._on_choice(None)

    def _on_choice(self, layer: Any) -> None:
        self.table.layer = layer
        self._below.setVisible(isinstance(layer, Labels))
        self.edited.emit()


class TissueSection(_PaintedSection[MaterialTable]):
    """Section for the tissue: Labels with a table, a stiffness image, or a brightness curve.

    Attributes
    ----------
    menu : MaterialMenu
    border : CheckBox
        Check box that excludes dark, unpainted surroundings from the tissue.
    brightness_curve : StiffnessCurve or None
        Curve of the image, if the menu offers it.
    editor : CurveEditor
        Editor for the curve.
    """

    brightness_curve: StiffnessCurve | None = None

    def __init__(self, layers: Layers, view: Shown) -> None:
        choice = LayerChoice(
            layers,
            # Result layers, which have a "kind", cannot define the tissue.
            lambda layer: isinstance(layer, Labels | Image) and "kind" not in metadata_of(layer),
            "tissue",
            "Labels layer with painted tissues, stiffness image, or brightness of the image",
            lambda: [("brightness of the image", BRIGHTNESS)] if self.brightness_curve else [],
        )
        self.border = CheckBox(
            value=True,
            text="Ignore dark background",
            tooltip="Exclude dark, unpainted surroundings, such as air, from the tissue",
        )
        self.editor = CurveEditor(_UNKNOWN)
        table = MaterialTable(view)
        self.menu = MaterialMenu(table, layers)
        super().__init__(choice, [], table, self.menu)
        for part in (self.editor, self.border):
            self.native.layout().addWidget(part.native)
        self.border.changed.connect(lambda _: self.edited.emit())

    @property
    def layer(self) -> Any:
        """Chosen layer, or None."""
        return None if self.choice.value == BRIGHTNESS else self.choice.value

    @property
    def curve(self) -> StiffnessCurve | None:
        """Curve of the image, if brightness defines the tissue; else None."""
        return self.brightness_curve if self.choice.value == BRIGHTNESS else None

    def offer(self, curve: StiffnessCurve | None) -> None:
        """Offer the curve of the image in the menu; None removes it."""
        self.brightness_curve = curve
        if curve is not None:
            self.editor.curve = curve
        self.choice.reset_choices()

    def go_by(self, curve: StiffnessCurve) -> None:
        """Define the tissue by brightness, using a curve."""
        self.offer(curve)
        self.choice.value = BRIGHTNESS
        self.edited.emit()

    def _on_choice(self, layer: Any) -> None:
        self.editor.visible = layer == BRIGHTNESS
        # Without labels, the border is always tissue.
        self.border.visible = isinstance(layer, Labels)
        super()._on_choice(layer)


class BoundarySection(_PaintedSection[BoundaryTable]):
    """Section for the boundary: Labels with rules, or Vectors with confidence.

    Attributes
    ----------
    confidence : LayerChoice
        Confidence of the Vectors layer.
    """

    def __init__(self, layers: Layers, view: Shown) -> None:
        choice = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Labels | Vectors) and "kind" not in metadata_of(layer),
            "boundary",
            "Labels layer with regions to hold or move, or Vectors layer with observed "
            "displacements, such as a field from File > Open",
        )
        self.confidence = LayerChoice(
            layers,
            _may_be_confidence,
            "confidence",
            "Confidence in the Vectors layer: an image from 0 to 1, a mask, or the edges of the "
            "image; 1 if nothing is chosen",
            lambda: [("edges of the image", EDGES)],
        )
        super().__init__(choice, [self.confidence], BoundaryTable(view))
        self.confidence.changed.connect(lambda _: self.edited.emit())

    def _on_choice(self, layer: Any) -> None:
        self.confidence.visible = isinstance(layer, Vectors)
        super()._on_choice(layer)


def _may_be_confidence(layer: Any) -> bool:
    """Return whether a layer is a grey image or a mask, but not painted confidence."""
    grey = isinstance(layer, Labels) or (isinstance(layer, Image) and not layer.rgb)
    return grey and metadata_of(layer).get("kind") != CONFIDENCE

"""The parts of the widget that say what the tissue is and what its boundary does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from magicgui.widgets import CheckBox, Container
from napari.layers import Image, Labels, Vectors
from psygnal import Signal
from qtpy.QtWidgets import QHBoxLayout, QPushButton, QWidget

from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, Role, known_of, role_of
from napari_hmrf.layers.slice_view import View
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.ui.boundary_table import BoundaryTable
from napari_hmrf.ui.curve.tissue import TissueCurve
from napari_hmrf.ui.label_sync import PaintedLabels
from napari_hmrf.ui.label_table import LabelTable
from napari_hmrf.ui.landmark_choice import LandmarkChoice
from napari_hmrf.ui.layer_choice import LayerChoice
from napari_hmrf.ui.material_menu import MaterialMenu
from napari_hmrf.ui.material_table import MaterialTable
from napari_hmrf.ui.preview import is_preview

Layers = Callable[[], list[Any]]
Shown = Callable[[], View | None]
Table = TypeVar("Table", bound=LabelTable)


#: Beside the box that turns the preview on.
PREVIEW = "Preview arrows while painting"
NO_PREVIEW = "No preview: the slice is too large"


def _is_tissue(layer: Any) -> bool:
    return isinstance(layer, Labels) or role_of(layer) == TISSUE


def _add_button(table: LabelTable, text: str, tooltip: str) -> QPushButton:
    button = QPushButton(text)
    button.setToolTip(tooltip)
    button.clicked.connect(lambda: table.add())
    return button


class _PaintedSection(Container, Generic[Table]):
    """A menu of layers; for Labels, their table and a row of buttons below it."""

    edited = Signal()

    def __init__(
        self, choice: LayerChoice, others: list[LayerChoice], role: Role, table: Table, view: Shown
    ) -> None:
        super().__init__(widgets=[choice, *others], labels=True)
        self._choice = choice
        self._table = table
        self._painted = PaintedLabels(role, table, view)
        self._rows: list[QWidget] = []
        self._choice.changed.connect(self._on_choice)
        self._painted.changed.connect(self.edited)

    @property
    def choice(self) -> LayerChoice:
        """The menu of layers."""
        return self._choice

    @property
    def table(self) -> Table:
        """The table, for what a script wants to set."""
        return self._table

    @property
    def painted(self) -> PaintedLabels:
        """What keeps layer and table in step."""
        return self._painted

    def _put_below(self, *buttons: QWidget) -> None:
        """Put the table and a row of buttons, plain Qt widgets, under the section's own."""
        for widgets in ((self._table,), buttons):
            row = QWidget()
            layout = QHBoxLayout(row)
            layout.setContentsMargins(0, 0, 0, 0)
            for widget in widgets:
                layout.addWidget(widget)
            if widgets is buttons:
                layout.addStretch()
            self.native.layout().addWidget(row)
            self._rows.append(row)
        self._on_choice(None)

    def _on_choice(self, layer: Any) -> None:
        self._painted.layer = layer
        for row in self._rows:
            row.setVisible(isinstance(layer, Labels))
        self.edited.emit()


class TissueSection(_PaintedSection[MaterialTable]):
    """Labels with a table of stiffness, or an image that is the stiffness, by a curve or not."""

    def __init__(self, layers: Layers, view: Shown) -> None:
        choice = LayerChoice(
            layers,
            # What a dock has deformed, or drawn of it, is nobody's stiffness.
            lambda layer: (
                isinstance(layer, Labels)
                or (isinstance(layer, Image) and "kind" not in known_of(layer))
            ),
            lambda layer: layer.name + ("" if _is_tissue(layer) else " (as stiffness)"),
            label="tissue",
            tooltip="A Labels layer in which tissues are painted, or an image of stiffness",
        )
        super().__init__(choice, [], TISSUE, MaterialTable(), view)
        self._background = QPushButton("Background is no tissue")
        self._background.setToolTip(
            "Paints what is dark around the image with a label of stiffness 0, as far as it is "
            "unpainted; Undo at the bottom takes it back with its row"
        )
        self.menu = MaterialMenu(self._table, layers, lambda: self._painted.layer)
        self._put_below(
            _add_button(self._table, "Add tissue", "Add a label to paint with"),
            self.menu,
            self._background,
        )
        self.curve = TissueCurve(layers, view)
        self.native.layout().addWidget(self.curve.editor)
        self.curve.changed.connect(lambda _: self.edited.emit())
        self._choice.changed.connect(self._show_curve)
        self._show_curve(None)

    @property
    def background(self) -> QPushButton:
        """The button that tells air from tissue."""
        return self._background

    @property
    def materials(self) -> tuple[Material, ...]:
        """The tissues."""
        return self._table.rows

    def _show_curve(self, layer: Any) -> None:
        self.curve.layer = layer
        self.curve.editor.setVisible(self.curve.layer is not None)


class BoundarySection(_PaintedSection[BoundaryTable]):
    """Labels with a table of rules, or arrows with an image of confidence; and landmarks.

    Attributes
    ----------
    landmarks : LandmarkChoice
        Two Points layers or lines, beside all that or without any of it.
    """

    def __init__(self, layers: Layers, view: Shown) -> None:
        choice = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Labels | Vectors) and not is_preview(layer),
            lambda layer: layer.name + ("" if isinstance(layer, Labels) else " (arrows)"),
            label="boundary",
            tooltip="A Labels layer in which is painted what holds or moves, or observed "
            "displacements as a Vectors layer. Landmarks, as two Points layers or as lines of "
            "a Shapes layer, come on top: their menus are below once there are such layers",
        )
        self._confidence = LayerChoice(
            layers,
            lambda layer: isinstance(layer, Image) and not layer.rgb,
            label="confidence",
            tooltip="How sure each arrow is, from 0 to 1; without an image, 1",
        )
        super().__init__(choice, [self._confidence], BOUNDARY, BoundaryTable(), view)
        self._preview = CheckBox(
            value=True,
            text=PREVIEW,
            tooltip="A layer of its own shows what the boundary will do",
        )
        self._put_below(
            _add_button(self._table, "Add boundary", "Add a label to paint with"),
            self._preview.native,
        )
        self.landmarks = LandmarkChoice(layers)
        self.landmarks.margins = (0, 0, 0, 0)
        self.native.layout().addWidget(self.landmarks.native)
        self.landmarks.edited.connect(self.edited)
        for widget in (self._confidence, self._preview):
            widget.changed.connect(lambda _: self.edited.emit())

    @property
    def confidence(self) -> LayerChoice:
        """The menu of images of confidence, for arrows."""
        return self._confidence

    @property
    def preview(self) -> CheckBox:
        """Whether arrows are drawn while painting."""
        return self._preview

    @property
    def rules(self) -> tuple[BoundaryRule, ...]:
        """What each label does."""
        return self._table.rows

    def _on_choice(self, layer: Any) -> None:
        self._confidence.visible = isinstance(layer, Vectors)
        super()._on_choice(layer)

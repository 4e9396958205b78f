"""Layout of the dock: the forms, which scroll, and the footer, which is always visible.

The image and the tools come first. Settings that are not needed while pulling are in sections,
which are closed until the user opens them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from magicgui.widgets import Container, PushButton
from psygnal import Signal
from qtpy.QtCore import QPoint, Qt
from qtpy.QtWidgets import (
    QAbstractSlider,
    QAbstractSpinBox,
    QComboBox,
    QFrame,
    QScrollArea,
    QSizePolicy,
    QWidget,
)

from napari_hmrf.field.directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.font_size import FontFollower, WidthFitter
from napari_hmrf.ui.footer import Footer
from napari_hmrf.ui.forms import CalmField, Section, row
from napari_hmrf.ui.keyboard_access import name_fields
from napari_hmrf.ui.layer_choice import ExtentChoice, LayerChoice, LayerSubmenu, is_picture
from napari_hmrf.ui.model import ModelForm
from napari_hmrf.ui.motion.carry_over import CarryOverForm
from napari_hmrf.ui.motion.motion_form import MotionForm
from napari_hmrf.ui.motion.tools import TOOLS
from napari_hmrf.ui.remembered_settings import remember_open
from napari_hmrf.ui.result.result_form import ResultForm
from napari_hmrf.ui.scene import NEW_TISSUE
from napari_hmrf.ui.tissue_form import Layers, TissueSection
from napari_hmrf.ui.tissue_tables import BoundaryTable, MaterialTable

#: Title and tooltip of each section.
_SECTIONS = {
    "comparison": (
        "Second image: compare, register",
        "Later image of the same tissue: comparison, registration, and fit of the tissues",
    ),
    "tissue": (
        "Tissue and stiffness",
        "Kinds of tissue and their stiffness: painted, or derived from brightness",
    ),
    "edges": (
        "Boundary and gravity",
        "Outer edge, painted regions that are held or moved, weight, and cavities",
    ),
    "model": ("Model", "Model of the tissue, with advice on its use"),
    "advanced": ("Advanced", "Settings of the solver; the default settings suit most studies"),
}
#: Minimum width of the dock, in pixels.
_WIDTH = 336


class DockForm:
    """All widgets of the *Soft tissue* dock, arranged in its container.

    Parameters
    ----------
    outer : Container
        The dock widget.
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    image : LayerChoice
    extent : ExtentChoice
    carry_over : CarryOverForm
        Question about the drawing after a change of the extent.
    make, intensity : PushButton
        Button that adds layers for painting, and button that derives stiffness from brightness.
    sections : dict of str to Section
        Sections by the name under which their state is stored.
    tissue : TissueSection
    motion : MotionForm
    result : ResultForm
    model : ModelForm
    footer : Footer
    """

    #: Emitted when the user changes an input to the solve.
    edited = Signal()

    def __init__(self, outer: Container, viewer: Any) -> None:
        self._viewer = viewer
        layers: Layers = partial(list, viewer.layers)
        self.image = LayerChoice(
            layers, is_picture, "image", "Image to deform; in a stack, the visible slice"
        )
        self.extent = ExtentChoice()
        self.carry_over = CarryOverForm()
        self.make = PushButton(
            text=NEW_TISSUE,
            tooltip="Add an empty tissue layer, and an empty boundary layer for 'Boundary and "
            "gravity', on the pixels of the image; a layer that is in use is kept",
        )
        self.intensity = PushButton(
            text="Tissue from brightness",
            tooltip="Derive stiffness from the brightness of the image, with a curve that you draw",
        )

        self.tissue = TissueSection(layers, self.view)
        self.motion = MotionForm(layers, self.view)
        self.result = ResultForm(layers, self.image)
        self.model = ModelForm()
        keys = ", ".join(f"{tool.key}: {tool.title.lower()}" for tool in TOOLS)
        self.footer = Footer(self.result, self.result.files, f"Tools: {keys}.")
        self.tissue.edited.connect(self._on_tissue)
        self.extent.changed.connect(lambda _: self.model.extent_is(self.extent.is_volume))
        model, motion = self.model, self.motion
        loads = motion.weight, motion.cavity
        fields = (self.extent, model, model.in_detail, *motion.switches, *loads)
        presets = motion.fields.preset
        self._place: tuple[str, Directions, str] | None = None
        parts = (self.tissue.edited, motion.boundary.edited)
        for signal in (*parts, *(field.changed for field in (*fields, presets))):
            signal.connect(self.edited, max_args=0)
        self._assemble(outer)

    def view(self) -> View:
        """Return the view of the visible slice, or of the volume if the extent is "volume"."""
        return View.of(self._viewer.dims, self.extent.is_volume)

    @property
    def choices(self) -> tuple[LayerChoice | LayerSubmenu, ...]:
        """Layer menus."""
        boundary, result = self.motion.boundary, self.result
        marks = (self.motion.landmarks.sources, self.motion.landmarks.targets)
        compared = (result.reference, result.second)
        tissue = self.tissue.choice
        return (self.image, tissue, boundary.choice, boundary.confidence, *marks, *compared)

    @property
    def tables(self) -> tuple[MaterialTable, BoundaryTable]:
        """Tissue table and boundary table."""
        return self.tissue.table, self.motion.boundary.table

    def show_place(self, unit: str, ways: Directions, stiffness: str) -> None:
        """Show the units of length and stiffness, and the directions of rows and columns."""
        if self._place == (unit, ways, stiffness):
            return
        self._place = unit, ways, stiffness
        self.motion.fields.show_place(unit, ways)
        for part in (self.motion.boundary.table, self.motion.weight):
            part.show_place(unit, ways, stiffness)
        self.motion.cavity.show_place(unit, stiffness)

    def release(self) -> None:
        """Disconnect the tables from their layers."""
        for table in self.tables:
            table.release()

    def _assemble(self, outer: Container) -> None:
        first = Container(widgets=[self.image, self.extent])
        ways = row(self.make, self.intensity)
        tissue = Container(widgets=[ways, self.tissue], labels=False)
        body = Container(widgets=[first, self.carry_over, self.motion], labels=False)
        layout = body.native.layout()
        parts: dict[str, Container] = {
            "comparison": self.result.comparison,
            "tissue": tissue,
            "edges": self.motion.edges,
            "model": self.model,
            "advanced": self.model.in_detail,
        }
        self.sections: dict[str, Section] = {}
        for name, part in parts.items():
            title, about = _SECTIONS[name]
            self.sections[name] = step = Section(title)
            step.toggleButton().setToolTip(about)
            for inner in (step.layout(), step.content().layout()):
                inner.setSpacing(2)
                inner.setContentsMargins(0, 0, 0, 0)
            step.addWidget(part.native)
            # The section of the second image is visible only if there is one.
            remember_open(step, name, usual=name == "comparison")
            (parts["model"].native.layout() if name == "advanced" else layout).addWidget(step)
            step.opened.connect(single_shot(step, 0, partial(self._scroll_to, step)).start)
        layout.setSpacing(4)
        layout.addStretch()
        # The form scrolls vertically only, so the dock must not be narrower than the form.
        self._scroll = scroll = QScrollArea()
        scroll.setWidgetResizable(True)
        scroll.setFocusPolicy(Qt.FocusPolicy.ClickFocus)  # it scrolls to the field with the focus
        scroll.setFrameShape(QFrame.Shape.NoFrame)
        scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        scroll.setWidget(body.native)
        scroll.setMinimumWidth(_WIDTH)
        WidthFitter(scroll, _WIDTH)
        scroll.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Expanding)
        outer.native.layout().addWidget(scroll)
        self._body = body, tissue  # magicgui deletes an unreferenced container
        outer.native.layout().addWidget(self.footer)
        calm = CalmField(scroll)
        for place in (body.native, self.footer):
            for field in place.findChildren(QWidget):
                if isinstance(field, QComboBox | QAbstractSpinBox | QAbstractSlider):
                    calm.watch(field)
        for container in (outer, body, first, ways, self.motion, *parts.values()):
            container.margins = (2, 2, 2, 2)
        self.tissue.margins = (0, 0, 0, 0)
        self.result.second.listed.connect(self._show_comparison)
        self.result.registration.shown.connect(self._show_comparison)
        self._show_comparison()
        FontFollower(self.motion.fields.radius.native, [*self.motion.tools.values(), *self.tables])
        # Nested widgets, which magicgui does not list, follow the forms that contain them.
        inner = (self.tissue, self.tissue.editor)
        for form in (body, *parts.values(), *inner, self.result):
            name_fields(form)

    def _show_comparison(self) -> None:
        """Show the section of the second image only if it has an image or a registration."""
        is_registered = self.result.registration.is_registered
        self.sections["comparison"].setVisible(is_registered or bool(self.result.second.offered))

    def _scroll_to(self, step: Section) -> None:
        """Scroll until all of an opened section is visible, or at least its top."""
        bar = self._scroll.verticalScrollBar()
        top = step.mapTo(self._scroll.widget(), QPoint(0, 0)).y()
        bar.setValue(min(top, max(bar.value(), top + step.height() - bar.pageStep())))

    def _on_tissue(self) -> None:
        by_brightness = self.tissue.curve is not None
        self.model.tissue_is(self.image.value if by_brightness else self.tissue.layer)

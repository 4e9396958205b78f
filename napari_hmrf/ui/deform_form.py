"""How the widget looks: its parts in their order, what scrolls and what stays in sight."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import CheckBox, Container, Label, PushButton
from magicgui.widgets.bases import ValueWidget
from napari.layers import Labels
from qtpy.QtWidgets import QSizePolicy
from superqt import QCollapsible

from napari_hmrf.layers.result_layers import Kind
from napari_hmrf.ui.energy_plot import EnergyPlot
from napari_hmrf.ui.footer import Footer
from napari_hmrf.ui.forms import Prose, put_scrolled, row
from napari_hmrf.ui.layer_choice import LayerChoice, is_picture
from napari_hmrf.ui.material_table import POISSON
from napari_hmrf.ui.model import TissueModel
from napari_hmrf.ui.remembered_settings import remember
from napari_hmrf.ui.sections import BoundarySection, Layers, Shown, TissueSection
from napari_hmrf.ui.settings import SolverSettings

_OUTPUTS: dict[Kind, tuple[str, str, bool]] = {
    "image": ("deformed image", "The image, moved with the tissue", True),
    "arrows": ("arrows", "Where the tissue goes, at true length", True),
    "grid": ("grid", "A square grid, moved with the tissue", False),
    "magnitude": ("magnitude", "How far the tissue goes, in the image's unit of length", False),
    "labels": ("deformed labels", "The tissue labels, moved with the tissue", False),
    "folds": ("folds", "Where the tissue is pushed through itself, before it moved", False),
}


#: napari's own, for who paints.
KEYS = (
    "While painting: 2 paints, 1 erases, 3 draws an outline, 4 fills; [ and ]: size of the brush; "
    "hold Space: move the view. Ctrl+Z: undo. Ctrl+Shift+Z or Ctrl+Y: redo. "
    "Ctrl+Shift+P: all commands, by their words."
)
#: Of the dock, in pixels: enough for the widest table.
_WIDTH = 430


class Face:
    """The widgets of *Deform tissue*, put into its container.

    Parameters
    ----------
    outer : Container
        The dock widget.
    layers, view : callable
        The viewer's layers, and which slice it shows.
    """

    def __init__(self, outer: Container, layers: Layers, view: Shown) -> None:
        self.image = LayerChoice(
            layers, is_picture, "image", "The image to deform; of a stack, the slice that is shown"
        )
        self.make = PushButton(
            text="Make layers to paint on",
            tooltip="Adds a tissue and a boundary layer on the image's pixels",
            enabled=False,
        )
        self.intensity = PushButton(
            text="Tissue from intensity",
            tooltip="Adds a layer of stiffness made from how bright the image is, by a curve that "
            "you draw; then only the boundary is left to paint",
            enabled=False,
        )
        self.tissue = TissueSection(layers, view)
        self.boundary = BoundarySection(layers, view)
        self._checks = {
            kind: CheckBox(text=words, tooltip=tooltip, value=on)
            for kind, (words, tooltip, on) in _OUTPUTS.items()
        }
        self.model = TissueModel()
        self.settings = SolverSettings(self.model)
        self.footer = Footer()
        self.energy = EnergyPlot()
        self.tissue.edited.connect(self._on_tissue)
        self.model.energy.changed.connect(self._on_energy)
        self._on_energy()
        self.keys = Prose()
        remember("deform", {"preview": self.boundary.preview, "device": self.settings.device})
        self._assemble(outer)

    @property
    def choices(self) -> tuple[LayerChoice, ...]:
        """The menus of layers."""
        boundary = self.boundary
        landmarks = (boundary.landmarks.where, boundary.landmarks.should)
        return (self.image, self.tissue.choice, boundary.choice, boundary.confidence, *landmarks)

    @property
    def checks(self) -> tuple[CheckBox, ...]:
        """The boxes that say which layers a result makes."""
        return tuple(self._checks.values())

    @property
    def solved(self) -> dict[str, ValueWidget[Any]]:
        """All that says how to solve, and what to show of it, by names."""
        model = self.model
        fields: dict[str, ValueWidget[Any]] = {
            "energy": model.energy,
            "schedule": model.schedule,
            "plane": model.plane,
            "poisson": model.poisson,
        }
        fields.update((str(kind), check) for kind, check in self._checks.items())
        return fields | self.settings.details

    @property
    def folds(self) -> CheckBox:
        """The box for the layer of folds, which not every result has."""
        return self._checks["folds"]

    @property
    def outputs(self) -> tuple[Kind, ...]:
        """The kinds of layers that are ticked."""
        return tuple(kind for kind, check in self._checks.items() if check.value)

    @outputs.setter
    def outputs(self, kinds: tuple[Kind, ...]) -> None:
        unknown = set(kinds) - set(self._checks)
        if unknown:
            raise ValueError(f"there are no outputs {sorted(unknown)}; take {list(self._checks)}")
        for kind, check in self._checks.items():
            check.value = kind in kinds

    def listen(self) -> None:
        """Listen to the layers that are chosen, again."""
        for section in (self.tissue, self.boundary):
            section.painted.layer = section.choice.value
        self.boundary.landmarks.listen()

    def release(self) -> None:
        """Stop listening to layers."""
        self.tissue.painted.release()
        self.boundary.painted.release()
        self.boundary.landmarks.release()

    def _assemble(self, outer: Container) -> None:
        ways = row(self.make, self.intensity)
        first = Container(widgets=[self.image, ways])
        kinds = list(self._checks.values())
        rows = [row(*kinds[:3]), row(*kinds[3:])]
        kinds_of = Label(value="Layers to make of a result")
        parts = [first, self.tissue, self.boundary, self.model]
        body = Container(widgets=[*parts, kinds_of, *rows], labels=False)
        advanced = QCollapsible("Advanced", expandedIcon="▾", collapsedIcon="▸")
        advanced.addWidget(self.settings.native)
        layout = body.native.layout()
        self.keys.say(KEYS)
        for part in (advanced, self.energy, self.keys.native):
            layout.addWidget(part)
        layout.setSpacing(4)
        layout.addStretch()
        put_scrolled(outer, body, _WIDTH)
        outer.native.layout().addWidget(self.footer.build())
        for button in (self.make, self.intensity):
            button.native.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        ways.margins = (0, 0, 0, 0)
        for container in (outer, body, *parts, *rows):
            container.margins = (2, 2, 2, 2)

    def _on_tissue(self) -> None:
        layer = self.tissue.choice.value
        self.model.tissue_is(layer, self.tissue.table.rows if isinstance(layer, Labels) else ())

    def _on_energy(self, *_: str) -> None:
        # Only elastic tissue has it.
        self.tissue.seen.setColumnHidden(POISSON, not self.model.is_elastic)

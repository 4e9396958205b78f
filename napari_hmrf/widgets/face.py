"""How the widget looks: its parts in their order, what scrolls and what stays in sight."""

from __future__ import annotations

from typing import Any

from magicgui.widgets import CheckBox, Container, Label, ProgressBar, PushButton
from napari.layers import Image
from napari.utils import progress as napari_progress
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QFrame, QLabel, QScrollArea, QSizePolicy
from superqt import QCollapsible

from napari_hmrf.layers.metadata import known_of
from napari_hmrf.layers.outputs import Kind
from napari_hmrf.solution import Solution
from napari_hmrf.widgets.layer_choice import LayerChoice
from napari_hmrf.widgets.sections import BoundarySection, Layers, Shown, TissueSection
from napari_hmrf.widgets.settings import SolverSettings

_OUTPUTS: dict[Kind, tuple[str, str, bool]] = {
    "image": ("deformed image", "The image, moved with the tissue", True),
    "arrows": ("arrows", "Where the tissue goes, at true length", True),
    "grid": ("grid", "A square grid, moved with the tissue", False),
    "magnitude": ("magnitude", "How far the tissue goes, in the image's unit of length", False),
    "labels": ("deformed labels", "The tissue labels, moved with the tissue", False),
}


#: Of the dock, in pixels: enough for the widest table.
_WIDTH = 395


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
            layers,
            lambda layer: isinstance(layer, Image) and "kind" not in known_of(layer),
            label="image",
            tooltip="The image to deform; of a stack, the slice that is shown",
        )
        self.make = PushButton(
            text="Make layers to paint on",
            tooltip="Adds a tissue and a boundary layer on the image's pixels",
            enabled=False,
        )
        self.tissue = TissueSection(layers, view)
        self.boundary = BoundarySection(layers, view)
        self._checks = {
            kind: CheckBox(text=words, tooltip=tooltip, value=on)
            for kind, (words, tooltip, on) in _OUTPUTS.items()
        }
        self.settings = SolverSettings()
        self.deform = PushButton(text="Deform", tooltip="Compute how the tissue moves")
        self.cancel = PushButton(text="Cancel", tooltip="Stop; nothing is changed")
        self._progress = ProgressBar(min=0, max=1000, visible=False)
        self._status = QLabel()
        self._canvas: Any = None
        self._assemble(outer)

    @property
    def choices(self) -> tuple[LayerChoice, ...]:
        """The menus of layers."""
        boundary = self.boundary
        return (self.image, self.tissue.choice, boundary.choice, boundary.confidence)

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

    def start(self) -> Any:
        """Show that work is going on; the bar in napari's own activity panel is given back."""
        self.deform.enabled, self.cancel.enabled = False, True
        self._progress.value = 0
        self._progress.visible = True
        return napari_progress(total=1000, desc="Deform tissue")

    def progress(self, bar: Any, fraction: float) -> None:
        """Show how far the work is."""
        done = round(1000 * fraction)
        self._progress.value = done
        if bar is not None and done > bar.n:
            bar.update(done - bar.n)

    def stop(self, bar: Any) -> None:
        """Show that nothing is going on."""
        self.deform.enabled, self.cancel.enabled = True, False
        self._progress.visible = False
        if bar is not None:
            bar.close()

    def say(self, status: str) -> None:
        """Show a sentence at the bottom."""
        self._status.setText(status)

    def draw_energy(self, solution: Solution, viewer: Any) -> None:
        """Show the energies of a solution."""
        from napari_hmrf.widgets.energy_plot import draw_energy, energy_canvas

        if self._canvas is None:
            dark = str(getattr(viewer, "theme", "dark")) != "light"
            self._canvas = energy_canvas("#dddddd" if dark else "#333333")
            self._energy.addWidget(self._canvas)
            self._energy.expand(animate=False)
        draw_energy(self._canvas, solution)
        self._reveal.start()

    def release(self) -> None:
        """Stop listening to layers."""
        self.tissue.painted.release()
        self.boundary.painted.release()

    def _assemble(self, outer: Container) -> None:
        first = Container(widgets=[self.image, self.make])
        kinds = list(self._checks.values())
        rows = [
            Container(widgets=part, layout="horizontal", labels=False)
            for part in (kinds[:3], kinds[3:])
        ]
        body = Container(
            widgets=[first, self.tissue, self.boundary, Label(value="Show as layers"), *rows],
            labels=False,
        )
        self._body = body
        advanced = QCollapsible("Advanced", expandedIcon="▾", collapsedIcon="▸")
        advanced.addWidget(self.settings.native)
        self._energy = QCollapsible("Energy", expandedIcon="▾", collapsedIcon="▸")
        layout = body.native.layout()
        for part in (advanced, self._energy):
            layout.addWidget(part)
        layout.setSpacing(4)
        layout.addStretch()
        scroll = QScrollArea()
        # The plot has its place only once Qt has laid it out.
        self._reveal = QTimer(scroll)
        self._reveal.setSingleShot(True)
        self._reveal.setInterval(50)
        self._reveal.timeout.connect(lambda: scroll.ensureWidgetVisible(self._canvas, 0, 0))
        scroll.setWidgetResizable(True)
        scroll.setFrameShape(QFrame.Shape.NoFrame)
        scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        scroll.setWidget(body.native)
        scroll.setMinimumWidth(_WIDTH)
        scroll.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        outer.native.layout().addWidget(scroll)
        buttons = Container(widgets=[self.deform, self.cancel], layout="horizontal", labels=False)
        self._footer = Container(widgets=[buttons, self._progress], labels=False)
        outer.native.layout().addWidget(self._footer.native)
        outer.native.layout().addWidget(self._status)
        self._status.setWordWrap(True)
        self._status.setContentsMargins(6, 0, 6, 4)
        self._status.setMinimumHeight(4 * self._status.fontMetrics().lineSpacing())
        self._status.setAlignment(Qt.AlignmentFlag.AlignTop)
        self._status.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.make.native.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        for container in (outer, body, first, self.tissue, self.boundary, self._footer, *rows):
            container.margins = (2, 2, 2, 2)

"""What *Grab and pull* is set to and does, by hand or from Python."""

from __future__ import annotations

from typing import Any

from napari_hmrf.tissue.drawing import Drawing, History
from napari_hmrf.ui.forms import Part, put_scrolled
from napari_hmrf.ui.grab.form import GrabForm
from napari_hmrf.ui.grab.grab_messages import REMOVED_ALL
from napari_hmrf.ui.grab.pointer_events import Answers
from napari_hmrf.ui.grab.puller import Puller
from napari_hmrf.ui.viewer_dock import Dock

#: Of the dock, in pixels: enough for the row of tools.
_WIDTH = 350


class GrabControls(Dock):
    """The layers that are chosen and what is drawn; when the mouse pulls comes on top.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    form : GrabForm
        The fields and buttons.
    image : napari.layers.Image or None
        Whose tissue is pulled.
    tissue : napari.layers.Labels, Image or None
        How stiff tissue is: labels with their table, or an image of stiffness.
    boundary : napari.layers.Labels or None
        What holds and moves beside what is drawn.
    warning : str
        What is to be known of the tissue that is seen, folds above all; "" if nothing.
    history : History
        Of the slice that is shown.
    active : bool
        Whether the mouse pulls tissue.
    """

    image = Part[Any]("form.image.value")
    tissue = Part[Any]("form.tissue.value")
    boundary = Part[Any]("form.boundary.value")
    warning = Part[str]("form.warning.value")
    history = Part[History]("_puller.history")
    active = Part[bool]("_puller.active")

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self.form = GrabForm(self._layers)
        put_scrolled(self, self.form, _WIDTH)
        self._puller = Puller(self._viewer, lambda: self.form.fields.how, Answers)

    @property
    def drawing(self) -> Drawing:
        """What is drawn on the slice that is shown."""
        return self.history.drawing

    @drawing.setter
    def drawing(self, drawing: Drawing) -> None:
        self._puller.set_drawing(drawing, "took over a drawing")

    def undo(self) -> None:
        """Take back what was done last."""
        self._puller.answers.undo()

    def redo(self) -> None:
        """Do again what was taken back."""
        self._puller.answers.redo()

    def remove(self) -> None:
        """Remove what is selected."""
        self._puller.answers.remove()

    def clear(self) -> None:
        """Remove all that is drawn."""
        self._puller.set_drawing(Drawing(), "removed all")
        self._puller.said.emit(REMOVED_ALL)

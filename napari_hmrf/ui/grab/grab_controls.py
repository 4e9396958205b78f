"""What *Grab and pull* is set to and does, by hand or from Python."""

from __future__ import annotations

from typing import Any

from napari_hmrf.tissue.drawing import Drawing, History
from napari_hmrf.ui.forms import put_scrolled
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
    """

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self.form = GrabForm(self._layers)
        put_scrolled(self, self.form, _WIDTH)
        self._puller = Puller(self._viewer, lambda: self.form.fields.how, Answers)

    @property
    def image(self) -> Any:
        """The image whose tissue is pulled, or None."""
        return self.form.image.value

    @image.setter
    def image(self, layer: Any) -> None:
        self.form.image.choose(layer)

    @property
    def tissue(self) -> Any:
        """How stiff tissue is: a Labels layer with its table, an image of stiffness, or None."""
        return self.form.tissue.value

    @tissue.setter
    def tissue(self, layer: Any) -> None:
        self.form.tissue.choose(layer)

    @property
    def boundary(self) -> Any:
        """A Labels layer of what holds and moves beside what is drawn, or None."""
        return self.form.boundary.value

    @boundary.setter
    def boundary(self, layer: Any) -> None:
        self.form.boundary.choose(layer)

    @property
    def drawing(self) -> Drawing:
        """What is drawn on the slice that is shown."""
        return self.history.drawing

    @drawing.setter
    def drawing(self, drawing: Drawing) -> None:
        self._puller.set_drawing(drawing, "took over a drawing")

    @property
    def history(self) -> History:
        """Of the slice that is shown."""
        return self._puller.history

    @property
    def active(self) -> bool:
        """Whether the mouse pulls tissue."""
        return self._puller.active

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

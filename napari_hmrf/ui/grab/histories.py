"""The drawings of all slices of all images, among all else that is edited in a viewer."""

from __future__ import annotations

from typing import Any

from napari_hmrf.layers.edit_history import DRAWING, Place, Slot, steps_of
from napari_hmrf.layers.place import Frame
from napari_hmrf.tissue.drawing import History


class Histories:
    """Each slice of an image has its own drawing, as long as the image is there.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    steps : ViewerSteps
        Which goes back and forth between them, and whatever else is edited.
    """

    def __init__(self, viewer: Any) -> None:
        self.steps = steps_of(viewer)

    def of(self, image: Any, frame: Frame) -> History:
        """The drawing of a slice.

        Parameters
        ----------
        image : napari.layers.Image
        frame : Frame
            Of the slice.
        """
        slot = Slot(DRAWING, image, Place.of(frame))
        return History(edits=self.steps.edits, slot=slot)


def drawn_on(viewer: Any) -> list[Any]:
    """The images on any slice of which something is drawn."""
    edits = steps_of(viewer).edits
    slots = [slot for slot in edits.slots if isinstance(slot, Slot) and slot.what == DRAWING]
    return [slot.layer for slot in slots if edits.get(slot).marks]

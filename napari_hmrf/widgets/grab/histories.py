"""The drawings of all slices of all images."""

from __future__ import annotations

import weakref
from typing import Any

from napari_hmrf.drawing import History
from napari_hmrf.layers.frame import Frame


class Histories:
    """Each slice of an image has its own drawing, as long as the image is there."""

    def __init__(self) -> None:
        self._known: weakref.WeakKeyDictionary[Any, dict[Any, History]]
        self._known = weakref.WeakKeyDictionary()

    def of(self, image: Any, frame: Frame) -> History:
        """The drawing of a slice.

        Parameters
        ----------
        image : napari.layers.Image
        frame : Frame
            Of the slice.
        """
        return self._known.setdefault(image, {}).setdefault((frame.plane, frame.index), History())

"""Which tool is in the hand, said on the canvas."""

from __future__ import annotations

from typing import Any

from napari_hmrf.layers.compat import text_of


class Badge:
    """The text in a corner of the canvas, while it is not somebody else's.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._text = text_of(viewer)
        self._said = ""

    def say(self, words: str) -> None:
        """Say something, or nothing; what somebody else wrote there stays."""
        text = self._text
        if text.visible and text.text != self._said:
            return
        self._said = words
        text.text = words
        text.visible = bool(words)

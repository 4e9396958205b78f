"""The result that is looked at, and its layers."""

from __future__ import annotations

from typing import Any

from napari_hmrf.layers.image_result import Part, Result
from napari_hmrf.layers.overlay import Overlay
from napari_hmrf.layers.result_lookup import FoundResult


class LookedAt:
    """One result at a time.

    Attributes
    ----------
    result : FoundResult, optional
    layers : Result, optional
        Which the viewer shows of it.
    overlay : Overlay, optional
        What lies over its image.
    source : napari.layers.Image, optional
        What is moved.
    """

    def __init__(self) -> None:
        self.result: FoundResult | None = None
        self.layers: Result | None = None
        self.overlay: Overlay | None = None
        self.source: Any = None

    def layer(self, part: Part) -> Any:
        """The layer of a part; None if it is gone, or the arrows are that hold the result."""
        if self.result is None or self.layers is None or self.layers.layer("arrows") is None:
            return None
        return self.layers.layer(part)

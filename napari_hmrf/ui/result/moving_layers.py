"""The layers of the result that is looked at, at a moment of its deformation."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from napari_hmrf.field.animation import Moment, Motion
from napari_hmrf.field.deformation import magnitude
from napari_hmrf.field.quantities import QUANTITIES
from napari_hmrf.layers.image_result import Part, Result
from napari_hmrf.layers.overlay import Overlay
from napari_hmrf.layers.read import look_of
from napari_hmrf.layers.result_layers import Answer, picture_layer
from napari_hmrf.layers.result_lookup import picture_of, source_of
from napari_hmrf.study.study import Pictures
from napari_hmrf.ui.result.result_messages import FULL


class MovingLayers:
    """A result, and what the viewer shows of it.

    How long its arrows are at 100 % is said by napari's own control of their layer.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    arrows : napari.layers.Vectors
        Which hold the result.
    answer : Answer
        What they hold.
    layers : Result
        Those that there are.

    Attributes
    ----------
    overlay : Overlay, optional
        What lies over the image.
    motion : Motion
        What moves.
    source : napari.layers.Image, optional
        What is moved.
    image : ndarray, optional
        A copy of that.
    percent : int
        How much of the deformation is drawn.
    longest : float
        How far anything moves, in the unit of the answer.
    """

    def __init__(self, viewer: Any, arrows: Any, answer: Answer, layers: Result) -> None:
        self.arrows, self.answer, self.layers = arrows, answer, layers
        self.overlay: Overlay | None = None
        self.source = source_of(viewer.layers, answer)
        self.image: npt.NDArray[Any] | None = None
        self.motion = Motion(answer.solution)
        self.percent = FULL
        self.longest = float(magnitude(answer.solution.displacement).max(initial=0.0))
        # How long arrows are at 100 %.
        self._length = arrows.length

    def copy_image(self) -> None:
        """Have the image be moved as it is now.

        Raises
        ------
        HmrfError
            If it cannot be read; the rest moves.
        """
        if self.source is not None:
            self.image = picture_of(self.source, self.answer)
            self.motion = Motion(self.answer.solution, self.image)

    def lay_over(self, made: Overlay | None, show: bool = False) -> None:
        """Have something lie over the image, or nothing, and move with the tissue from now on."""
        solution, self.overlay = self.answer.solution, made
        if made is None:
            self.layers.drop("overlay")
            self.motion = Motion(solution, self.image)
        else:
            self.layers.put("overlay", made.layer, self.source, show)
            quantity = made.name if made.name in QUANTITIES else None
            is_grid = made.name == "grid"
            self.motion = Motion(solution, self.image, made.picture, is_grid, quantity)

    def layer(self, part: Part) -> Any:
        """The layer of a part; None if it is gone, or the arrows are that hold the result."""
        return None if self.layers.layer("arrows") is None else self.layers.layer(part)

    def ready(self) -> bool:
        """Have a layer that can be moved; whether there is one."""
        if self.image is not None:
            if self.layer("image") is None:  # as it is before it moves
                pictures = Pictures(name=self.source.name, look=look_of(self.source))
                facts = {**self.answer.facts, "percent": 0}
                run = self.answer.solution.provenance.parameters
                made = picture_layer(self.answer.frame, pictures, self.image, run, facts)
                self.layers.put("image", made, self.source)
            self.layers.want("image", True)
        return any(self.layer(part) is not None for part in ("image", "overlay"))

    def draw(self, percent: int, moment: Moment) -> None:
        """Draw a moment."""
        frame, parts = self.answer.frame, dict[Part, Any]()
        if moment.image is not None:
            parts["image"] = frame.put_image(moment.image)
        if moment.overlay is not None:
            parts["overlay"] = frame.put_image(moment.overlay)
        if moment.grid is not None:
            parts["overlay"] = frame.put_vectors(moment.grid)
        self.layers.show_part(percent, parts)
        self.draw_arrows(percent)

    def draw_arrows(self, percent: int) -> None:
        """Let them end where the tissue is at so much of the deformation; their data stay."""
        if (arrows := self.layer("arrows")) is not None:
            # Somebody may have chosen another length.
            if self.percent and arrows.length != self._length * self.percent / FULL:
                self._length = arrows.length * FULL / self.percent
            arrows.length = self._length * percent / FULL
        self.percent = percent

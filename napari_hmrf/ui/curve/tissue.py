"""Keeping a layer of stiffness, the image it comes from and the editor of its curve in step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from psygnal import Signal

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.stiffness_layers import (
    curve_of,
    first_curve,
    intensities_of,
    source_name,
    update_stiffness,
)
from napari_hmrf.layers.stiffness_sources import StiffnessSources
from napari_hmrf.tissue.stiffness_curve import STIFFNESSES, StiffnessCurve
from napari_hmrf.ui.curve.editor import CurveEditor
from napari_hmrf.ui.messages import in_short
from napari_hmrf.ui.timers import single_shot

#: Shown until there is a layer with a curve of its own.
_NOTHING = StiffnessCurve(tuple(zip((0.0, 0.5, 1.0), STIFFNESSES, strict=True)))


class TissueCurve:
    """The curve of the layer that is chosen as tissue, if that has one.

    Parameters
    ----------
    layers : callable
        The viewer's layers.
    view : callable
        Which slice it shows.

    Attributes
    ----------
    editor : CurveEditor
        A Qt widget.
    changed : Signal(StiffnessCurve)
        Emitted with the curve after the layer has followed it, while dragging, too.
    settled : Signal(StiffnessCurve)
        Emitted when an edit is at its end: what it led to is one step.
    refused : Signal(str)
        Why an edit was not taken.
    """

    changed = Signal(StiffnessCurve)
    settled = Signal(StiffnessCurve)
    refused = Signal(str)

    def __init__(self, layers: Callable[[], list[Any]], view: Callable[[], View | None]) -> None:
        self._layers, self._view = layers, view
        self._layer: Any = None
        self._sources = StiffnessSources(layers)
        self._looked_at: Any = None
        self.editor = CurveEditor(_NOTHING)
        # Qt may report many moves of the mouse at a time; only the last of them is computed.
        self._following = single_shot(self.editor, 0, self._follow)
        self.editor.changed.connect(self._on_changed)
        self.editor.settled.connect(self._on_settled)
        self.editor.refused.connect(self.refused.emit)
        self.editor.anew.clicked.connect(self._on_anew)

    @property
    def layer(self) -> Any:
        """The layer of stiffness, or None."""
        return self._layer

    @layer.setter
    def layer(self, layer: Any) -> None:
        self._following.stop()
        curve = None if layer is None else curve_of(layer)
        self._layer = layer if curve is not None else None
        self._looked_at = None
        if curve is not None:
            self.editor.plot.select(None)
            self.editor.curve = curve
            self.look()

    @property
    def curve(self) -> StiffnessCurve | None:
        """The curve; to set it changes the layer at once.

        Setting it raises `ProblemError` if no layer with a curve is chosen, or its image is gone.
        """
        return None if self._layer is None else self.editor.curve

    @curve.setter
    def curve(self, curve: StiffnessCurve) -> None:
        if self._layer is None:
            raise ProblemError("tissue", "has no curve: make it from the image's intensity first.")
        self._following.stop()
        before = curve_of(self._layer)
        update_stiffness(self._layer, self._sources.open_image_of(self._layer), curve)
        self.editor.curve = curve
        if curve != before:
            self.changed.emit(curve)

    def layer_of(self, image: Any, curve: StiffnessCurve | None = None) -> Any:
        """The layer of stiffness of an image that there is already, or a new one.

        Parameters
        ----------
        image : napari.layers.Image
        curve : StiffnessCurve, optional
            Of a new one; by default a first guess from the slice that is shown.

        Returns
        -------
        napari.layers.Image
            A new one is to be added to the viewer.

        Raises
        ------
        ProblemError
            If the image cannot be read or is of one value.
        """
        known = self._sources.made(image)
        if known is not None:
            return known
        return self._sources.make(image, curve or first_curve(image, self._view()))

    def look(self, *_: Any) -> None:
        """Look again at the image: another slice is shown, or it was opened or closed."""
        if self._layer is None:
            return
        image = self._sources.image_of(self._layer)
        self.editor.setEnabled(image is not None)
        self.editor.setToolTip(
            ""
            if image is not None
            else f"The image '{source_name(self._layer)}' is not open, so that the curve cannot be "
            "changed. Open it, or give another that name."
        )
        if image is None:
            return
        view = self._view()
        if (image, view) == self._looked_at:
            return
        self._looked_at = (image, view)
        try:
            self.editor.show_intensities(intensities_of(image, view))
        except ProblemError:
            self._looked_at = None  # nothing of it is in this slice; the curve stays what it is

    def _follow(self) -> None:
        if self._layer is None or self._layer not in self._layers():
            return
        curve = self.editor.curve
        try:
            update_stiffness(self._layer, self._sources.open_image_of(self._layer), curve)
        except ProblemError as error:
            self.editor.curve = curve_of(self._layer) or curve
            self.refused.emit(in_short(error))
            return
        self.changed.emit(curve)

    def _on_changed(self, _: StiffnessCurve) -> None:
        self._following.start()

    def _on_settled(self, _: StiffnessCurve) -> None:
        if self._following.isActive():
            self._following.stop()
            self._follow()
        if self._layer is not None and self.editor.curve == curve_of(self._layer):
            self.settled.emit(self.editor.curve)

    def _on_anew(self) -> None:
        try:
            self.curve = first_curve(self._sources.open_image_of(self._layer), self._view())
        except ProblemError as error:
            self.refused.emit(in_short(error))
        else:
            assert self.curve is not None
            self.settled.emit(self.curve)

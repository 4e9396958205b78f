"""The results that a viewer shows: of an image and a slice there is one, the newest."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Mapping
from typing import Any

from psygnal import Signal

from napari_hmrf.layers.image_result import FILLING, Maker, Result
from napari_hmrf.layers.metadata import known_of
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import Kind, LayerData


class ResultLayers:
    """The results that a viewer shows, whoever computes them.

    A newer result of the same image and slice takes the place of the one before. What is hidden or
    named by hand stays so. The results of an image go with it.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    changed : Signal(Result)
        Another result, or none, is seen in a place.
    orphaned : Signal
        An image is gone: `remove_orphans` is to be called, once napari is done with its own layers.
    """

    changed = Signal(object)
    orphaned = Signal()

    def __init__(self, viewer: Any) -> None:
        self._viewer_ref = weakref.ref(viewer)
        # By the layer itself, not its id: that is given to another layer when the layer is gone.
        self._results: weakref.WeakKeyDictionary[Any, dict[str, Result]]
        self._results = weakref.WeakKeyDictionary()
        self._orphans: list[Result] = []
        viewer.layers.events.removed.connect(self._on_removed)

    @property
    def _viewer(self) -> Any:
        return self._viewer_ref()

    def at(self, source: Any, where: str) -> Result:
        """The result of a layer and a slice, which need not be there yet."""
        known = self._results.setdefault(source, {})
        return known.setdefault(where, Result(self._viewer, source, where))

    def of(self, arrows: Any) -> Result:
        """The result that a layer of arrows holds, be it from a file."""
        for result in self._all():
            if result.holds(arrows):
                return result
        result = self.at(arrows, str(known_of(arrows).get("slice", "")))
        result.take("arrows", arrows)
        return result

    def show(
        self,
        source: Any,
        frame: Frame,
        layers: Mapping[Kind, LayerData],
        by: Maker,
        *,
        asked: bool = True,
        moving: bool = False,
        unasked: Collection[Kind] = (),
    ) -> dict[Kind, Any]:
        """Show a result in place of the one there is of the same layer and slice.

        What that had and this does not is hidden until there is a result that has it.

        Parameters
        ----------
        source : napari.layers.Layer
            What was deformed.
        frame : Frame
            Where.
        layers : dict of kind to LayerData
            In stacking order.
        by : {"deform", "grab"}
            Who computed it.
        asked : bool
            Whether somebody is at work there; else it takes nobody else's place, and does not
            cover an image that is being painted on.
        moving : bool
            Whether more will follow soon, and only the canvas counts.
        unasked : collection of kind
            Layers that are made, and hidden until somebody opens their eye.

        Returns
        -------
        dict of kind to layer
            Empty if it is not shown.
        """
        result = self.at(source, frame.slice_name)
        theirs = result.aside or result.by not in (None, by)
        if source not in self._viewer.layers or (theirs and not asked):
            return {}
        shown = result.show(frame, layers, by, unasked, moving)
        if asked:
            for other in self._all():
                if other.by == by and other.aside:
                    other.bring(by)
        self.changed.emit(result)
        return shown

    def claim(self, source: Any, frame: Frame, by: Maker) -> None:
        """Have nobody else's result seen of a layer and slice, nor put there unasked."""
        result = self.at(source, frame.slice_name)
        if result.by == by:
            result.bring(by)
        else:
            result.set_aside()
            result.by = by
        self.changed.emit(result)

    def set_aside(self, but: Maker | None = None) -> bool:
        """Hide what covers images, until the next result; whether anything is hidden.

        Paint says where tissue is before it moves, so it must be put on the image as it was.

        Parameters
        ----------
        but : {"deform", "grab"}, optional
            Whose results stay.
        """
        others = [result for result in self._all() if but is None or result.by != but]
        hidden = [result.set_aside(FILLING) for result in others]
        for result in others:
            self.changed.emit(result)
        return any(hidden)

    def remove_orphans(self) -> None:
        """Remove what is left of images that are gone."""
        orphans, self._orphans = self._orphans, []
        for result in orphans:
            result.remove()

    def _all(self) -> list[Result]:
        return [result for known in [*self._results.values()] for result in known.values()]

    def _on_removed(self, event: Any) -> None:
        results = self._results.pop(event.value, {})
        if results:
            self._orphans += results.values()
            self.orphaned.emit()

"""The results that a viewer shows: of an image and a slice there is one, the newest."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any

from psygnal import Signal

from napari_hmrf.layers.image_result import Result
from napari_hmrf.layers.metadata import known_of
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import Kind, LayerData


class ResultLayers:
    """The results that a viewer shows.

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

    @property
    def sources(self) -> list[Any]:
        """The layers of which a result is seen."""
        known = [*self._results.items()]
        return [each for each, of in known if any(result.visible for result in of.values())]

    def at(self, source: Any, where: str) -> Result:
        """The result of a layer and a slice, which need not be there yet."""
        known = self._results.setdefault(source, {})
        return known.setdefault(where, Result(self._viewer, source, where))

    def of(self, arrows: Any) -> Result:
        """The result that a layer of arrows holds, be it from a file."""
        for result in self._all():
            if result.part_of(arrows) is not None:
                return result
        result = self.at(arrows, str(known_of(arrows).get("slice", "")))
        result.take("arrows", arrows)
        return result

    def show(
        self,
        source: Any,
        frame: Frame,
        layers: Mapping[Kind, LayerData],
        *,
        moving: bool = False,
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
        moving : bool
            Whether more will follow soon, and only the canvas counts.

        Returns
        -------
        dict of kind to layer
            Empty if what was deformed is gone.
        """
        if source not in self._viewer.layers:
            return {}
        result = self.at(source, frame.slice_name)
        shown = result.show(frame, layers, moving)
        self.changed.emit(result)
        return shown

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

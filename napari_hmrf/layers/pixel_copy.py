"""Cache of copies of layer data: a layer is copied again only after it has changed."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.slice_view import copy_slice
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.study.study import is_same

T = TypeVar("T")
#: Largest number of cached copies per layer; more than one, so that an earlier copy is reused when
#: paint is undone.
_MOST_COPIES = 4
#: Names of the events after which the data of a layer may have changed. "set_data" is also emitted
#: for many other reasons, but it is the only event emitted when a script changes an array in place
#: and then refreshes the layer.
CHANGES = ("data", "labels_update", "paint", "set_data")


class LayerCopies:
    """Cache of copies of layer data.

    For unchanged data, the same object is returned, so that callers can compare by identity.

    Parameters
    ----------
    viewer : object, optional
        Ignored; accepted because `shared` passes the viewer to the class.
    """

    def __init__(self, viewer: Any = None) -> None:
        self._copies: weakref.WeakKeyDictionary[Any, _Copies] = weakref.WeakKeyDictionary()

    def of(self, layer: Any, own: Frame | None = None) -> npt.NDArray[Any]:
        """Return a copy of a slice of a layer, or of all its data.

        Parameters
        ----------
        layer : napari.layers.Layer
        own : Frame, optional
            Slice of the layer; by default, all data are copied.

        Returns
        -------
        ndarray
            Read-only copy.

        Raises
        ------
        ProblemError
            If the layer cannot be read.
        """
        known = self._copies.get(layer)
        if known is None:
            known = self._copies[layer] = _Copies(layer)
        return known.slice(layer, own)

    def derive(self, layer: Any, of: tuple[Any, ...], make: Callable[[], T]) -> T:
        """Return a value derived from the copy of a layer, cached until an input changes.

        Parameters
        ----------
        layer : napari.layers.Layer
            Layer for which `of` has been called.
        of : tuple
            Inputs of the value: arrays, which are compared by identity, and other objects.
        make : callable
            Function without arguments that computes the value.
        """
        known = self._copies[layer]
        if known.derived is None or not all(map(is_same, known.derived[0], of)):
            known.derived = (of, make())
        value: T = known.derived[1]
        return value

    def invalidate(self) -> None:
        """Mark all copies as stale, because arrays may have been changed without an event."""
        for known in self._copies.values():
            known.mark_stale()


class _Copies:
    """Cached copies of the data of one layer."""

    def __init__(self, layer: Any) -> None:
        self._slices: deque[tuple[Any, npt.NDArray[Any]]] = deque(maxlen=_MOST_COPIES)
        self._fresh: set[Any] = set()
        self.derived: tuple[tuple[Any, ...], Any] | None = None
        for name in CHANGES:
            if hasattr(layer.events, name):
                getattr(layer.events, name).connect(self.mark_stale)

    def slice(self, layer: Any, own: Frame | None) -> npt.NDArray[Any]:
        key = None if own is None else (own.plane, own.index)
        known = [copy for at, copy in self._slices if at == key]
        if known and key in self._fresh:
            return known[-1]
        copy = np.array(layer.data) if own is None else copy_slice(layer, own)
        copy.setflags(write=False)
        kept = next((each for each in known if are_equal(each, copy)), copy)
        others = [each for each in self._slices if each[1] is not kept]
        self._slices = deque([*others, (key, kept)], maxlen=_MOST_COPIES)
        self._fresh.add(key)
        return kept

    def mark_stale(self, *_: Any) -> None:
        self._fresh.clear()

"""Copying the same pixels out of several layers, and again only where one has changed since."""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.slice_view import copy_slice
from napari_hmrf.study.study import is_same

T = TypeVar("T")
#: Of each layer so many copies are kept: what is painted and taken back is the same as it was.
_KEPT = 4
#: The events after which a layer's data may be others. A layer draws itself anew for many other
#: reasons, too, but a script that has changed its array in place can say so in no other way.
CHANGES = ("data", "labels_update", "paint", "set_data")


class LayerCopies:
    """Remembers copies. What did not change is the same object as before: nobody needs compare.

    Parameters
    ----------
    viewer : object, optional
        Whose layers they are; there is one of these for each.
    """

    def __init__(self, viewer: Any = None) -> None:
        self._known: weakref.WeakKeyDictionary[Any, _Copies] = weakref.WeakKeyDictionary()

    def of(self, layer: Any, own: Frame | None = None) -> npt.NDArray[Any]:
        """Copy a slice of a layer, or all of it.

        Parameters
        ----------
        layer : napari.layers.Layer
        own : Frame, optional
            The slice of the layer.

        Returns
        -------
        ndarray
            Read-only.

        Raises
        ------
        ProblemError
            If it cannot be read.
        """
        known = self._known.get(layer)
        if known is None:
            known = self._known[layer] = _Copies(layer)
        return known.slice(layer, own)

    def made(self, layer: Any, of: tuple[Any, ...], make: Callable[[], T]) -> T:
        """Make something of a layer's copy, or find what was made of the same things last.

        Parameters
        ----------
        layer : napari.layers.Layer
            Copied before.
        of : tuple
            What it depends on: arrays that are compared by identity, and values.
        make : callable
        """
        known = self._known[layer]
        if known.made is None or not all(map(is_same, known.made[0], of)):
            known.made = (of, make())
        found: T = known.made[1]
        return found

    def forget(self) -> None:
        """Look at every layer anew: an array may have been changed in place, and nobody told."""
        for known in self._known.values():
            known.doubt()


class _Copies:
    """The copies of one layer."""

    def __init__(self, layer: Any) -> None:
        self._known: deque[tuple[Any, npt.NDArray[Any]]] = deque(maxlen=_KEPT)
        self._fresh: set[Any] = set()
        self.made: tuple[tuple[Any, ...], Any] | None = None
        for name in CHANGES:
            if hasattr(layer.events, name):
                getattr(layer.events, name).connect(self.doubt)

    def slice(self, layer: Any, own: Frame | None) -> npt.NDArray[Any]:
        key = None if own is None else (own.plane, own.index)
        known = [copy for at, copy in self._known if at == key]
        if known and key in self._fresh:
            return known[-1]
        now = np.array(layer.data) if own is None else copy_slice(layer, own)
        now.setflags(write=False)
        found = next((each for each in known if _same(each, now)), now)
        others = [each for each in self._known if each[1] is not found]
        self._known = deque([*others, (key, found)], maxlen=_KEPT)
        self._fresh.add(key)
        return found

    def doubt(self, *_: Any) -> None:
        self._fresh.clear()


def _same(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    same_type = one.dtype == other.dtype
    return same_type and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")

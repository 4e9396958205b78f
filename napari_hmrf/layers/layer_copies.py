"""Copies of slices of layers, made again only where a layer has changed since."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.pixel_copy import copy_slice
from napari_hmrf.layers.place import Frame

T = TypeVar("T")
#: Of each slice so many copies are known: what is painted and taken back is the same as it was.
_KEPT = 4
#: The events after which a layer's data may be others. A layer draws itself anew for many other
#: reasons, too, but a script that has changed its array in place can say so in no other way.
_EVENTS = ("data", "labels_update", "paint", "set_data")


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
        if known.made is None or not _are_same(known.made[0], of):
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
        # What is shown is kept; of all else what somebody else has kept.
        self._newest: dict[Any, npt.NDArray[Any]] = {}
        self._known: dict[Any, list[weakref.ref[npt.NDArray[Any]]]] = {}
        self._fresh: set[Any] = set()
        self.made: tuple[tuple[Any, ...], Any] | None = None
        for name in _EVENTS:
            if hasattr(layer.events, name):
                getattr(layer.events, name).connect(self.doubt)

    def slice(self, layer: Any, own: Frame | None) -> npt.NDArray[Any]:
        key = None if own is None else (own.plane, own.index)
        if key in self._fresh and key in self._newest:
            return self._newest[key]
        now = np.array(layer.data) if own is None else copy_slice(layer, own)
        now.setflags(write=False)
        known = [copy for each in self._known.get(key, ()) if (copy := each()) is not None]
        found = next((each for each in known if _same(each, now)), now)
        self._newest = {key: found}
        others = [each for each in known if each is not found]
        self._known[key] = [weakref.ref(each) for each in (found, *others)][:_KEPT]
        self._fresh.add(key)
        return found

    def doubt(self, *_: Any) -> None:
        self._fresh.clear()


def _are_same(some: tuple[Any, ...], others: tuple[Any, ...]) -> bool:
    """Whether arrays are the same ones, and values equal."""
    return all(
        one is other
        if isinstance(one, np.ndarray) or isinstance(other, np.ndarray)
        else one == other
        for one, other in zip(some, others, strict=True)
    )


def _same(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> bool:
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")

"""Putting a result's layers into the viewer, and in place of an earlier result's."""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import numpy as np
from napari.layers import Layer

from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import FILLING, Kind, LayerData, Outputs
from napari_hmrf.ui.result_state import Latest
from napari_hmrf.ui.result_turns import give_way, sign, take_turn
from napari_hmrf.ui.viewer_layers import same_selection, still_there, update_layer


class _Shown(NamedTuple):
    """A layer that holds a result, the name meant for it and what napari made of that."""

    reference: weakref.ref[Any]
    meant: str
    name: str


class ResultLayers:
    """The layers that hold the results of *Deform tissue*, by what they show and of which slice.

    What fills its pixels lies directly above what was deformed, so that paint stays above it;
    lines and arrows lie on top. A dock that is opened after another was closed goes on with those
    of the other: have them `shared`.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer_ref = weakref.ref(viewer)
        # By the source itself, not its id: that is given to another layer when the source is gone.
        self._layers: weakref.WeakKeyDictionary[Any, dict[tuple[Kind, str], _Shown]]
        self._layers = weakref.WeakKeyDictionary()
        self._aside: list[weakref.ref[Any]] = []
        #: Layers of earlier results, until a newer one has them, too.
        self._stale: weakref.WeakSet[Any] = weakref.WeakSet()
        self._left: tuple[Latest, weakref.ref[Any]] | None = None

    def leave(self, latest: Latest, source: Any) -> None:
        """Keep what a dock that was closed knows of its latest result of a layer."""
        self._left = None if source is None else (latest, weakref.ref(source))

    def left(self) -> tuple[Latest | None, Any]:
        """What `leave` kept, if the layer is still there, and that layer."""
        latest, reference = self._left or (None, None)
        source = still_there(self._viewer, None if reference is None else reference())
        return (None, None) if source is None else (latest, source)

    @property
    def _viewer(self) -> Any:
        return self._viewer_ref()

    def show(self, outputs: Outputs, source: Any, *, turn: bool = True) -> dict[Kind, Any]:
        """Update the layers of the same source and slice; make those that are not there.

        Parameters
        ----------
        outputs : Outputs
        source : napari.layers.Layer
            What was deformed.
        turn : bool
            Whether somebody is at work here; else what another dock shows stays seen.

        Returns
        -------
        dict of kind to layer
        """
        shown: dict[Kind, Any] = {}
        known = self._layers.setdefault(source, {})
        layers = self._viewer.layers
        above = layers.index(source) + 1 if source in layers else len(layers)
        places = set()
        for made in outputs.layers.values():
            facts = sign(made, "deform").attributes["metadata"][METADATA]
            places.add((facts["source"], facts["slice"]))
        given = set()
        for place in places:
            if not turn and give_way(self._viewer, "deform", *place):
                given.add(place)
            else:
                take_turn(self._viewer, "deform", *place)
        with same_selection(self._viewer):
            for kind, made in outputs.layers.items():
                where = str(made.attributes["metadata"][METADATA]["slice"])
                key = (kind, where)
                layer = self._existing(known.get(key))
                if layer is None or not _fits(layer, made):
                    layer = Layer.create(made.data, made.attributes, made.kind)
                    layers.insert(above if kind in FILLING else len(layers), layer)
                    if kind == "magnitude":
                        layer.colorbar.visible = True
                    known[key] = _Shown(weakref.ref(layer), made.attributes["name"], layer.name)
                else:
                    update_layer(layer, made)
                    if layer in self._stale:
                        layer.visible = True
                        self._stale.discard(layer)
                    known[key] = _rename(layer, made.attributes["name"], known[key])
                if kind in FILLING:
                    above = layers.index(layer) + 1
                shown[kind] = layer
        for reference in self._aside:
            if (layer := reference()) is not None:
                layer.visible = True
        self._aside.clear()
        self._outdate(outputs, known)
        for place in given:
            give_way(self._viewer, "deform", *place)
        return shown

    def show_picture(self, source: Any, where: str, data: Any, *, turn: bool = True) -> bool:
        """Show another picture in the *deformed image* there is; whether there is one.

        All that is not the picture is that of an earlier result, and hidden until it is shown
        anew; a picture that was hidden stays so.

        Parameters
        ----------
        source : napari.layers.Layer
            What was deformed.
        where : str
            The slice, as in the layers' metadata.
        data : ndarray
            As the layer takes it.
        turn : bool
            As of `show`; while it is another dock's turn no picture is seen.
        """
        known = self._layers.get(source, {})
        layer = self._existing(known.get(("image", where)))
        if layer is None or layer.data.shape != data.shape:
            return False
        name = str(known_of(layer).get("source", ""))
        if not turn and give_way(self._viewer, "deform", name, where):
            return False
        take_turn(self._viewer, "deform", name, where)
        layer.data = data
        for (kind, _), made in known.items():
            other = self._existing(made)
            if kind != "image" and other is not None and other.visible:
                other.visible = False
                self._aside.append(made.reference)
        return True

    def take_turn(self) -> bool:
        """Hide what other docks have moved; whether there was anything."""
        return take_turn(self._viewer, "deform")

    def set_aside(self) -> bool:
        """Hide what covers the image, until the next result; whether there was anything.

        Paint says where tissue is before it moves, so it must be put on the image as it was.
        What other docks show waits for their turn.
        """
        others = self.take_turn()
        for known in self._layers.values():
            for (kind, _), made in known.items():
                layer = made.reference()
                if kind in FILLING and layer is not None and layer.visible:
                    layer.visible = False
                    self._aside.append(made.reference)
        return others or bool(self._aside)

    def _outdate(self, outputs: Outputs, known: dict[tuple[Kind, str], _Shown]) -> None:
        """Hide what an earlier result of the slice has shown and this one does not."""
        here = Frame.from_dict(outputs.solution.frame or {}).slice_name
        for (kind, where), made in known.items():
            layer = self._existing(made)
            if where != here or kind in outputs.layers or layer is None:
                continue
            if kind == "folds" and not outputs.folds:
                layer.data = np.zeros_like(layer.data)
            elif layer.visible:
                layer.visible = False
                self._stale.add(layer)

    def _existing(self, made: _Shown | None) -> Any:
        return still_there(self._viewer, None if made is None else made.reference())


def _rename(layer: Any, meant: str, before: _Shown) -> _Shown:
    """Name a layer after what it holds now, unless the user has named it."""
    if meant == before.meant or layer.name != before.name:
        return before
    layer.name = meant
    return _Shown(before.reference, meant, layer.name)


def _fits(layer: Any, made: LayerData) -> bool:
    return bool(
        layer.ndim == len(made.attributes["scale"])
        and getattr(layer, "rgb", False) == made.attributes.get("rgb", False)
    )

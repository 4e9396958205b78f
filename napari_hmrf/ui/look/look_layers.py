"""The layers of the result that is looked at: found, made, moved and put back."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Sequence
from typing import Any

from napari.layers import Layer

from napari_hmrf.layers.animation import Moment
from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.result_layers import Kind, LayerData
from napari_hmrf.layers.result_lookup import FoundResult, companion, result_of
from napari_hmrf.ui.result_turns import Maker, give_way, has_turn, hide, take_turn
from napari_hmrf.ui.viewer_layers import same_selection, still_there, update_layer

#: The layers that take the pixels of a moment.
_MOVING = ("image", "labels", "colours")
_BELOW = ("image", "colours")
#: The layers made for each result's layer, and their names: of all docks, as one that is opened
#: after another was closed goes on with its layers.
_made: weakref.WeakKeyDictionary[Any, dict[str, weakref.ref[Any]]] = weakref.WeakKeyDictionary()
_names: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()


class ShownLayers:
    """The layers of one result at a time.

    Those that *Deform tissue* made are used where they are there; the others are made once for each
    result's layer, and updated from then on.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._hidden: list[tuple[weakref.ref[Any], bool]] = []
        self._full: list[tuple[weakref.ref[Any], Any, Any]] = []
        self._drawn: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()
        self.arrows: Any = None
        self.result: FoundResult | None = None
        self.source: Any = None

    def layer(self, kind: str) -> Any:
        """The layer of a kind: "image", "labels", "grid", "colours", "arrows"; None if missing."""
        if self.result is None or self.arrows not in self._viewer.layers:
            return None
        if kind == "arrows":
            return self.arrows
        made = self.own(kind)
        if made is not None:
            return made
        kinds: dict[str, Kind] = {"image": "image", "labels": "labels", "grid": "grid"}
        found = kinds.get(kind)
        return None if found is None else companion(self._viewer.layers, self.result, found)

    def own(self, kind: str) -> Any:
        """The layer of a kind that nobody but this keeps; None if there is none."""
        reference = None if self.arrows is None else _made.get(self.arrows, {}).get(kind)
        return still_there(self._viewer, None if reference is None else reference())

    def leave(self) -> None:
        """Hide what nobody but this has drawn of a result, as another is looked at."""
        for kind in ("image", "colours", "grid"):
            layer = self.own(kind)
            if layer is not None:
                hide(layer)

    def hide_own_picture(self) -> None:
        """Hide a picture that follows nobody's next result, until it is moved again."""
        picture = self.own("image")
        if picture is not None:
            picture.visible = False

    def put(self, kind: str, made: LayerData) -> Any:
        """Show a layer of a kind: the one that is there, with other data, or a new one."""
        layer = self.layer(kind)
        if self.result is not None and "by" in self.result.facts:
            # Whoever made the result does not know of another picture of it, and moves on.
            by = "look" if kind == "image" else self.result.facts["by"]
            made.attributes["metadata"][METADATA]["by"] = by
        if layer is not None:
            named_by_us = _names.get(layer) == layer.name
            update_layer(layer, made)
            if kind == "colours":
                layer.colormap = made.attributes["colormap"]
                layer.contrast_limits = made.attributes["contrast_limits"]
            if named_by_us:
                layer.name = made.attributes["name"]
                _names[layer] = layer.name
            layer.visible = True
            return layer
        layer = Layer.create(made.data, made.attributes, made.kind)
        layers = self._viewer.layers
        with same_selection(self._viewer):
            layers.insert(self._place(kind), layer)
        if kind == "colours":
            layer.colorbar.visible = True
        _made.setdefault(self.arrows, {})[kind] = weakref.ref(layer)
        _names[layer] = layer.name
        return layer

    def draw(self, percent: int, moment: Moment) -> None:
        """Show image, labels and colours at a moment; quick, for the window waits for it."""
        assert self.result is not None
        for kind in _MOVING:
            picture, layer = getattr(moment, kind), self.layer(kind)
            if picture is None or layer is None:
                continue
            layer.data = self._drawn[layer] = self.result.frame.put_image(picture)
            known = layer.metadata.get(METADATA)
            if isinstance(known, dict):  # whoever saves the layer now can tell what it is
                known["percent"] = percent

    def draw_grid(self, moment: Moment) -> None:
        """Show the deformation grid at a moment."""
        layer = self.layer("grid")
        if layer is not None and moment.grid is not None and self.result is not None:
            layer.data = self.result.frame.put_vectors(moment.grid)
            self._drawn[layer] = layer.data

    def remember(self) -> None:
        """Keep what the layers show now, to be put back: the whole deformation."""
        self._full = []
        for kind in ("image", "labels", "grid"):
            layer = self.layer(kind)
            if layer is not None:
                self._full.append((weakref.ref(layer), layer.data, known_of(layer).get("percent")))

    def restore(self) -> None:
        """Put back what `remember` kept, where nobody else has drawn since."""
        full, self._full = self._full, []
        for reference, data, percent in full:
            layer = still_there(self._viewer, reference())
            if layer is None or layer.data is not self._drawn.get(layer):
                continue
            layer.data = data
            known = layer.metadata.get(METADATA)
            if isinstance(known, dict) and percent is None:
                known.pop("percent", None)

    @property
    def percent(self) -> int:
        """How much of the deformation the layers show: that which one sees."""
        for kind in ("image", "colours"):
            layer = self.layer(kind)
            if layer is not None and layer.visible:
                return int(known_of(layer).get("percent", 0 if kind == "colours" else 100))
        return 0

    def hold_before(self) -> None:
        """Show the image as it was, without anything of the result, until `release`.

        Nothing is done where there is no result.
        """
        if self._hidden or self.result is None:
            return
        for layer in self._of_result():
            self._hidden.append((weakref.ref(layer), layer.visible))
            layer.visible = False
        if still_there(self._viewer, self.source) is not None:
            self._hidden.append((weakref.ref(self.source), self.source.visible))
            self.source.visible = True

    def take_turn(self) -> None:
        """Have the result that is looked at seen, and no other of its slice."""
        if self.result is not None and "by" in self.result.facts:
            own = self.own("image")
            seen = own is not None and own.visible
            take_turn(self._viewer, *_place_of(self.result))
            if seen:  # it is a picture of this result, too
                own.visible = True

    def give_way(self) -> None:
        """Have it wait, if another of its slice is seen."""
        if self.result is not None and "by" in self.result.facts:
            give_way(self._viewer, *_place_of(self.result))

    def come_forward(self) -> None:
        """Have the result seen that somebody has chosen, with its picture if there is one."""
        self.take_turn()
        picture = self.layer("image")
        if picture is not None and picture is not self.own("image"):
            picture.visible = True

    def release(self) -> None:
        """Show again what `hold_before` hid."""
        hidden, self._hidden = self._hidden, []
        for reference, visible in hidden:
            layer = reference()
            if layer is not None:
                layer.visible = visible

    @property
    def held(self) -> bool:
        """Whether the image is seen as it was."""
        return bool(self._hidden)

    def _of_result(self) -> Iterator[Any]:
        """Whatever was made of the result, by whomever."""
        made = {id(reference()) for reference in _made.get(self.arrows, {}).values()}
        for layer in self._viewer.layers:
            known = known_of(layer)
            same = self.result is not None and all(
                known.get(key) == self.result.facts.get(key) for key in ("source", "slice")
            )
            if (
                layer is self.arrows
                or id(layer) in made
                or (same and known.keys() & {"by", "folds"})
            ):
                yield layer

    def _place(self, kind: str) -> int:
        """Pictures go directly above what was deformed and has moved, lines on top."""
        layers = self._viewer.layers
        if kind not in _BELOW:
            return len(layers)
        here = None if self.result is None else self.result.facts.get("slice")
        moved = [layer for layer in layers if _is_moved(layer, here)]
        below = [self.source, self.layer("image"), *moved]
        places = [layers.index(layer) + 1 for layer in below if layer in layers]
        return max(places, default=0)


def is_seen(viewer: Any, arrows: Any) -> bool:
    """Whether it is the result in a layer that is seen, of those of its slice."""
    result = result_of(arrows)
    if result is None or "by" not in result.facts:
        return bool(arrows.visible)
    return has_turn(viewer, *_place_of(result))


def seen_instead(viewer: Any, arrows: Any, others: Sequence[Any]) -> Any:
    """Of other layers' results that of the same slice which is seen while this one's is not."""
    if is_seen(viewer, arrows):
        return None
    here = _where(arrows)
    found = (other for other in others if _where(other) == here and is_seen(viewer, other))
    return next(found, None)


def _where(arrows: Any) -> tuple[Any, Any]:
    """The image and the slice of a layer."""
    known = known_of(arrows)
    return known.get("source"), known.get("slice")


def _place_of(result: FoundResult) -> tuple[Maker, str, str | None]:
    """Who made a result, of what image and slice."""
    return result.facts["by"], result.source, result.facts.get("slice")


def _is_moved(layer: Any, where: Any) -> bool:
    """Whether a layer shows an image of a slice where its tissue has moved to."""
    known = known_of(layer)
    return known.get("kind") == "image" and known.get("slice") == where

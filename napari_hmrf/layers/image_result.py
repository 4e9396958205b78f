"""The results that a viewer shows: of an image and a slice there is one, the newest."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from napari.layers import Layer
from psygnal import Signal

from napari_hmrf.layers.metadata import METADATA, known_of
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import Kind, LayerData
from napari_hmrf.layers.viewer_layers import overwrite, same_selection, still_there, update_layer

#: A layer of a result: what was made with it, what it is looked at with, one thing at a time, or
#: the confidence that was painted.
Part = Kind | Literal["overlay", "painted confidence"]
#: Of an overlay's looks, those that belong to the numbers it shows.
_LOOKS = ("colormap", "contrast_limits")
_WHOLE = 100


@dataclass(eq=False)
class _Held:
    """A layer of a result."""

    #: Returns it, as long as it is kept anywhere.
    layer: Callable[[], Any]
    #: The name meant for it, and what napari made of that.
    meant: str
    name: str
    #: Whether it was hidden, not by hand, as a newer result does not have it yet.
    stale: bool = False
    #: Whether it was put there to be looked at, and not made with the result.
    added: bool = False
    #: Whether somebody else made it, and says what it shows.
    taken: bool = False
    #: Its data, if nobody else holds them: they can be written to.
    own: Any = None
    #: Its data while it shows a part of the deformation, and those of all of it.
    part: Any = None
    whole: Any = None


class Result:
    """The layers of one result.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    anchor : napari.layers.Layer
        What was deformed; of a result from a file the layer of arrows that holds it.
    where : str
        The slice, as in the layers' metadata.
    """

    #: Whether more will follow soon than what was shown last.
    moving = False

    def __init__(self, viewer: Any, anchor: Any, where: str) -> None:
        self._viewer_ref, self._anchor = weakref.ref(viewer), weakref.ref(anchor)
        self.where = where
        #: Whether its layers go by our own doing.
        self.leaving = False
        self._frame: Frame | None = None
        self._held: dict[Part, _Held] = {}
        self._before: list[tuple[weakref.ref[Any], bool]] = []

    @property
    def _viewer(self) -> Any:
        return self._viewer_ref()

    # What there is

    def layer(self, part: Part) -> Any:
        """The layer of a part, if it is in the viewer."""
        held = self._held.get(part)
        return still_there(self._viewer, None if held is None else held.layer())

    def part_of(self, layer: Any) -> Part | None:
        """Which part a layer is, or was until it was removed; None if it is none of these."""
        return next((part for part, held in self._held.items() if held.layer() is layer), None)

    def wants(self, part: Part) -> bool:
        """Whether a part is seen, or will be with what comes next."""
        layer = self.layer(part)
        return layer is not None and (layer.visible or self._held[part].stale)

    def is_added(self, part: Part) -> bool:
        """Whether a part was put there to be looked at."""
        return part in self._held and self._held[part].added

    @property
    def visible(self) -> bool:
        """Whether anything of it is seen."""
        return any(layer.visible for layer, _ in self._there())

    @property
    def percent(self) -> int:
        """How much of the deformation is seen."""
        for part in ("image", "overlay"):
            layer = self.layer(part)
            if layer is not None and layer.visible:
                return _percent_of(layer)
        return 0

    # What is shown

    def take(self, part: Part, layer: Any) -> None:
        """Have a layer that somebody else made."""
        self._held[part] = _Held(weakref.ref(layer), layer.name, layer.name, taken=True)
        self._keep_before()

    def put(self, part: Part, made: LayerData, source: Any = None, show: bool = True) -> Any:
        """Have one more layer of the result there is; returns it.

        Parameters
        ----------
        part : Part
        made : LayerData
        source : napari.layers.Layer, optional
            The image that is moved, where that is not what was deformed.
        show : bool
            Whether it is shown though somebody has hidden it.
        """
        seen = show or self.layer(part) is None or self.wants(part) or self.is_before
        held = self._put(part, made, source)
        layer, held.added = held.layer(), True
        layer.visible, held.stale = seen, False
        self._keep_before()
        return layer

    def show(
        self, frame: Frame, layers: Mapping[Kind, LayerData], moving: bool = False
    ) -> dict[Kind, Any]:
        """Show another state of the result; as of `ResultLayers.show`."""
        quick = moving and frame == self._frame
        self._frame, self.moving = frame, moving
        for kind, held in self._held.items():
            if kind not in layers and not held.taken:
                self._hide(held)
        shown: dict[Kind, Any] = {}
        for kind, made in layers.items():
            if not (quick and self._overwrite(kind, made)):
                self._put(kind, made)
            held = self._held[kind]
            layer = shown[kind] = held.layer()
            if held.stale:
                layer.visible, held.stale = True, False
        self._keep_before()
        return shown

    def show_part(self, percent: int, parts: Mapping[Part, Any]) -> None:
        """Show a part of the deformation, until `show_whole` or a newer result."""
        for part, data in parts.items():
            layer = self.layer(part)
            if layer is None:
                continue
            held = self._held[part]
            if _percent_of(layer) == _WHOLE:
                held.whole = layer.data
            layer.data = held.part = data
            held.own = None
            # Whoever saves the layer now can tell what it is.
            _know(layer, percent=percent)

    def show_whole(self) -> None:
        """Put back what was there before a part was shown, where nobody else has drawn since."""
        for layer, held in self._there():
            if held.part is not None and layer.data is held.part:
                if held.whole is not None:
                    layer.data = held.whole
                    _know(layer)
                elif _percent_of(layer) != _WHOLE:
                    layer.visible = False
            held.part = held.whole = None

    # What is hidden

    def hide(self, part: Part) -> None:
        """Hide a part that nobody wants to see; no result brings it back."""
        if (layer := self.layer(part)) is not None:
            layer.visible, self._held[part].stale = False, False

    def drop(self, part: Part) -> None:
        """Take a part out of the viewer; one that somebody has named is theirs, and hidden."""
        layer = self.layer(part)
        if layer is not None and layer.name == self._held[part].name:
            self._take_out(layer)
        elif layer is not None:
            layer.visible = False
        self._held.pop(part, None)

    def leave(self) -> None:
        """Hide what was added, as another result is looked at."""
        for held in self._held.values():
            if held.added:
                self._hide(held)

    def hold_before(self, source: Any) -> None:
        """Show the image as it was, and nothing of the result, until `release`."""
        if self._before:
            return
        self._put_aside()
        if self._before and still_there(self._viewer, source) is not None:
            self._before.append((weakref.ref(source), source.visible))
            source.visible = True

    def release(self) -> None:
        """Show again what `hold_before` hid."""
        before, self._before = self._before, []
        for reference, visible in before:
            if (layer := reference()) is not None:
                layer.visible = visible

    @property
    def is_before(self) -> bool:
        """Whether the image is seen as it was."""
        return bool(self._before)

    def remove(self) -> None:
        """Take the layers out of the viewer, but for those that somebody has named."""
        for layer, held in self._there():
            if layer.name == held.name:
                self._take_out(layer)

    # How it is done

    def _take_out(self, layer: Any) -> None:
        self.leaving = True
        self._viewer.layers.remove(layer)
        self.leaving = False

    def _keep_before(self) -> None:
        """What comes while the image is seen as it was is seen later."""
        if self._before:
            self._put_aside()

    def _put_aside(self) -> None:
        """Hide what is seen, until `release`."""
        for layer, _ in self._there():
            if layer.visible:
                self._before.append((weakref.ref(layer), True))
                layer.visible = False

    def _there(self) -> Iterator[tuple[Any, _Held]]:
        """The layers that are in the viewer."""
        for part, held in [*self._held.items()]:
            if (layer := self.layer(part)) is not None:
                yield layer, held

    def _overwrite(self, part: Part, made: LayerData) -> bool:
        """Give a layer other pixels where nothing else of it is another; whether that is so."""
        layer, held = self.layer(part), self._held.get(part)
        if layer is None or held is None or held.part is not None or not _fits(layer, made):
            return False
        if layer.data is not held.own or not overwrite(self._viewer, layer, made.data):
            layer.data = held.own = np.array(made.data)
        return True

    def _put(self, part: Part, made: LayerData, source: Any = None) -> _Held:
        """Have a layer show this: the one that is there, or a new one."""
        layers, layer, held = self._viewer.layers, self.layer(part), self._held.get(part)
        name, is_scale = made.attributes["name"], part == "overlay" and made.kind == "image"
        with same_selection(self._viewer):
            if held is None or layer is None or not _fits(layer, made):
                self.drop(part)
                layer = Layer.create(*made)
                # Who hears that it comes can ask whose it is.
                held = self._held[part] = _Held(weakref.ref(layer), name, name)
                layers.insert(self._index(part, made, source), layer)
                held.name = layer.name
                if is_scale:
                    layer.colorbar.visible = True
            else:
                update_layer(layer, made)
                for look in _LOOKS if is_scale else ():
                    setattr(layer, look, made.attributes[look])
                if name != held.meant and layer.name == held.name:
                    layer.name = name
                    held.meant, held.name = name, layer.name
        held.added, held.own, held.part, held.whole = False, None, None, None
        return held

    def _index(self, part: Part, made: LayerData, source: Any) -> int:
        """Pictures go directly above what was deformed and has moved, lines on top."""
        layers = self._viewer.layers
        if made.kind == "vectors":
            return len(layers)
        below = [] if part == "image" else [self.layer("image")]
        if source is None:
            below.append(self._anchor())
        else:
            below += [source, *(each for each in layers if _is_moved(each, self.where))]
        return max((layers.index(each) + 1 for each in below if each in layers), default=0)

    def _hide(self, held: _Held) -> None:
        layer = held.layer()
        if layer is not None and layer.visible:
            layer.visible, held.stale = False, True


def _percent_of(layer: Any) -> int:
    return int(known_of(layer).get("percent", _WHOLE))


def _know(layer: Any, **facts: Any) -> None:
    """Have a layer's metadata say how much of the deformation it shows; by default all."""
    known = {key: value for key, value in known_of(layer).items() if key != "percent"}
    layer.metadata = {**layer.metadata, METADATA: {**known, **facts}}


def _fits(layer: Any, made: LayerData) -> bool:
    """Whether a layer can show this: other pixels or another scale, but no other sort of thing."""
    axes, rgb = len(made.attributes["scale"]), made.attributes.get("rgb", False)
    kind = made.attributes["metadata"][METADATA]["kind"]
    same = made.kind == "image" or known_of(layer).get("kind") == kind
    same = same and made.kind == type(layer).__name__.lower()
    return bool(same and layer.ndim == axes and getattr(layer, "rgb", False) == rgb)


def _is_moved(layer: Any, where: str) -> bool:
    """Whether a layer shows an image of a slice where its tissue has moved to."""
    known = known_of(layer)
    return known.get("kind") == "image" and known.get("slice") == where


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
    """

    changed = Signal(object)

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
        """Remove what is left of images that are gone, once napari is done with its own layers."""
        orphans, self._orphans = self._orphans, []
        for result in orphans:
            result.remove()

    def _all(self) -> list[Result]:
        return [result for known in [*self._results.values()] for result in known.values()]

    def _on_removed(self, event: Any) -> None:
        self._orphans += self._results.pop(event.value, {}).values()

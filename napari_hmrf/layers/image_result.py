"""The results that a viewer shows: of an image and a slice there is one, the newest."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from napari.layers import Layer, Vectors
from psygnal import Signal

from napari_hmrf.field.animation import MARKS
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.compat import show_name
from napari_hmrf.layers.metadata import BOUNDARY, METADATA, TISSUE, add_known, known_of, role_of
from napari_hmrf.layers.result_layers import Kind, LayerData
from napari_hmrf.layers.viewer_layers import overwrite, same_selection, still_there, update_layer

#: The confidence that was painted, and all that was.
CONFIDENCE: Literal["painted confidence"] = "painted confidence"
PAINTED: Literal["painted"] = "painted"
#: A layer of a result: what was made with it, what was painted, or what it is looked at with, one
#: thing at a time.
Part = Kind | Literal["overlay", "painted confidence", "painted"]
#: Looks that belong to the numbers that are shown, of an overlay and of what was painted.
_LOOKS = {"overlay": ("colormap", "contrast_limits"), PAINTED: ("colormap",)}
_WHOLE = 100


@dataclass(eq=False)
class _Held:
    """A layer of a result."""

    #: Returns it, as long as it is kept anywhere.
    layer: Callable[[], Any]
    #: What napari made of the name meant for it.
    name: str
    #: Whether somebody wants to see it.
    wanted: bool = True
    #: Whether it is of the newest result, and does not wait for what that will have.
    current: bool = True
    #: Whether it was seen when we looked last: if it is otherwise now, that was done by hand.
    seen: bool = True
    #: Its data, if nobody else holds them: they can be written to.
    own: Any = None
    #: Its data while it shows a part of the deformation, and those of all of it.
    part: Any = None
    whole: Any = None


class Result:
    """The layers of one result.

    A layer is seen if somebody wants to see it, if it is of the newest result, if the image is not
    looked at as it was before it moved, and if no other extent of it is worked on.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
        Or a weak proxy of it.
    anchor : napari.layers.Layer
        What was deformed; of a result from a file the layer of arrows that holds it.
    where : str
        The slice, as in the layers' metadata.

    Attributes
    ----------
    is_before : bool
        Whether the image is seen as it was.
    is_away : bool
        Whether it is hidden, as another extent of the image is worked on.
    """

    #: Whether all of the deformation is seen.
    _is_whole = True
    #: Whether more will follow soon than what was shown last.
    moving = False

    def __init__(self, viewer: Any, anchor: Any, where: str) -> None:
        self._viewer = viewer
        #: Returns what was deformed, as long as it is kept anywhere.
        self.anchor: Callable[[], Any] = weakref.ref(anchor)
        self.where = where
        self.is_before = self.is_away = False
        self._frame: Frame | None = None
        self._held: dict[Part, _Held] = {}

    # What there is

    def layer(self, part: Part) -> Any:
        """The layer of a part, if it is in the viewer."""
        held = self._held.get(part)
        return still_there(self._viewer, None if held is None else held.layer())

    def part_of(self, layer: Any) -> Part | None:
        """Which part a layer is, or was until somebody removed it; None if it is none of these."""
        return next((part for part, held in self._held.items() if held.layer() is layer), None)

    def wants(self, part: Part) -> bool:
        """Whether a part is seen, or will be with what comes next."""
        layer = self.layer(part)
        if layer is None:
            return False
        held = self._held[part]
        return bool(layer.visible if layer.visible != held.seen else held.wanted)

    def holds(self, part: Part) -> bool:
        """Whether the newest result has a part; tissue that is at rest has no arrows."""
        return part in self._held and self._held[part].current

    @property
    def visible(self) -> bool:
        """Whether anything of it is seen."""
        return any(layer.visible for _, layer, _ in self._there())

    @property
    def percent(self) -> int:
        """How much of the deformation is seen."""
        pictures = (layer for part, layer, _ in self._there() if part in ("image", "overlay"))
        return next((_percent_of(layer) for layer in pictures if layer.visible), 0)

    # What is shown

    def take(self, part: Part, layer: Any) -> None:
        """Have a layer that somebody else made."""
        seen = layer.visible
        self._held[part] = _Held(weakref.ref(layer), layer.name, seen, seen=seen)
        self._set_eyes()

    def put(self, part: Part, made: LayerData, source: Any = None, show: bool = True) -> None:
        """Have a layer be one of the result there is.

        Parameters
        ----------
        part : Part
        made : LayerData
        source : napari.layers.Layer, optional
            The image that is moved, where that is not what was deformed.
        show : bool
            Whether it is shown though somebody has hidden it; it is to be seen without paint then.
        """
        if part != PAINTED or not self._overwrite(part, made):
            self._put(part, made, source)
        if show and part == "overlay" and not self.is_before:
            for each in self._viewer.layers:
                each.visible = each.visible and role_of(each) not in (TISSUE, BOUNDARY)
        self._held[part].current = True
        self.want(part, show or self.wants(part))

    def show(self, frame: Frame, layers: Mapping[Part, LayerData], moving: bool = False) -> None:
        """Show another state of the result; as of `ResultLayers.show`."""
        quick = moving and frame == self._frame
        self._frame, self.moving, self._is_whole = frame, moving, True
        for part, made in layers.items():
            if not (quick and self._overwrite(part, made)):
                self._put(part, made)
        for part, held in self._held.items():
            held.current = part in layers
        arrows = self.layer("arrows")
        if arrows is not None and not (moving or self.holds("arrows")):
            add_known(arrows, answer=None, solution=None)  # tissue is at rest again
        self._set_eyes()

    def show_part(self, percent: int, parts: Mapping[Part, Any]) -> None:
        """Show a part of the deformation, until `show_whole` or a newer result.

        What was painted lies where all of it has led, and is not seen with less.
        """
        self._is_whole = percent == _WHOLE
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
            add_known(layer, percent=percent)
        self._set_eyes()

    def show_whole(self) -> None:
        """Put back what was there before a part was shown, where nobody else has drawn since."""
        self._is_whole = True
        for part, layer, held in self._there():
            if held.part is not None and layer.data is held.part:
                if held.whole is not None:
                    layer.data = held.whole
                    add_known(layer, percent=_WHOLE)
                elif _percent_of(layer) != _WHOLE:
                    self.want(part, False)
            held.part = held.whole = None
        self._set_eyes()

    # What is hidden

    def want(self, part: Part, wanted: bool) -> None:
        """Have a part be seen, or not; no result brings back what nobody wants to see."""
        if (layer := self.layer(part)) is not None:
            held = self._held[part]
            held.wanted, held.seen = wanted, layer.visible
            held.current = held.current or wanted
            self._set_eyes()

    def drop(self, part: Part) -> None:
        """Take a part out of the viewer; one that somebody has named is theirs, and hidden."""
        layer, held = self.layer(part), self._held.pop(part, None)
        if held is not None and layer is not None:
            if layer.name == held.name:
                self._viewer.layers.remove(layer)
            else:
                layer.visible = False

    def drop_paint(self, besides: Collection[Part] = ()) -> None:
        """Take what was painted out of the viewer, but for some parts."""
        for part in (PAINTED, CONFIDENCE):
            if part not in besides:
                self.drop(part)

    def leave(self) -> None:
        """Hide what was put there to be looked at, as another result is."""
        self.want("overlay", False)
        if self.anchor() is self.layer("arrows"):  # of a file: its image was not made with it
            self.want("image", False)

    def show_before(self, before: bool) -> None:
        """Show nothing of the result, so that the image is seen as it was; or show it again."""
        before = before and (self.is_before or self.visible)
        if before != self.is_before:
            self.is_before = before
            self._set_eyes()

    def make_way(self, place: Frame) -> None:
        """Be hidden if this would be seen through a place that is worked on; else be seen again."""
        self.is_away = self._frame is not None and self._frame.plane != place.plane
        self._set_eyes()

    def remove(self) -> None:
        """Take the layers out of the viewer, but for those that somebody has named."""
        for part, layer, held in self._there():
            if layer.name == held.name:
                self.drop(part)

    # How it is done

    def _there(self) -> Iterator[tuple[Part, Any, _Held]]:
        """The layers that are in the viewer."""
        for part, held in [*self._held.items()]:
            if (layer := self.layer(part)) is not None:
                yield part, layer, held

    def _set_eyes(self) -> None:
        """Have each layer be seen or not, as it should."""
        for part, layer, held in self._there():
            held.wanted = self.wants(part)
            partly = not self._is_whole and part in (PAINTED, CONFIDENCE)
            hidden = self.is_before or self.is_away or partly
            held.seen = held.wanted and held.current and not hidden
            if layer.visible != held.seen:
                layer.visible = held.seen

    def _overwrite(self, part: Part, made: LayerData) -> bool:
        """Give a layer other pixels where nothing else of it is another; whether that is so."""
        layer, held = self.layer(part), self._held.get(part)
        if layer is None or held is None or held.part is not None or not _fits(layer, made):
            return False
        if part == PAINTED and layer.colormap is not made.attributes["colormap"]:
            return False
        if layer.data is not held.own or not overwrite(self._viewer, layer, made.data):
            layer.data = held.own = np.array(made.data)
        return True

    def _put(self, part: Part, made: LayerData, source: Any = None) -> None:
        """Have a layer show this: the one that is there, or a new one."""
        layers, layer, held = self._viewer.layers, self.layer(part), self._held.get(part)
        name, is_scale = made.attributes["name"], part != "image" and made.kind == "image"
        is_overlaid = part == "overlay" and made.kind != "vectors"
        with same_selection(self._viewer):
            if held is None or layer is None or not _fits(layer, made):
                wanted = layer is None or self.wants(part)
                self.drop(part)
                layer = Layer.create(*made)
                # Who hears that it comes can ask whose it is.
                held = self._held[part] = _Held(weakref.ref(layer), name, wanted)
                layers.insert(self._index(part, made, source), layer)
                held.name = layer.name
                # Two bars in one corner would be read as one, under one title.
                corner = "top_left" if part == CONFIDENCE else "top_right"
                if is_scale:
                    layer.colorbar.position, layer.colorbar.visible = corner, True
                if part in ("overlay", CONFIDENCE):
                    show_name(layer, corner)
                layer.editable = part != PAINTED and layer.editable
            else:
                update_layer(layer, made)
                for look in _LOOKS.get(part, ()):
                    if look in made.attributes:
                        setattr(layer, look, made.attributes[look])
                if layer.name == held.name:
                    layer.name = name
                    held.name = layer.name
                now, at = layers.index(layer), self._index(part, made, source)
                if is_overlaid and now + 1 < at:  # paint has come since
                    layers.move(now, at)
        held.own = held.part = held.whole = None

    def _index(self, part: Part, made: LayerData, source: Any) -> int:
        """Pictures go directly above what was deformed and has moved, lines and marks on top."""
        layers = self._viewer.layers
        if made.kind == "vectors" or _kind_of(made) in MARKS:  # as lines often lie where folds are
            return len(layers)
        if part in (PAINTED, CONFIDENCE):  # below what else is drawn on it
            lowest = self._above(self.layer("image"), self.anchor())
            drawn = (at for at, each in enumerate(layers) if at >= lowest and _is_drawn(each))
            return next(drawn, len(layers))
        below = [] if part == "image" else [self.layer("image")]
        if part == "overlay":  # through paint its colours would be read as others
            below += [each for each in layers if _is_paint(each)]
        if source is None:
            below.append(self.anchor())
        else:
            below += [source, *(each for each in layers if _is_moved(each, self.where))]
        return self._above(*below)

    def _above(self, *below: Any) -> int:
        """Where a layer lies directly above others."""
        layers = self._viewer.layers
        return max((layers.index(each) + 1 for each in below if each in layers), default=0)


def _percent_of(layer: Any) -> int:
    return int(known_of(layer).get("percent", _WHOLE))


def _kind_of(made: LayerData) -> Any:
    return made.attributes["metadata"][METADATA]["kind"]


def _fits(layer: Any, made: LayerData) -> bool:
    """Whether a layer can show this: other pixels or another scale, but no other sort of thing."""
    axes, rgb = len(made.attributes["scale"]), made.attributes.get("rgb", False)
    same = made.kind == "image" or known_of(layer).get("kind") == _kind_of(made)
    same = same and made.kind == type(layer).__name__.lower()
    return bool(same and layer.ndim == axes and getattr(layer, "rgb", False) == rgb)


def _is_drawn(layer: Any) -> bool:
    """Whether a layer is of lines, or shows what brushes have painted."""
    return isinstance(layer, Vectors) or known_of(layer).get("kind") == PAINTED


def _is_paint(layer: Any) -> bool:
    """Whether a layer says what tissue is, what holds it, or how sure that is."""
    painted = known_of(layer).get("kind") in (CONFIDENCE, PAINTED)
    return painted or role_of(layer) in (TISSUE, BOUNDARY)


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
        self._viewer = weakref.proxy(viewer)
        self._results: list[Result] = []

    @property
    def sources(self) -> list[Any]:
        """The layers of which a result is seen."""
        return [result.anchor() for result in self._results if result.visible]

    def at(self, source: Any, where: str) -> Result:
        """The result of a layer and a slice, which need not be there yet."""
        for result in self._results:
            if result.anchor() is source and result.where == where:
                return result
        self._results.append(Result(self._viewer, source, where))
        return self._results[-1]

    def pictures_of(self, source: Any) -> list[Any]:
        """The layers that show a layer as it has moved, of all slices."""
        own = (result for result in self._results if result.anchor() is source)
        return [layer for result in own if (layer := result.layer("image")) is not None]

    def of(self, arrows: Any) -> Result:
        """The result that a layer of arrows holds, be it from a file."""
        for result in self._results:
            if result.part_of(arrows) is not None:
                return result
        result = self.at(arrows, str(known_of(arrows).get("slice", "")))
        result.take("arrows", arrows)
        return result

    def stand_on(self, source: Any, place: Frame) -> None:
        """Have the result of a place be seen, if there is one, and none of another extent."""
        for result in [each for each in self._results if each.anchor() is source]:
            result.make_way(place)
            if result.is_away or result.where == place.slice_name:
                self.changed.emit(result)

    def show(
        self, source: Any, frame: Frame, layers: Mapping[Part, LayerData], *, moving: bool = False
    ) -> None:
        """Show a result in place of the one there is of the same layer and slice.

        What that had and this does not is hidden until there is a result that has it. Nothing is
        shown if what was deformed is gone.

        Parameters
        ----------
        source : napari.layers.Layer
            What was deformed.
        frame : Frame
            Where.
        layers : dict of part to LayerData
            In stacking order.
        moving : bool
            Whether more will follow soon, and only the canvas counts.
        """
        if source in self._viewer.layers:
            result = self.at(source, frame.slice_name)
            result.show(frame, layers, moving)
            self.changed.emit(result)

    def show_only(self, source: Any) -> None:
        """Show what came of a layer, and what came of no other; what is of a file stays."""
        for result in self._results:
            if not isinstance(result.anchor(), Vectors):
                result.show_before(result.anchor() is not source)

    def remove_orphans(self) -> None:
        """Remove what is left of images that are gone, once napari is done with its own layers."""
        for result in [*self._results]:
            if result.anchor() not in self._viewer.layers:
                self._results.remove(result)
                result.remove()

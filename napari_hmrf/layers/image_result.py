"""Result layers in a viewer: the latest result of each image and slice."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from napari.layers import Image, Layer, Vectors
from psygnal import Signal

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.compat import hide_in_list, outline_arrows, show_name
from napari_hmrf.layers.label_colours import opaque_gaps
from napari_hmrf.layers.metadata import (
    BOUNDARY,
    METADATA,
    TISSUE,
    add_metadata,
    metadata_of,
    role_of,
)
from napari_hmrf.layers.result_layers import Kind, LayerData
from napari_hmrf.layers.viewer_layers import (
    ViewerLayers,
    layer_painted,
    layers_of,
    lies_still,
    still_there,
)
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.results.animation import FOLD_MARKS
from napari_hmrf.study.session import DisplayChoice, Session

#: Kind of the layer that shows painted confidence.
CONFIDENCE: Literal["painted confidence"] = "painted confidence"
#: Kind of the layer that shows all other paint.
PAINTED: Literal["painted"] = "painted"
#: Name of a part of a result: image or arrows of the solution, overlay, or paint.
Part = Kind | Literal["overlay", "painted confidence", "painted"]
#: Display settings that are updated together with the data, by part.
_LOOKS = {
    "overlay": ("colormap", "contrast_limits", "interpolation3d", "rendering"),
    PAINTED: ("colormap",),
}
#: Percentage of the complete deformation.
_WHOLE = 100
#: Why a layer is shown undeformed: the user compares it with the result, it is a sample that is
#: introduced, the user paints on it, or another image is chosen.
Reason = Literal["comparison", "introduction", "paint", "other image"]


@dataclass(eq=False)
class _Look:
    """How a deformed layer is shown in all its slices."""

    #: Axes of the slice or volume that the user is working on; None for a result from a file.
    plane: tuple[int, ...] | None = None
    #: Why the undeformed layer is shown instead of its results; empty if the results are shown.
    undeformed: set[Reason] = field(default_factory=set)


@dataclass(eq=False)
class _PartState:
    """Layer of one part of a result, and its state."""

    #: Weak reference to the layer.
    layer: Callable[[], Any]
    #: Name of the layer when it was created or updated; if the layer's name differs, the user has
    #: renamed the layer.
    name: str
    #: Name for which the layer was created; napari may append a number to it.
    base_name: str
    #: True if the latest result includes the part; otherwise the layer is temporarily hidden.
    current: bool = True
    #: Data of the layer if no other object uses the array, so that the array can be overwritten;
    #: otherwise None.
    writable: Any = None
    #: Data of the layer while a fraction of the deformation is shown; otherwise None.
    part: Any = None
    #: Data for the complete deformation while a fraction is shown; otherwise None.
    complete: Any = None


class Result:
    """Layers of one result.

    The layer of a part is hidden while the latest result does not include the part, while the
    undeformed image is shown instead, and while the user is working on another extent (slice or
    volume).

    Parameters
    ----------
    layers : ViewerLayers
        Layers of the viewer.
    anchor : napari.layers.Layer
        Deformed layer; for a result from a file, the arrow layer that contains the result.
    where : str
        Name of the slice, as in the metadata of the layers.
    look : _Look
        How the deformed layer is shown.
    session : Session
        Session of the viewer, which stores whether arrows are shown.
    paint_hidden : callable
        Called with the painted layers that were hidden for the deformed image.
    """

    #: True if the complete deformation is shown.
    _is_whole = True
    #: True if another update will follow soon.
    moving = False

    def __init__(
        self,
        layers: ViewerLayers,
        anchor: Any,
        where: str,
        look: _Look,
        session: Session,
        paint_hidden: Callable[[list[Any]], object],
    ) -> None:
        self._layers, self._viewer, self._paint_hidden = layers, layers.viewer, paint_hidden
        self._look, self._session = look, session
        #: Weak reference to the deformed layer.
        self.anchor: Callable[[], Any] = weakref.ref(anchor)
        self.where = where
        self._frame: Frame | None = None
        self._states: dict[Part, _PartState] = {}

    # Queries

    def layer(self, part: Part) -> Any:
        """Return the layer of a part, or None if it is not in the viewer."""
        state = self._states.get(part)
        return still_there(self._viewer, None if state is None else state.layer())

    def part_of(self, layer: Any) -> Part | None:
        """Return the part that a layer shows, or None; the layer may have been removed."""
        return next((part for part, state in self._states.items() if state.layer() is layer), None)

    def is_wanted(self, part: Part) -> bool:
        """Return whether a part is in the viewer and has not been hidden by the user.

        The part can still be hidden for other reasons; see `Result`.
        """
        layer = self.layer(part)
        return layer is not None and self._layers.is_wanted(layer)

    def holds(self, part: Part) -> bool:
        """Return whether the latest result includes a part.

        For example, a result without deformation includes no arrows.
        """
        return part in self._states and self._states[part].current

    @property
    def visible(self) -> bool:
        """True if any layer of the result is visible."""
        return any(layer.visible for _, layer, _ in self._present_layers())

    @property
    def is_before(self) -> bool:
        """True while the undeformed image is shown instead of the result."""
        present = self._present_layers()
        wanted = (state.current and self._layers.is_wanted(layer) for _, layer, state in present)
        return bool(self._look.undeformed) and any(wanted)

    @property
    def is_away(self) -> bool:
        """True while the user is working on another extent of the image, slice or volume."""
        frame, plane = self._frame, self._look.plane
        return frame is not None and plane is not None and frame.plane != plane

    @property
    def percent(self) -> int:
        """Displayed percentage of the deformation, or 0 if no image or overlay is visible."""
        pictures = (
            layer for part, layer, _ in self._present_layers() if part in ("image", "overlay")
        )
        return next((_percent_of(layer) for layer in pictures if layer.visible), 0)

    # Display

    def adopt(self, part: Part, layer: Any) -> None:
        """Use an existing layer as the layer of a part."""
        self._states[part] = _PartState(weakref.ref(layer), layer.name, layer.name)
        if part == "arrows":
            layer.events.visible.connect(self._on_eye)
        self.update_visibility()

    def put(self, part: Part, made: LayerData, source: Any = None, show: bool = True) -> None:
        """Add or update the layer of a part.

        Parameters
        ----------
        part : Part
        made : LayerData
            New data of the layer.
        source : napari.layers.Layer, optional
            Deformed image, if it is not the anchor of the result.
        show : bool
            If True, show the layer even if the user has hidden it; for an overlay, also hide the
            tissue and boundary layers.
        """
        if part != PAINTED or not self._overwrite(part, made):
            self._update_or_replace(part, made, source)
        if show and part == "overlay" and not self.is_before:
            still = [each for each in self._viewer.layers if lies_still(each)]
            self._layers.want(*still, wanted=False)
        self._states[part].current = True
        self.set_wanted(part, show or self.is_wanted(part))

    def show(self, frame: Frame, layers: Mapping[Part, LayerData], moving: bool = False) -> None:
        """Update all layers of the result; see `ResultLayers.show`."""
        quick = moving and frame == self._frame
        self._frame, self.moving, self._is_whole = frame, moving, True
        for part, made in layers.items():
            if not (quick and self._overwrite(part, made)):
                self._update_or_replace(part, made)
        for part, state in self._states.items():
            state.current = part in layers
        arrows = self.layer("arrows")
        if arrows is not None and not (moving or self.holds("arrows")):
            add_metadata(arrows, answer=None, solution=None)  # the tissue is undeformed again
        self.update_visibility()

    def show_part(self, percent: int, parts: Mapping[Part, Any]) -> None:
        """Show a fraction of the deformation, until `show_whole` is called or a result arrives.

        Meanwhile, paint is hidden, because it is drawn for the complete deformation.

        Parameters
        ----------
        percent : int
            Percentage of the deformation.
        parts : mapping of Part to ndarray
            Data of the layers for this percentage.
        """
        self._is_whole = percent == _WHOLE
        for part, data in parts.items():
            layer = self.layer(part)
            if layer is None:
                continue
            state = self._states[part]
            if _percent_of(layer) == _WHOLE:
                state.complete = layer.data
            state.part = data
            self._layers.set_data(layer, data)
            state.writable = None
            # The metadata record the percentage, in case the user saves the layer.
            add_metadata(layer, percent=percent)
        self.update_visibility()

    def show_whole(self) -> None:
        """Restore the layers changed by `show_part`, unless their data were changed afterwards."""
        self._is_whole = True
        for part, layer, state in self._present_layers():
            if state.part is not None and layer.data is state.part:
                if state.complete is not None:
                    self._layers.set_data(layer, state.complete)
                    add_metadata(layer, percent=_WHOLE)
                elif _percent_of(layer) != _WHOLE:
                    self.set_wanted(part, False)
            state.part = state.complete = None
        self.update_visibility()

    # Visibility

    def set_wanted(self, part: Part, is_wanted: bool) -> None:
        """Show or hide a part, in this and in later results."""
        if (layer := self.layer(part)) is not None:
            state = self._states[part]
            state.current = state.current or is_wanted
            self._layers.want(layer, wanted=is_wanted)
            self.update_visibility()

    @property
    def _wants_arrows(self) -> bool:
        """True if the arrows are shown, by choice or because the result has no image."""
        chosen = self._session.display.arrows
        return not isinstance(self.anchor(), Image) if chosen is None else chosen

    def show_chosen_arrows(self) -> None:
        """Show or hide the arrows as chosen in the session."""
        if (layer := self.layer("arrows")) is not None:
            self._layers.want(layer, wanted=self._wants_arrows)

    def _on_eye(self, _: Any) -> None:
        """Choose whether arrows are shown if the user clicks the eye of their layer."""
        layer = self.layer("arrows")
        if layer is not None and self._layers.is_wanted(layer) != self._wants_arrows:
            self._session.choose_display(arrows=self._layers.is_wanted(layer))

    def drop(self, part: Part) -> None:
        """Remove the layer of a part; if the user has renamed the layer, only hide it.

        The layer list does not show paint, so that its layers are always removed.
        """
        layer, state = self.layer(part), self._states.pop(part, None)
        if state is not None and layer is not None:
            if layer.name == state.name or part in (PAINTED, CONFIDENCE):
                self._layers.remove(layer)
            else:
                self._layers.want(layer, wanted=False)
            if part in ("image", "overlay"):
                self.update_visibility()  # paint may be visible again

    def drop_paint(self, besides: Collection[Part] = ()) -> None:
        """Remove the paint layers, except those of the parts in `besides`."""
        for part in (PAINTED, CONFIDENCE):
            if part not in besides:
                self.drop(part)

    def leave(self) -> None:
        """Hide the overlay when another result is selected."""
        self.set_wanted("overlay", False)
        # The anchor of a result from a file is its arrow layer; hide the deformed image as well.
        if self.anchor() is self.layer("arrows"):
            self.set_wanted("image", False)

    def remove(self) -> None:
        """Remove the layers from the viewer, except layers that the user has renamed."""
        for part, layer, state in self._present_layers():
            if layer.name == state.name:
                self.drop(part)

    # Implementation

    def _present_layers(self) -> Iterator[tuple[Part, Any, _PartState]]:
        """Yield the part, layer and state of each layer that is in the viewer."""
        for part, state in [*self._states.items()]:
            if (layer := self.layer(part)) is not None:
                yield part, layer, state

    def update_visibility(self) -> None:
        """Hide the layers that do not belong to what is shown now."""
        paint, overlay = (PAINTED, CONFIDENCE), self.layer("overlay")
        # Two colour scales on one image, and their legends, could be mistaken for each other.
        has_scale = isinstance(overlay, Image) and self.holds("overlay")
        is_scaled = has_scale and self._layers.is_wanted(overlay)
        self._layers.hide_while(
            self,
            [
                layer
                for part, layer, state in self._present_layers()
                if self._look.undeformed
                or self.is_away
                or not state.current
                or (part in paint and not self._is_whole)
                or (part == CONFIDENCE and is_scaled)
            ],
        )
        self.hide_paint()

    def hide_paint(self) -> None:
        """Hide painted layers, which do not move, if the deformed image is visible."""
        hidden = self._layers.hide_still_paint()
        if hidden:
            self._paint_hidden(hidden)

    def _overwrite(self, part: Part, made: LayerData) -> bool:
        """Write new pixels to a layer if nothing else has changed; return True on success."""
        layer, state = self.layer(part), self._states.get(part)
        if layer is None or state is None or state.part is not None or not _fits(layer, made):
            return False
        if layer.name == state.name and made.attributes["name"] != state.base_name:
            return False  # the image was renamed
        # A coarse preview of a volume has fewer, larger voxels.
        if made.kind == "image" and layer.data.shape != made.data.shape:
            return False
        if part == PAINTED and layer.colormap is not made.attributes["colormap"]:
            return False
        if layer.data is not state.writable or not self._layers.overwrite(layer, made.data):
            state.writable = np.array(made.data)
            self._layers.set_data(layer, state.writable)
        return True

    def _update_or_replace(self, part: Part, made: LayerData, source: Any = None) -> None:
        """Update the layer of a part, or replace the layer if it cannot show the new data."""
        layers, layer, state = self._viewer.layers, self.layer(part), self._states.get(part)
        name, is_scale = made.attributes["name"], part != "image" and made.kind == "image"
        is_overlaid = part == "overlay" and made.kind != "vectors"
        with self._layers.same_selection():
            if state is None or layer is None or not _fits(layer, made):
                wanted = layer is None or self.is_wanted(part)
                wanted = self._wants_arrows if part == "arrows" else wanted
                self.drop(part)
                layer = Layer.create(*made)
                # Register the layer first, so that callbacks of the insertion can find it.
                state = self._states[part] = _PartState(weakref.ref(layer), name, name)
                self._layers.add(layer, self._index(part, made, source))
                self._layers.want(layer, wanted=wanted)
                state.name = layer.name
                if part == "arrows":
                    layer.events.visible.connect(self._on_eye)
                if part in (PAINTED, CONFIDENCE):  # parts of the drawing, which the tools edit
                    hide_in_list(self._viewer, layer)
                if made.kind == "vectors":
                    outline_arrows(self._viewer, layer)
                # The title is above the legend. If the canvas is narrow, the title loses its end.
                corner = "top_left"
                if is_scale:
                    layer.colorbar.position, layer.colorbar.visible = corner, True
                if part in ("overlay", CONFIDENCE):
                    show_name(layer, corner)
                layer.editable = part != PAINTED and layer.editable
            else:
                self._layers.update(layer, made)
                for look in _LOOKS.get(part, ()):
                    if look in made.attributes:
                        setattr(layer, look, made.attributes[look])
                if layer.name == state.name:
                    layer.name = name
                    state.name, state.base_name = layer.name, name
                now, at = layers.index(layer), self._index(part, made, source)
                if is_overlaid and now + 1 < at:  # paint was added above the overlay
                    self._layers.move(layer, at)
        is_grey = part == "image" and not layer.rgb
        if is_grey and layer.dtype.kind == "f" and np.isnan(layer.data).any():
            layer.colormap = opaque_gaps(layer.colormap)
        state.writable = state.part = state.complete = None

    def _index(self, part: Part, made: LayerData, source: Any) -> int:
        """Return the index for a new layer: lines on top, and pictures above their source."""
        layers = self._viewer.layers
        # Marks, such as folds, are also on top, because lines would often cover them.
        if made.kind == "vectors" or _kind_of(made) == FOLD_MARKS:
            return len(layers)
        if part in (PAINTED, CONFIDENCE):  # below the lines on the image
            lowest = self._layers.above(self.layer("image"), self.anchor())
            drawn = (at for at, each in enumerate(layers) if at >= lowest and _is_drawn(each))
            return next(drawn, len(layers))
        below = [] if part == "image" else [self.layer("image")]
        if part == "overlay":  # paint above the overlay would change its colours
            below += [each for each in layers if _is_paint(each)]
        if source is None:
            below.append(self.anchor())
        else:
            below += [source, *(each for each in layers if _is_moved(each, self.where))]
        return self._layers.above(*below)


def _percent_of(layer: Any) -> int:
    return int(metadata_of(layer).get("percent", _WHOLE))


def _kind_of(made: LayerData) -> Any:
    return made.attributes["metadata"][METADATA]["kind"]


def _fits(layer: Any, made: LayerData) -> bool:
    """Return whether a layer can show new data, which must have the same type, axes and kind."""
    axes, rgb = len(made.attributes["scale"]), made.attributes.get("rgb", False)
    same = made.kind == "image" or metadata_of(layer).get("kind") == _kind_of(made)
    same = same and made.kind == type(layer).__name__.lower()
    return bool(same and layer.ndim == axes and getattr(layer, "rgb", False) == rgb)


def _is_drawn(layer: Any) -> bool:
    """Return whether a layer shows lines or paint."""
    return isinstance(layer, Vectors) or metadata_of(layer).get("kind") == PAINTED


def _is_paint(layer: Any) -> bool:
    """Return whether a layer shows paint, or is a tissue or boundary layer."""
    painted = metadata_of(layer).get("kind") in (CONFIDENCE, PAINTED)
    return painted or role_of(layer) in (TISSUE, BOUNDARY)


def _is_moved(layer: Any, where: str) -> bool:
    """Return whether a layer shows the deformed image of a slice."""
    known = metadata_of(layer)
    return known.get("kind") == "image" and known.get("slice") == where


class ResultLayers:
    """Results displayed in a viewer.

    A new result replaces the previous result of the same image and slice. Layers that the user has
    hidden stay hidden, and renamed layers keep their names. When an image is removed, its results
    are removed as well.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    changed : Signal(Result)
        Emitted when the displayed result of an image and slice changes.
    paint_hidden : Signal(list)
        Emitted with the painted layers that were hidden for a deformed image.
    before_changed : Signal
        Emitted when there is another reason to show an undeformed image, or one less.
    """

    changed = Signal(object)
    paint_hidden = Signal(object)
    before_changed = Signal()

    def __init__(self, viewer: Any) -> None:
        self._layers = layers_of(viewer)
        self._viewer = self._layers.viewer
        self._results: list[Result] = []
        self._session = undo_of(viewer).session
        self._session.displayed.connect(self._on_displayed)
        self._looks: weakref.WeakKeyDictionary[Any, _Look] = weakref.WeakKeyDictionary()

    @property
    def sources(self) -> list[Any]:
        """Layers with a visible result."""
        return [result.anchor() for result in self._results if result.visible]

    def at(self, source: Any, where: str) -> Result:
        """Return the result of a layer and a slice, creating it if necessary."""
        for result in self._results:
            if result.anchor() is source and result.where == where:
                return result
        look, report = self._look_of(source), self.paint_hidden.emit
        self._results.append(Result(self._layers, source, where, look, self._session, report))
        return self._results[-1]

    def pictures_of(self, source: Any) -> list[Any]:
        """Return the layers with the deformed image of a layer, one for each slice."""
        own = (result for result in self._results if result.anchor() is source)
        return [layer for result in own if (layer := result.layer("image")) is not None]

    def of(self, arrows: Any) -> Result:
        """Return the result of an arrow layer, which may come from a file."""
        for result in self._results:
            if result.part_of(arrows) is not None:
                return result
        result = self.at(arrows, str(metadata_of(arrows).get("slice", "")))
        result.adopt("arrows", arrows)
        return result

    def show_extent(self, source: Any, place: Frame) -> None:
        """Show the result for the extent that the user is working on, and hide other results.

        The extent is a slice or the volume. Only results of the layer `source` are affected.
        """
        self._look_of(source).plane = place.plane
        for result in [each for each in self._results if each.anchor() is source]:
            result.update_visibility()
            if result.is_away or result.where == place.slice_name:
                self.changed.emit(result)

    def show(
        self, source: Any, frame: Frame, layers: Mapping[Part, LayerData], *, moving: bool = False
    ) -> None:
        """Show a result, in place of the previous result of the same layer and slice.

        If the new result lacks a part, the layer of that part is hidden until a later result
        includes the part. If the deformed layer has been removed, nothing is shown.

        Parameters
        ----------
        source : napari.layers.Layer
            Deformed layer.
        frame : Frame
            Frame of the result.
        layers : dict of part to LayerData
            Layers in stacking order.
        moving : bool
            True if another update will follow soon. In this case, only the canvas is updated, if
            possible.
        """
        if source in self._viewer.layers:
            result = self.at(source, frame.slice_name)
            result.show(frame, layers, moving)
            self.changed.emit(result)

    def show_only(self, source: Any) -> None:
        """Show the results of a layer, and hide the results of other layers.

        Results from files are not affected.
        """
        for layer in [*self._looks]:
            if layer is source:
                self.show_deformed(layer)
            elif not isinstance(layer, Vectors):
                self.show_undeformed(layer, "other image")

    def show_undeformed(self, source: Any, reason: Reason) -> None:
        """Show an undeformed layer in all its slices, until `show_deformed`."""
        self._set_undeformed(source, {*self._look_of(source).undeformed, reason})

    def show_deformed(self, source: Any, *reasons: Reason) -> None:
        """Show the results of a layer again, unless it is shown undeformed for other reasons.

        By default, all reasons end. However, the undeformed layer stays visible while the user
        paints on it.
        """
        before = self._look_of(source).undeformed
        paint = {"paint"} if layer_painted(self._viewer) is not None else set()
        self._set_undeformed(source, before - set(reasons) if reasons else before & paint)

    def _on_displayed(self, display: DisplayChoice) -> None:
        """Show or hide the arrows of all results, if the user has chosen this."""
        for result in self._results if display.arrows is not None else ():
            result.show_chosen_arrows()

    def _look_of(self, source: Any) -> _Look:
        return self._looks.setdefault(source, _Look())

    def _set_undeformed(self, source: Any, reasons: set[Reason]) -> None:
        look = self._look_of(source)
        if reasons != look.undeformed:
            look.undeformed = reasons
            for result in self._results:
                if result.anchor() is source:
                    result.update_visibility()
            self.before_changed.emit()

    def hide_paint(self) -> None:
        """Hide painted layers, which do not move, if a deformed image is visible."""
        if self._results:
            self._results[0].hide_paint()

    def remove_orphans(self) -> None:
        """Remove the results of images that are no longer in the viewer."""
        for result in [*self._results]:
            if result.anchor() not in self._viewer.layers:
                self._results.remove(result)
                result.remove()

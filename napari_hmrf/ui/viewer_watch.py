"""Callbacks of the dock for viewer events."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np
from napari.layers import Labels, Points
from psygnal import Signal

from napari_hmrf.field.frame import PLACE
from napari_hmrf.layers.compat import camera_of, shorter_side_of
from napari_hmrf.layers.image_choice import in_middle, uncover
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.pixel_copy import CHANGES
from napari_hmrf.layers.viewer_layers import is_deformed, is_painted, layers_of, lies_still, shared
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.study.session import Part
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.usual_lengths import (
    largest_spread,
    length_range,
    usual_radius,
    usual_step,
)
from napari_hmrf.ui import messages
from napari_hmrf.ui.controller import Controller
from napari_hmrf.ui.events import EventConnections, single_shot
from napari_hmrf.ui.guide import Guide
from napari_hmrf.ui.motion.motion_messages import ARROWS_GONE


class ViewerWatch:
    """Listener that updates a dock when its viewer changes.

    napari's own brushes paint on the undeformed image, so the undeformed image is shown while a
    brush is selected.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    controller : Controller
    guide : Guide
    """

    #: Emitted when the first image is ready to be pulled, and no other layer is active.
    first_image_ready = Signal()

    def __init__(self, native: Any, viewer: Any, controller: Controller, guide: Guide) -> None:
        self._viewer, self._controller, self._guide = viewer, controller, guide
        self._form, self._binding, self._pointer = (
            controller.form,
            controller.binding,
            controller.pointer,
        )
        self._session = undo_of(viewer).session
        self._results = shared(viewer, ResultLayers)
        self._active = viewer.layers.selection.active
        self._first_timer = single_shot(native, 0, self._on_first)
        # Deferred, because napari may still be removing other layers.
        self._removal_timer = single_shot(native, 0, self._on_left)
        self._has_started = self._was_active = False
        # Painted layer that the user works on, shown on the undeformed image; or None.
        self._in_use: Any = None
        # True while a brush is selected in this layer, also while Space is pressed.
        self._is_painting = self._is_view_moved = False
        # Stack that unbinds the Space key of this layer.
        self._space = ExitStack()
        # Message about removed paint, and removed slice with a drawing and its name, until shown.
        self._removal_message = ""
        self._removed_slice: tuple[Part | None, str] = (None, "")
        # True from then on until another image is chosen.
        self._reports_removal = False
        controller.slice_changed.connect(self._on_moved)
        self._slice = self._slice_shown
        self._form.edited.connect(self._on_choice)
        self._callbacks: dict[str, Any] = {
            "inserted": self._on_inserted,
            "removed": self._on_removed,
            "renamed": self._on_renamed,
            "reordered": guide.show,
            "visible": self._on_visible,
            "mode": self._on_mode,
            **dict.fromkeys((*CHANGES, *PLACE), self._on_pixels),
        }
        self._events = EventConnections(
            (viewer.layers.events, self._on_layers),
            (viewer.layers.selection.events.active, self._on_active),
            (viewer.dims.events, self._on_slice),
            (self._session.selected, self._on_image),
            (camera_of(viewer).events.zoom, self._suggest_radius),
        )
        self._results.paint_hidden.connect(self._on_paint_hidden)
        self._results.before_changed.connect(guide.show)
        self._on_choice()

    def release(self) -> None:
        """Disconnect from all events."""
        self._events.release()
        self._results.paint_hidden.disconnect(self._on_paint_hidden)
        self._results.before_changed.disconnect(self._guide.show)
        self._space.close()

    def _on_moved(self, study: Study) -> None:
        """Set the range of the tool sizes and the default radius; for the first image, the growth.

        After the first image, schedule `first_image_ready`.
        """
        size = study.grid.shape, study.grid.spacing
        usual, (smallest, largest) = (usual_radius(*size), usual_step(*size)), length_range(*size)
        self._form.motion.fields.limit(smallest, largest, *usual, largest_spread(*size))
        self._suggest_radius()
        self._form.motion.boundary.table.largest = largest
        self._show_paint()
        if not self._has_started:
            self._has_started = True
            self._form.motion.fields.begin_with(usual[1])
            self._first_timer.start()

    def _suggest_radius(self, *_: Any) -> None:
        """Make the default radius of the tools a fraction of the visible part of the image."""
        if (study := self._session.study) is None:
            return
        shape, spacing = study.grid.shape, study.grid.spacing
        world = np.linalg.norm(np.array(study.grid.known_place.matrix)[:-1, :-1], axis=0)
        across = shorter_side_of(self._viewer) / float(camera_of(self._viewer).zoom)
        visible = across * spacing[-1] / float(world[-1])
        self._pointer.suggest_radius(usual_radius(shape, spacing, visible))

    def _on_first(self) -> None:
        """Emit `first_image_ready`, unless a painted layer is chosen or another layer is active."""
        has_paint = any(layer is not None for layer in self._painted)
        is_active = self._viewer.layers.selection.active in (None, self._session.image)
        if is_active and not has_paint:
            self.first_image_ready.emit()

    def hide_paint(self) -> None:
        """Hide painted layers, which show the undeformed tissue and would tint the image."""
        shown = [each for each in self._viewer.layers if each.visible]
        shown = [each for each in shown if each in self._painted or lies_still(each)]
        layers_of(self._viewer).want(*shown, wanted=False)
        if shown:
            hidden = messages.describe_hidden_paint(shown)
            self._guide.show_message(f"{self._guide.situation.hint} {hidden}", "step")

    def hand_brush(self, layer: Any) -> None:
        """Show the active painted layer on the undeformed image, and select its brush."""
        layers_of(self._viewer).want(layer)
        if isinstance(layer, Labels):
            layer.mode = "paint"
        self._guide.add_aside("")  # the layer is no longer hidden
        self._guide.show_message("")

    @property
    def _painted(self) -> tuple[Any, Any]:
        """Choices of tissue and boundary: layers, None, or `BRIGHTNESS` for the tissue."""
        return self._form.tissue.choice.value, self._form.motion.boundary.choice.value

    # Choices

    def _on_choice(self, *_: Any) -> None:
        self._controller.schedule_refresh()
        self._guide.show()

    def _on_image(self, image: Any, _: Any = None) -> None:
        """Show the chosen image and its results, and hide the results of other images."""
        self._results.show_only(image)
        if image is None:
            self._rest()
        if not self._binding.automatic:
            hidden = () if image is None else uncover(layers_of(self._viewer), image)
            if image is not None and not in_middle(self._viewer, image):
                self._viewer.reset_view()
            self._guide.show_message(messages.describe_image_choice(image, hidden), why="step")
        elif image is not None and self._reports_removal:
            self._reports_removal = False
            self._guide.show_message("")
        self._on_choice()

    def _rest(self) -> None:
        """Clear the current study."""
        self._controller.cancel()
        self._controller.clear()
        self._guide.show_message("")
        self._removal_timer.start()

    # Visible slice, and layers

    def _on_slice(self, *_: Any) -> None:
        self._pointer.display.arrows.update_wheel()
        # `dims` also emits events if an arrow beyond the image's edge enlarges the canvas.
        before, self._slice = self._slice, self._slice_shown
        if self._slice != before:
            self._pointer.turn()
            self.update_mouse_mode()
            self._controller.schedule_refresh()

    @property
    def _slice_shown(self) -> tuple[tuple[int, ...], list[float]]:
        """Displayed axes, and positions along the other axes."""
        dims = self._viewer.dims
        return dims.displayed, [dims.point[axis] for axis in dims.not_displayed]

    def _on_layers(self, event: Any) -> None:
        """Dispatch an event of the layer list or of a layer in the list."""
        if event.type in self._callbacks:
            self._callbacks[event.type](event)

    def _on_renamed(self, event: Any) -> None:
        """List the new name, and schedule a refresh, because results are named after the image."""
        self._binding.refresh(event)
        self._controller.schedule_refresh()

    def _on_pixels(self, event: Any) -> None:
        """Schedule a refresh, because the pixels of a layer or their position may have changed."""
        layer = event.sources[0]
        if self._reads(layer):
            self._controller.schedule_refresh()
        if isinstance(layer, Points):
            self._form.motion.landmarks.suggest()

    def _reads(self, layer: Any) -> bool:
        """Return whether the study is read from a layer."""
        choice = self._session.choice
        return layer in (self._session.image, choice.tissue, choice.boundary, choice.confidence)

    def _on_inserted(self, event: Any) -> None:
        self._binding.refresh()
        self._binding.use_layer(event.value)
        self._on_choice()

    def _on_removed(self, event: Any) -> None:
        layer, controller, display = event.value, self._controller, self._pointer.display
        was_read = self._reads(layer)
        self._removal_message = self._removal_message_for(layer) or self._removal_message
        if layer is self._session.slice.layer and self._pointer.drawing.marks:
            self._removed_slice = self._session.slice, layer.name
        self._binding.refresh()
        if layer is display.arrows.former and not display.quiet:
            self._guide.show_message(ARROWS_GONE, why="step")
        if layer is self._session.slice.layer:
            self._rest()
        elif was_read and controller.settling:
            controller.cancel()
        self._removal_timer.start()
        self._on_choice()

    def _removal_message_for(self, layer: Any) -> str:
        """Return a message about paint that is lost with a removed layer; "" if none is lost.

        napari cannot restore a removed layer.
        """
        tissue, boundary = self._painted
        words = {id(tissue): messages.TISSUE_GONE, id(boundary): messages.BOUNDARY_GONE}
        is_source = layer is self._session.slice.layer
        return "" if is_source else words.get(id(layer), "").format(name=layer.name)

    def _pop_removal_message(self) -> str:
        """Return the message about a removed drawing, or else about removed paint, once."""
        (here, name), sentence = self._removed_slice, self._removal_message
        self._removed_slice, self._removal_message = (None, ""), ""
        if here is None:
            return sentence
        work = self._session.unsaved
        if here in work.removed:
            return messages.DRAWING_KEPT.format(name=name)
        if (file := work.paths.get(here)) is not None:
            return messages.DRAWING_SAVED.format(name=name, file=file.name)
        return messages.DRAWING_GONE.format(name=name)

    def _on_left(self) -> None:
        """Remove the results of removed images, and the tools if no image is left."""
        self._results.remove_orphans()
        if self._session.image is None and self._session.study is None:
            self._pointer.leave()
            self.update_mouse_mode()
        if message := self._pop_removal_message():
            self._guide.show_message(message, why="step")
            self._reports_removal = True

    # Mouse

    def update_mouse_mode(self) -> None:
        """Update the status and the tool after the mouse may have started or stopped drawing."""
        pointer = self._pointer
        if not pointer.display.quiet:
            stopped, self._was_active = self._was_active and not pointer.active, pointer.active
            if stopped:
                pointer.release()
                self._guide.show_message("")
            self._guide.show()
            pointer.changed.emit()

    def _on_active(self, *_: Any) -> None:
        before, self._active = self._active, self._viewer.layers.selection.active
        self.update_mouse_mode()
        if self._active is not before:  # unchanged if the dock only added a layer
            self._on_mode()
            is_painted = self._active in self._painted and isinstance(self._active, Labels)
            if is_painted and not self._active.visible and is_deformed(self._viewer):
                self.hand_brush(self._active)

    @property
    def _is_painted(self) -> bool:
        """True if a napari brush is selected in the chosen tissue or boundary layer."""
        active = self._viewer.layers.selection.active
        return active in self._painted and is_painted(self._viewer, active)

    def _on_mode(self, *_: Any) -> None:
        """Show the undeformed image while a painted layer is in use, else the deformed image.

        A layer is in use while a brush is selected in it. A layer that the user has shown on the
        undeformed image stays in use until another layer is selected.
        """
        active, was_painting = self._viewer.layers.selection.active, self._is_painting
        if self._is_view_moved and active is self._in_use:
            return
        self._is_painting = self._is_painted
        if self._is_painting:
            if active is not self._in_use or not was_painting:
                self._bind_space(active)
            self._in_use = active
            if not was_painting:
                self._guide.invite()  # the message about the layer in use is out of date
        elif was_painting or active is not self._in_use:
            self._space.close()
            self._in_use = None
        self._show_paint()

    def _bind_space(self, layer: Any) -> None:
        self._space.close()
        with suppress(ValueError):  # the key is already bound by another plugin
            layer.bind_key("Space", self._on_space)
            self._space.callback(layer.bind_key, "Space", None)

    def _on_space(self, layer: Any) -> Iterator[None]:
        """Move the view with the mouse while Space is pressed, as napari does, and keep painting.

        From napari's own key binding, the change of the mode would look like the end of painting.
        """
        mode, self._is_view_moved = layer.mode, True
        layer.mode = "pan_zoom"
        yield
        layer.mode = mode
        self._is_view_moved = False

    def _show_paint(self) -> None:
        """Show the undeformed image with the paint in use, or the deformed image without paint."""
        image, results = self._session.slice.layer, self._results
        if image is not None:
            show = results.show_deformed if self._in_use is None else results.show_undeformed
            show(image, "paint")
        results.hide_paint()

    def _on_visible(self, event: Any) -> None:
        """Show the undeformed image while the user shows a painted layer on it."""
        self._guide.show()
        layer = event.sources[0]
        if not lies_still(layer) or self._pointer.display.quiet:
            return
        if layer.visible and is_deformed(self._viewer):
            self._in_use = layer
            self._show_paint()
            if layer.visible:  # else the deformed image is that of another study
                self._guide.show_message(messages.PAINT_SHOWN.format(layer.name))
        elif layer is self._in_use and not layer.visible:
            self._in_use = None
            self._show_paint()
            self._guide.invite()

    def _on_paint_hidden(self, layers: list[Any]) -> None:
        """Report hidden layers; an active one is no longer, so that selecting it paints again."""
        selection, image = self._viewer.layers.selection, self._session.image
        if selection.active in layers and image is not None:
            selection.active = image
        names = ", ".join(f"'{layer.name}'" for layer in layers)
        self._guide.add_aside(messages.PAINT_HIDDEN.format(names))

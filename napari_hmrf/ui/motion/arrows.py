"""Layer *Motion*: shows the drawing, and receives mouse and key events while active."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, nullcontext
from typing import Any, Protocol

import numpy as np
from napari.layers import Layer

from napari_hmrf.field.frame import Frame
from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.layers.arrow_layer import arrow_layer, arrow_lines
from napari_hmrf.layers.compat import compile_once, drawn_node, outline_arrows, thin_thumbnail
from napari_hmrf.layers.line_of_sight import DepthDrag, LineOfSight, shows_volume
from napari_hmrf.layers.metadata import add_metadata
from napari_hmrf.layers.slice_view import View, plane_shown
from napari_hmrf.layers.viewer_layers import layers_of, still_there
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.drawing.marks import Point

#: Largest distance from the mouse to an arrow's end that counts as a hit, in screen pixels.
_NEAR = 8.0
#: Keys that move tissue away from the camera or towards it during a drag, and their steps.
DEPTH_KEYS = {"Up": 1.0, "Down": -1.0}


class CanvasListener(Protocol):
    """Receiver of mouse and key actions on the canvas; points are in image pixels."""

    @property
    def keys(self) -> Mapping[str, Callable[[], object]]:
        """Actions by key."""

    def press(self, point: Point, reach: float) -> None:
        """Begin a drag; `reach` is the hit distance in the unit of the spacing."""

    def pick(self, point: Point, reach: float) -> None:
        """Select the mark at a point."""

    def move(self, point: Point) -> None:
        """Continue the drag to a point."""

    def release(self) -> None:
        """End the drag."""

    @property
    def follows_surface(self) -> bool:
        """True if a drag in the 3-D view follows the surface instead of the screen."""

    def find(
        self, line: LineOfSight, reach: float | None = None, picks: bool = False
    ) -> Point | None:
        """Return the tissue on a line of sight, or the end of a mark within `reach` of the line."""

    def takes_wheel_at(self, point: Point | None = None) -> bool:
        """Return whether the mouse wheel changes a mark at a point, or at any point."""

    def turn_wheel(self, point: Point, notches: float) -> None:
        """Change a mark at a point; `notches` is positive if the wheel was turned up."""


class ArrowsLayer:
    """Vectors layer *Motion* of the viewer, created on first use.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    listener : CanvasListener
        Receiver of the mouse and key actions.
    """

    def __init__(self, viewer: Any, listener: CanvasListener) -> None:
        self._viewer, self._layers = viewer, layers_of(viewer)
        self._listener = listener
        self._layer: Any = None
        self._frame: Frame | None = None
        # Shape of the slice or volume.
        self._shape: tuple[int, ...] | None = None
        # Radius of the circle around the pointer; None if there is no circle.
        self._circle: float | None = None
        # Callbacks for the end of the drag.
        self._drag = ExitStack()
        # Drag in the 3-D view, or None.
        self._deep: DepthDrag | None = None
        # True after the mouse has turned the view beside the tissue.
        self._turns = False

    @property
    def layer(self) -> Any:
        """The *Motion* layer, or None if the layer is not in the viewer."""
        return still_there(self._viewer, self._layer)

    @property
    def former(self) -> Any:
        """Layer that was created last, even if it was removed from the viewer."""
        return self._layer

    @property
    def is_hidden(self) -> bool:
        """True if the user has hidden the layer."""
        return self.layer is not None and not self._layers.is_wanted(self._layer)

    @property
    def active(self) -> bool:
        """True if the layer receives mouse events; in the 3-D view only for a volume."""
        layer, frame, dims = self.layer, self._frame, self._viewer.dims
        if layer is None or self._viewer.layers.selection.active is not layer:
            return False
        return dims.ndisplay == 2 or (frame is not None and shows_volume(frame, View.of(dims)))

    def activate(self, frame: Frame, shape: tuple[int, ...], circle: float | None) -> None:
        """Place the layer on a slice, raise and activate it, and show a circle at the pointer."""
        if self.layer is None:
            self._add(frame, shape)
        self.place(frame, shape)
        self.raise_up()
        self._layers.want(self._layer)
        self._viewer.layers.selection = {self._layer}
        self._circle = circle
        self._equip(self._layer)

    def raise_up(self) -> None:
        """Move the layer to the top, if it is in the viewer."""
        layers, layer = self._viewer.layers, self.layer
        if layer is not None and layers[-1] is not layer:
            self._layers.move(layer, len(layers))

    def place(self, frame: Frame, shape: tuple[int, ...], drawn: bool = False) -> None:
        """Place the layer on another slice, if there is a layer or a drawing to show."""
        layer, self._shape = self.layer, shape
        if (layer is None and not drawn) or frame == self._frame:
            return
        if layer is None or layer.ndim != frame.ndim:
            active = self.active
            with self._layers.same_selection():
                self._add(frame, shape)
            if active:
                self._viewer.layers.selection = {self._layer}
            self._equip(self._layer)
            return
        for name, value in frame.placement().items():
            setattr(layer, name, value)
        add_metadata(layer, slice=frame.slice_name)
        self._frame = frame

    def show(
        self,
        drawing: Drawing,
        selected: int | None,
        below: Iterable[Lines] = (),
        quick: bool = False,
    ) -> None:
        """Draw the arrows, and other lines below the arrows.

        With `quick`, which is set during a drag, only the canvas is updated if possible.
        """
        layer, frame = self.layer, self._frame
        if layer is None or frame is None:
            return
        is_volume, view = len(frame.plane) == 3, View.of(self._viewer.dims)
        across = plane_shown(frame, view)[0] if is_volume else 0
        own = arrow_lines(drawing, frame.spacing, selected, across, self._shape)
        lines, colours = map(np.concatenate, zip(*below, own, strict=True))
        placed = frame.put_vectors(lines)
        same = np.array_equal(layer.edge_color, colours)
        if quick and same and len(lines) and self._layers.overwrite(layer, placed):
            return
        self._layers.set_data(layer, placed)
        # Setting colours is as slow as drawing lines, so only the first move of a drag sets them.
        if len(lines) and not same:
            # napari does not update the number of lines of a hidden layer.
            with nullcontext() if layer.visible else layer.events.edge_color.blocker():
                layer.edge_color = colours

    def keep(self, drawing: Drawing) -> None:
        """Store the drawing in the metadata of the layer."""
        if self.layer is not None:
            add_metadata(self._layer, drawing=drawing)

    def show_cursor(self, circle: float | None) -> None:
        """Show a circle of this radius around the pointer; None hides the circle."""
        self._circle = circle
        layer, frame = self.layer, self._frame
        # In the other modes of the layer, napari sets the cursor.
        if layer is None or frame is None or layer.mode != "pan_zoom":
            return
        if circle is None:
            layer.cursor = "pointing"
            return
        # Length of one pixel along the layer's last axis, in world units.
        step = float(np.linalg.norm(np.array(frame.matrix)[:-1, -2]))
        layer.cursor_size = 2 * circle * step / frame.spacing[-1]
        layer.cursor = "circle"

    def update_wheel(self, point: Point | None = None) -> None:
        """Let napari zoom with the mouse wheel, unless the wheel changes a mark at a point."""
        layer = self.layer
        if layer is not None:
            draws = layer.mode == "pan_zoom" and self._viewer.dims.ndisplay == 2
            layer.mouse_zoom = not (draws and self._listener.takes_wheel_at(point))

    def end_drag(self) -> None:
        """Resume the updates that were suspended for the drag."""
        self._deep = None
        self._drag.close()

    def remove(self) -> None:
        """Remove the layer from the viewer."""
        if self.layer is not None:
            self._layers.remove(self._layer)
        self._layer = self._frame = None

    def _add(self, frame: Frame, shape: tuple[int, ...]) -> None:
        """Add a new layer in place of the previous layer."""
        self.remove()
        layer = self._layer = Layer.create(*arrow_layer(frame, shape))
        self._frame = frame
        # A thumbnail of all lines would take longer than the rest of the update.
        thin_thumbnail(layer, 8)
        layer.mouse_drag_callbacks.append(self._on_drag)
        layer.mouse_move_callbacks.append(self._on_move)
        layer.mouse_wheel_callbacks.append(self._on_wheel)
        for key, steps in DEPTH_KEYS.items():
            layer.bind_key(key, lambda _, steps=steps: self._push(steps))
        for key, callback in self._listener.keys.items():
            layer.bind_key(key, lambda _, callback=callback: callback())
        layer.bind_key("Space", self._on_space)
        layer.events.mode.connect(self._on_mode)
        self._layers.add(layer)
        # Otherwise vispy builds a shader program in each update, which takes longer than drawing.
        compile_once(drawn_node(self._viewer, layer))
        outline_arrows(self._viewer, layer)

    def _equip(self, layer: Any) -> None:
        """Configure the mouse and the cursor for drawing.

        napari resets the mouse and the cursor when the layer is added and when its mode changes.
        """
        layer.mouse_pan = False
        self.update_wheel()
        self.show_cursor(self._circle)

    def _on_mode(self, *_: Any) -> None:
        self.update_wheel()
        if self.layer is not None and self._layer.mode == "pan_zoom":
            self._equip(self._layer)

    def _on_space(self, layer: Any) -> Iterator[None]:
        """Move the view with the mouse while Space is pressed, as in napari's own tools."""
        layer.mouse_pan = layer.mouse_zoom = True
        yield
        layer.mouse_pan = False
        self.update_wheel()

    def _on_move(self, layer: Any, event: Any) -> None:
        self._stop_turning(layer)
        is_flat = len(event.dims_displayed) == 2
        if is_flat and not layer.mouse_pan and self._listener.takes_wheel_at():
            self.update_wheel(self._pixel(layer, event))

    def _on_wheel(self, layer: Any, event: Any) -> None:
        """Move dragged tissue in depth, or pass a turn of the wheel to the listener.

        Otherwise napari zooms.
        """
        if len(event.dims_displayed) == 3:
            self._push(float(event.delta[1]))
            return
        point = self._pixel(layer, event)
        if not (layer.mouse_zoom or event.modifiers or point is None):
            self._listener.turn_wheel(point, float(event.delta[1]))

    def _on_drag(self, layer: Any, event: Any) -> Iterator[None]:
        self._stop_turning(layer)
        draws = layer.mode == "pan_zoom" and not layer.mouse_pan
        if not draws or event.button != 1 or "Alt" in event.modifiers or self._frame is None:
            return
        if len(event.dims_displayed) == 3 and not self._grab(layer, event):
            yield from self._turn_view(layer, event)
            return
        point = self._point(layer, event)
        if point is None:
            return
        if "Shift" in event.modifiers:
            self._deep = None
            self._listener.pick(point, self._reach(layer, event))
            return
        self._listener.press(point, self._reach(layer, event))
        self._suspend_status()
        yield
        # vispy drops a move that closely follows another move, so the release counts as a move.
        while True:
            point = self._point(layer, event)
            if point is not None:
                self._listener.move(point)
            if event.type != "mouse_move":
                break
            yield
        self._listener.release()

    def _suspend_status(self) -> None:
        """Suspend the updates of the status bar until the drag ends."""
        # At every cursor move, a napari thread reads the values under the cursor and blocks the
        # GUI thread. To show the values, napari recomputes the layout of the whole window. These
        # updates can be disabled only permanently and for all viewers.
        cursor = self._viewer.cursor
        self._drag.callback(lambda: cursor.events.position(value=cursor.position))
        self._drag.enter_context(cursor.events.position.blocker())

    # Drags in the 3-D view

    def _grab(self, layer: Any, event: Any) -> bool:
        """Begin a drag at the tissue or mark under the mouse; return whether there is any."""
        line, begin = self._line(layer, event), None
        if line is not None:
            picks = "Shift" in event.modifiers
            begin = self._listener.find(line, self._reach(layer, event), picks)
        self._deep = None if line is None or begin is None else DepthDrag(begin, line)
        if self._deep is not None:
            # The wheel moves tissue during the drag, instead of zooming.
            layer.mouse_zoom = False
            self._drag.callback(setattr, layer, "mouse_zoom", True)
        return self._deep is not None

    def _turn_view(self, layer: Any, event: Any) -> Iterator[None]:
        """Turn the view with the mouse, because there is nothing to grab."""
        layer.mouse_pan = self._turns = True
        yield
        while event.type == "mouse_move":
            yield

    def _stop_turning(self, layer: Any, *_: Any) -> None:
        """Use the mouse for drawing again, at the first event after the view was turned."""
        # At the release of the mouse, vispy's camera must still receive the event.
        if self._turns:
            layer.mouse_pan = self._turns = False

    def _push(self, steps: float) -> None:
        """Move dragged tissue away from the camera by a number of voxels."""
        if self._deep is not None and not self._listener.follows_surface:
            self._deep.push(steps)
            self._listener.move(self._deep.point)

    def _line(self, layer: Any, event: Any) -> LineOfSight | None:
        assert self._frame is not None
        return LineOfSight.of(event, layer, self._frame, View.of(self._viewer.dims))

    def _point(self, layer: Any, event: Any) -> Point | None:
        """Return the position of the mouse in pixels of the image or volume, or None."""
        deep = self._deep
        if deep is None:
            return self._pixel(layer, event)
        if event.type == "mouse_press":
            return deep.begin
        line = self._line(layer, event)
        if line is None:
            return None
        deep.line = line
        return self._listener.find(line) if self._listener.follows_surface else deep.point

    def _pixel(self, layer: Any, event: Any) -> Point | None:
        """Return the position of the mouse in image pixels, or None in 3D display."""
        flat = len(event.dims_displayed) == 2 and self._viewer.dims.ndisplay == 2
        if self._frame is None or not flat:
            return None
        at = View.of(self._viewer.dims).pixel(layer, event.position)
        return tuple(at[list(self._frame.plane)].tolist())

    def _reach(self, layer: Any, event: Any) -> float:
        """Return the largest distance that counts as a hit, in the unit of the spacing."""
        assert self._frame is not None
        if (line := self._line(layer, event)) is not None:
            return float(_NEAR / event.camera_zoom * line.unit)
        start = np.asarray(event.position, dtype=float)
        end = start.copy()
        end[list(event.dims_displayed)[-1]] += _NEAR / event.camera_zoom
        view = View.of(self._viewer.dims)
        difference = view.pixel(layer, end) - view.pixel(layer, start)
        return math.hypot(*(difference[list(self._frame.plane)] * self._frame.spacing))

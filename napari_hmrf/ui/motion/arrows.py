"""The layer *Motion*: shows what is drawn, and feels the mouse and the keys while it is active."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, nullcontext
from typing import Any

import numpy as np
from napari.layers import Layer

from napari_hmrf.field.frame import Frame
from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.layers.arrow_layer import arrow_layer, arrow_lines
from napari_hmrf.layers.compat import compile_once, drawn_node, thin_thumbnail
from napari_hmrf.layers.metadata import add_known
from napari_hmrf.layers.slice_view import View, plane_shown
from napari_hmrf.layers.viewer_layers import overwrite, same_selection, still_there
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.drawing.marks import Point

#: How near the pointer must be to the end of an arrow, in pixels of the screen.
_NEAR = 8.0


class ArrowsLayer:
    """A Vectors layer of the viewer, made when it is first needed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    told : Pointer
        Who is told what the mouse and the keys do.
    """

    def __init__(self, viewer: Any, told: Any) -> None:
        self._viewer = viewer
        self._told = told
        self._layer: Any = None
        self._frame: Frame | None = None
        self._radius = 1.0
        # What is to be done when the drag is over.
        self._drag = ExitStack()

    @property
    def layer(self) -> Any:
        """The layer, if it is in the viewer."""
        return still_there(self._viewer, self._layer)

    @property
    def former(self) -> Any:
        """The layer, whether or not it still is in the viewer."""
        return self._layer

    @property
    def active(self) -> bool:
        """Whether the layer is the one that feels the mouse, in two dimensions."""
        layer = self.layer
        flat = self._viewer.dims.ndisplay == 2
        return flat and layer is not None and self._viewer.layers.selection.active is layer

    def take(self, frame: Frame, shape: tuple[int, ...], radius: float) -> None:
        """Have the layer lie on a slice, on top and active."""
        if self.layer is None:
            self._add(frame, shape)
        self.place(frame, shape)
        layers = self._viewer.layers
        self.raise_up()
        self._layer.visible = True
        layers.selection = {self._layer}
        self._radius = radius
        self._equip(self._layer)

    def raise_up(self) -> None:
        """Have the layer lie on top, if there is a layer."""
        layers, layer = self._viewer.layers, self.layer
        if layer is not None and layers[-1] is not layer:
            layers.move(layers.index(layer), len(layers))

    def place(self, frame: Frame, shape: tuple[int, ...], drawn: bool = False) -> None:
        """Have the layer lie on another slice, if there is a layer, or something drawn to show."""
        layer = self.layer
        if (layer is None and not drawn) or frame == self._frame:
            return
        if layer is None or layer.ndim != frame.ndim:
            active = self.active
            with same_selection(self._viewer):
                self._add(frame, shape)
            if active:
                self._viewer.layers.selection = {self._layer}
            self._equip(self._layer)
            return
        for name, value in frame.placement().items():
            setattr(layer, name, value)
        add_known(layer, slice=frame.slice_name)
        self._frame = frame

    def show(
        self,
        drawing: Drawing,
        selected: int | None,
        below: Iterable[Lines] = (),
        quick: bool = False,
    ) -> None:
        """Draw the arrows, and more lines below them.

        With `quick` more will follow soon, and only the canvas counts.
        """
        layer, frame = self.layer, self._frame
        if layer is None or frame is None:
            return
        is_volume, view = len(frame.plane) == 3, View.of(self._viewer.dims)
        across = plane_shown(frame, view)[0] if is_volume else 0
        own = arrow_lines(drawing, frame.spacing, selected, across)
        lines, colours = map(np.concatenate, zip(*below, own, strict=True))
        placed = frame.put_vectors(lines)
        same = np.array_equal(layer.edge_color, colours)
        if quick and same and len(lines) and overwrite(self._viewer, layer, placed):
            return
        layer.data = placed
        # Of a drag only the first move changes colours; to set them takes as long as the lines.
        if len(lines) and not same:
            # Of a hidden layer napari has not yet looked which lines there are to be coloured.
            with nullcontext() if layer.visible else layer.events.edge_color.blocker():
                layer.edge_color = colours

    def keep(self, drawing: Drawing) -> None:
        """Keep the drawing with the layer."""
        if self.layer is not None:
            add_known(self._layer, drawing=drawing.as_dict())

    def show_radius(self, radius: float) -> None:
        """Have the pointer be as large as the patch that would be taken hold of."""
        self._radius = radius
        layer, frame = self.layer, self._frame
        if layer is not None and frame is not None:
            # One pixel along the layer's last axis, in lengths of the world.
            step = float(np.linalg.norm(np.array(frame.matrix)[:-1, -2]))
            layer.cursor_size = 2 * radius * step / frame.spacing[-1]
            layer.cursor = "circle"

    def hide_circle(self) -> None:
        """Show no circle around the pointer until the drag is over.

        napari paints the whole canvas for every step of it; and what is held has an outline, and
        what is painted its colour.
        """
        if self.layer is not None:
            self._layer.cursor = "pointing"
            self._drag.callback(lambda: self.show_radius(self._radius))

    def end_drag(self) -> None:
        """Whatever drag goes on is over."""
        self._drag.close()

    def remove(self) -> None:
        """Take the layer out of the viewer."""
        if self.layer is not None:
            self._viewer.layers.remove(self._layer)
        self._layer = self._frame = None

    def _add(self, frame: Frame, shape: tuple[int, ...]) -> None:
        """Add the layer, in place of the one that there was."""
        self.remove()
        layer = self._layer = Layer.create(*arrow_layer(frame, shape))
        self._frame = frame
        # Drawing the thumbnail of every line would take longer than all the rest.
        thin_thumbnail(layer, 8)
        layer.mouse_drag_callbacks.append(self._on_drag)
        for key, answer in self._told.keys.items():
            layer.bind_key(key, lambda _, answer=answer: answer())
        layer.bind_key("Space", self._on_space)
        layer.events.mode.connect(self._on_mode)
        self._viewer.add_layer(layer)
        # Else more than all the rest of drawing a canvas goes into a program for each update.
        compile_once(drawn_node(self._viewer, layer))

    def _equip(self, layer: Any) -> None:
        """Have napari's own mode look like ours; it sets all this when a layer is added, too."""
        layer.mouse_pan = False
        self.show_radius(self._radius)

    def _on_mode(self, *_: Any) -> None:
        if self.layer is not None and self._layer.mode == "pan_zoom":
            self._equip(self._layer)

    def _on_space(self, layer: Any) -> Iterator[None]:
        """While Space is held the mouse moves the view, as in napari's own tools."""
        layer.mouse_pan = True
        yield
        layer.mouse_pan = False

    def _on_drag(self, layer: Any, event: Any) -> Iterator[None]:
        draws = layer.mode == "pan_zoom" and not layer.mouse_pan
        point = self._pixel(layer, event)
        if not draws or event.button != 1 or "Alt" in event.modifiers or point is None:
            return
        if "Shift" in event.modifiers:
            self._told.pick(point, self._reach(layer, event))
            return
        self._told.press(point, self._reach(layer, event))
        self._hush()
        yield
        # The release is a move, too: vispy drops moves that follow another closely.
        while True:
            point = self._pixel(layer, event)
            if point is not None:
                self._told.move(point)
            if event.type != "mouse_move":
                break
            yield
        self._told.release()

    def _hush(self) -> None:
        """Have the status bar stay as it is until the drag is over."""
        # For every step of the cursor a thread of napari's reads what is below it, which takes
        # Python from the window's thread, and the whole window is put together anew to show it.
        # napari can stop that for all viewers and for good only.
        cursor = self._viewer.cursor
        self._drag.callback(lambda: cursor.events.position(value=cursor.position))
        self._drag.enter_context(cursor.events.position.blocker())

    def _pixel(self, layer: Any, event: Any) -> Point | None:
        """Where the mouse is, in pixels of what is drawn on; None in three dimensions."""
        flat = len(event.dims_displayed) == 2 and self._viewer.dims.ndisplay == 2
        if self._frame is None or not flat:
            return None
        at = View.of(self._viewer.dims).pixel(layer, event.position)
        return tuple(at[list(self._frame.plane)].tolist())

    def _reach(self, layer: Any, event: Any) -> float:
        """How near an arrow's end is near enough, in the unit of the spacing."""
        assert self._frame is not None
        here = np.asarray(event.position, dtype=float)
        there = here.copy()
        there[list(event.dims_displayed)[-1]] += _NEAR / event.camera_zoom
        view = View.of(self._viewer.dims)
        apart = view.pixel(layer, there) - view.pixel(layer, here)
        return math.hypot(*(apart[list(self._frame.plane)] * self._frame.spacing))

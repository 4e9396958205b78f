"""Layers that show a drawing and the deformed image."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.field.volume_preview import CutPlane
from napari_hmrf.layers.compat import fade
from napari_hmrf.layers.image_choice import image_covering
from napari_hmrf.layers.image_result import CONFIDENCE, PAINTED, Result, ResultLayers
from napari_hmrf.layers.line_of_sight import LineOfSight, cut_of
from napari_hmrf.layers.paint_layer import confidence_layer, number_of, painted_layer, way_of
from napari_hmrf.layers.painted_overlay import painted_confidence
from napari_hmrf.layers.result_layers import CompleteResult, Kind, LayerData, picture_layer
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.viewer_layers import shared, still_there
from napari_hmrf.layers.volume_look import VolumeLook
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.session import Session
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import box_of, covered
from napari_hmrf.tissue.drawing.marks import Point
from napari_hmrf.ui.events import EventConnections, single_shot
from napari_hmrf.ui.motion.arrows import ArrowsLayer, CanvasListener

#: Longest time that a brush stroke waits for the updated tissue, in milliseconds. Painting both
#: together saves a repaint.
_AHEAD = 80
#: Share of the opacity of marks while the mouse is outside the canvas.
_FADED = 0.2


class Display:
    """View of the drawing on a slice of an image, and of the resulting deformation.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    session : Session
        Session with the selected slice and its drawing.
    listener : CanvasListener
        Receiver of the mouse and key events.

    Attributes
    ----------
    arrows : ArrowsLayer
    moved : Deformation or None
        Visible deformation.
    tissues : dict of int to colour
        Colours of the paintable tissues, by label.
    quiet : bool
        True while the program itself adds or removes layers.
    """

    def __init__(
        self, native: Any, viewer: Any, session: Session, listener: CanvasListener
    ) -> None:
        self.arrows = ArrowsLayer(viewer, listener)
        self.moved: Deformation | None = None
        # Paint, deformed with the tissue, and the current stroke, which is drawn on top.
        self._painted: npt.NDArray[np.uint8] | None = None
        self._stroke: Stroke | None = None
        self._shows_confidence = False
        self.tissues: dict[int, Any] = {}
        self._viewer, self._session = viewer, session
        self._results = shared(viewer, ResultLayers)
        # Displayed image, and whether it is a private copy with newer slices.
        self._whole: Any = None
        self._is_copy = False
        self.quiet = False
        self._volume_look = VolumeLook(viewer)
        self._stroke_timer = single_shot(native, _AHEAD, self._show_stroke)
        self._is_faded = False
        self._events = EventConnections((viewer.events.mouse_over_canvas, self._on_mouse))

    @property
    def result(self) -> Result | None:
        """Result layers of the visible slice, or None."""
        moved, source = self.moved, self._source
        if moved is None or source is None:
            return None
        return self._results.at(source, moved.study.grid.known_place.slice_name)

    @property
    def _source(self) -> Any:
        """Layer that is deformed, or None."""
        return self._session.slice.layer

    def close_slice(self) -> None:
        """Remove what is shown of the selected slice, except a result."""
        self._stroke_timer.stop()
        result, moved = self.result, self.moved
        self._volume_look.release()
        self.moved = self._painted = self._stroke = self._whole = None
        self._is_copy = False
        with self.program_changes():
            if result is not None and moved is not None:
                result.drop_paint()
                if moved.ground is not None and not moved.moves:
                    result.remove()  # the displayed image is undeformed

    def open_slice(self, study: Study) -> None:
        """Show the slice that was selected, in its undeformed state."""
        place, self._whole = study.grid.known_place, study.pictures.image
        self.moved = Deformation(study, image=study.pictures.image)
        with self.program_changes():
            self.arrows.place(place, study.grid.shape, bool(self._session.drawing.marks))
            self._results.show_extent(self._source, place)

    @property
    def covering(self) -> Any:
        """Other image layer that covers this result at the cursor, or None."""
        image, result = still_there(self._viewer, self._source), self.result
        picture = None if result is None else result.layer("image")
        lowest = picture if picture is not None and picture.visible else image
        place = [self._viewer.cursor.position]
        return None if lowest is None else image_covering(self._viewer, lowest, place)

    # Visible tissue in a 3-D view

    @property
    def visible_image(self) -> Any:
        """Layer of the deformed image if it is visible, else the chosen image, or None."""
        image, result = still_there(self._viewer, self._source), self.result
        picture = None if result is None else result.layer("image")
        return picture if picture is not None and picture.visible else image

    @property
    def cut(self) -> CutPlane | None:
        """Plane that the image is cut by in a 3-D view; None if the whole volume is visible."""
        moved, layer = self.moved, self.visible_image
        if moved is None or layer is None:
            return None
        return cut_of(layer, moved.study.grid.known_place, View.of(self._viewer.dims))

    @property
    def hides_inside(self) -> bool:
        """True if the 3-D view shows a surface or a cut plane, behind which nothing is seen."""
        layer = self.visible_image
        return layer is not None and (self.cut is not None or str(layer.rendering) == "iso")

    def tissue_on(self, line: LineOfSight) -> Point | None:
        """Return the point where a line of sight meets visible tissue, or None.

        This is a point of the cut plane if there is one, else the first tissue from the camera.
        """
        moved, layer, cut = self.moved, self.visible_image, self.cut
        if moved is None or layer is None:
            return None
        return moved.first_tissue(line.visible_points(layer, cut, moved.study.grid.shape))

    def show(self, moved: Deformation, stroke: Stroke | None) -> None:
        """Show a new state of the tissue, with the stroke that is being painted."""
        result, picture = self.result, self._picture_of(moved)
        self.moved = moved
        self._take_paint(moved, stroke)
        with self.program_changes():
            # Also show undeformed tissue, so that the image layer exists before the first motion.
            if picture is not None and (moved.moves or self.arrows.active):
                study = moved.study
                run = {"prior": study.prior.parameters, "optimizer": study.optimizer.parameters}
                made = picture_layer(study.grid.known_place, study.pictures, picture, run)
                made = _spread(made, moved)
                self._show_result({"image": made}, moving=moved.solution is not None)
            elif not moved.moves and result is not None:
                # Hide, rather than remove, the layers: napari 0.7 can crash if no lines are left.
                self._show_result({}, moving=False)
            else:
                self._show_painting()

    def discard(self, still: Deformation) -> None:
        """Show undeformed tissue, and remove the layers of unfinished work without a result."""
        result = self.result
        self.moved = still
        self._picture_of(still)
        with self.program_changes():
            if result is not None:
                result.drop("image")
            self._show_result({}, moving=False)

    def _picture_of(self, moved: Deformation) -> Any:
        """Return the deformed image.

        In a volume, a preview replaces only one slice or cut, or it is the whole coarse volume. The
        preview of a large image has fewer, larger pixels.
        """
        preview = moved.preview
        if _pixel_of(moved) > 1:
            return moved.image
        if preview is None or (preview.axis is None and preview.cut is None):
            self._whole, self._is_copy = moved.image, False
        elif moved.image is not None:
            if not self._is_copy:
                self._whole, self._is_copy = np.array(self._whole), True
            if preview.axis is not None:
                np.moveaxis(self._whole, preview.axis, 0)[preview.number] = moved.image
            elif preview.cut is not None:
                voxels = preview.cut.voxels(self._whole.shape[:3])
                self._whole[tuple(voxels.T)] = moved.image
        return self._whole

    def finish(self, done: CompleteResult | None) -> None:
        """Show all layers of a complete result, or only the undeformed image if `done` is None."""
        before = self.moved
        assert before is not None
        image = before.study.pictures.image
        layers = {} if done is None else done.outputs.layers
        still = replace(before, solution=None, image=image, overlay=(), lines=None, preview=None)
        self.moved = still if done is None else done.moved
        self._picture_of(self.moved)
        with self.program_changes():
            self._show_result(layers)
            self.arrows.raise_up()

    def _show_result(self, layers: Mapping[Kind, LayerData], moving: bool = False) -> None:
        """Show the layers of the result together with the paint."""
        moved, result = self.moved, self.result
        assert moved is not None
        place, shown = moved.study.grid.known_place, dict[Any, LayerData](layers)
        confidence = painted_confidence(moved)
        if confidence is not None and self._shows_confidence:
            shown[CONFIDENCE] = confidence_layer(place, confidence)
        if (picture := self._picture()) is not None:
            shown[PAINTED] = painted_layer(place, picture, self.tissues)
        if result is not None:
            result.drop_paint(besides=shown)
        self._results.show(self._source, place, shown, moving=moving)
        self._fade(self._is_faded)  # the layers may be new
        is_volume = result is not None and len(place.plane) == 3
        picture_shown = result.layer("image") if is_volume and result is not None else None
        self._volume_look.link(self._source, picture_shown)

    def show_confidence(self, is_shown: bool) -> None:
        """Show the painted confidence, or remove its picture."""
        before, self._shows_confidence = self._shows_confidence, is_shown
        result, moved = self.result, self.moved
        if is_shown == before or result is None or moved is None:
            return
        with self.program_changes():
            if not is_shown:
                result.drop(CONFIDENCE)
            elif (confidence := painted_confidence(moved)) is not None:
                place = moved.study.grid.known_place
                result.put(CONFIDENCE, confidence_layer(place, confidence), show=False)
        self._fade(self._is_faded)  # the layer may be new

    def show_painted(self, moved: Deformation) -> None:
        """Show the paint of a deformation."""
        self._take_paint(moved, None)
        with self.program_changes():
            self._show_painting()

    def _take_paint(self, moved: Deformation, stroke: Stroke | None) -> None:
        self._stroke_timer.stop()
        if moved.preview is None:  # a preview does not change the paint
            self._painted = None if moved.lines is None else moved.overlay[0]
        self._stroke = stroke

    def _picture(self) -> npt.NDArray[np.uint8] | None:
        """Return the paint and the current stroke, deformed with the tissue."""
        moved, stroke, painted = self.moved, self._stroke, self._painted
        if moved is None or stroke is None:
            return painted
        grid = moved.study.grid
        lines = (moved.moved_positions(np.array(line)).tolist() for line in stroke.lines)
        deformed = replace(stroke, lines=tuple(tuple(map(tuple, line)) for line in lines))
        picture = np.zeros(grid.shape, np.uint8) if painted is None else painted.copy()
        box = box_of(deformed, grid.spacing, tuple(slice(0, size) for size in grid.shape))
        number = number_of(stroke.action, stroke.label)
        picture[box][covered(deformed, grid.spacing, box)] = number
        return picture

    def _show_painting(self) -> None:
        result, moved, picture = self.result, self.moved, self._picture()
        if result is None or moved is None:
            return
        if picture is None:
            result.drop(PAINTED)
        else:
            place = moved.study.grid.known_place
            result.put(PAINTED, painted_layer(place, picture, self.tissues), show=False)
        self._fade(self._is_faded)  # the layer may be new

    def show_stroke(self, stroke: Stroke, at_once: bool) -> None:
        """Show the stroke that is being painted, immediately or after a short delay."""
        self._stroke = stroke
        if at_once:
            self._show_stroke()
        elif not self._stroke_timer.isActive():
            self._stroke_timer.start()

    def _show_stroke(self) -> None:
        self._stroke_timer.stop()
        with self.program_changes():
            self._show_painting()

    def draw(self, drawing: Drawing, selected: int | None, is_dragging: bool) -> None:
        """Show the arrows, landmarks and paint marks; during a drag, update only the canvas."""
        below: list[Lines] = []
        moved, mark = self.moved, None if selected is None else drawing.marks[selected]
        if moved is not None and moved.lines is not None:
            below.append(moved.lines)
        if isinstance(mark, Stroke) and not is_dragging and moved and moved.ground:
            # Removed tissue does not move, while tissue at the edge of its paint does.
            is_void = mark.action == "remove"
            goes_to = np.asarray if is_void else moved.moved_positions
            below.append(way_of(mark, moved.study.grid.spacing, goes_to))
        self.arrows.show(drawing, selected, below, quick=is_dragging)
        self._fade(self._is_faded)  # the layer may be new

    def release(self) -> None:
        """Disconnect from the viewer, whose window may be deleted."""
        self._events.release()

    def _on_mouse(self, *_: object) -> None:
        """Fade the marks when the mouse leaves the canvas, so that the result is visible."""
        self._fade(not self._viewer.mouse_over_canvas)

    def _fade(self, is_faded: bool) -> None:
        before, self._is_faded = self._is_faded, is_faded
        if not (before or is_faded):
            return
        result = self.result
        parts = () if result is None else (result.layer(part) for part in (PAINTED, CONFIDENCE))
        for layer in (self.arrows.layer, *parts):
            if layer is not None:
                fade(self._viewer, layer, _FADED if is_faded else 1.0)

    def leave(self) -> None:
        """Remove the arrow layer, which no longer responds to the mouse."""
        self._fade(False)
        self._volume_look.release()
        with self.program_changes():
            self.arrows.remove()

    @contextmanager
    def program_changes(self) -> Iterator[None]:
        """Set `quiet` to True inside the block, while the program changes layers."""
        before, self.quiet = self.quiet, True
        try:
            yield
        finally:
            self.quiet = before


def _pixel_of(moved: Deformation) -> int:
    """Return the distance of neighbouring pixels of the deformed image, in pixels of the image."""
    preview = moved.preview
    if preview is None or preview.axis is not None or preview.cut is not None:
        return 1
    return preview.pixel if len(moved.study.grid.shape) == 2 else preview.grid.step


def _spread(made: LayerData, moved: Deformation) -> LayerData:
    """Return the layer of a coarse picture with pixels as far apart as in the image."""
    if (pixel := _pixel_of(moved)) == 1:
        return made
    scale, plane = np.array(made.attributes["scale"]), moved.study.grid.known_place.plane
    scale[list(plane)] *= pixel
    return made._replace(attributes={**made.attributes, "scale": scale})

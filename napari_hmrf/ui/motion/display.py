"""The layers that show a drawing, and the picture that has moved as it says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.layers.image_choice import image_covering
from napari_hmrf.layers.image_result import CONFIDENCE, PAINTED, Result, ResultLayers
from napari_hmrf.layers.paint_layer import confidence_layer, number_of, painted_layer, way_of
from napari_hmrf.layers.result_layers import Kind, LayerData, picture_layer
from napari_hmrf.layers.viewer_layers import shared, still_there
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import box_of, covered
from napari_hmrf.ui.events import single_shot
from napari_hmrf.ui.follower import Done, Seen
from napari_hmrf.ui.motion.arrows import ArrowsLayer
from napari_hmrf.ui.motion.hands import Hand

#: Touches of the brush are shown with the tissue that follows them, one painting rather than two;
#: if that takes longer than so many milliseconds, they go ahead.
_AHEAD = 80


class Display:
    """Shows what is drawn on a slice of an image, and what comes of it.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    told : Pointer
        Who is told what the mouse and the keys do.

    Attributes
    ----------
    arrows : ArrowsLayer
    seen : Seen or None
        The tissue as it is seen.
    tissues : dict of int to colour
        Of the tissues that can be painted.
    quiet : bool
        Whether layers come and go by our own doing.
    """

    def __init__(self, native: Any, viewer: Any, told: Any) -> None:
        self.arrows = ArrowsLayer(viewer, told)
        self.seen: Seen | None = None
        # What was painted, as it has moved, and what is being painted, which lies on top.
        self._painted: npt.NDArray[np.uint8] | None = None
        self._stroke: Stroke | None = None
        self.tissues: dict[int, Any] = {}
        self._viewer = viewer
        self._results = shared(viewer, ResultLayers)
        self._image: Any = None
        # The image as it was seen last, and whether it is our own copy, put together of slices.
        self._whole: Any = None
        self._pieced = False
        self.quiet = False
        self._stroke_waits = single_shot(native, _AHEAD, self._show_stroke)

    @property
    def moved(self) -> Deformation | None:
        """The tissue as it is seen."""
        return None if self.seen is None else self.seen.moved

    @property
    def result(self) -> Result | None:
        """The layers of the result of what is shown."""
        moved = self.moved
        if moved is None or self._image is None:
            return None
        return self._results.at(self._image, moved.study.grid.known_place.slice_name)

    def stand_on(self, study: Study | None, image: Any, drawn: bool) -> None:
        """Go over to another slice, of which nothing has moved yet; or to none."""
        self._stroke_waits.stop()
        before, moved = self.result, self.moved
        self._image = image
        self.seen = self._painted = self._stroke = None
        self._whole, self._pieced = None if study is None else study.pictures.image, False
        with self.own_doing():
            if before is not None and moved is not None:
                before.drop_paint()
                if moved.ground is not None and not moved.moves:
                    before.remove()  # its picture is shown although nothing has moved
            if study is not None:
                self.seen = Seen(Deformation(study, image=study.pictures.image))
                self.arrows.place(study.grid.known_place, study.grid.shape, drawn)
                self._results.stand_on(image, study.grid.known_place)

    @property
    def covering(self) -> Any:
        """The image of somebody else's that hides the place the mouse is at; else None."""
        image, result = still_there(self._viewer, self._image), self.result
        picture = None if result is None else result.layer("image")
        lowest = picture if picture is not None and picture.visible else image
        place = [self._viewer.cursor.position]
        return None if lowest is None else image_covering(self._viewer, lowest, place)

    def show(self, seen: Seen, hand: Hand) -> None:
        """Show another state of the tissue."""
        moved, result = seen.moved, self.result
        picture = self._picture_of(moved)
        self.seen = seen
        self._take_paint(seen, hand)
        with self.own_doing():
            # What has not moved yet is shown, too, so that the first movement finds its layer.
            if picture is not None and (moved.moves or self.arrows.active):
                study = moved.study
                run = {"prior": study.prior.parameters, "optimizer": study.optimizer.parameters}
                made = picture_layer(study.grid.known_place, study.pictures, picture, run)
                self._show_result({"image": made}, moving=moved.solution is not None)
            elif not moved.moves and result is not None:
                # Hidden, not removed: where no lines are left napari 0.7 can end the program.
                self._show_result({}, moving=False)
            else:
                self._show_painting()

    def _picture_of(self, moved: Deformation) -> Any:
        """The image as it has moved; of a volume a slice may be newer than the rest of it."""
        if moved.glance is None or moved.glance.axis is None:
            self._whole, self._pieced = moved.image, False
        elif moved.image is not None:
            if not self._pieced:
                self._whole, self._pieced = np.array(self._whole), True
            np.moveaxis(self._whole, moved.glance.axis, 0)[moved.glance.number] = moved.image
        return self._whole

    def finish(self, done: Done | None) -> None:
        """Show all layers of a state that has come to rest; None: the image as it was alone."""
        seen = self.seen
        assert seen is not None
        image, layers = seen.moved.study.pictures.image, {} if done is None else done.outputs.layers
        still = replace(seen.moved, solution=None, image=image, overlay=(), glance=None)
        moved = still if done is None else done.moved
        self.seen = Seen(moved, seen.marks if moved.overlay else None)
        self._picture_of(moved)
        with self.own_doing():
            self._show_result(layers)
            self.arrows.raise_up()

    def _show_result(self, layers: Mapping[Kind, LayerData], moving: bool = False) -> None:
        """Show layers of the result, with what was painted."""
        seen, result = self.seen, self.result
        assert seen is not None
        place, shown = seen.moved.study.grid.known_place, dict[Any, LayerData](layers)
        if seen.confidence is not None:
            shown[CONFIDENCE] = confidence_layer(place, seen.confidence)
        if (picture := self._picture()) is not None:
            shown[PAINTED] = painted_layer(place, picture, self.tissues)
        if result is not None:
            result.drop_paint(besides=shown)
        self._results.show(self._image, place, shown, moving=moving)

    def show_painted(self, seen: Seen, hand: Hand) -> None:
        """Show what is painted."""
        self._take_paint(seen, hand)
        with self.own_doing():
            self._show_painting()

    def _take_paint(self, seen: Seen, hand: Hand) -> None:
        self._stroke_waits.stop()
        if seen.moved.glance is None:  # else it stays as it was until all has followed
            self._painted = None if seen.marks is None else seen.moved.overlay[0]
        self._stroke = hand.mark if hand.holding and isinstance(hand.mark, Stroke) else None

    def _picture(self) -> npt.NDArray[np.uint8] | None:
        """What was painted and what is being painted, where it is seen."""
        moved, stroke, painted = self.moved, self._stroke, self._painted
        if moved is None or stroke is None:
            return painted
        grid = moved.study.grid
        lines = (moved.goes_to(np.array(line)).tolist() for line in stroke.lines)
        seen = replace(stroke, lines=tuple(tuple(map(tuple, line)) for line in lines))
        picture = np.zeros(grid.shape, np.uint8) if painted is None else painted.copy()
        box = box_of(seen, grid.spacing, tuple(slice(0, size) for size in grid.shape))
        number = number_of(stroke.action, stroke.label)
        picture[box][covered(seen, grid.spacing, box)] = number
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

    def touch(self, hand: Hand, first: bool) -> None:
        """Show where the brush is: at once if it was put down, else as soon as that is worth it."""
        self._stroke = hand.mark if isinstance(hand.mark, Stroke) else None
        if first:
            self._show_stroke()
        elif not self._stroke_waits.isActive():
            self._stroke_waits.start()

    def _show_stroke(self) -> None:
        self._stroke_waits.stop()
        with self.own_doing():
            self._show_painting()

    def draw(self, drawing: Drawing, hand: Hand) -> None:
        """Show arrows, landmarks, and the marks of what is painted."""
        below: list[Lines] = []
        seen, stroke = self.seen, hand.mark
        if seen is not None and seen.marks is not None:
            below.append(seen.marks)
        if isinstance(stroke, Stroke) and not hand.holding and seen and seen.moved.ground:
            below.append(way_of(stroke, seen.moved.study.grid.spacing, seen.moved.goes_to))
        self.arrows.show(drawing, hand.selected, below, quick=hand.holding)

    def leave(self) -> None:
        """Take away what nobody answers any more."""
        with self.own_doing():
            self.arrows.remove()

    @contextmanager
    def own_doing(self) -> Iterator[None]:
        """Layers that come and go meanwhile do so by our own doing."""
        before, self.quiet = self.quiet, True
        try:
            yield
        finally:
            self.quiet = before

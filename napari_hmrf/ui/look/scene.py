"""The result in the viewer: what the parts of *Look at the result* do to its layers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from napari.layers import Labels

from napari_hmrf.errors import HmrfError
from napari_hmrf.field.deformation import magnitude
from napari_hmrf.layers.animation import Moment, Motion
from napari_hmrf.layers.image_result import Part
from napari_hmrf.layers.result_lookup import (
    FoundResult,
    picture_of,
    result_of,
    slices_apart,
    source_of,
    tissue_of,
)
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.tissue_point import Points
from napari_hmrf.layers.viewer_results import ResultLayers
from napari_hmrf.ui.look.arrow_choices import ArrowChoices
from napari_hmrf.ui.look.cursor import UnderCursor
from napari_hmrf.ui.look.errands import Errands
from napari_hmrf.ui.look.layer_choices import LayerChoices
from napari_hmrf.ui.look.look_form import LookFace
from napari_hmrf.ui.look.look_layers import LookedAt
from napari_hmrf.ui.look.look_messages import (
    FULL,
    NO_IMAGE,
    NOTHING,
    POINT,
    SAVING,
    colour_choices,
    folded,
    how_far,
    saved,
)
from napari_hmrf.ui.look.look_work import figures_of, unmoved
from napari_hmrf.ui.look.player import Player
from napari_hmrf.ui.look.saving import new_folder, save_canvas
from napari_hmrf.ui.timers import single_shot

#: What takes the pixels of a moment.
_MOVING: tuple[Part, ...] = ("image", "labels", "colours")
#: Between drawing pictures and drawing lines, in milliseconds: napari paints meanwhile.
_TURN = 10


class Scene:
    """Does what the widget is asked for, and says what came of it.

    Parameters
    ----------
    widget : Container
        The dock widget.
    viewer : napari.Viewer or ViewerModel
    face : LookFace
    results : ResultLayers
        Of the viewer.
    """

    def __init__(self, widget: Any, viewer: Any, face: LookFace, results: ResultLayers) -> None:
        self._viewer = viewer
        self._face = face
        self.words = ""
        self._errands = Errands(widget.native, self._refuse)
        self._results = results
        self.shown = LookedAt()
        self.player = Player(widget.native, self._errands, self._draw)
        self.cursor = UnderCursor(
            viewer, lambda line: face.point.say(line or POINT), lambda: int(face.slider.value)
        )
        self._arrows = ArrowChoices(face, self.shown, self._errands)
        self._layers = LayerChoices(face, self.shown, self._errands, self.cursor, self._moves_anew)
        self._longest = 0.0
        self._drawn: tuple[int, Moment] | None = None
        # Lines take napari as long as the image: each has a turn of its own.
        self._lines = single_shot(widget.native, _TURN, self._draw_lines)

    @property
    def busy(self) -> bool:
        """Whether something that was asked for is not seen yet."""
        return self._errands.busy() or self._lines.isActive()

    @property
    def outdated(self) -> bool:
        """Whether the layer holds another result by now."""
        arrows, result = self.shown.layer("arrows"), self.shown.result
        now = None if arrows is None else result_of(arrows)
        solution = None if result is None else result.solution
        return (None if now is None else now.solution) is not solution

    @property
    def before(self) -> bool:
        """Whether the image is seen as it was; never without a result."""
        return self.shown.layers is not None and self.shown.layers.is_before

    @before.setter
    def before(self, hold: bool) -> None:
        layers = self.shown.layers
        if layers is not None and hold:
            layers.hold_before(self.shown.source)
        elif layers is not None:
            layers.release()

    def take(self, arrows: Any, chosen: bool = False) -> None:
        """Look at another result, or at the same layer with another result in it.

        Parameters
        ----------
        arrows : napari.layers.Vectors, optional
            The layer that holds it.
        chosen : bool
            Whether somebody wants to see it, whichever is seen now.
        """
        face, shown = self._face, self.shown
        layers = None if arrows is None else self._results.of(arrows)
        other = layers is not shown.layers
        drawn = other and bool(face.grid.value)
        self.put_back()
        if other and shown.layers is not None:
            shown.layers.leave()
        self.cursor.coloured = None
        result = None if arrows is None else result_of(arrows)
        shown.layers, shown.result = layers, result
        for part in face.of_result:
            part.enabled = result is not None
        self.cursor.watch(None, None, None, self._fraction)
        self.words = ""
        if result is None or layers is None:
            shown.layers = None
            face.image.reset_choices()
            self.player.motion = None
            face.how_far.say("")
            face.energy.show_solution(None)
            return
        with face.image.changed.blocked():
            face.image.reset_choices()
            if face.image.value is None or face.image.value.name != result.source:
                face.image.value = source_of(self._viewer.layers, result)
        with face.colours.changed.blocked():
            quantity = face.colours.value
            face.colours.choices = colour_choices(
                result.unit, Directions.of(result.frame, self._viewer)
            )
            face.colours.value = quantity
        self._longest = float(magnitude(result.solution.displacement).max(initial=0.0))
        face.energy.show_solution(result.solution)
        if chosen:
            layers.bring()
        self._take_layers(result, drawn)
        self._errands.send(
            "points", partial(Points, result.solution), partial(self._on_points, arrows, result)
        )

    def _take_layers(self, result: FoundResult, drawn: bool) -> None:
        """Let the parts of the widget say what the layers are, and the layers what it says."""
        face, shown = self._face, self.shown
        self.look_at_eyes()
        if drawn:  # as that of the result before
            with face.grid.changed.blocked():
                face.grid.value = True
        self.say_where()
        self.prepare()
        self._arrows.apply()
        if face.colours.value != NOTHING:
            self._layers.make_colours(result, face.colours.value)
        grid = shown.layer("grid")
        if face.grid.value and (grid is None or not grid.visible):
            self._layers.make_grid(result)

    def look_at_eyes(self) -> None:
        """Let the boxes say which layers are seen, whoever has hidden or shown them."""
        face, shown = self._face, self.shown
        if shown.layers is None or self.before:
            return
        with face.grid.changed.blocked(), face.arrows.changed.blocked():
            if not self._errands.busy("grid"):  # else there is one soon
                face.grid.value = shown.layers.wants("grid")
            face.arrows.value = shown.layers.wants("arrows")

    def prepare(self) -> None:
        """Collect what moves: copies of what is chosen now."""
        result, shown, face = self.shown.result, self.shown, self._face
        if result is None:
            self.player.motion = None
            return
        shown.source = face.image.value
        image = labels = None
        try:
            if shown.source is not None:
                image = picture_of(shown.source, result)
            tissue = tissue_of(self._viewer.layers, result)
            if isinstance(tissue, Labels) and shown.layer("labels") is not None:
                labels = picture_of(tissue, result)
        except HmrfError as error:
            self._refuse(error)
        self.cursor.stiffness_from(tissue_of(self._viewer.layers, result), result)
        seen = self.cursor.coloured
        colours = None if seen is None else seen[1]
        self.player.motion = Motion(result.solution, image, labels, colours, bool(face.grid.value))

    def ready_to_move(self) -> bool:
        """Have a layer that can be moved; whether there is one."""
        shown, layers = self.shown, self.shown.layers
        if self.player.motion is None or layers is None:
            return False
        if self.player.motion.grid != self._face.grid.value:  # its eye was opened or closed since
            self.prepare()
        motion = self.player.motion
        layers.bring()
        if motion.image is not None:
            image = shown.layer("image")
            if image is None or (layers.is_added("image") and not image.visible):
                image = self._make_image()
            image.visible = True
        return any(shown.layer(part) is not None for part in (*_MOVING, "grid"))

    def go(self, percent: int) -> None:
        """Show so much of the deformation."""
        self._say_how_far(percent)
        self.player.show(percent)

    def put_back(self) -> None:
        """Leave the layers as they were before they were moved."""
        self.player.stop()
        self._errands.forget()
        if self.shown.layers is not None:
            self.shown.layers.release()
            self.shown.layers.show_whole()
        self._draw_whole()

    def interrupt(self) -> None:
        """What was moved is all there again, by another's doing."""
        if self.player.playing or self._errands.busy("moment") or self._face.slider.value != FULL:
            self.player.stop()
            self._errands.forget("moment")
            self._draw_whole()

    def rest(self) -> None:
        """Touch nothing any more, until a result is taken again."""
        self.put_back()
        self.cursor.watch(None, None, None, self._fraction)
        self.shown.layers = self.shown.result = None

    def release(self) -> None:
        """The window is gone."""
        self._errands.forget()
        self.cursor.release()

    def save(self, folder: Path, done: Callable[[Any], None], own_folder: bool = False) -> None:
        """Write pictures of what is seen, and of the result."""
        result, face = self.shown.result, self._face
        if result is None:
            return
        try:
            if own_folder:
                folder = new_folder(folder, f"{result.source or 'result'} pictures")
            written = save_canvas(self._viewer, folder / "canvas.png")
        except OSError as error:
            self._refuse(error)
            return
        motion, percent = self.player.motion, face.slider.value
        image = None if motion is None else motion.image
        work = partial(figures_of, result, image, folder)

        def tell(paths: list[Path]) -> None:
            face.status.say(saved(written, paths, percent))
            done([*written, *paths])

        face.status.say(SAVING)
        self._errands.send("pictures", work, tell)

    # Answers of the compute thread

    def _on_points(self, arrows: Any, result: FoundResult, points: Points) -> None:
        self.cursor.watch(arrows, result, points, self._fraction)
        if points.folds:
            self.words = folded(points.folds)
        elif self._face.image.value is None:
            self.words = NO_IMAGE
        self._face.status.say(self.words)

    def _draw(self, percent: int, moment: Moment) -> None:
        result, layers = self.shown.result, self.shown.layers
        if result is None or layers is None:
            return
        moved = {part: getattr(moment, part) for part in _MOVING}
        place = result.frame.put_image
        parts = {part: place(data) for part, data in moved.items() if data is not None}
        layers.show_part(percent, parts)
        self._drawn = percent, moment
        self._lines.start()

    def _draw_lines(self) -> None:
        if self._drawn is not None:
            percent, moment = self._drawn
            self._arrows.show(percent)
            result, layers = self.shown.result, self.shown.layers
            if result is not None and layers is not None and moment.grid is not None:
                layers.show_part(percent, {"grid": result.frame.put_vectors(moment.grid)})

    def _draw_whole(self) -> None:
        """Arrows of the whole deformation, and no lines of what was seen before."""
        self._lines.stop()
        self._drawn = None
        self._arrows.show_whole()
        self._set_slider(FULL)

    # What is shown

    def _moves_anew(self, now: bool) -> None:
        """Other layers move from now on."""
        self.prepare()
        if now:
            self.player.show(self._face.slider.value)

    def _make_image(self) -> Any:
        result, layers, source, motion = (
            self.shown.result,
            self.shown.layers,
            self.shown.source,
            self.player.motion,
        )
        assert result is not None
        assert layers is not None
        assert motion is not None
        assert motion.image is not None
        return layers.put("image", unmoved(result, source, motion.image), source)

    def _fraction(self) -> float:
        return 0.0 if self.shown.layers is None else self.shown.layers.percent / FULL

    def _set_slider(self, percent: int) -> None:
        with self._face.slider.changed.blocked():
            self._face.slider.value = percent
        self.player.expect(percent)
        self._say_how_far(percent)

    def say_where(self) -> None:
        """Say whether it is the slice of the result that is shown."""
        self._say_how_far(self._face.slider.value)

    def _say_how_far(self, percent: int) -> None:
        result, view = self.shown.result, View.of(self._viewer.dims)
        if result is not None:
            apart = slices_apart(self.shown.layer("arrows"), result, view)
            self._face.how_far.say(how_far(result, self._longest, percent, apart))

    def _refuse(self, error: Exception) -> None:
        self._face.status.say(str(error) or type(error).__name__)

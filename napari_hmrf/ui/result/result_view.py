"""The result in the viewer: which one is looked at, how much of it is seen, and how."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from napari.utils.key_bindings import coerce_keybinding
from psygnal import Signal
from qtpy.QtWidgets import QFileDialog

from napari_hmrf.field.deformation import magnitude
from napari_hmrf.layers.image_result import Result
from napari_hmrf.layers.result_lookup import (
    FoundResult,
    can_be_source,
    result_of,
    slices_apart,
    source_of,
)
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.tissue_point import Points
from napari_hmrf.layers.viewer_results import ResultLayers
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.result.arrow_choices import ArrowChoices
from napari_hmrf.ui.result.cursor import UnderCursor
from napari_hmrf.ui.result.errands import Errands
from napari_hmrf.ui.result.layer_choices import LayerChoices
from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.moving_layers import MovingLayers
from napari_hmrf.ui.result.player import Player
from napari_hmrf.ui.result.result_form import BEFORE_KEY, PAUSE, PLAY, ResultForm
from napari_hmrf.ui.result.result_messages import (
    FULL,
    LOST,
    NO_IMAGE,
    NO_RESULT,
    NOTHING,
    POINT,
    SAVING,
    colour_choices,
    how_far,
    saved,
)
from napari_hmrf.ui.result.result_work import figures_of
from napari_hmrf.ui.timers import single_shot

_BEFORE = coerce_keybinding(BEFORE_KEY)


class ResultView:
    """Does to the layers of a result what its form is asked for.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    form : ResultForm
    results : ResultLayers
        Of the viewer.
    """

    #: What there is to say.
    said = Signal(str)
    #: Pictures are written: a list of `Path`.
    saved = Signal(object)

    def __init__(
        self,
        native: Any,
        viewer: Any,
        form: ResultForm,
        results: ResultLayers,
    ) -> None:
        self._native, self._viewer, self._form = native, viewer, form
        self._errands = Errands(native, self._refuse)
        self._results = results
        self.shown = LookedAt()
        self.cursor = UnderCursor(
            viewer, lambda line: form.point.say(line or POINT), lambda: int(form.slider.value)
        )
        self._arrows = ArrowChoices(form, self.shown)
        self._moving = MovingLayers(
            native, viewer, self.shown, self.cursor, self._arrows, self._refuse
        )
        self.player = Player(native, self._errands, self._moving.draw)
        self._layers = LayerChoices(form, self.shown, self._errands, self.cursor, self._moves_anew)
        self._longest = 0.0
        self._followed: Any = None
        self._grid: Any = None
        self._heard = Listening()
        # A layer is known to be the grid of a result only after it has come.
        self._eyes = single_shot(native, 0, self._on_eye)
        form.result.changed.connect(lambda _: self._take(chosen=True))
        form.slider.changed.connect(self._on_slider)
        form.play.changed.connect(self._on_play)
        form.save.changed.connect(self._on_save)
        form.before.native.pressed.connect(partial(setattr, self, "before", True))
        form.before.native.released.connect(partial(setattr, self, "before", False))
        self.player.moved.connect(self._on_moved)
        self.player.playing_changed.connect(
            lambda playing: setattr(form.play, "text", PAUSE if playing else PLAY)
        )
        self._events = Listening(
            (viewer.layers.events.inserted, self._on_inserted),
            (viewer.layers.events.removed, self._on_layers),
            (viewer.layers.events.renamed, self._on_layers),
            (viewer.dims.events.current_step, self._say_where),
            (viewer.dims.events.order, self._say_where),
            (results.changed, self._on_changed),
        )
        if not any(key == _BEFORE for key in getattr(viewer, "keymap", {})):
            viewer.bind_key(BEFORE_KEY, self._while_key_is_held)
        self._choose(seen=True)
        self._take()

    # What there is

    @property
    def busy(self) -> bool:
        """Whether something that was asked for is not seen yet."""
        return self._errands.busy() or self._moving.busy or self._eyes.isActive()

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

    @property
    def _outdated(self) -> bool:
        """Whether the layer holds another result by now."""
        arrows, result = self.shown.layer("arrows"), self.shown.result
        now = None if arrows is None else result_of(arrows)
        return (None if now is None else now.solution) is not (
            None if result is None else result.solution
        )

    # What can be done

    def play(self) -> None:
        """Go back and forth between 0 and 100 % until `player.stop`."""
        if self.shown.result is None:
            self.said.emit(NO_RESULT)
        elif self._ready_to_move():
            self.player.play()
        else:
            self.said.emit(NO_IMAGE)

    def save(self, folder: Path, own_folder: bool = False) -> None:
        """Write pictures of the result, perhaps into a new folder; then `saved` is emitted."""
        result = self.shown.result
        if result is None:
            self.said.emit(NO_RESULT)
            return
        image = None if self.player.motion is None else self.player.motion.image
        self.said.emit(SAVING)
        work = partial(figures_of, result, image, folder, own_folder)
        self._errands.send("pictures", work, self._on_saved)

    def rest(self) -> None:
        """Leave the layers as they were before they were moved."""
        if self._while_key_is_held in getattr(self._viewer, "keymap", {}).values():
            self._viewer.bind_key(BEFORE_KEY, None)
        self._put_back()

    def release(self) -> None:
        """Listen no more."""
        self._follow(None, None)
        self._events.release()
        self._errands.forget()
        self.cursor.release()

    # Which result is looked at

    def _choose(self, seen: bool = False) -> None:
        """Choose the newest result, or the newest of those that are seen."""
        offered = self._form.result.offered
        if seen:
            offered = [each for each in offered if self._results.of(each).visible] or offered
        if offered and offered[-1] is not self._form.result.value:
            with self._form.result.changed.blocked():
                self._form.result.value = offered[-1]
            self._take()

    def _take(self, chosen: bool = False) -> None:
        """Look at the result that is chosen, as it is now; `chosen`: somebody wants to see it."""
        form, shown, arrows = self._form, self.shown, self._form.result.value
        gone = self._followed
        lost = arrows is None and gone is not None and gone not in self._viewer.layers
        lost = lost and not (shown.layers is not None and shown.layers.leaving)
        if lost and shown.result is not None and shown.source in self._viewer.layers:
            self.said.emit(LOST.format(layer=gone.name))
        layers = None if arrows is None else self._results.of(arrows)
        other = layers is not shown.layers
        drawn = (other or self._errands.busy("grid")) and bool(form.grid.value)
        self._put_back()
        if other and shown.layers is not None:
            shown.layers.leave()
        self.cursor.coloured = None
        result = None if arrows is None else result_of(arrows)
        shown.layers, shown.result = (None if result is None else layers), result
        form.result.visible = len(form.result.offered) > 1
        for part in form.of_result:
            part.enabled = result is not None
        self.cursor.watch(None, None, None, self._fraction)
        if result is None or layers is None:
            self.player.motion = None
            form.how_far.say("")
            form.point.say(POINT)
        else:
            self._show_result(result, layers, drawn, chosen)
            work = partial(Points, result.solution)
            self._errands.send("points", work, partial(self._on_points, arrows, result))
        self._follow(arrows, shown.layer("grid"))

    def _show_result(self, result: FoundResult, layers: Result, drawn: bool, chosen: bool) -> None:
        """Let the form say what the layers are, and the layers what it says."""
        form = self._form
        self.shown.source = source_of(self._viewer.layers, result)
        with form.colours.changed.blocked():
            quantity = form.colours.value
            ways = Directions.of(result.frame, self._viewer)
            form.colours.choices = colour_choices(result.unit, ways)
            form.colours.value = quantity
        self._longest = float(magnitude(result.solution.displacement).max(initial=0.0))
        if chosen:
            layers.release()
        self._look_at_eyes()
        if drawn:  # as that of the result before
            with form.grid.changed.blocked():
                form.grid.value = True
        self._say_where()
        self._prepare()
        if form.colours.value != NOTHING:
            self._layers.make_colours(result, form.colours.value)
        grid = self.shown.layer("grid")
        if form.grid.value and (grid is None or not grid.visible):
            self._layers.make_grid(result)

    def _follow(self, arrows: Any, grid: Any) -> None:
        """Hear of the arrows that are looked at and of their grid, and of no others."""
        if arrows is self._followed and grid is self._grid:
            return
        self._heard.release()
        self._followed, self._grid = arrows, grid
        there = [each for each in (arrows, grid) if each is not None]
        self._heard = Listening(*((each.events.visible, self._on_eye) for each in there))

    def _on_changed(self, result: Result) -> None:
        """What is seen in a place is another result, or none."""
        if result is not self.shown.layers:
            if (arrows := result.layer("arrows")) is not None and arrows.visible:
                with self._form.result.changed.blocked():
                    self._form.result.value = arrows
                self._take()
        elif not result.moving and self._outdated:
            self._take()
        else:
            self._interrupt()

    def _on_eye(self, *_: Any) -> None:
        self._follow(self._followed, self.shown.layer("grid"))
        self._look_at_eyes()

    def _on_inserted(self, event: Any) -> None:
        result, source = self.shown.result, self.shown.source
        if result_of(event.value) is not None:
            self._form.result.reset_choices()
            self._choose()
        elif source not in self._viewer.layers and _may_move(event.value, result):
            self._take()
        self._on_layers()

    def _on_layers(self, *_: Any) -> None:
        self._form.result.reset_choices()
        self._form.result.visible = len(self._form.result.offered) > 1
        self._eyes.start()

    # How much is seen

    def _look_at_eyes(self) -> None:
        """Let the boxes say which layers are seen, whoever has hidden or shown them."""
        form, shown = self._form, self.shown
        if shown.layers is None or self.before:
            return
        with form.grid.changed.blocked(), form.arrows.changed.blocked():
            if not self._errands.busy("grid"):  # else there is one soon
                form.grid.value = shown.layers.wants("grid")
            form.arrows.value = shown.layers.wants("arrows")

    def _prepare(self) -> None:
        """Collect what moves: copies of what is there now."""
        self.player.motion = self._moving.motion(bool(self._form.grid.value))

    def _ready_to_move(self) -> bool:
        """Have a layer that can be moved; whether there is one."""
        if self.player.motion is None:
            return False
        if self.player.motion.grid != self._form.grid.value:  # its eye was opened or closed since
            self._prepare()
        return self._moving.ready(self.player.motion)

    def _go(self, percent: int) -> None:
        """Show so much of the deformation."""
        self._say_how_far(percent)
        self.player.show(percent)

    def _put_back(self) -> None:
        """Leave the layers as they were before they were moved."""
        self.player.stop()
        self._errands.forget()
        if self.shown.layers is not None:
            self.shown.layers.release()
            self.shown.layers.show_whole()
        self._draw_whole()

    def _interrupt(self) -> None:
        """What was moved is all there again, by another's doing."""
        moving = self.player.playing or self._errands.busy("moment")
        if moving or self._form.slider.value != FULL:
            self.player.stop()
            self._errands.forget("moment")
            self._draw_whole()

    def _moves_anew(self, now: bool) -> None:
        """Other layers move from now on."""
        self._prepare()
        if now:
            self.player.show(self._form.slider.value)

    def _on_points(self, arrows: Any, result: FoundResult, points: Points) -> None:
        self.cursor.watch(arrows, result, points, self._fraction)

    def _draw_whole(self) -> None:
        """Arrows of the whole deformation, and no lines of what was seen before."""
        self._moving.draw_whole()
        self._set_slider(FULL)

    def _fraction(self) -> float:
        return 0.0 if self.shown.layers is None else self.shown.layers.percent / FULL

    def _set_slider(self, percent: int) -> None:
        with self._form.slider.changed.blocked():
            self._form.slider.value = percent
        self.player.expect(percent)
        self._say_how_far(percent)

    def _say_where(self, *_: Any) -> None:
        """Say whether it is the slice of the result that is shown."""
        self._say_how_far(self._form.slider.value)

    def _say_how_far(self, percent: int) -> None:
        result, view = self.shown.result, View.of(self._viewer.dims)
        arrows = self.shown.layer("arrows")
        if result is not None:
            apart = None if arrows is None else slices_apart(arrows, result, view)
            self._form.how_far.say(how_far(result, self._longest, percent, apart))

    # What is pressed

    def _on_slider(self, percent: int) -> None:
        if self.shown.result is not None:
            self.player.stop()
            if self._ready_to_move():
                self._go(percent)
            else:
                self.said.emit(NO_IMAGE)

    def _on_moved(self, percent: int) -> None:
        with self._form.slider.changed.blocked():
            self._form.slider.value = percent
        self._go(percent)

    def _on_play(self, *_: Any) -> None:
        if self.player.playing:
            self.player.stop()
        else:
            self.play()

    def _on_save(self, *_: Any) -> None:
        title = "Where to make a folder of pictures"
        chosen = QFileDialog.getExistingDirectory(self._native, title)
        if chosen:
            self.save(Path(chosen), own_folder=True)

    def _on_saved(self, paths: list[Path]) -> None:
        self.said.emit(saved(paths))
        self.saved.emit(paths)

    def _while_key_is_held(self, _: Any) -> Any:
        self.before = True
        yield
        self.before = False

    def _refuse(self, error: Exception) -> None:
        self.said.emit(str(error) or type(error).__name__)


def _may_move(layer: Any, result: FoundResult | None) -> bool:
    """Whether a layer may be the image that a result was made from: of a file, or opened again."""
    return result is not None and can_be_source(layer, result)

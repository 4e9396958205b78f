"""The result in the viewer: which one is looked at, how much of it is seen, and how."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from napari.utils.key_bindings import coerce_keybinding
from psygnal import Signal
from qtpy.QtWidgets import QFileDialog

from napari_hmrf.field.deformation import magnitude
from napari_hmrf.layers.image_result import Result, ResultLayers
from napari_hmrf.layers.metadata import known_of
from napari_hmrf.layers.overlay import Name, Overlay, overlay_of
from napari_hmrf.layers.result_lookup import (
    FoundResult,
    can_be_source,
    result_of,
    slices_apart,
    source_of,
    tissue_of,
)
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.tissue_point import Points
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.result.arrow_choices import ArrowChoices
from napari_hmrf.ui.result.cursor import UnderCursor
from napari_hmrf.ui.result.errands import Errands
from napari_hmrf.ui.result.looked_at import LookedAt
from napari_hmrf.ui.result.moving_layers import MovingLayers
from napari_hmrf.ui.result.player import Player
from napari_hmrf.ui.result.result_form import BEFORE_KEY, PAUSE, PLAY, ResultForm
from napari_hmrf.ui.result.result_messages import (
    FULL,
    LACKING,
    LOST,
    NO_IMAGE,
    NO_RESULT,
    NOTHING,
    POINT,
    SAVING,
    how_far,
    overlay_choices,
    saved,
)
from napari_hmrf.ui.result.result_work import figures_of

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
            viewer,
            self.shown,
            lambda line: form.point.say(line or POINT),
            lambda: int(form.slider.value),
        )
        self._arrows = ArrowChoices(form, self.shown)
        self._moving = MovingLayers(native, self.shown, self._arrows, self._refuse)
        self.player = Player(native, self._errands, self._moving.draw)
        self._longest = 0.0
        self._followed: Any = None
        self._heard = Listening()
        form.result.changed.connect(lambda _: self._take(chosen=True))
        form.slider.changed.connect(self._on_slider)
        form.overlay.changed.connect(lambda _: self._lay_over(chosen=True))
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
            (viewer.layers.events.removed, self._on_removed),
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
        return self._errands.busy() or self._moving.busy

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
        self._follow(None)
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
        self._put_back()
        if other and shown.layers is not None:
            shown.layers.leave()
        self.cursor.watch(None)
        result = None if arrows is None else result_of(arrows)
        shown.layers, shown.result = (None if result is None else layers), result
        shown.overlay = None
        form.result.visible = len(form.result.offered) > 1
        for part in form.of_result:
            part.enabled = result is not None
        if result is None or layers is None:
            self.player.motion = None
            form.how_far.say("")
            form.point.say(POINT)
        else:
            self._show_result(result, layers, other, chosen)
            self._errands.send("points", partial(Points, result.solution), self.cursor.watch)
        self._follow(arrows)

    def _show_result(self, result: FoundResult, layers: Result, other: bool, chosen: bool) -> None:
        """Let the form say what the layers are, and the layers what it says."""
        form = self._form
        self.shown.source = source_of(self._viewer.layers, result)
        there = layers.layer("overlay")
        with form.overlay.changed.blocked():
            name = form.overlay.value
            if name == NOTHING and there is not None and there.visible:
                name = known_of(there)["kind"]  # of a dock that was closed
            ways = Directions.of(result.frame, self._viewer)
            form.overlay.choices = overlay_choices(result.unit, ways)
            form.overlay.value = name
        self._longest = float(magnitude(result.solution.displacement).max(initial=0.0))
        if chosen:
            layers.release()
        self._on_eye()
        self._say_where()
        self.player.motion = self._moving.motion()
        self.cursor.stiffness_from(tissue_of(self._viewer.layers, result), result)
        if form.overlay.value != NOTHING:
            self._lay_over(chosen=other)

    def _follow(self, arrows: Any) -> None:
        """Hear of the eye of the arrows that are looked at, and of no others."""
        if arrows is not self._followed:
            self._heard.release()
            self._followed = arrows
            eyes = [] if arrows is None else [(arrows.events.visible, self._on_eye)]
            self._heard = Listening(*eyes)

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
        """Let the box say whether arrows are seen, whoever has hidden or shown them."""
        layers = self.shown.layers
        if layers is not None and not self.before:
            with self._form.arrows.changed.blocked():
                self._form.arrows.value = layers.wants("arrows")

    def _on_inserted(self, event: Any) -> None:
        result, source = self.shown.result, self.shown.source
        if result_of(event.value) is not None:
            self._form.result.reset_choices()
            self._choose()
        elif source not in self._viewer.layers and _may_move(event.value, result):
            self._take()
        self._on_layers()

    def _on_removed(self, event: Any) -> None:
        layers = self.shown.layers
        if layers is not None and not layers.leaving and layers.part_of(event.value) == "overlay":
            self._form.overlay.value = NOTHING
        self._on_layers()

    def _on_layers(self, *_: Any) -> None:
        self._form.result.reset_choices()
        self._form.result.visible = len(self._form.result.offered) > 1

    # What lies over the image

    def _lay_over(self, chosen: bool) -> None:
        """Have what is chosen lie over the image; `chosen`: just now, so that it is to be seen."""
        result, layers, name = self.shown.result, self.shown.layers, self._form.overlay.value
        if result is None or layers is None:
            return
        if name == NOTHING:
            self._errands.forget("overlay")
            layers.drop("overlay")
            self._move_with(None)
        else:
            answer = partial(self._show_overlay, result, name, chosen)
            self._errands.send("overlay", partial(overlay_of, result, name), answer)

    def _show_overlay(
        self, result: FoundResult, name: Name, chosen: bool, made: Overlay | None
    ) -> None:
        layers, percent = self.shown.layers, self._form.slider.value
        if result is not self.shown.result or layers is None:
            return
        if made is None:
            layers.drop("overlay")
            if chosen:
                self.said.emit(LACKING[name])
        else:
            layers.put("overlay", made.layer, self.shown.source, chosen)
        self._move_with(made)
        if percent != FULL:
            self.player.show(percent)

    def _move_with(self, overlay: Overlay | None) -> None:
        """Have an overlay move with the tissue from now on."""
        self.shown.overlay, motion = overlay, self.player.motion
        if motion is not None:
            picture, grid = (overlay.picture, overlay.name == "grid") if overlay else (None, False)
            self.player.motion = replace(motion, overlay=picture, grid=grid)

    # How much is seen

    def _ready_to_move(self) -> bool:
        """Have a layer that can be moved; whether there is one."""
        return self.player.motion is not None and self._moving.ready(self.player.motion)

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

    def _draw_whole(self) -> None:
        """Arrows of the whole deformation, and no lines of what was seen before."""
        self._moving.draw_whole()
        self._set_slider(FULL)

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

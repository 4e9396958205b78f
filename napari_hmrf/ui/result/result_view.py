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
from napari_hmrf.field.tissue_point import Points
from napari_hmrf.layers.image_result import Result, ResultLayers
from napari_hmrf.layers.metadata import known_of
from napari_hmrf.layers.overlay import Name, Overlay, overlay_of
from napari_hmrf.layers.result_layers import Answer
from napari_hmrf.layers.result_lookup import (
    can_be_source,
    result_of,
    slices_apart,
    source_of,
)
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View
from napari_hmrf.ui.events import Listening
from napari_hmrf.ui.handover import Errands
from napari_hmrf.ui.result import result_messages as words
from napari_hmrf.ui.result.cursor import UnderCursor
from napari_hmrf.ui.result.moving_layers import LookedAt, MovingLayers
from napari_hmrf.ui.result.player import Player
from napari_hmrf.ui.result.result_form import BEFORE_KEY, PAUSE, PLAY, ResultForm

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

    Attributes
    ----------
    arrows : napari.layers.Vectors or None
        Which hold the result that is looked at: the newest, or those that are selected.
    """

    #: What there is to say.
    said = Signal(str)
    #: Pictures are written: a list of `Path`.
    saved = Signal(object)

    def __init__(self, native: Any, viewer: Any, form: ResultForm, results: ResultLayers) -> None:
        self._native, self._viewer, self._form, self._results = native, viewer, form, results
        self._errands = Errands(self._refuse)
        self.shown = LookedAt()
        self.cursor = UnderCursor(viewer, self.shown)
        self._moving = MovingLayers(native, self.shown, self._refuse)
        self.player = Player(native, self._errands, self._moving.draw)
        self._longest = 0.0
        self._arrows: Any = None
        self._heard = Listening()
        form.slider.changed.connect(self._on_slider)
        form.overlay.changed.connect(lambda _: self._lay_over(chosen=True))
        form.arrows.changed.connect(self._on_ticked)
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
            (viewer.layers.selection.events.active, self._on_active),
            (viewer.dims.events.current_step, self._say_how_far),
            (viewer.dims.events.order, self._say_how_far),
            (results.changed, self._on_changed),
        )
        if not any(key == _BEFORE for key in getattr(viewer, "keymap", {})):
            viewer.bind_key(BEFORE_KEY, self._while_key_is_held)
        found = [layer for layer in viewer.layers if result_of(layer) is not None]
        seen = [layer for layer in found if results.of(layer).visible]
        self._look_at(next(reversed(seen or found), None))

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
    def arrows(self) -> Any:
        """Which hold the result that is looked at."""
        return self._arrows

    @arrows.setter
    def arrows(self, arrows: Any) -> None:
        self._look_at(arrows)

    # What can be done

    def play(self) -> None:
        """Go back and forth between 0 and 100 % until `player.stop`."""
        if self._can_move():
            self.player.play()

    def save(self, folder: Path, own_folder: bool = False) -> None:
        """Write pictures of the result, perhaps into a new folder; then `saved` is emitted."""
        result = self.shown.result
        if result is None:
            self.said.emit(words.NO_RESULT)
            return
        image = None if self.player.motion is None else self.player.motion.image
        self.said.emit(words.SAVING)
        work = partial(_figures_of, result, image, folder, own_folder)
        self._errands.send("pictures", work, self._on_saved)

    def rest(self) -> None:
        """Leave the layers as they were before they were moved."""
        if self._while_key_is_held in getattr(self._viewer, "keymap", {}).values():
            self._viewer.bind_key(BEFORE_KEY, None)
        self._put_back()

    def release(self) -> None:
        """Listen no more."""
        self._heard.release()
        self._events.release()
        self._errands.release()
        self.cursor.release()

    # Which result is looked at

    def _look_at(self, arrows: Any) -> None:
        """Look at the result that a layer of arrows holds, as it is now; None: at none."""
        form, shown = self._form, self.shown
        self._put_back()
        result = None if arrows is None else result_of(arrows)
        layers = None if result is None else self._results.of(arrows)
        other = layers is not shown.layers
        if other and shown.layers is not None:
            shown.layers.leave()
        shown.layers, shown.result, shown.overlay = layers, result, None
        self._arrows = None if result is None else arrows
        self._heard.release()
        self.cursor.watch(None)
        for part in form.of_result:
            part.enabled = result is not None
        if result is None or layers is None:
            self.player.motion = None
            form.how_far.say("")
            return
        self._heard = Listening((arrows.events.visible, self._on_eye))
        self._show_result(result, layers, other)
        self._errands.send("points", partial(Points, result.solution), self.cursor.watch)

    def _show_result(self, result: Answer, layers: Result, other: bool) -> None:
        """Let the form say what the layers are, and the layers what it says."""
        form = self._form
        self.shown.source = source_of(self._viewer.layers, result)
        there = layers.layer("overlay")
        with form.overlay.changed.blocked():
            name = form.overlay.value
            if name == words.NOTHING and there is not None and there.visible:
                name = known_of(there)["kind"]  # of a dock that was closed
            ways = Directions.of(result.frame, self._viewer)
            form.overlay.choices = words.overlay_choices(result.unit, ways)
            form.overlay.value = name
        self._longest = float(magnitude(result.solution.displacement).max(initial=0.0))
        self._on_eye()
        self._say_how_far()
        self.player.motion = self._moving.motion()
        if form.overlay.value != words.NOTHING:
            self._lay_over(chosen=other)

    def _on_changed(self, result: Result) -> None:
        """What is seen in a place is another result, or none."""
        arrows = result.layer("arrows")
        if result is not self.shown.layers:
            if arrows is not None and arrows.visible:
                self._look_at(arrows)
        elif not result.moving and self._is_other(arrows):
            self._look_at(arrows)
        else:
            self._interrupt()

    def _is_other(self, arrows: Any) -> bool:
        """Whether arrows hold another result by now than the one that is looked at."""
        now, before = None if arrows is None else result_of(arrows), self.shown.result
        return now is None or before is None or now.solution is not before.solution

    def _on_active(self, *_: Any) -> None:
        """Look at another result that is selected: of another image, slice or file."""
        active = self._viewer.layers.selection.active
        if active not in (None, self._arrows) and result_of(active) is not None:
            self._look_at(active)

    def _on_eye(self, *_: Any) -> None:
        """Let the box say whether arrows are seen, whoever has hidden or shown them."""
        layers = self.shown.layers
        if layers is not None:
            with self._form.arrows.changed.blocked():
                self._form.arrows.value = layers.wants("arrows")

    def _on_ticked(self, drawn: bool) -> None:
        if self.shown.layers is not None:
            self.shown.layers.want("arrows", drawn)

    def _on_inserted(self, event: Any) -> None:
        result, source = self.shown.result, self.shown.source
        if result_of(event.value) is not None:
            self._look_at(event.value)
        elif result is None or source in self._viewer.layers:
            return
        elif can_be_source(event.value, result):  # of a file, or opened again
            self._look_at(self._arrows)

    def _on_removed(self, event: Any) -> None:
        layers = self.shown.layers
        # What goes by our own doing is no part any more.
        part = None if layers is None else layers.part_of(event.value)
        if part == "overlay":
            self._form.overlay.value = words.NOTHING
        elif event.value is self._arrows:
            if part is not None and self.shown.source in self._viewer.layers:
                self.said.emit(words.LOST.format(layer=event.value.name))
            self._look_at(None)

    # What lies over the image

    def _lay_over(self, chosen: bool) -> None:
        """Have what is chosen lie over the image; `chosen`: just now, so that it is to be seen."""
        result, layers, name = self.shown.result, self.shown.layers, self._form.overlay.value
        if result is None or layers is None:
            return
        if name == words.NOTHING:
            self._errands.forget("overlay")
            layers.drop("overlay")
            self._move_with(None)
        else:
            answer = partial(self._show_overlay, result, name, chosen)
            self._errands.send("overlay", partial(overlay_of, result, name), answer)

    def _show_overlay(self, result: Answer, name: Name, chosen: bool, made: Overlay | None) -> None:
        layers, percent = self.shown.layers, self._form.slider.value
        if result is not self.shown.result or layers is None:
            return
        if made is None:
            layers.drop("overlay")
            if chosen:
                self.said.emit(words.LACKING[name])
        else:
            layers.put("overlay", made.layer, self.shown.source, chosen)
        self._move_with(made)
        if percent != words.FULL:
            self.player.show(percent)

    def _move_with(self, overlay: Overlay | None) -> None:
        """Have an overlay move with the tissue from now on."""
        self.shown.overlay, motion = overlay, self.player.motion
        if motion is not None:
            picture, grid = (overlay.picture, overlay.name == "grid") if overlay else (None, False)
            self.player.motion = replace(motion, overlay=picture, grid=grid)

    # How much is seen

    def _can_move(self) -> bool:
        """Have a layer that can be moved; whether there is one, or else why not is said."""
        motion = self.player.motion
        if self.shown.result is None:
            self.said.emit(words.NO_RESULT)
        elif motion is None or not self._moving.ready(motion):
            self.said.emit(words.NO_IMAGE)
        else:
            return True
        return False

    def _put_back(self) -> None:
        """Leave the layers as they were before they were moved."""
        self._errands.forget()
        if self.shown.layers is not None:
            self.shown.layers.release()
            self.shown.layers.show_whole()
        self._draw_whole()

    def _interrupt(self) -> None:
        """What was moved is all there again, by another's doing."""
        moving = self.player.playing or self._errands.busy("moment")
        if moving or self._form.slider.value != words.FULL:
            self._draw_whole()

    def _draw_whole(self) -> None:
        """Arrows of the whole deformation, and nothing of what was seen before."""
        self.player.stop()
        self._errands.forget("moment")
        self._moving.draw_whole()
        self.player.percent = words.FULL
        self._set_slider(words.FULL)

    def _set_slider(self, percent: int) -> None:
        with self._form.slider.changed.blocked():
            self._form.slider.value = percent
        self._say_how_far()

    def _say_how_far(self, *_: Any) -> None:
        """Say how much is seen, and whether it is the slice of the result that is shown."""
        shown, view = self.shown, View.of(self._viewer.dims)
        shown.percent, arrows = self._form.slider.value, shown.layer("arrows")
        if shown.result is not None:
            apart = None if arrows is None else slices_apart(arrows, shown.result, view)
            self._form.how_far.say(words.how_far(shown.result, self._longest, shown.percent, apart))

    # What is pressed

    def _on_slider(self, percent: int) -> None:
        self.player.stop()
        if self._can_move():
            self._on_moved(percent)

    def _on_moved(self, percent: int) -> None:
        self._set_slider(percent)
        self.player.show(percent)

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
        self.said.emit(words.saved(paths))
        self.saved.emit(paths)

    def _while_key_is_held(self, _: Any) -> Any:
        self.before = True
        yield
        self.before = False

    def _refuse(self, error: Exception) -> None:
        self.said.emit(str(error) or type(error).__name__)


def _figures_of(result: Answer, image: Any, folder: Path, own_folder: bool) -> list[Path]:
    """Write the figures of a result into a folder, or into a new one there."""
    from napari_hmrf.io.figures import save_result_pictures

    if own_folder:
        folder = _new_folder(folder, f"{result.source or 'result'} pictures")
    return save_result_pictures(folder, result.solution, image, result.unit)


def _new_folder(parent: Path, name: str) -> Path:
    """Make a folder of a name that is not taken, so that no file is replaced."""
    kept = "".join(letter if letter.isalnum() or letter in " -_." else "_" for letter in name)
    folder, number = parent / kept, 1
    while True:
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
            folder = parent / f"{kept} {number}"
        else:
            return folder

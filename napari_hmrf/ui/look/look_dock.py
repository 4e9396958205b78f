"""The dock widget *Look at the result*: the tissue on its way, and what happens to it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, get_args

from napari.utils.key_bindings import coerce_keybinding
from psygnal import Signal
from qtpy.QtWidgets import QFileDialog

from napari_hmrf.layers.image_result import Result
from napari_hmrf.layers.result_lookup import FoundResult, can_be_source, result_of
from napari_hmrf.layers.strain_layers import Quantity
from napari_hmrf.layers.tissue_point import Probe
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.forms import Part
from napari_hmrf.ui.look.look_form import BEFORE_KEY, PAUSE, PLAY, LookFace
from napari_hmrf.ui.look.look_messages import LOST, NO_CHOICE, NO_IMAGE, NO_RESULT, NOTHING, POINT
from napari_hmrf.ui.look.scene import Scene
from napari_hmrf.ui.timers import single_shot
from napari_hmrf.ui.viewer_dock import Dock

_BEFORE = coerce_keybinding(BEFORE_KEY)


class LookAtResult(Dock):
    """Go through a deformation, colour it by what it does to the tissue, and save pictures.

    Everything the user can do a script can do too: set `result`, `image`, `percent`, `before`,
    `colours`, `grid`, `arrows`, `arrow_count` and `arrow_length`; `play` and `stop`; `at` and
    `save_pictures`. What takes longer is computed on the compute thread: `idle` tells when it is
    done.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    result : napari.layers.Vectors or None
        The arrows that hold the result.
    image : napari.layers.Image or None
        What is moved.
    percent : int
        How much of the deformation is seen, from 0 to 100.
    playing : bool
        Whether it goes back and forth by itself.
    before : bool
        Whether the image is seen as it was, and nothing of the result.
    grid, arrows : bool
        Whether the deformation grid is drawn, and whether arrows are.
    arrow_count : int
        How many arrows are drawn, roughly.
    arrow_length : float
        How many times longer than true arrows are drawn.
    status : str
        The sentence at the bottom.
    point : str
        What is said of the tissue under the cursor.
    saved : Signal(object)
        Emitted when pictures are written: a list of `Path`.
    """

    result = Part[Any]("_face.result.value")
    image = Part[Any]("_face.image.value")
    percent = Part[int]("_face.slider.value")
    playing = Part[bool]("_scene.player.playing")
    before = Part[bool]("_scene.before")
    grid = Part[bool]("_face.grid.value")
    arrows = Part[bool]("_face.arrows.value")
    arrow_count = Part[int]("_face.count.value")
    arrow_length = Part[float]("_face.length.value")
    status = Part[str]("_face.status.value")
    point = Part[str]("_face.point.value")
    saved = Signal(object)

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self._taken: FoundResult | None = None
        self._face = LookFace(self, self._layers, self._is_result, self._is_source)
        self._scene = Scene(self, self._viewer, self._face, self._results)
        # A layer is known to be the grid of a result only after it has come.
        self._eyes = single_shot(self.native, 0, self._on_eye)
        self._followed: Any = None
        self._grid: Any = None
        self._heard = Listening()
        self._nothing = NO_RESULT
        self._connect()
        self._on_theme()
        self._choose(seen=True)
        if self.result is None:
            self._take()

    @property
    def idle(self) -> bool:
        """Whether all that was asked for is seen."""
        return not (self._eyes.isActive() or self._scene.busy)

    @property
    def colours(self) -> str:
        """What colours show: "nothing", "magnitude", "jacobian", "equivalent", ... (`Quantity`)."""
        return str(self._face.colours.value)

    @colours.setter
    def colours(self, quantity: str) -> None:
        known = (NOTHING, *get_args(Quantity))
        if quantity not in known:
            raise ValueError(f"there are no colours {quantity!r}; take one of {list(known)}")
        self._face.colours.value = quantity

    # What can be done

    def play(self) -> None:
        """Go back and forth between 0 and 100 % until `stop`."""
        if self.result is None:
            self._face.status.say(self._nothing)
        elif self._scene.ready_to_move():
            self._scene.player.play()
        else:
            self._face.status.say(NO_IMAGE)

    def stop(self) -> None:
        """Stay at what is seen."""
        self._scene.player.stop()

    def at(self, position: Any) -> Probe | None:
        """Say what happens to the tissue that is seen at a point of the world; None beside it."""
        return self._scene.cursor.at(position)[0]

    def save_pictures(self, folder: str | Path) -> None:
        """Write pictures into a folder that exists; `saved` is emitted when they are there."""
        self._scene.save(Path(folder), self.saved.emit)

    def _is_result(self, layer: Any) -> bool:
        return result_of(layer) is not None

    def _is_source(self, layer: Any) -> bool:
        return self._taken is not None and can_be_source(layer, self._taken)

    # What Qt and napari tell

    def _connect(self) -> None:
        face, viewer = self._face, self._viewer
        face.result.changed.connect(self._on_result)
        face.image.changed.connect(self._on_image)
        face.slider.changed.connect(self._on_slider)
        face.play.changed.connect(self._on_play)
        face.save.changed.connect(self._on_save)
        for signal, hold in (
            (face.before.native.pressed, True),
            (face.before.native.released, False),
        ):
            signal.connect(partial(setattr, self, "before", hold))
        self._scene.player.moved.connect(self._on_moved)
        self._scene.player.playing_changed.connect(self._on_playing)
        self._events = Listening(
            (viewer.layers.events.inserted, self._on_inserted),
            (viewer.layers.events.removed, self._on_layers),
            (viewer.layers.events.renamed, self._on_layers),
            (viewer.dims.events.current_step, self._on_slice),
            (viewer.dims.events.order, self._on_slice),
            (viewer.dims.events.ndisplay, self._on_slice),
            (viewer.events.theme, self._on_theme),
            (self._results.changed, self._on_changed),
        )
        self._bind_key()

    def _choose(self, seen: bool = False) -> None:
        """Look at the newest result, or at the newest of those that are seen."""
        self._face.result.reset_choices()
        offered = self._face.result.offered
        if seen:
            offered = [each for each in offered if self._results.of(each).visible] or offered
        if offered and offered[-1] is not self.result:
            with self._face.result.changed.blocked():
                self._face.result.value = offered[-1]
            self._take()

    def _on_result(self, *_: Any) -> None:
        self._take(chosen=True)

    def _take(self, chosen: bool = False) -> None:
        """Look at the result that is chosen, as it is now."""
        if self.away:
            return
        gone = self._followed
        self._nothing = NO_CHOICE if self._face.result.offered else NO_RESULT
        if self.result is None and gone is not None and gone not in self._viewer.layers:
            self._nothing = LOST.format(layer=gone.name)
        self._follow(self.result, self._grid)
        self._taken = None if self.result is None else result_of(self.result)
        self._scene.take(self.result, chosen)
        self._follow(self._followed, self._scene.shown.layer("grid"))
        self._face.status.say(self._nothing if self.result is None else self._scene.words)

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
        if self.away or result is not self._scene.shown.layers:
            return
        if self._scene.outdated:
            self._take()
        else:
            self._scene.interrupt()

    def _on_eye(self, *_: Any) -> None:
        if not self.away:
            self._follow(self._followed, self._scene.shown.layer("grid"))
            self._scene.look_at_eyes()

    def _on_inserted(self, event: Any) -> None:
        if self.away:
            return
        if self._is_result(event.value):
            self._choose()
        self._on_layers()

    def _on_layers(self, *_: Any) -> None:
        if not self.away:
            self._face.result.reset_choices()
            self._face.image.reset_choices()
            self._eyes.start()

    def _on_slice(self, *_: Any) -> None:
        if not self.away:
            self._scene.say_where()

    def _on_image(self, *_: Any) -> None:
        if not self.away:
            self._scene.prepare()

    def _on_slider(self, percent: int) -> None:
        if self.result is None:
            return
        self.stop()
        if self._scene.ready_to_move():
            self._scene.go(percent)
        else:
            self._face.status.say(NO_IMAGE)

    def _on_moved(self, percent: int) -> None:
        with self._face.slider.changed.blocked():
            self._face.slider.value = percent
        self._scene.go(percent)

    def _on_play(self, *_: Any) -> None:
        if self.playing:
            self.stop()
        else:
            self.play()

    def _on_playing(self, playing: bool) -> None:
        self._face.play.text = PAUSE if playing else PLAY

    def _on_save(self, *_: Any) -> None:
        title = "Where to make a folder of pictures"
        chosen = QFileDialog.getExistingDirectory(self.native, title)
        if chosen:
            self._scene.save(Path(chosen), self.saved.emit, own_folder=True)

    def _on_theme(self, *_: Any) -> None:
        theme = getattr(self._viewer, "theme", None)
        if theme is not None and not self.away:
            self._face.energy.show_theme(str(theme))

    @property
    def _key(self) -> Any:
        """What the key does that is held to see the image as it was, if it does anything."""
        keys = getattr(self._viewer, "keymap", {})
        return next((does for key, does in keys.items() if key == _BEFORE), None)

    def _bind_key(self) -> None:
        if self._key is None:
            self._viewer.bind_key(BEFORE_KEY, self._while_key_is_held)

    def _unbind_key(self) -> None:
        if self._key == self._while_key_is_held:
            self._viewer.bind_key(BEFORE_KEY, None)

    def _while_key_is_held(self, _: Any) -> Any:
        self.before = True
        yield
        self.before = False

    def _on_opened(self) -> None:
        self._bind_key()
        self._choose(seen=True)
        self._take()

    def _on_closed(self) -> None:
        self._unbind_key()
        self._scene.rest()
        self._face.point.say(POINT)

    def _on_end(self) -> None:
        self._follow(None, None)
        self._events.release()
        self._unbind_key()
        self._scene.release()

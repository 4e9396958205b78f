"""Live mode of *Deform tissue*: every edit of what is painted is followed by the tissue."""

from __future__ import annotations

import logging
import time
import weakref
from dataclasses import replace
from typing import Any

from napari_hmrf.errors import Cancelled, HmrfError
from napari_hmrf.layers.slice_view import layer_extents
from napari_hmrf.study.engine import Deformation, Engine
from napari_hmrf.study.study import Study
from napari_hmrf.ui.job import Done, drawn
from napari_hmrf.ui.messages import in_short, progress
from napari_hmrf.ui.newest_result import Newest
from napari_hmrf.ui.pixels import Pixels
from napari_hmrf.ui.result_dock import ResultDock
from napari_hmrf.ui.timers import repeating, single_shot

_log = logging.getLogger("napari_hmrf")
#: So many pixels are followed without being asked. On two cores and no GPU the picture follows an
#: edit of 1200 x 1200 pixels in 0.4 s (elastic) to 1.4 s, and one of 2048 x 2048 in 1.6 to 5 s.
LARGEST = 1200 * 1200
#: How long there must be no answer until it is said that there is none yet, in seconds.
_PATIENCE = 0.4
#: How long edits must rest until all layers of a result are drawn, in milliseconds.
_REST = 120
_POLL = 50

# What those who wait for it are told.
_DOING = "an edit that 'Deform tissue' follows, which its Cancel stops"
_DRAWING = "the layers of a result of 'Deform tissue', which its next edit stops"

LIVE = "Live: follow every edit"
STAYS = "The last result stays."
SLOW = "So many pixels take seconds an edit, unless there is a graphics card: tick it to try.\n"
ABOUT = (
    "Any edit of tissue, boundary or tables is followed by the result, once there is one. "
    "Elastic tissue, and the paper's energy 'to convergence', go on from the last field; the "
    "paper's schedule begins anew each time"
)


class LiveMode:
    """Has a result follow the layers, while it is on.

    Parameters
    ----------
    widget : ResultDock
        Which shows what comes of it.
    check : CheckBox
        Which turns it on and off.
    """

    def __init__(self, widget: ResultDock, check: Any) -> None:
        self._widget = widget
        self._check = check
        #: Whether somebody ticked or unticked the box; None while the size decides.
        self._wanted: bool | None = None
        self._engine: Engine | None = None
        self._newest = Newest(self._on_news)
        self._asked: Study | None = None
        self._source: weakref.ref[Any] | None = None
        #: What is followed, if anything yet: nobody asked for another image to be deformed.
        self._followed: weakref.ref[Any] | None = None
        #: Where it was looked last, and whether what was asked for last is somebody's edit.
        self._place: Any = None
        self._turn = True
        self._layers: tuple[Any, ...] = ()
        #: Whether what was asked for last is not shown yet.
        self._pending = False
        self._since = 0.0
        self._said = ""
        self._pixels = Pixels(self.touch, refreshed=True)
        self._looking = single_shot(widget.native, 0, self._look)
        self._resting = single_shot(widget.native, _REST, self._complete)
        self._poll = repeating(widget.native, _POLL, self._on_poll)
        check.changed.connect(self._on_check)

    # What there is to see

    @property
    def on(self) -> bool:
        """Whether edits are followed."""
        return bool(self._check.value)

    @property
    def begun(self) -> bool:
        """Whether there is something to follow with: a result, or somebody who asked for one."""
        wanted = self._wanted is True or self._widget.solution is not None
        return self.on and wanted and not self._elsewhere

    @property
    def busy(self) -> bool:
        """Whether an answer is still to come."""
        return self._pending or self._looking.isActive()

    # What can be done

    def turn(self, on: bool) -> None:
        """Turn it on or off; from then on the size of the image decides nothing."""
        if self._check.value == on:
            self._on_check(on)
        else:
            self._check.value = on

    def touch(self) -> None:
        """Something was edited: look what, when Qt has nothing more urgent to do."""
        if self.begun and not self._widget.away:
            self._looking.start()

    def choose(self) -> None:
        """Other layers are chosen: follow those, unless they are too large."""
        layers, sure = self._chosen(), self._widget.confidence
        others = () if sure is None else (sure,)
        self._pixels.listen_to((*layers, *others, *self._widget.landmark_layers))
        self._judge(layers)
        if self._elsewhere:
            self._drop()
        self.touch()

    def result_shown(self, study: Study, source: Any) -> None:
        """There is a result that was asked for: what comes next begins from these layers."""
        self._asked, self._said = study, ""
        self._source = self._followed = weakref.ref(source)
        self.touch()

    def cancel(self) -> bool:
        """Give up the edit that is being followed; whether there was one."""
        if not self._drop():
            return False
        self._tell("Cancelled; " + STAYS[0].lower() + STAYS[1:])
        return True

    def layer_removed(self, layer: Any) -> None:
        """What is computed of a layer that is gone is shown nowhere."""
        if any(layer is each for each in self._layers):
            self._drop()
            self._layers = ()

    def release(self) -> None:
        """Follow nothing any more."""
        self._pixels.release()
        if self._engine is not None:
            self._engine.close()
            self._engine = None
        self._newest.release()

    def leave(self) -> None:
        """The dock was closed: drop what goes on."""
        self._drop()

    # How it goes on

    def _on_check(self, on: bool) -> None:
        self._wanted = bool(on)
        chosen = self._chosen()
        self._judge(chosen)
        if on:
            self._asked = self._widget.shown
            self._followed = weakref.ref(chosen[0]) if chosen else None
            self.touch()
        else:
            self._drop()

    def _chosen(self) -> tuple[Any, ...]:
        widget = self._widget
        chosen = (widget.image, widget.tissue, widget.boundary)
        return tuple(layer for layer in chosen if layer is not None)

    def _judge(self, layers: tuple[Any, ...]) -> None:
        """Decide by the size, unless somebody else has decided; say why it is off."""
        rows, cols = self._size(layers[0]) if layers else (0, 0)
        large = rows * cols > LARGEST
        if self._wanted is None and self._check.value == large:
            with self._check.changed.blocked():
                self._check.value = not large
        off = large and not self.on
        self._check.text = f"Live: off, slow at {rows} x {cols}" if off else LIVE
        self._check.tooltip = (SLOW if off else "") + ABOUT

    @property
    def _elsewhere(self) -> bool:
        """Whether another image is chosen than the one that is followed, or it is gone."""
        chosen = self._chosen()
        return self._followed is not None and (not chosen or self._followed() is not chosen[0])

    def _size(self, layer: Any) -> tuple[int, int]:
        """Rows and columns of what is shown of a layer."""
        extents, dims = layer_extents(layer), self._widget.dims
        missing = dims.ndim - len(extents)
        rows, cols = (axis - missing for axis in dims.displayed[-2:])
        return (extents[rows], extents[cols]) if extents and min(rows, cols) >= 0 else (0, 0)

    def _shown_place(self) -> tuple[Any, ...]:
        """Which slice is shown."""
        dims = self._widget.dims
        return (*(dims.current_step[axis] for axis in dims.not_displayed), *dims.order)

    def _look(self) -> None:
        widget = self._widget
        if not self.begun or widget.away:
            return
        before, self._place = self._place, self._shown_place()
        try:
            request = widget.request()
            study = widget.read(request)
        except (HmrfError, ValueError) as error:
            self._drop()
            self._asked = None
            self._fail(error)
            return
        if self._asked is not None and self._asked.same_as(study):
            return
        self._asked, self._layers = study, request.layers
        # To go to another slice is no work in this dock, and hides nothing of another's.
        self._turn = before in (None, self._place)
        self._source = self._followed = weakref.ref(request.layers[0])
        if self._engine is None:
            self._engine = Engine(self._newest.put, _DOING)
        self._resting.stop()
        self._engine.submit(study, backend=widget.backend)
        self._pending = True
        if not self._poll.isActive():
            self._since = time.monotonic()
            self._poll.start()

    def _on_news(self, news: Deformation | Done) -> None:
        engine, source = self._engine, None if self._source is None else self._source()
        if engine is None or not self.on or self._widget.away or source is None:
            self._pending = False
            return
        if isinstance(news, Done):
            self._pending = engine.busy
            self._widget.show_live(news, source, self._turn)
            self._said = ""
        elif news.error is not None:
            self._asked, self._pending = None, engine.busy
            self._fail(news.error)
        else:
            self._since = time.monotonic()
            shown = self._widget.show_picture(news, source, self._turn)
            self._resting.start(_REST if shown else 0)

    def _complete(self) -> None:
        engine = self._engine
        if engine is None or engine.busy:
            return
        kinds, newest = self._widget.outputs, self._newest

        def checkpoint() -> None:
            if engine.busy:
                raise Cancelled

        def draw(latest: Deformation | None) -> None:
            if latest is None or engine.busy:
                return
            ground, stated, solution = latest.ground, latest.stated, latest.solution
            assert ground is not None
            assert stated is not None
            assert solution is not None
            try:
                newest.put(drawn(ground, stated, solution, kinds, checkpoint))
            except Cancelled:
                return
            except Exception as error:  # noqa: BLE001 - whatever it is, the user is told
                _log.exception("a live result could not be drawn")
                newest.put(replace(latest, error=error))

        engine.beside(draw, _DRAWING)

    def _on_poll(self) -> None:
        engine, footer = self._engine, self._widget.footer
        if engine is None or not engine.busy:
            self._poll.stop()
            footer.following(False)
            return
        waited = time.monotonic() - self._since
        if waited > _PATIENCE and self._widget.idle:
            footer.following(True)
            doing = progress(engine.monitor, waited)
            self._widget.say(f"Following the last edit: {doing[0].lower()}{doing[1:]}")

    def _fail(self, error: Exception) -> None:
        """Say why there is no answer, once; the last result stays."""
        self._widget.outdate()
        stays = f" {STAYS}" if self._widget.solution is not None else ""
        self._tell(f"The tissue does not follow yet. {in_short(error)}{stays}")

    def _tell(self, sentence: str) -> None:
        if sentence != self._said or self._widget.status != sentence:
            self._said = sentence
            self._widget.say(sentence)

    def _drop(self) -> bool:
        """Give up what is going on; whether anything was."""
        was = self.busy
        for timer in (self._looking, self._resting, self._poll):
            timer.stop()
        self._newest.forget()
        self._pending = False
        if self._engine is not None:
            self._engine.forget()
        self._widget.footer.following(False)
        return was

"""Going through a deformation: which moment is drawn, kept ones, playing back and forth."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from functools import partial
from typing import Any

from psygnal import Signal

from napari_hmrf.field.animation import Moment, Motion
from napari_hmrf.ui.events import repeating
from napari_hmrf.ui.handover import Errands
from napari_hmrf.ui.result.moving_layers import MovingLayers

#: All of the deformation in one direction, in seconds.
SECONDS = 2.0
#: The shortest time between two moments while playing, in milliseconds.
_TICK = 40
#: Steps of the slider in which is played, at best, in per cent.
_STEP = 2
#: Moments kept, in bytes; a second pass then costs nothing.
_KEPT = 256 * 2**20


class Player:
    """Draws moments of a deformation, computed on the compute thread.

    Parameters
    ----------
    parent : QWidget
    errands : Errands

    Attributes
    ----------
    moved : Signal(int)
        Per cent that playing has come to.
    playing_changed : Signal(bool)
    """

    moved = Signal(int)
    playing_changed = Signal(bool)

    def __init__(self, parent: Any, errands: Errands) -> None:
        self._errands = errands
        self._shown: MovingLayers | None = None
        self._motion: Motion | None = None
        self._kept: OrderedDict[int, Moment] = OrderedDict()
        self._timer = repeating(parent, _TICK, self._on_tick)
        self._started = 0.0

    def go_through(self, shown: MovingLayers | None) -> None:
        """Draw moments of this from now on, by what moves of it now; or of nothing."""
        self._shown = shown
        self._motion = None if shown is None else shown.motion
        self._kept.clear()

    @property
    def playing(self) -> bool:
        """Whether it is moving by itself."""
        return bool(self._timer.isActive())

    def play(self) -> None:
        """Go back and forth until stopped, beginning where the slider is."""
        if self._shown is None or self.playing:
            return
        self._started = time.monotonic() - SECONDS * self._shown.percent / 100
        self._timer.start()
        self.playing_changed.emit(True)

    def stop(self) -> None:
        """Stay at what is shown."""
        if self.playing:
            self._timer.stop()
            self.playing_changed.emit(False)

    def show(self, percent: int) -> None:
        """Draw a moment, at once if it is kept, else as soon as it is computed."""
        if self._shown is None or self._motion is None:
            return
        kept = self._kept.get(percent)
        if kept is not None:
            self._kept.move_to_end(percent)
            self._shown.draw(percent, kept)
            return
        work = partial(self._motion.at, percent / 100)
        self._errands.send("moment", work, partial(self._on_moment, percent, self._motion))

    def _on_moment(self, percent: int, motion: Motion, moment: Moment) -> None:
        if self._shown is None or motion is not self._motion:
            return
        self._kept[percent] = moment
        while len(self._kept) > 1 and len(self._kept) * moment.nbytes > _KEPT:
            self._kept.popitem(last=False)
        self._shown.draw(percent, moment)

    def _on_tick(self) -> None:
        # The slider waits for the picture: both always say the same.
        if self._shown is None or self._errands.busy("moment"):
            return
        along = (time.monotonic() - self._started) / SECONDS % 2
        part = along if along <= 1 else 2 - along
        step = self._step
        percent = min(100, round(100 * part / step) * step)
        if percent != self._shown.percent:
            self.moved.emit(percent)

    @property
    def _step(self) -> int:
        """As fine as all moments can be kept."""
        if not self._kept:
            return _STEP
        size = next(reversed(self._kept.values())).nbytes
        return max(_STEP, math.ceil(100 * size / _KEPT))

"""Going through a deformation: which moment is drawn, kept ones, playing back and forth."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from psygnal import Signal

from napari_hmrf.field.animation import Moment
from napari_hmrf.ui.events import repeating
from napari_hmrf.ui.handover import Errands
from napari_hmrf.ui.result.moving_layers import MovingLayers
from napari_hmrf.ui.result.result_messages import FULL

#: All of the deformation in one direction, in seconds.
SECONDS = 2.0
#: The shortest time between two moments while playing, in milliseconds.
_TICK = 40
#: Steps of the slider in which is played, at best, in per cent.
_STEP = 2


class Player:
    """Draws moments of a deformation, computed on the compute thread.

    Parameters
    ----------
    parent : QWidget
    errands : Errands
    shown : callable
        Returns the result whose moments are drawn, or None.

    Attributes
    ----------
    moved : Signal(int)
        Per cent that playing has come to.
    playing_changed : Signal(bool)
    drawn : Signal()
        A moment is.
    """

    moved = Signal(int)
    playing_changed = Signal(bool)
    drawn = Signal()

    def __init__(
        self, parent: Any, errands: Errands, shown: Callable[[], MovingLayers | None]
    ) -> None:
        self._errands, self._shown = errands, shown
        self._timer = repeating(parent, _TICK, self._on_tick)
        self._started = 0.0

    @property
    def playing(self) -> bool:
        """Whether it is moving by itself."""
        return bool(self._timer.isActive())

    def play(self) -> None:
        """Go back and forth until stopped, beginning where the slider is."""
        if (shown := self._shown()) is None or self.playing:
            return
        self._started = time.monotonic() - SECONDS * shown.percent / FULL
        self._timer.start()
        self.playing_changed.emit(True)

    def stop(self) -> None:
        """Stay at what is shown."""
        if self.playing:
            self._timer.stop()
            self.playing_changed.emit(False)

    def show(self, percent: int) -> None:
        """Draw a moment, at once if it is kept, else as soon as it is computed."""
        if (shown := self._shown()) is None:
            return
        if (moment := shown.motion.known(percent / FULL)) is not None:
            self._errands.forget("moment")
            self._draw(shown, percent, moment)
        else:
            work = partial(shown.motion.at, percent / FULL)
            self._errands.send("moment", work, partial(self._draw, shown, percent))

    def _draw(self, shown: MovingLayers, percent: int, moment: Moment) -> None:
        shown.draw(percent, moment)
        self.drawn.emit()

    def _on_tick(self) -> None:
        # The slider waits for the picture: both always say the same.
        if (shown := self._shown()) is None or self._errands.busy("moment"):
            return
        along = (time.monotonic() - self._started) / SECONDS % 2
        part = along if along <= 1 else 2 - along
        # As fine as all moments can be kept.
        step = max(_STEP, math.ceil(FULL * shown.motion.finest))
        percent = min(FULL, round(FULL * part / step) * step)
        if percent != shown.percent:
            self.moved.emit(percent)

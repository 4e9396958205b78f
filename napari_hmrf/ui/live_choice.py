"""Whether every edit is followed: by default unless an image is large."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

#: So many pixels are followed without being asked. On two cores and no GPU the picture follows an
#: edit of 1200 x 1200 pixels in 0.4 s (elastic) to 1.4 s, and one of 2048 x 2048 in 1.6 to 5 s.
LARGEST = 1200 * 1200
LIVE = "Live"
_SLOW = "So many pixels take seconds an edit, unless there is a graphics card: tick it to try.\n"
_ABOUT = (
    "The tissue follows any edit of tissue, boundary or tables. Elastic tissue, and the paper's "
    "computed to the end, go on from the last field; the paper's 70 sweeps begin anew each time. "
    "What is pulled is followed always"
)


class LiveChoice:
    """The box that says so.

    Parameters
    ----------
    check : CheckBox
    turned : callable
        Called when it is turned on.
    """

    def __init__(self, check: Any, turned: Callable[[], None]) -> None:
        self._check, self._turned = check, turned
        #: Whether somebody ticked or unticked the box; None while the size decides.
        self._wanted: bool | None = None
        self._shape = (0, 0)
        check.changed.connect(self._on_check)
        self.judge(self._shape)

    @property
    def on(self) -> bool:
        """Whether edits are followed; once it is set the size of the image decides nothing."""
        return bool(self._check.value)

    @on.setter
    def on(self, on: bool) -> None:
        if self._check.value == on:
            self._on_check(on)
        else:
            self._check.value = on

    def judge(self, shape: tuple[int, int]) -> None:
        """Decide by the size, unless somebody else has decided; say why it is off."""
        self._shape = rows, cols = shape
        large = rows * cols > LARGEST
        if self._wanted is None and self._check.value == large:
            with self._check.changed.blocked():
                self._check.value = not large
        off = large and not self.on
        self._check.text = f"Live: off, slow at {rows} x {cols}" if off else LIVE
        self._check.tooltip = (_SLOW if off else "") + _ABOUT

    def _on_check(self, on: bool) -> None:
        self._wanted = bool(on)
        self.judge(self._shape)
        if on:
            self._turned()

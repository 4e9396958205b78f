"""The keys of the tools, while their layer is the active one."""

from __future__ import annotations

from typing import Any, Protocol

from napari_hmrf.layers.edit_history import Owner
from napari_hmrf.layers.undo_keys import KEYS
from napari_hmrf.tissue.drawing.marks import Point
from napari_hmrf.ui.motion.tools import TOOLS

#: By how much a key makes the brush larger.
_LARGER = 1.25


class Listener(Owner, Protocol):
    """Who is told what the mouse and the keys do on the canvas."""

    def press(self, point: Point, reach: float) -> bool:
        """The button is pressed at a pixel; whether a drag begins."""
        ...

    def pick(self, point: Point, reach: float) -> None:
        """The button is pressed while Shift is held."""
        ...

    def move(self, point: Point) -> None:
        """The mouse moves on in a drag."""
        ...

    def release(self) -> None:
        """The drag ends."""
        ...

    def cancel(self) -> None:
        """Escape."""
        ...

    def remove(self) -> None:
        """Delete."""
        ...

    def undo(self) -> None:
        """Ctrl+Z."""
        ...

    def redo(self) -> None:
        """Ctrl+Shift+Z."""
        ...

    def ask_for(self, tool: str) -> None:
        """The key of a tool."""
        ...

    def ask_for_size(self, factor: float) -> None:
        """Have the brush be so many times larger."""
        ...


def bind_keys(layer: Any, told: Listener) -> None:
    """Have the keys of a layer be ours."""
    for key, answer in (
        ("Delete", lambda _: told.remove()),
        ("Backspace", lambda _: told.remove()),
        ("Escape", lambda _: told.cancel()),
        ("[", lambda _: told.ask_for_size(1 / _LARGER)),
        ("]", lambda _: told.ask_for_size(_LARGER)),
        *((key, lambda _, name=name: getattr(told, name)()) for key, name in KEYS.items()),
    ):
        layer.bind_key(key, answer)
    for tool in TOOLS:
        layer.bind_key(tool.key, lambda _, name=tool.name: told.ask_for(name))

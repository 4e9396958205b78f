"""The hands of all tools, on one drawing."""

from __future__ import annotations

from collections.abc import Sequence

from napari_hmrf.tissue.drawing.brush import Brush
from napari_hmrf.tissue.drawing.hands import Hand, History, Pairs, Pull
from napari_hmrf.tissue.drawing.marks import Arrow, Landmark
from napari_hmrf.ui.motion.tools import BY_NAME, Tool


class Hands:
    """One of them is in use; what one has selected is forgotten when another is taken.

    Parameters
    ----------
    history : History
        Of the drawing; all of them share it.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.
    shape : (int, int)
        Of the image.
    """

    def __init__(
        self,
        history: History,
        spacing: Sequence[float] = (1.0, 1.0),
        shape: tuple[int, int] = (1, 1),
    ) -> None:
        self._history = history
        self._hands: dict[type[Hand], Hand] = {
            Pull: Pull(history, spacing),
            Pairs: Pairs(history, spacing),
            Brush: Brush(history, spacing, shape),
        }

    def of(self, tool: Tool) -> Hand:
        """The hand that holds a tool."""
        return self._hands[{"pull": Pull, "landmark": Pairs}.get(tool.name, Brush)]

    def tool_for(self, number: int) -> Tool:
        """The tool a mark is made with."""
        mark = self._history.drawing.marks[number]
        if isinstance(mark, Arrow):
            return BY_NAME["pull"]
        return BY_NAME["landmark" if isinstance(mark, Landmark) else mark.action]

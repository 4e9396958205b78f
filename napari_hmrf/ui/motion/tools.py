"""The tools: what each is called, which keys and which fields it has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from napari_hmrf.tissue.drawing import Arrow, Mark, Stroke
from napari_hmrf.tissue.drawing.marks import Action


@dataclass(frozen=True)
class Tool:
    """A tool.

    Attributes
    ----------
    name : str
        In Python.
    title : str
        On its button and on the canvas.
    key : str
        That takes it, while the layer *Motion* is active. None of these is one of napari's for a
        layer of that kind, or for the viewer.
    fields : tuple of str
        The attributes of `ToolFields` it needs.
    how : str
        How it is used, for its button and the status.
    """

    name: str
    title: str
    key: str
    fields: tuple[str, ...]
    how: str

    @property
    def is_brush(self) -> bool:
        """Whether it paints."""
        return self.name in get_args(Action)


#: The fields of what speaks of tissue that moves or stays.
_HELD = ("radius", "confidence", "components")

TOOLS: tuple[Tool, ...] = (
    Tool("pull", "Pull", "G", _HELD, "Drag tissue to pull it, or click it to hold it in place."),
    Tool(
        "landmark",
        "Landmark",
        "L",
        ("radius", "confidence"),
        "Drag from where something is to where it should be, or click what stays there.",
    ),
    Tool("pin", "Hold", "P", _HELD, "Paint what does not move."),
    Tool("free", "Free", "F", ("radius",), "Paint what nothing holds, whatever else says so."),
    Tool(
        "move",
        "Push",
        "M",
        ("radius", "by_row", "by_col", "confidence", "components"),
        "Paint what moves, then drag it to where it goes.",
    ),
    Tool(
        "expand",
        "Grow",
        "E",
        ("radius", "amount", "confidence"),
        "Paint a patch or a closed ring that grows; a negative amount shrinks it.",
    ),
    Tool(
        "confidence",
        "Confidence",
        "C",
        ("radius", "sure", "softness"),
        "Paint over what is held or moved how sure that is.",
    ),
    Tool("tissue", "Tissue", "T", ("radius", "material"), "Paint which tissue is where."),
)
BY_NAME = {tool.name: tool for tool in TOOLS}


def tool_of(mark: Mark) -> Tool:
    """The tool a mark is made with."""
    if isinstance(mark, Stroke):
        return BY_NAME[mark.action]
    return BY_NAME["pull" if isinstance(mark, Arrow) else "landmark"]

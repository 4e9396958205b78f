"""List of all tools; new tools must be added here."""

from __future__ import annotations

from napari_hmrf.tissue.drawing import Mark
from napari_hmrf.ui.motion.brush_tools import (
    ConfidenceTool,
    FreeTool,
    GrowTool,
    HoldTool,
    PushTool,
    ResectTool,
    SlideTool,
    TissueTool,
)
from napari_hmrf.ui.motion.pull_tools import LandmarkTool, PullTool
from napari_hmrf.ui.motion.tool import Tool

#: Tools in the order of their buttons; the first four have larger buttons.
TOOLS: tuple[type[Tool], ...] = (
    PullTool,
    HoldTool,
    LandmarkTool,
    GrowTool,
    FreeTool,
    PushTool,
    SlideTool,
    TissueTool,
    ResectTool,
    ConfidenceTool,
)
BY_NAME = {tool.name: tool for tool in TOOLS}


def tool_of(mark: Mark) -> type[Tool]:
    """Return the tool that makes marks of this kind."""
    return next(tool for tool in TOOLS if tool.makes(mark))

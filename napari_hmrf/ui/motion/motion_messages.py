"""Messages about drawing with the mouse."""

from __future__ import annotations

START = "Press 'Pull', then drag tissue in the image."
PREPARING = "Getting ready ..."
OFF = "To draw on, press a tool, or choose the layer 'Motion'."
FLAT = "Tissue is pulled in two dimensions: press the 2D/3D button below the canvas first."
ARROWS_GONE = "The layer 'Motion' is gone: press a tool to have it back."
NOTHING = "There is no tissue to take hold of there."
OUTSIDE = "That is outside the image."
PICKED = "Selected: the fields change it, Delete removes it."
NOTHING_DRAWN = "Nothing is drawn there: nothing is selected."
NOTHING_SELECTED = "Nothing is selected: Shift+click what was drawn."
REMOVED = "Removed; undo brings it back."
REMOVED_ALL = "Removed all; undo brings it back."
CANCELLED = "Cancelled; everything is as before."
OPEN = "Go on to where you began: what is to expand is a closed ring, or a patch."
NO_STEP = "Now drag it to where it goes, or say above how far; till then it is held."
NO_WAY = "This landmark holds what is there: drag the dot to where it should be."
NO_OUTSIDE = (
    "Nothing was painted: an open line has no outside to expand to. Close it to a ring, paint a "
    "patch, or take 'Push'."
)


def covered(other: str) -> str:
    """Return the message that another layer covers the image, and the remedy."""
    return f"The image is covered by '{other}': hide that one, or choose it here."

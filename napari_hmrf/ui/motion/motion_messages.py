"""Messages about drawing with the mouse."""

from __future__ import annotations

import numpy as np

from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.drawing import Landmark, Mark, Stroke
from napari_hmrf.tissue.drawing.marks import Action

HERE = "Drag here: pull any tissue in the image with the mouse."
HERE_OR_PLAY = f"{HERE} To see how the sample itself moves, press Play."
ON_CANVAS = "{}: drag tissue here"
START = "Press 'Pull', then drag tissue in the image."
PREPARING = "Getting ready ..."
EARLY = "Getting ready ... Your drag is shown as soon as the tissue is ready."
OFF = "To continue drawing, press a tool, or select the layer 'Motion'."
FLAT = "The tools work only in the 2D view: press napari's 2D/3D button first."
ONE_SLICE = (
    "In the 3D view, the tools work only on a whole volume: choose 'the whole volume' above, or "
    "press napari's 2D/3D button."
)
TURN = "Drag beside the tissue to turn the view."
IN_DEPTH = "While you drag tissue, the wheel or the keys Up and Down move it away or nearer."
ARROWS_GONE = "The layer 'Motion' was deleted: press a tool to restore it."
HIDDEN = "Marks are drawn, but hidden: to see them, click the eye icon of the layer 'Motion'."
NOTHING = "There is no tissue at this point."
OUTSIDE = "This point is outside the image."
PICKED = "Mark selected: edit the fields to change it, or press Delete to remove it."
NOTHING_DRAWN = "There is no mark at this point: nothing is selected."
NOTHING_SELECTED = "Nothing is selected: Shift+click a mark to select it."
REMOVED = "Removed the selected mark. Press Undo to restore it."
REMOVED_ALL = "Removed all marks. Press Undo to restore them."
CANCELLED = "Cancelled; the drawing is unchanged."
RETURNED = "This click brought the window to the front. Click again to draw."
OPEN = "Continue to the start of the line: only a closed ring or a patch can grow."
NO_STEP = (
    "Now drag the paint to push the tissue, or set a distance above. Until then, the tissue is "
    "held in place."
)
NO_MOTION = (
    "This stroke has no effect: the tissue under it is neither held nor moved. Paint confidence "
    "over held or moved tissue."
)
SLIDES_INSIDE = (
    "To let tissue slide along this surface, give the other side the stiffness 0. With tissue on "
    "both sides, it keeps its place."
)
NO_WAY = "This landmark holds tissue in place: drag the dot to its target to move the tissue."
NO_OUTSIDE = (
    "Nothing was painted: an open line has no inside, so it cannot grow. Close the line to form a "
    "ring, paint a patch, or use 'Push'."
)
TOO_SMALL = "Not grown: the patch is too small. Shift+click the patch, and set a larger radius."
NO_INSIDE = "Not grown: an open line has no inside. Push a patch or a closed ring instead."
_HELD = "a held place"
#: Names of painted tissue that moves or is free to move.
_STROKES: dict[Action, str] = {
    "move": "pushed tissue",
    "expand": "growing tissue",
    "free": "freed tissue",
    "slide": "a sliding surface",
}


def in_the_way(mark: Mark, can_grow: bool) -> str:
    """Return a message that a patch does not grow because of another mark nearby.

    Parameters
    ----------
    mark : Arrow, Landmark or Stroke
    can_grow : bool
        True if the wheel over this mark makes its tissue grow.
    """
    if isinstance(mark, Stroke):
        is_held = mark.action == "pin" or (mark.action == "move" and not any(mark.by))
        name = _HELD if is_held else _STROKES[mark.action]
    else:
        is_still = mark.source == mark.target if isinstance(mark, Landmark) else not any(mark.by)
        is_held = is_still or mark.motion is not None  # held where a pull has moved it
        name = _HELD if is_held else "a landmark" if isinstance(mark, Landmark) else "a pull"
    remedy = "Turn the wheel over it, or set" if can_grow else "Set"
    return f"Not grown: {name} is in the way. {remedy} a smaller radius."


def grown(amount: float, unit: str, is_pulled: bool = False) -> str:
    """Return a message about growth with the mouse wheel."""
    if is_pulled and not amount:
        return "This displaced tissue neither grows nor shrinks."
    way = "shrinks" if amount < 0 else "grows"
    still = "" if amount else ": its outline is held in place"
    noun = "displaced tissue" if is_pulled else "tissue"
    return f"This {noun} {way} by {abs(amount):.3g} {unit}{still}."


def region_grown(material: Material) -> str:
    """Return a message about the growth of a labelled region with the mouse wheel."""
    growth = " / ".join(f"{100 * part:.3g}" for part in np.atleast_1d(material.growth))
    name = material.name or f"label {material.label}"
    return f"All of '{name}' grows by {growth} % in length, as in the table of tissues."


def pulling(distance: float, unit: str) -> str:
    """Return a message about the distance of a drag that is in progress."""
    return f"Pulling {distance:.3g} {unit}"


def covered(other: str) -> str:
    """Return a message that another layer covers the image, with a remedy."""
    return f"'{other}' covers the image: hide '{other}', or choose it as the image."

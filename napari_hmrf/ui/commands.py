"""What napari's command palette (Ctrl+Shift+P) can do with our docks."""

from __future__ import annotations

from typing import Any, TypeVar

import napari

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.edit_history import steps_of
from napari_hmrf.ui.deform_dock import DeformTissue
from napari_hmrf.ui.grab.grab_dock import GrabAndPull
from napari_hmrf.ui.look.look_dock import LookAtResult

_Dock = TypeVar("_Dock", DeformTissue, GrabAndPull, LookAtResult)
#: As napari's menu names them, so that it finds them open.
_TITLES: dict[type[Any], str] = {
    DeformTissue: "Deform tissue (HMRF soft tissue)",
    GrabAndPull: "Grab and pull (HMRF soft tissue)",
    LookAtResult: "Look at the result (HMRF soft tissue)",
}


def dock(kind: type[_Dock], viewer: Any = None) -> _Dock:
    """One of our docks, in sight; opened if there is none of its kind yet.

    Parameters
    ----------
    kind : type
        `DeformTissue`, `GrabAndPull` or `LookAtResult`.
    viewer : napari.Viewer, optional
        The one that is used now, if not given.

    Raises
    ------
    HmrfError
        If there is no window.
    """
    viewer = _current() if viewer is None else viewer
    found = next((each for each in viewer.window.dock_widgets.values() if type(each) is kind), None)
    if found is None:
        found = kind(viewer)
        viewer.window.add_dock_widget(found, name=_TITLES[kind])
    frame = found.native.parent()
    frame.show()
    frame.raise_()
    return found


def _current() -> Any:
    viewer = napari.current_viewer()
    if viewer is None:
        raise HmrfError("There is no napari window open: start napari first.")
    return viewer


def deform_now() -> None:
    """Press Deform."""
    dock(DeformTissue).deform()


def live() -> None:
    """Have the result follow every edit, or no longer."""
    deform = dock(DeformTissue)
    deform.live = not deform.live


def grab_and_pull() -> None:
    """Have the mouse pull tissue, or move the view again."""
    grab = dock(GrabAndPull)
    if grab.active:
        grab.stop()
    else:
        grab.tool = "pull"
        grab.start()


def undo() -> None:
    """Take back what was done last, in whichever dock."""
    steps_of(_current()).undo()


def redo() -> None:
    """Do again what was taken back."""
    steps_of(_current()).redo()


def play() -> None:
    """Play the deformation back and forth, or stop."""
    look = dock(LookAtResult)
    if look.playing:
        look.stop()
    else:
        look.play()

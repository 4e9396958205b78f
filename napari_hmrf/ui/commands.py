"""What napari's command palette (Ctrl+Shift+P) can do with the dock."""

from __future__ import annotations

from typing import Any

import napari

from napari_hmrf.errors import HmrfError
from napari_hmrf.ui.soft_tissue import SoftTissue

#: As napari's menu names it, so that it finds it open.
_TITLE = "Soft tissue (napari-hmrf)"


def dock(viewer: Any = None) -> SoftTissue:
    """The dock of a viewer, in sight; opened if there is none yet.

    Parameters
    ----------
    viewer : napari.Viewer, optional
        The one that is used now, if not given.

    Raises
    ------
    HmrfError
        If there is no window.
    """
    viewer = napari.current_viewer() if viewer is None else viewer
    if viewer is None:
        raise HmrfError("There is no napari window open: start napari first.")
    widgets = viewer.window.dock_widgets.values()
    found = next((each for each in widgets if isinstance(each, SoftTissue)), None)
    if found is None:
        found = SoftTissue(viewer)
        viewer.window.add_dock_widget(found, name=_TITLE)
    frame = found.native.parent()
    frame.show()
    frame.raise_()
    return found


def deform_now() -> None:
    """Press Deform."""
    dock().deform()


def live() -> None:
    """Have the result follow every edit, or no longer."""
    found = dock()
    found.live = not found.live


def pull() -> None:
    """Have the mouse pull tissue, or move the view again."""
    found = dock()
    if found.active:
        found.stop()
    else:
        found.tool = "pull"
        found.start()


def undo() -> None:
    """Take back what was done last."""
    dock().undo()


def redo() -> None:
    """Do again what was taken back."""
    dock().redo()


def play() -> None:
    """Play the deformation back and forth, or stop."""
    found = dock()
    if found.playing:
        found.pause()
    else:
        found.play()

"""What outlasts a session: how many arrows are drawn, and where results are computed.

Never what is computed, and never which layers a result makes: whoever opens a dock has the paper's
model and the calm picture of the first minute, whatever was tried last.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from magicgui.widgets.bases import ValueWidget
from qtpy.QtCore import QSettings

from napari_hmrf.layers.viewer_shared import shared


def remember(dock: str, widgets: Mapping[str, ValueWidget[Any]]) -> None:
    """Give fields the values that they had last, and keep those that they get.

    Parameters
    ----------
    dock : str
        Whose fields they are; one word.
    widgets : mapping of str to ValueWidget
        By the name under which each is kept.
    """
    store = QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )
    for name, widget in widgets.items():
        key = f"{dock}/{name}"
        with suppress(TypeError, ValueError):  # another version's, or written by hand
            widget.value = store.value(key, widget.value, type(widget.value))
        widget.changed.connect(lambda value, key=key: store.setValue(key, value))


class _Kept(dict[str, Any]):
    """What fields held last in a viewer."""

    def __init__(self, _: Any) -> None:
        super().__init__()


def keep(viewer: Any, widgets: Mapping[str, ValueWidget[Any]]) -> None:
    """Give fields the values that they had in a dock of this viewer, and keep those they get.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    widgets : mapping of str to ValueWidget
        By the name under which each is kept.
    """
    kept = shared(viewer, _Kept)
    for name, widget in widgets.items():
        if name in kept:
            widget.value = kept[name]
        widget.changed.connect(lambda value, name=name: kept.update({name: value}))

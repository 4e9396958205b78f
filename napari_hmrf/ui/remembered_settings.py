"""Settings stored between sessions: the chosen device, and the open sections of the dock.

The choice of result layers is not stored, so each new dock initially shows the same few layers.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial

from magicgui.widgets import ComboBox
from qtpy.QtCore import QSettings
from superqt import QCollapsible

_DEVICE = "deform/device"


def settings() -> QSettings:
    """Return the store of the settings that all sessions share."""
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )


def remember(device: ComboBox) -> None:
    """Set a menu to the device that was chosen last, and store later choices."""
    store = settings()
    with suppress(ValueError):  # the stored value may be from another version
        device.value = store.value(_DEVICE, device.value)
    device.changed.connect(lambda value: store.setValue(_DEVICE, value))


def remember_open(section: QCollapsible, name: str, *, usual: bool = False) -> None:
    """Open a section if it was open in the last session, and store later changes.

    Parameters
    ----------
    section : QCollapsible
    name : str
        Name of the section in the store, which stays the same if its title changes.
    usual : bool
        True if the section is open until the user closes it.
    """
    store, key = settings(), f"open/{name}"
    if store.value(key, usual, type=bool):
        section.expand(animate=False)
    section.toggled.connect(partial(store.setValue, key))

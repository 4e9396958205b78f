"""What outlasts a program: the device that was chosen.

Never which layers a result makes: whoever opens a dock has the calm picture of the first minute,
whatever was tried last.
"""

from __future__ import annotations

from contextlib import suppress

from magicgui.widgets import ComboBox
from qtpy.QtCore import QSettings

_DEVICE = "deform/device"


def settings() -> QSettings:
    """What is remembered for good."""
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )


def remember(device: ComboBox) -> None:
    """Have a field say which device was chosen last on this machine, and keep what will be."""
    store = settings()
    with suppress(ValueError):  # another version's, or written by hand
        device.value = store.value(_DEVICE, device.value)
    device.changed.connect(lambda value: store.setValue(_DEVICE, value))

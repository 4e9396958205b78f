"""Settings that are kept between sessions: the chosen device.

The choice of result layers is not kept, so that each new dock shows the same few layers at first.
"""

from __future__ import annotations

from contextlib import suppress

from magicgui.widgets import ComboBox
from qtpy.QtCore import QSettings

_DEVICE = "deform/device"


def settings() -> QSettings:
    """Return the store of settings that are kept between sessions."""
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )


def remember(device: ComboBox) -> None:
    """Set a field to the device that was chosen last, and record later choices."""
    store = settings()
    with suppress(ValueError):  # written by another version, or by hand
        device.value = store.value(_DEVICE, device.value)
    device.changed.connect(lambda value: store.setValue(_DEVICE, value))

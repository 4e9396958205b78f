"""What outlasts a dock: how it solves, as long as its viewer is there; and the device, for good.

Never which layers a result makes: whoever opens a dock has the calm picture of the first minute,
whatever was tried last.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from qtpy.QtCore import QSettings

from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.ui.model import ModelForm

_DEVICE = "deform/device"


def _kept(_: Any) -> dict[str, Any]:
    """What was chosen last in a viewer."""
    return {}


def settings() -> QSettings:
    """What is remembered for good."""
    return QSettings(
        QSettings.Format.IniFormat, QSettings.Scope.UserScope, "napari-hmrf", "napari-hmrf"
    )


def remember(viewer: Any, form: ModelForm) -> None:
    """Have a form say what was chosen last, here or on this machine, and keep what will be."""
    store = settings()
    kept, device = shared(viewer, _kept), form.in_detail["device"]
    with suppress(ValueError):  # another version's, or written by hand
        device.value = store.value(_DEVICE, device.value)
    form.values = kept
    for part in (form, form.in_detail):
        part.changed.connect(lambda _: kept.update(form.values))
    device.changed.connect(lambda value: store.setValue(_DEVICE, value))

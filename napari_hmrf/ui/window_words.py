"""Names of settings in the window, for messages that state the Python name of a setting."""

from __future__ import annotations

from napari_hmrf.wording import reworded

_NAMES = {
    "hold_edge=False": "'Fix outer edge' off",
    "drift=False": "'affine drift' off",
    "measured=None": "'Unregister'",
    "weight=...": "'gravity'",
    "weight=..., cavity=...": "'gravity', 'cavity'",
    "slides=False": "the column 'slides' of the table",
    "penalty=None": "'spring strength' under 'Advanced' at 'by confidence'",
    "action='move'": "'moves by'",
    "budget": "press 'Continue'",
    'backend="cpu"': "the device 'CPU'",
    'backend="opengl:compute"': "the device 'OpenGL, compute'",
    'backend="opengl:fragment"': "the device 'OpenGL, fragment'",
    "pictures=Pictures(image)": "'image'",
    "RIGID": "'rigid'",
    "without_border=True": "leave them unpainted and tick 'Ignore dark background'",
}


def in_window_words(message: str) -> str:
    """Replace the Python names of settings in a message with those of the window."""
    return reworded(message, lambda setting: _NAMES.get(setting, ""))

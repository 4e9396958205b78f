"""What all tests share."""

import os
import sys

import pytest

_NO_DISPLAY = sys.platform.startswith("linux") and not (
    os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
)
_WINDOWS = {"make_napari_viewer", "make_napari_viewer_proxy"}

if _NO_DISPLAY:
    # Qt would end the process for want of a display; single widgets do without one.
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a window where none can be opened."""
    if not _NO_DISPLAY:
        return
    for item in items:
        if _WINDOWS & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.skip(reason="napari needs a display (try: make test)"))

"""Take the README's pictures, from a real napari window: ``make screenshots``."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import napari
from qtpy.QtWidgets import QApplication

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "images"
SAMPLE = "mass-effect"
SIZE = (1400, 900)


def wait_until(done: Callable[[], bool], seconds: float = 120.0) -> None:
    """Let Qt work until something is the case, and what follows from it is drawn."""
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            raise TimeoutError(f"nothing happened within {seconds:g} s")
        QApplication.processEvents()
        time.sleep(0.01)
    settled = time.monotonic() + 1.0
    while time.monotonic() < settled:
        QApplication.processEvents()
        time.sleep(0.01)


def take(viewer: napari.Viewer, name: str) -> None:
    """Take a picture of the whole window."""
    wait_until(lambda: True)
    path = FOLDER / f"{name}.png"
    viewer.screenshot(str(path), canvas_only=False, flash=False)
    shown = ", ".join(layer.name for layer in viewer.layers if layer.visible)
    print(f"{path.relative_to(FOLDER.parent.parent)}: {shown}")


def main() -> None:
    """Open the sample, dock the widget, press Deform; a picture of each."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    viewer = napari.Viewer(title="napari")
    viewer.window.resize(*SIZE)
    viewer.open_sample("napari-hmrf", SAMPLE)
    take(viewer, "sample")
    _, widget = viewer.window.add_plugin_dock_widget("napari-hmrf", "Deform tissue")
    viewer.reset_view()
    take(viewer, "widget")
    widget.deform()
    wait_until(lambda: widget.idle)
    if widget.solution is None:
        raise RuntimeError(f"there is no result: {widget.status}")
    take(viewer, "result")
    viewer.close()


if __name__ == "__main__":
    main()

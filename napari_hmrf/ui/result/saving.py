"""Pictures of what is looked at, for a paper: the canvas, and figures."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from napari_hmrf.atomic_write import write_whole
from napari_hmrf.layers.compat import scale_bar_of
from napari_hmrf.ui.brush_circle import no_circle


def save_canvas(viewer: Any, path: Path) -> list[Path]:
    """Save what the canvas shows, with a scale bar.

    Parameters
    ----------
    viewer : napari.Viewer
        One without a window has no canvas, and nothing is saved.
    path : Path

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    if not hasattr(viewer, "screenshot"):
        return []
    bar = scale_bar_of(viewer)
    visible = bar.visible
    bar.visible = True
    try:
        with _no_brush(viewer), no_circle(viewer):
            shown = viewer.screenshot(canvas_only=True, flash=False)
    finally:
        bar.visible = visible
    from matplotlib.image import imsave

    drawn = io.BytesIO()
    imsave(drawn, shown, format="png")
    write_whole(path, drawn.getvalue())
    return [path]


def new_folder(parent: Path, name: str) -> Path:
    """Make a folder of a name that is not taken, so that no file is replaced.

    Raises
    ------
    OSError
        If it cannot be made.
    """
    kept = "".join(letter if letter.isalnum() or letter in " -_." else "_" for letter in name)
    for number in range(1, 10_000):
        folder = parent / (kept if number == 1 else f"{kept} {number}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{parent / kept} and all its numbers are taken")


@contextmanager
def _no_brush(viewer: Any) -> Iterator[None]:
    """Put the brush away, whose circle would be in the picture."""
    active = viewer.layers.selection.active
    mode = getattr(active, "mode", "pan_zoom")
    if mode != "pan_zoom":
        active.mode = "pan_zoom"
    try:
        yield
    finally:
        if mode != "pan_zoom":
            active.mode = mode

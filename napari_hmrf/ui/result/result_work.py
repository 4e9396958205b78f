"""What is computed to show a result; without Qt, so that any thread may."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy.typing as npt

from napari_hmrf.layers.read import look_of
from napari_hmrf.layers.result_layers import LayerData, picture_layer, result_layers
from napari_hmrf.layers.result_lookup import FoundResult
from napari_hmrf.layers.strain_layers import FloatArray, Quantity, quantity_layer, quantity_of
from napari_hmrf.study.study import Pictures


def coloured(result: FoundResult, quantity: Quantity) -> tuple[LayerData, FloatArray]:
    """A layer of a quantity, before the tissue moves, and its values, (H, W)."""
    values = quantity_of(result, quantity)
    return quantity_layer(result, quantity, values), values


def grid_of(result: FoundResult) -> LayerData:
    """The deformation grid."""
    made = result_layers(result.solution, result.frame, Pictures(name=result.source), {"grid"})
    return made.layers["grid"]


def unmoved(result: FoundResult, source: Any, image: npt.NDArray[Any]) -> LayerData:
    """A layer for the moving image, as the image is before it moves.

    Parameters
    ----------
    result : FoundResult
    source : napari.layers.Image
        Of the image; to be asked in the window's thread.
    image : ndarray, shape (H, W) or (H, W, 3 or 4)
    """
    pictures = Pictures(name=source.name, look=look_of(source))
    facts = {**result.facts, "percent": 0}
    return picture_layer(
        result.frame, pictures, image, result.solution.provenance.parameters, facts
    )


def figures_of(
    result: FoundResult, image: npt.NDArray[Any] | None, folder: Path, own_folder: bool
) -> list[Path]:
    """Write the figures of a result into a folder, or into a new one there."""
    from napari_hmrf.io.figures import save_result_pictures

    if own_folder:
        folder = _new_folder(folder, f"{result.source or 'result'} pictures")
    return save_result_pictures(folder, result.solution, image, result.unit)


def _new_folder(parent: Path, name: str) -> Path:
    """Make a folder of a name that is not taken, so that no file is replaced."""
    kept = "".join(letter if letter.isalnum() or letter in " -_." else "_" for letter in name)
    for number in range(1, 10_000):
        folder = parent / (kept if number == 1 else f"{kept} {number}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{parent / kept} and all its numbers are taken")

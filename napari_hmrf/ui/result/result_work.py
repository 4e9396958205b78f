"""What is computed to show a result; without Qt, so that any thread may."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy.typing as npt

from napari_hmrf.layers.result_lookup import FoundResult


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

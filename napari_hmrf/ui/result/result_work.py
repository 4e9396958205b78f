"""What is computed to show a result; without Qt, so that any thread may."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy.typing as npt

from napari_hmrf.layers.result_lookup import FoundResult


def figures_of(result: FoundResult, image: npt.NDArray[Any] | None, folder: Path) -> list[Path]:
    """Write the figures of a result into a folder."""
    from napari_hmrf.io.figures import save_result_pictures

    return save_result_pictures(folder, result.solution, image, result.unit)

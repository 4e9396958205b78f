"""How far a result is from a reference: a field of another tool, or another result."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import Frame
from napari_hmrf.field.observation import PixelField
from napari_hmrf.field.units import as_seen
from napari_hmrf.solver.solution import Solution


class Comparison(NamedTuple):
    """How far a result is from a reference, over the tissue that the reference knows.

    Attributes
    ----------
    reference : str
        Its name.
    difference : ndarray, shape ([D,] H, W), float32
        The distance between where both have tissue go, in the unit of the result; NaN elsewhere.
    rmsd : float
        The root of its mean square; NaN if the reference knows none of the tissue.
    part : float
        How much of the tissue that is, from 0 to 1.
    """

    reference: str
    difference: npt.NDArray[np.float32]
    rmsd: float
    part: float

    def in_words(self, solution: Solution, unit: str) -> str:
        """How far a result is from the reference, in a sentence; of rounding nothing is said."""
        if not self.part:
            return f"'{self.reference}' reaches none of this tissue."
        where = "" if self.part > 0.995 else f" over {self.part:.0%} of the tissue"
        rmsd = as_seen(self.rmsd, solution.spacing)
        return f"RMSD from '{self.reference}'{where}: {rmsd:.3g} {unit}."


def compare(solution: Solution, frame: Frame, field: PixelField, reference: str) -> Comparison:
    """Compare a result, of a slice or volume, with a field of that name, wherever it lies.

    Raises
    ------
    ProblemError
        As of `PixelField.on`.
    """
    found = field.on(frame, solution.tissue.shape)
    known = found.known & solution.tissue
    apart = np.linalg.norm(solution.displacement - found.displacement, axis=-1)
    rmsd = float(np.sqrt((apart[known] ** 2).mean())) if known.any() else np.nan
    difference = np.where(known, apart, np.nan).astype(np.float32)
    return Comparison(reference, difference, rmsd, float(known.sum() / solution.tissue.sum()))

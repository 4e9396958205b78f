"""Comparison of a result with a reference: another result, or a field from another program."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.deformation import rmsd
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.units import as_seen
from napari_hmrf.results.observation import PixelField
from napari_hmrf.solver.solution import Solution


class Comparison(NamedTuple):
    """Difference between a result and a reference, in the tissue that the reference covers.

    Attributes
    ----------
    reference : str
        Name of the reference.
    difference : ndarray, shape ([D,] H, W), float32
        Distance between the two moved positions of each site, in the unit of the result; NaN
        outside the tissue that the reference covers.
    rmsd : float
        Root mean square of `difference`; NaN if the reference covers none of the tissue.
    part : float
        Fraction of the tissue that the reference covers, from 0 to 1.
    """

    reference: str
    difference: npt.NDArray[np.float32]
    rmsd: float
    part: float

    def in_words(self, solution: Solution, unit: str) -> str:
        """Describe the comparison in one sentence; rounding errors are shown as 0.

        Parameters
        ----------
        solution : Solution
            The result.
        unit : str
            Symbol of the unit of the result.

        Returns
        -------
        str
        """
        if not self.part:
            return f"'{self.reference}' covers none of this tissue."
        where = "" if self.part > 0.995 else f" over {self.part:.0%} of the tissue"
        rmsd = as_seen(self.rmsd, solution.spacing)
        return f"RMSD from '{self.reference}'{where}: {rmsd:.3g} {unit}."


def compare(solution: Solution, frame: Frame, field: PixelField, reference: str) -> Comparison:
    """Compare a result with a reference field, resampled to the pixels of the result.

    Parameters
    ----------
    solution : Solution
        Result of a slice or a volume.
    frame : Frame
        Position of the result in world coordinates.
    field : PixelField
        Reference field, which may have a different position and pixel grid.
    reference : str
        Name of the reference.

    Returns
    -------
    Comparison

    Raises
    ------
    ProblemError
        As for `PixelField.on`.
    """
    observation = field.on(frame, solution.tissue.shape)
    known = observation.known & solution.tissue
    distance = np.linalg.norm(solution.displacement - observation.displacement, axis=-1)
    moved = solution.displacement, observation.displacement
    deviation = rmsd(*moved, known) if known.any() else np.nan
    difference = np.where(known, distance, np.nan).astype(np.float32)
    return Comparison(reference, difference, deviation, float(known.sum() / solution.tissue.sum()))

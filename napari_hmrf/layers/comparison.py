"""How far a result is from a reference: a field of another tool, or another result."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from napari_hmrf.layers.field_layer import LayerField
from napari_hmrf.layers.result_layers import Answer, Array
from napari_hmrf.study.layer_names import Named, naming


class Comparison(NamedTuple):
    """How far a result is from a reference, over the tissue that the reference knows.

    Attributes
    ----------
    reference : str
        Its name.
    difference : ndarray, shape (H, W), float32
        The distance between where both have tissue go, in the unit of the result; NaN elsewhere.
    rmsd : float
        The root of its mean square; NaN if the reference knows none of the tissue.
    part : float
        How much of the tissue that is, from 0 to 1.
    """

    reference: str
    difference: Array
    rmsd: float
    part: float


def compare(answer: Answer, field: LayerField, reference: Named) -> Comparison:
    """Compare a result with a field, wherever that lies.

    Raises
    ------
    ProblemError
        As of `LayerField.on`.
    """
    solution = answer.solution
    with naming(observed=reference):
        found = field.on(answer.frame, answer.shape)
    known = found.known & solution.tissue
    apart = np.linalg.norm(solution.displacement - found.displacement, axis=-1)
    rmsd = float(np.sqrt((apart[known] ** 2).mean())) if known.any() else np.nan
    difference = np.where(known, apart, np.nan).astype(np.float32)
    return Comparison(reference.name, difference, rmsd, float(known.sum() / solution.tissue.sum()))

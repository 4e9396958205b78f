"""Record of a drawing: its dictionary, without the displacements of the pixels of held patches.

The record of a drawing with hundreds of held patches is short. Study files store it in their
header, and the displacements in an array.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.tissue.drawing.drawing import Drawing
from napari_hmrf.tissue.drawing.marks import mark_as_dict
from napari_hmrf.tissue.drawing.patch_motion import Values


def record_of(drawing: Drawing) -> dict[str, Any]:
    """Return a drawing as by `Drawing.as_dict`, without the displacements of held patches."""
    marks = [mark_as_dict(mark, motion=False) for mark in drawing.marks]
    return {**Drawing().as_dict(), "marks": marks}


def held_motion(drawing: Drawing) -> Values | None:
    """Return the displacements of all held patches, one after another in the order of the marks.

    Returns
    -------
    ndarray, shape (N,), float32, or None
        None if the drawing has no held patches.
    """
    motions = (mark.motion for mark in drawing.marks)
    values = [motion.values for motion in motions if motion is not None]
    return np.concatenate(values) if values else None


def drawing_of(record: Mapping[str, Any], motion: npt.NDArray[Any] | None = None) -> Drawing:
    """Create a drawing from its record and the displacements of its held patches.

    Parameters
    ----------
    record : mapping
        Dictionary that `record_of` or `Drawing.as_dict` returned.
    motion : ndarray, optional
        Array that `held_motion` returned.

    Raises
    ------
    ValueError
        If the record is invalid, or does not belong to the displacements.
    """
    values = np.empty(0, np.float32) if motion is None else motion
    begin, marks = 0, []
    for mark in record["marks"]:
        stored = mark.get("motion")
        if stored is not None and "values" not in stored:
            end = begin + math.prod(stored["shape"]) * len(stored["shape"])
            mark = {**mark, "motion": {**stored, "values": values[begin:end]}}
            begin = end
        marks.append(mark)
    if begin != values.size:
        raise ValueError(f"the held patches have {begin} displacements, not {values.size}")
    return Drawing.from_dict({**record, "marks": marks})

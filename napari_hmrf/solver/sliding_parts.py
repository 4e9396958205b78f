"""Parts of the tissue that slide along each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import real, refuse_unless
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_int32

#: Stiffness of the connection along the normal, relative to the softer of the two tissues.
STRENGTH = 100.0
# Smallest and largest strength. A weaker connection leaves a gap, and a stronger one exceeds single
# precision.
_STRENGTHS = (1.0, 1e5)


class SlidingParts:
    """Labels of the parts of tissue that slide along each other; immutable.

    Neighbouring tissue of different labels slides along the interface without friction, and stays
    together along its normal, in compression and in tension. Tissue of one label is connected as
    usual.

    Each part has a displacement field of its own. An element with sites of two parts exists once in
    each field, with the share of the stiffness of its own sites, so that the interface may cut
    through elements. At the sites of such elements, the fields of the two parts are connected along
    the normal n of the interface, with the energy ``1/2 k (n . (d_a - d_b))^2``. The normal is
    fitted to the labels.

    Parameters
    ----------
    labels : array_like of int, shape (H, W) or (D, H, W)
        Label of the part to which each site belongs. Labels of void are ignored.
    strength : float
        Stiffness k of the connection at a site, relative to the softer of the two tissues there,
        from 1 to 100,000.

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """

    labels: npt.NDArray[np.int32]
    strength: float

    def __init__(self, labels: npt.ArrayLike, *, strength: float = STRENGTH) -> None:
        given = as_int32("sliding", labels)
        if given.ndim not in (2, 3):
            raise ProblemError(
                "sliding",
                f"has labels of shape {given.shape}. Pass an image (H, W) or a volume (D, H, W).",
            )
        low, high = _STRENGTHS
        is_valid = low <= real(strength) <= high
        refuse_unless(is_valid, "strength", strength, f"from {low:g} to {high:g}")
        numbers = np.array(given, order="C")
        numbers.setflags(write=False)
        object.__setattr__(self, "labels", numbers)
        object.__setattr__(self, "strength", float(strength))

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("SlidingParts are immutable. Create new SlidingParts")

    def __repr__(self) -> str:
        return f"SlidingParts({len(np.unique(self.labels))} labels)"

    def check(self, stiffness: npt.NDArray[Any]) -> None:
        """Raise an error if the labels do not match the tissue of a problem.

        Raises
        ------
        ProblemError
            If the shape differs, or all tissue has the same label.
        """
        if self.labels.shape != stiffness.shape:
            raise ProblemError(
                "sliding",
                f"has labels of shape {self.labels.shape}, but stiffness has shape "
                f"{stiffness.shape}. Use the same pixel grid for both.",
            )
        of_tissue = self.labels[stiffness > 0]
        if len(of_tissue) and (of_tissue == of_tissue[0]).all():
            raise ProblemError(
                "sliding",
                f"gives all tissue the label {of_tissue[0]}, so that nothing slides. Use different "
                "labels on the two sides of an interface.",
            )


def refuse_sliding(sliding: SlidingParts | None, purpose: str) -> None:
    """Raise an error if parts slide, for results that need a single field of connected tissue.

    Parameters
    ----------
    sliding : SlidingParts or None
    purpose : str
        Result that is not available, as the subject of the message.

    Raises
    ------
    ProblemError
        If there are sliding parts.
    """
    if sliding is not None:
        raise ProblemError(
            "sliding",
            f"divides tissue into parts with fields of their own, for which {purpose} is not "
            "available. Use a problem without sliding parts.",
        )

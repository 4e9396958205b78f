"""Lengths to begin with, before anybody has set them."""

from __future__ import annotations

from collections.abc import Sequence


def usual_radius(shape: Sequence[int], spacing: Sequence[float]) -> float:
    """A radius to take hold of tissue with, in the unit of the spacing.

    Parameters
    ----------
    shape : sequence of int, shape (n,)
        Of the image.
    spacing : sequence of float, shape (n,)
        Size of a pixel.
    """
    shorter = min(size * step for size, step in zip(shape, spacing, strict=True))
    return float(f"{shorter / 16:.2g}")


def usual_step(shape: Sequence[int], spacing: Sequence[float]) -> float:
    """How far tissue is pushed to begin with: enough to be seen. As `usual_radius`.

    Around a disc that grows, tissue is squeezed by the part of its radius that it grows by, and
    around a ball by twice that. By a third nothing folds, at the steps of its rim either.
    """
    return float(f"{usual_radius(shape, spacing) / 3 / (len(shape) - 1):.2g}")

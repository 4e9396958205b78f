"""Default lengths of the drawing tools and their range, in proportion to the image."""

from __future__ import annotations

import math
from collections.abc import Sequence


def usual_radius(
    shape: Sequence[int], spacing: Sequence[float], visible: float = math.inf
) -> float:
    """Return the default radius of a patch of tissue that a tool moves.

    Parameters
    ----------
    shape : sequence of int, shape (n,)
        Shape of the image.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    visible : float
        Shortest side of the visible region, in the unit of the spacing.

    Returns
    -------
    float
        Radius in the unit of the spacing: 1/16 of the shortest side of the image, or of the visible
        region if it is smaller.
    """
    shorter = min(visible, *(size * step for size, step in zip(shape, spacing, strict=True)))
    return float(f"{shorter / 16:.2g}")


def length_range(shape: Sequence[int], spacing: Sequence[float]) -> tuple[float, float]:
    """Return the smallest radius and the largest length that have an effect in an image.

    Parameters
    ----------
    shape, spacing
        As for `usual_radius`.

    Returns
    -------
    smallest : float
        Half a pixel; the patch of a smaller radius is the same pixel.
    largest : float
        Longest side of the image.
    """
    sides = (size * step for size, step in zip(shape, spacing, strict=True))
    return float(f"{min(spacing) / 2:.2g}"), float(f"{max(sides):.4g}")


def largest_spread(shape: Sequence[int], spacing: Sequence[float]) -> float:
    """Return the largest standard deviation of a landmark: the diagonal of the image.

    Parameters
    ----------
    shape, spacing
        As for `usual_radius`.

    Returns
    -------
    float
    """
    diagonal = math.hypot(*(size * step for size, step in zip(shape, spacing, strict=True)))
    return float(f"{diagonal:.4g}")


def usual_step(shape: Sequence[int], spacing: Sequence[float]) -> float:
    """Return the default displacement of a patch: visible, but too small to fold tissue.

    The compression of the tissue around an expanding disc is the ratio of the expansion to the
    radius; around a ball it is twice this ratio. Up to a compression of 1/3, tissue does not fold,
    even at the pixel steps of the rim.

    Parameters
    ----------
    shape, spacing
        As for `usual_radius`.

    Returns
    -------
    float
        Displacement in the unit of the spacing.
    """
    return float(f"{usual_radius(shape, spacing) / 3 / (len(shape) - 1):.2g}")

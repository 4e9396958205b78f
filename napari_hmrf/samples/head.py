"""A head in three dimensions: a brain with ventricles in its skull, and a tumour that grows in it.

What `phantoms` draws in two. All of it is a formula, so that it has any size, and lengths are in
millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import is_whole, real, refuse_unless
from napari_hmrf.solver.problem import Problem
from napari_hmrf.tissue.boundary_rules import Material, stiffness_image

Uint8Array = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]

#: The smallest size at which the head still has an inside.
SMALLEST = 24
#: From the back of the head to its front, in millimetres; of the brain half as much along (up,
#: front, side), and how thick the skull is around it.
_LONG, _BRAIN, _SKULL = 190.0, (62.0, 84.0, 66.0), 7.0
#: Where the tumour is from the middle of the brain, and its radius.
_TUMOUR_AT, _TUMOUR = (10.0, -28.0, 30.0), 20.0
#: Halves of a ventricle's horns, and where they are: up, front, side.
_HORNS = (((8.0, 30.0, 8.0), (10.0, 6.0, 11.0)), ((16.0, 9.0, 7.0), (0.0, -24.0, 17.0)))

MATERIALS = (
    Material(0, "outside", 0.0),
    Material(1, "brain", 1.0),
    Material(2, "ventricles", 0.1),
    Material(3, "tumour", 4.0),
)


@dataclass(frozen=True, eq=False)
class HeadPhantom:
    """A head as a scanner might see it, and what its tissue is.

    Attributes
    ----------
    image : ndarray, shape (D, H, W), uint8
        Axes lead up, to the front and to the side.
    tissue_labels : ndarray, shape (D, H, W), uint8
        Labels of `materials`; the skull, which holds the brain, is outside.
    materials : tuple of Material
        Relative stiffness.
    spacing : tuple of float
        Size of a voxel along each axis, in millimetres.
    growth : float
        How far the rim of the tumour moves outward, in millimetres.
    """

    image: Uint8Array
    tissue_labels: Uint8Array
    materials: tuple[Material, ...]
    spacing: tuple[float, float, float]
    growth: float

    @cached_property
    def problem(self) -> Problem:
        """The brain is held at the skull, and the rim of the tumour moves as if all of it grew."""
        tissue = self.tissue_labels > 0
        rim = tissue & ~scipy.ndimage.binary_erosion(tissue)
        tumour = self.tissue_labels == 3
        # A rim without gaps across edges and corners: what is inside follows it alone.
        moved = tumour & ~scipy.ndimage.binary_erosion(tumour, np.ones((3, 3, 3)))
        away = np.stack(_from(self.image.shape, self.spacing, _TUMOUR_AT), axis=-1)
        known = (rim | moved)[..., None]
        y = np.where(moved[..., None], self.growth / _TUMOUR * away, 0.0)
        c = np.broadcast_to(known, y.shape)
        m = stiffness_image(self.tissue_labels, self.materials)
        return Problem(y, c, m, spacing=self.spacing)


def head_phantom(size: int = 64, *, growth: float = 5.0) -> HeadPhantom:
    """Draw the head at any size.

    Parameters
    ----------
    size : int
        Voxels from its back to its front; across and upward it has four fifths as many. At 190
        voxels are 1 mm wide.
    growth : float
        How far the rim of the tumour moves outward, in millimetres. Its radius is 20.

    Returns
    -------
    HeadPhantom

    Raises
    ------
    ArgumentError
        If the size is no whole number of at least 24, or the growth no number.
    """
    what = f"a whole number of at least {SMALLEST}"
    refuse_unless(is_whole(size) and size >= SMALLEST, "size", size, what)
    refuse_unless(math.isfinite(real(growth)), "growth", growth, "a length in millimetres")
    side = _LONG / int(size)
    spacing = (side, side, side)
    shape = (round(0.8 * size), int(size), round(0.8 * size))
    up, front, across = _from(shape, spacing)
    inside = _ball((up, front, across), _BRAIN) <= 1
    bone = ~inside & (_ball((up, front, across), [half + _SKULL for half in _BRAIN]) <= 1)
    tissue = inside.astype(np.uint8)
    for half, (high, ahead, beside) in _HORNS:
        for way in (-1, 1):
            horn = _ball((up - high, front - ahead, across - way * beside), half) <= 1
            tissue[horn & inside] = 2
    tissue[_ball(_from(shape, spacing, _TUMOUR_AT), (_TUMOUR,) * 3) <= 1] = 3
    grey = np.array([0.0, 130.0, 60.0, 200.0])[tissue] + 235.0 * bone
    # The fissure between the halves, and folds, so that motion within the brain can be seen.
    grey -= (tissue == 1) * 50.0 * np.exp(-((across / 2.5) ** 2)) * (up > 0)
    folds = np.sin(0.42 * up + 2.0 * np.sin(0.16 * front)) + np.sin(
        0.45 * across + 1.8 * np.sin(0.14 * up + 0.15 * front)
    )
    grey += (tissue > 0) * 12.0 * folds
    image = scipy.ndimage.gaussian_filter(grey, 0.6)
    pixels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    for array in (pixels, tissue):
        array.setflags(write=False)
    return HeadPhantom(pixels, tissue, MATERIALS, spacing, float(growth))


def _from(
    shape: tuple[int, ...],
    spacing: tuple[float, ...],
    middle: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far each voxel is from a place, which is given from the middle of all; in millimetres."""
    lines = [
        (np.arange(count) - (count - 1) / 2) * step - at
        for count, step, at in zip(shape, spacing, middle, strict=True)
    ]
    up, front, across = np.meshgrid(*lines, indexing="ij")
    return up, front, across


def _ball(away: tuple[FloatArray, ...], half: tuple[float, ...] | list[float]) -> FloatArray:
    """At most 1 inside an ellipsoid."""
    squares = ((part / size) ** 2 for part, size in zip(away, half, strict=True))
    inside: FloatArray = np.asarray(sum(squares), dtype=np.float64)
    return inside

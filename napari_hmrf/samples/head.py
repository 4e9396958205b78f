"""Three-dimensional phantom of a head: a brain with ventricles and a growing tumour, in a skull.

Formulas define all shapes, so the phantom can have any size. Lengths are in millimetres. The module
`phantoms` contains two-dimensional phantoms.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.checks import Number, convert
from napari_hmrf.field.frame import PATIENT_AXES, Frame
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.samples.phantoms import checked_size
from napari_hmrf.solver.problem import Problem
from napari_hmrf.tissue.boundary_rules import (
    BoundaryRule,
    Material,
    boundary_images,
    stiffness_image,
)

Uint8Array = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]

#: Smallest size at which every part of the head has interior voxels.
SMALLEST = 24
#: Size of the sample in napari, at which voxels are 2 mm wide.
SAMPLE_SIZE = 95
#: Outward displacement of the tumour's rim in the sample and the demonstration, in mm. With
#: 2.5 mm or more, elastic tissue around the tumour folds.
GROWTH = 2.0
#: Length of the image from front to back, half axes of the brain along (up, back, left), and
#: thickness of the skull, in millimetres.
_LONG, _BRAIN, _SKULL = 190.0, (62.0, 84.0, 66.0), 7.0
#: Position (up, back, left) of the tumour relative to the centre of the brain, and radius of the
#: tumour, in millimetres.
_TUMOUR_AT, _RADIUS = (10.0, 28.0, 30.0), 20.0
#: Half axes and position of each horn of a ventricle along (up, back, lateral), in millimetres.
_HORNS = (((8.0, 30.0, 8.0), (10.0, -6.0, 11.0)), ((16.0, 9.0, 7.0), (0.0, 24.0, 17.0)))

#: Label of the tumour.
TUMOUR = 3

MATERIALS = (
    Material(0, "outside", 0.0),
    Material(1, "brain", 1.0),
    Material(2, "ventricles", 0.1),
    Material(TUMOUR, "tumour", 4.0),
)


@dataclass(frozen=True, eq=False)
class HeadPhantom:
    """Synthetic head with its tissue and the known motion of its boundaries.

    Attributes
    ----------
    image : ndarray, shape (D, H, W), uint8
        Image with axes that point up, back and to the left of the patient.
    tissue_labels : ndarray, shape (D, H, W), uint8
        Labels of `materials`; the skull has label 0, like the outside.
    materials : tuple of Material
        Materials with relative stiffness.
    boundary_labels : ndarray, shape (D, H, W), uint8
        Label of the boundary rule at each voxel; 0 where the motion is not observed.
    boundary : tuple of BoundaryRule
        Rules of the boundary labels: the brain is fixed at the skull, and the rim of the tumour
        moves outward. Lengths are in millimetres.
    spacing : tuple of float
        Size of a voxel along each axis, in millimetres.
    growth : float
        Outward displacement of the rim of the tumour, in millimetres.
    """

    image: Uint8Array
    tissue_labels: Uint8Array
    materials: tuple[Material, ...]
    boundary_labels: Uint8Array
    boundary: tuple[BoundaryRule, ...]
    spacing: tuple[float, float, float]
    growth: float

    title = "Head with a growing tumour"

    def __repr__(self) -> str:
        sizes = f"{grid_in_words(self.image.shape)} voxels of {self.spacing[0]:.3g} mm"
        return f"HeadPhantom({sizes}, tumour grown by {self.growth:g} mm)"

    @cached_property
    def problem(self) -> Problem:
        """Problem that the labels and their tables define."""
        y, c = boundary_images(self.boundary_labels, self.boundary, spacing=self.spacing)
        m = stiffness_image(self.tissue_labels, self.materials)
        return Problem(observed=y, confidence=c, stiffness=m, spacing=self.spacing)

    @property
    def frame(self) -> Frame:
        """Frame that places the centre of the head at the origin of patient coordinates."""
        affine = np.eye(4)
        affine[:3, 3] = -(np.array(self.image.shape) - 1) / 2 * self.spacing
        units = ("millimeter",) * 3
        return Frame.at(
            self.spacing, units, affine=affine, axis_labels=tuple(PATIENT_AXES), volume=True
        )


def head_phantom(size: int = 64, *, growth: float = 5.0) -> HeadPhantom:
    """Create the phantom of a head at any size.

    Parameters
    ----------
    size : int
        Number of voxels from front to back. The other axes have 0.8 times as many voxels. At size
        190, voxels are 1 mm wide.
    growth : float
        Outward displacement of the rim of the tumour, in millimetres. The radius of the tumour is
        20 mm.

    Returns
    -------
    HeadPhantom

    Raises
    ------
    ArgumentError
        If the size is not a whole number of at least 24, or the growth is not a finite number.
    """
    size, growth = checked_size(size, SMALLEST), convert(Number, growth, "growth")
    side = _LONG / size
    spacing = (side, side, side)
    shape = (round(0.8 * size), size, round(0.8 * size))
    up, back, left = _from(shape, spacing)
    inside = _ball((up, back, left), _BRAIN) <= 1
    bone = ~inside & (_ball((up, back, left), [half + _SKULL for half in _BRAIN]) <= 1)
    tissue = inside.astype(np.uint8)
    for half, (high, behind, beside) in _HORNS:
        for way in (-1, 1):
            horn = _ball((up - high, back - behind, left - way * beside), half) <= 1
            tissue[horn & inside] = 2
    tumour = _ball(_from(shape, spacing, _TUMOUR_AT), (_RADIUS,) * 3) <= 1
    tissue[tumour] = TUMOUR
    grey = np.array([0.0, 130.0, 60.0, 200.0])[tissue] + 235.0 * bone
    # The fissure between the hemispheres, and folds that make motion within the brain visible.
    grey -= (tissue == 1) * 50.0 * np.exp(-((left / 2.5) ** 2)) * (up > 0)
    folds = np.sin(0.42 * up + 2.0 * np.sin(0.16 * back)) + np.sin(
        0.45 * left + 1.8 * np.sin(0.14 * up + 0.15 * back)
    )
    grey += (tissue > 0) * 12.0 * folds
    image = scipy.ndimage.gaussian_filter(grey, 0.6)
    pixels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    boundary = (inside & ~scipy.ndimage.binary_erosion(inside)).astype(np.uint8)
    # With the full neighbourhood the rim has no gaps at edges and corners, so it separates the
    # interior of the tumour from the brain.
    boundary[tumour & ~scipy.ndimage.binary_erosion(tumour, np.ones((3, 3, 3)))] = 2
    rules = (
        BoundaryRule(1, "fixed", name="skull"),
        BoundaryRule(2, "expand", amount=float(growth), name="tumour rim"),
    )
    for array in (pixels, tissue, boundary):
        array.setflags(write=False)
    return HeadPhantom(pixels, tissue, MATERIALS, boundary, rules, spacing, float(growth))


def _from(
    shape: tuple[int, ...],
    spacing: tuple[float, ...],
    middle: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the offset of each voxel from a position, in millimetres.

    The position `middle` is relative to the centre of the image.
    """
    lines = [
        (np.arange(count) - (count - 1) / 2) * step - at
        for count, step, at in zip(shape, spacing, middle, strict=True)
    ]
    up, back, left = np.meshgrid(*lines, indexing="ij")
    return up, back, left


def _ball(away: tuple[FloatArray, ...], half: tuple[float, ...] | list[float]) -> FloatArray:
    """Return the squared distance from the centre of an ellipsoid, scaled to 1 on its surface."""
    squares = ((part / size) ** 2 for part, size in zip(away, half, strict=True))
    inside: FloatArray = np.asarray(sum(squares), dtype=np.float64)
    return inside

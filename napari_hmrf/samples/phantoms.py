"""Phantoms: synthetic images with their tissue and the motion of their boundaries.

The phantoms are the brain of the paper's figure 1, which expands or is pushed by a growing tumour,
and a bar of two tissues. Each phantom consists of label images and two small tables, which are
converted to a `Problem` in the same way as painted layers.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import get_args

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import is_one_of, refuse_unless, shown
from napari_hmrf.errors import ArgumentError
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.resources import resource_folder
from napari_hmrf.samples import PhantomName
from napari_hmrf.solver.problem import Problem
from napari_hmrf.tissue.boundary_rules import (
    BoundaryRule,
    Material,
    boundary_images,
    sliding_parts,
    stiffness_image,
)
from napari_hmrf.tissue.normals import outer_rim
from napari_hmrf.tissue.painted_loads import growth_loads

#: Names of the phantoms.
PHANTOM_NAMES: tuple[str, ...] = get_args(PhantomName)
#: Smallest size, in pixels, at which every part of the phantoms has interior pixels.
SMALLEST = 16
#: Size, in pixels, for which the geometry is defined: the size of the paper's images.
_DRAWN_AT = 300

_OUTSIDE = Material(0, "outside", 0.0)
_NORMAL = Material(1, "normal tissue", 20.0)
_SOFT = Material(2, "soft tissue", 10.0)
_TUMOUR = Material(3, "tumour", 40.0)

_TITLES = {
    "expansion": "Brain that expands outward",
    "mass-effect": "Brain with a tumour whose rim is pushed",
    "bar": "Bar of two tissues, pulled",
}

_GROWING = "Brain with a growing tumour"
_PAIR = "Brain before and after its tumour grew"

Uint8Array = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Phantom:
    """Synthetic image with its tissue and the motion of its boundaries.

    Attributes
    ----------
    name : str
        "expansion", "mass-effect", "bar" or "chest".
    title : str
        Short description of the phantom.
    image : ndarray, shape (H, W), uint8
        Synthetic scan.
    tissue_labels : ndarray, shape (H, W), uint8
        Labels of `materials`, with 0 outside (void). In the brains and the bar, 1 is normal tissue,
        2 soft tissue and 3 a tumour.
    materials : tuple of Material
        Materials of the tissue labels with relative stiffness, in the brains and the bar that of
        the paper: 20, 10 and 40, and 0 outside.
    boundary_labels : ndarray, shape (H, W), uint8
        Label of the boundary rule at each pixel; 0 where the motion is not observed.
    boundary : tuple of BoundaryRule
        Rules of the boundary labels; lengths are in pixels.
    """

    name: str
    title: str
    image: Uint8Array
    tissue_labels: Uint8Array
    materials: tuple[Material, ...]
    boundary_labels: Uint8Array
    boundary: tuple[BoundaryRule, ...]

    def __repr__(self) -> str:
        return f"Phantom({self.name!r}, {grid_in_words(self.image.shape)} pixels)"

    @cached_property
    def problem(self) -> Problem:
        """Problem that the labels and their tables define, with spacing (1, 1)."""
        y, c = boundary_images(self.boundary_labels, self.boundary, spacing=1)
        loads = growth_loads(self.tissue_labels, self.materials)
        m = stiffness_image(self.tissue_labels, self.materials)
        parts = sliding_parts(self.tissue_labels, self.materials, m)
        return Problem(observed=y, confidence=c, stiffness=m, loads=loads, sliding=parts)

    def growing(self, strain: float = 0.4) -> Phantom:
        """Return the brain of "mass-effect" with a growing tumour instead of a pushed rim.

        Parameters
        ----------
        strain : float
            Growth of the tumour, as a relative change in length. With the default, the rim of the
            tumour moves by about 8 pixels at size 300, as in "mass-effect".

        Returns
        -------
        Phantom
        """
        tumour = replace(_TUMOUR, growth=strain)
        labels = np.where(self.boundary_labels == 2, 0, self.boundary_labels).astype(np.uint8)
        return replace(
            self,
            title=_GROWING,
            materials=tuple(tumour if row == _TUMOUR else row for row in self.materials),
            boundary_labels=labels,
            boundary=self.boundary[:1],
        )


def phantom(name: str, size: int = 300) -> Phantom:
    """Create a phantom at any size.

    Parameters
    ----------
    name : {"expansion", "mass-effect", "bar"}
        "expansion": the outline of the brain moves outward by 10 pixels. "mass-effect": the
        outline is fixed, and the rim of the tumour moves outward by 8 pixels. "bar": half of the
        bar is normal tissue and half is soft tissue; the left end is fixed, and the right end
        moves by 20 pixels to the right. These lengths apply at size 300 and scale with the size.
    size : int
        Number of pixels along each side, at least 16. The height of the bar is a third of this
        number.

    Returns
    -------
    Phantom

    Raises
    ------
    ArgumentError
        If there is no phantom with this name, or if `size` is not a whole number of at least 16.
    """
    size = _checked(name, size)
    if name == "bar":
        tissue, boundary_labels = _bar(size)
        image = _texture(_painted(tissue, {1: 105.0, 2: 205.0}), size)
    else:
        tissue, outline = _brain(size)
        boundary_labels = outline.astype(np.uint8)
        if name == "mass-effect":
            boundary_labels[_rim(tissue == _TUMOUR.label, size)] = 2
        image = _brain_image(tissue, size)
    return _assembled(name, size, image, tissue, boundary_labels)


def sample(name: str) -> Phantom:
    """Return the phantom of size 300 from `sample_data`, which equals ``phantom(name)``.

    Parameters
    ----------
    name : {"expansion", "mass-effect", "bar"}

    Returns
    -------
    Phantom

    Raises
    ------
    ArgumentError
        If there is no phantom with this name.
    FileNotFoundError
        If the installation is incomplete.
    """
    stored = _stored(name, "image", "tissue_labels", "boundary_labels")
    return _assembled(name, _DRAWN_AT, *stored)


def reference_displacement(name: str) -> npt.NDArray[np.float32]:
    """Return the finite-element displacement of ``phantom(name)`` from `sample_data`.

    The field was computed with bilinear quadrilaterals on the pixel grid, in plane stress and with
    a Poisson's ratio of 0.3. The values are stored with a resolution of 0.001 pixels.

    Parameters
    ----------
    name : {"expansion", "mass-effect", "bar"}

    Returns
    -------
    ndarray, shape (H, W, 2), float32
        Material displacement in pixels, in (row, col) order; 0 outside tissue.

    Raises
    ------
    ArgumentError
        If there is no phantom with this name.
    FileNotFoundError
        If the installation is incomplete.
    """
    (thousandths,) = _stored(name, "reference")
    return thousandths.astype(np.float32) / np.float32(1000)


def image_pair() -> tuple[Phantom, Uint8Array]:
    """Return a brain, and its image after its tumour has grown, from `sample_data`.

    The tumour grew by 40 % in length, and the outline of the brain did not move. Both images have
    noise; the second image has another contrast and a smooth bias.

    Returns
    -------
    before : Phantom
        Brain before the growth, with its tissues; its outline is fixed.
    after : ndarray, shape (H, W), uint8
        Image after the growth.

    Raises
    ------
    FileNotFoundError
        If the installation is incomplete.
    """
    with np.load(_file("two-images"), allow_pickle=False) as file:
        before, after = file["before"], file["after"]
    for image in (before, after):
        image.setflags(write=False)
    return replace(held_brain(), title=_PAIR, image=before), after


def held_brain() -> Phantom:
    """Return the brain of "mass-effect" with fixed outermost pixels, and without growth."""
    brain = sample("mass-effect").growing(0.0)
    rim = outer_rim(brain.tissue_labels != _OUTSIDE.label).astype(np.uint8)
    return replace(brain, boundary_labels=rim)


def _checked(name: str, size: object) -> int:
    if not is_one_of(name, PHANTOM_NAMES):
        names = ", ".join(PHANTOM_NAMES)
        raise ArgumentError(f"unknown phantom {shown(name)}; use one of {names}")
    return checked_size(size, SMALLEST)


def checked_size(size: object, smallest: int) -> int:
    """Return the size of a phantom, in pixels.

    Raises
    ------
    ArgumentError
        If the size is not a whole number of at least `smallest`.
    """
    try:
        pixels = operator.index(size)  # type: ignore[arg-type]
    except TypeError:
        pixels = 0
    refuse_unless(pixels >= smallest, "size", size, f"a whole number of at least {smallest}")
    return pixels


def _stored(name: str, *members: str) -> tuple[Uint8Array, ...]:
    _checked(name, _DRAWN_AT)
    with np.load(_file(name), allow_pickle=False) as file:
        return tuple(file[member] for member in members)


def _file(name: str) -> Path:
    return resource_folder("sample_data") / f"{name}.npz"


def _assembled(
    name: str, size: int, image: Uint8Array, tissue: Uint8Array, boundary_labels: Uint8Array
) -> Phantom:
    scale = size / _DRAWN_AT
    materials: tuple[Material, ...] = (_OUTSIDE, _NORMAL, _SOFT, _TUMOUR)
    boundary: tuple[BoundaryRule, ...]
    if name == "expansion":
        boundary = (BoundaryRule(1, "expand", amount=10.0 * scale, name="outline"),)
    elif name == "mass-effect":
        boundary = (
            BoundaryRule(1, "fixed", name="outline"),
            BoundaryRule(2, "expand", amount=8.0 * scale, name="tumour rim"),
        )
    else:
        materials = (_NORMAL, _SOFT)
        boundary = (
            BoundaryRule(1, "fixed", name="left end"),
            BoundaryRule(2, "move", vector=(0.0, 20.0 * scale), name="right end"),
        )
    for array in (image, tissue, boundary_labels):
        array.setflags(write=False)
    return Phantom(name, _TITLES[name], image, tissue, materials, boundary_labels, boundary)


def _width(size: int) -> int:
    """Return the width of the painted boundary, in pixels."""
    return max(2, round(3 * size / _DRAWN_AT))


def _rim(region: npt.NDArray[np.bool_], size: int) -> npt.NDArray[np.bool_]:
    """Return the mask of a region's rim, which is as wide as the painted boundary."""
    rim: npt.NDArray[np.bool_] = region & (
        scipy.ndimage.distance_transform_edt(region) <= _width(size)
    )
    return rim


def _coordinates(shape: tuple[int, int], size: int) -> tuple[FloatArray, FloatArray]:
    """Return the offset (row, col) of each pixel from the centre, in pixels at size 300."""
    row, col = np.ogrid[: shape[0], : shape[1]]
    scale = _DRAWN_AT / size
    return (row - (shape[0] - 1) / 2) * scale, (col - (shape[1] - 1) / 2) * scale


def _ellipse(
    row: FloatArray,
    col: FloatArray,
    centre: tuple[float, float],
    half: tuple[float, float],
    tilt: tuple[float, float] = (1.0, 0.0),
) -> npt.NDArray[np.bool_]:
    """Return the mask of an ellipse.

    The half axes `half` are parallel and perpendicular to the unit vector `tilt`.
    """
    row, col = row - centre[0], col - centre[1]
    along = (row * tilt[0] + col * tilt[1]) / half[0]
    across = (col * tilt[0] - row * tilt[1]) / half[1]
    inside: npt.NDArray[np.bool_] = along * along + across * across <= 1.0
    return inside


def _brain(size: int) -> tuple[Uint8Array, npt.NDArray[np.bool_]]:
    """Return the tissue labels of the brain, and the mask of its outline."""
    row, col = _coordinates((size, size), size)
    # The brain is egg-shaped and slightly wider at the back. It has two ventricles with two horns
    # each, and a round tumour. The formulas use only sums, products and quotients, so the labels
    # are identical on all platforms.
    egg = col / (106.0 * (1.0 + 0.06 * row / 128.0))
    inside = egg * egg + (row / 128.0) * (row / 128.0) <= 1.0
    tissue = np.zeros((size, size), dtype=np.uint8)
    tissue[inside] = _NORMAL.label
    for side in (-1.0, 1.0):
        front = _ellipse(row, col, (-36.0, side * 23.0), (34.0, 12.0), (0.96, -side * 0.28))
        back = _ellipse(row, col, (-2.0, side * 17.0), (18.0, 8.0), (0.96, side * 0.28))
        tissue[front | back] = _SOFT.label
    tissue[_ellipse(row, col, (50.0, 48.0), (30.0, 30.0))] = _TUMOUR.label
    return tissue, _rim(inside, size)


def _bar(size: int) -> tuple[Uint8Array, Uint8Array]:
    """Return the tissue labels and the boundary labels of the bar."""
    shape = (round(size / 3), size)
    tissue = np.full(shape, _NORMAL.label, dtype=np.uint8)
    tissue[:, size // 2 :] = _SOFT.label
    boundary = np.zeros(shape, dtype=np.uint8)
    boundary[:, : _width(size)] = 1
    boundary[:, -_width(size) :] = 2
    return tissue, boundary


def _painted(tissue: Uint8Array, greys: dict[int, float]) -> FloatArray:
    table = np.zeros(4)
    for label, grey in greys.items():
        table[label] = grey
    return table[tissue]


def _brain_image(tissue: Uint8Array, size: int) -> Uint8Array:
    grey = _painted(tissue, {1: 130.0, 2: 225.0, 3: 45.0})
    inside = tissue > 0
    row, col = _coordinates(tissue.shape, size)
    # The cortex and the fissure between the hemispheres are slightly darker.
    depth = scipy.ndimage.distance_transform_edt(inside) * (_DRAWN_AT / size)
    normal = tissue == _NORMAL.label
    grey -= normal * (28.0 * np.exp(-((depth / 9.0) ** 2)))
    fissure = np.exp(-((col / 2.0) ** 2)) * (np.abs(row) > 62.0)
    grey -= normal * (40.0 * fissure)
    return _texture(grey, size)


def _texture(grey: FloatArray, size: int) -> Uint8Array:
    """Return a slightly blurred image with folds, which make motion within a tissue visible."""
    row, col = _coordinates(grey.shape, size)
    folds = (
        6.0 * np.sin(0.23 * row + 2.1 * np.sin(0.083 * col + 0.4))
        + 6.0 * np.sin(0.27 * col + 1.7 * np.sin(0.071 * row + 1.3))
        + 3.5 * np.sin(0.61 * row - 0.44 * col + 1.9 * np.sin(0.15 * col))
        + 3.5 * np.sin(0.48 * row + 0.67 * col + 1.6 * np.sin(0.13 * row))
    )
    image = scipy.ndimage.gaussian_filter(grey + folds * (grey > 0), 0.7)
    grey_levels: Uint8Array = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return grey_levels

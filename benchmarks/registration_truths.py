"""Known deformations of a head, for the benchmark of registration.

Each case is a head, its image after a known displacement, and this displacement. The image after
the displacement has another gamma, a smooth bias and noise. The random numbers depend on the seed
only, so that a case is reproducible.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf import NeoHookeanPrior, Problem, solve, warp
from napari_hmrf.data import head_phantom
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.io.images import read_image
from napari_hmrf.loads import Loads

Array = npt.NDArray[Any]

#: Relative stiffness of grey matter, white matter, and everything else.
_GREY, _WHITE, _FLUID = 1.0, 1.5, 0.05
#: Relative stiffness of a lesion, its radius in mm, its growth as a strain, and its brightness.
_LESION, _RADIUS, _GROWTH, _DARKER = 4.0, 16.0, 0.4, 0.6
#: Radius and motion of a moved region in mm, and number of regions.
_REGION, _PULL, _REGIONS = 12.0, 9.0, 3
#: Distance from the brain, in mm, at which tissue is fixed.
_FIXED_BEYOND = 8.0
#: Pixels of elastic truths are larger by this factor.
_COARSER = 2
#: Smallest determinant of a truth.
_LEAST = 0.2


class Head(NamedTuple):
    """Image of a head with its tissue.

    Attributes
    ----------
    name : str
    image : ndarray, shape (D, H, W), float32
        Brightness from 0 to 1.
    brain : ndarray of bool
        Tissue in which errors are measured.
    stiffness : ndarray, float32
        Relative stiffness.
    spacing : tuple of float
        Size of a voxel in mm.
    """

    name: str
    image: Array
    brain: Array
    stiffness: Array
    spacing: tuple[float, ...]


class Case(NamedTuple):
    """Two images, and the displacement between them in mm."""

    fixed: Array
    moving: Array
    displacement: Array


def phantom_head(size: int) -> Head:
    """Return the synthetic head of the package."""
    head = head_phantom(size)
    m = head.problem.stiffness
    image = (head.image / head.image.max()).astype(np.float32)
    return Head(f"phantom-{size}", image, m > 0, np.maximum(m, _FLUID), head.spacing)


def head_from_files(image: Path, tissue: list[Path], voxel: float) -> Head:
    """Read a head from files.

    Parameters
    ----------
    image : path
        Volume, such as a T1-weighted MRI.
    tissue : list of path
        Probability maps of grey and white matter on the grid of `image`. Without maps, all pixels
        brighter than a threshold count as tissue.
    voxel : float
        Size of a voxel in mm; the volume is sampled at every n-th voxel.
    """
    read = read_image(image)
    if read.place is None or read.pixels.ndim != 3:
        raise SystemExit(f"{image} is not a volume with a place in mm. Pass a NIfTI file")
    steps = [max(1, round(voxel / size)) for size in read.place.spacing]

    def sampled(pixels: Array) -> Array:
        smooth = [step / 2.5 if step > 1 else 0 for step in steps]
        return ndimage.gaussian_filter(pixels.astype(np.float32), smooth)[
            tuple(slice(None, None, step) for step in steps)
        ]

    pixels = sampled(read.pixels)
    maps = [sampled(read_image(path).pixels) for path in tissue]
    m = np.full(pixels.shape, _FLUID, np.float32)
    if maps:
        half = max(each.max() for each in maps) / 2
        brain = sum(maps) > 0.8 * half
        m[brain] = _GREY
        if len(maps) > 1:
            m[brain & (maps[1] > maps[0])] = _WHITE
    else:
        brain = ndimage.binary_opening(pixels > 0.25 * np.quantile(pixels, 0.99), iterations=2)
        m[brain] = _GREY
    spacing = tuple(step * size for step, size in zip(steps, read.place.spacing, strict=True))
    name = f"{image.name.split('.')[0]}-{spacing[0]:g}mm"
    return Head(name, pixels / pixels.max(), brain, m, spacing)


def case(head: Head, truth: str, seed: int) -> Case:
    """Return a case.

    Parameters
    ----------
    head : Head
    truth : str
        Key of `TRUTHS`.
    seed : int
    """
    number = list(TRUTHS).index(truth)
    rng = np.random.default_rng([seed, number] if number else seed)
    fixed, displacement = TRUTHS[truth](head, rng)
    moving = warp(fixed, displacement, spacing=head.spacing)
    return Case(fixed, degraded(rng, moving, head.spacing), displacement)


def random_splines(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    spacing: tuple[float, ...],
    gap: float,
    size: float,
) -> Array:
    """Return a displacement of random cubic B-splines.

    Parameters
    ----------
    rng : Generator
    shape, spacing : tuple
        Grid.
    gap : float
        Distance of the knots, in the unit of the spacing.
    size : float
        Root mean square of the displacement.
    """
    extent = [count * side for count, side in zip(shape, spacing, strict=True)]
    knots = [math.ceil(length / gap) + 3 for length in extent]
    at = np.meshgrid(
        *(np.arange(count) * side / gap + 1 for count, side in zip(shape, spacing, strict=True)),
        indexing="ij",
    )
    parts = [
        ndimage.map_coordinates(
            rng.normal(size=knots), at, order=3, prefilter=False, mode="nearest"
        )
        for _ in shape
    ]
    field = np.stack(parts, axis=-1)
    return field * (size / np.sqrt((field**2).sum(axis=-1).mean()))


def degraded(rng: np.random.Generator, image: Array, spacing: tuple[float, ...]) -> Array:
    """Return an image with another gamma, a smooth bias of 20 %, and noise of 2 %."""
    bright = np.clip(image / image.max(), 0, 1) ** rng.uniform(0.7, 1.4)
    bias = random_splines(rng, image.shape, spacing, 80.0, 1.0)[..., 0]
    bright = bright * (1 + 0.2 * bias / np.abs(bias).max())
    return (bright + rng.normal(scale=0.02, size=image.shape)).astype(np.float32)


def _splines(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Move tissue by B-splines with knots 24 mm apart, and expand it around a point."""
    field = random_splines(rng, head.image.shape, head.spacing, 24.0, 3.6)
    inner = np.argwhere(_deeper(head, 16.0))
    centre = inner[rng.integers(len(inner))]
    away = _offsets(head, centre)
    far = np.linalg.norm(away, axis=-1, keepdims=True) / 20
    outward = away / 20 * np.exp(0.5 - 0.5 * far**2)
    return head.image, _unfolded(field + 4.0 * outward, head.spacing)


def _fine_splines(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Move tissue by B-splines with knots 12 mm apart."""
    field = random_splines(rng, head.image.shape, head.spacing, 12.0, 2.4)
    return head.image, _unfolded(field, head.spacing)


def _large(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pull three regions of the brain in random directions, in large motion."""
    moved = np.zeros((*head.image.shape, 3), np.float32)
    held = np.zeros(head.image.shape, bool)
    for centre in _places(head, rng, _REGIONS, 14.0, 40.0):
        ball = np.linalg.norm(_offsets(head, centre), axis=-1) <= _REGION
        direction = rng.normal(size=3)
        moved[ball] = _PULL * direction / np.linalg.norm(direction)
        held |= ball
    return head.image, _solved(head, moved, held, head.stiffness, None)


def _grown(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Let two darker lesions grow, in large motion."""
    lesion, m = np.zeros(head.image.shape), head.stiffness.copy()
    for centre in _places(head, rng, 2, 14.0, 45.0):
        radius = _RADIUS * rng.uniform(0.8, 1.2)
        far = np.linalg.norm(_offsets(head, centre) * rng.uniform(0.8, 1.25, 3), axis=-1)
        lesion = np.maximum(lesion, (far <= radius).astype(float))
    m[lesion > 0] = _LESION
    fixed = head.image * (1 - (1 - _DARKER) * ndimage.gaussian_filter(lesion, 0.7))
    nothing = np.zeros((*lesion.shape, 3), np.float32)
    displacement = _solved(head, nothing, np.zeros(lesion.shape, bool), m, _GROWTH * lesion)
    return fixed.astype(np.float32), displacement


TRUTHS: dict[str, Callable[[Head, np.random.Generator], tuple[Array, Array]]] = {
    "splines": _splines,
    "large": _large,
    "growth": _grown,
    "fine": _fine_splines,
}


def _solved(head: Head, y: Array, held: Array, m: Array, growth: Array | None) -> Array:
    """Return a large motion on every second voxel, interpolated by cubic splines."""
    every = (slice(None, None, _COARSER),) * 3
    outside = ndimage.distance_transform_edt(~head.brain, sampling=head.spacing) > _FIXED_BEYOND
    c = np.repeat((held | outside)[every][..., None], 3, axis=-1)
    problem = Problem(
        observed=y[every],
        confidence=c.astype(np.float32),
        stiffness=m[every],
        spacing=[_COARSER * size for size in head.spacing],
        loads=None if growth is None else Loads(growth=growth[every]),
    )
    coarse = solve(problem, NeoHookeanPrior(0.4), backend="cpu").displacement
    at = np.meshgrid(*(np.arange(count) / _COARSER for count in y.shape[:3]), indexing="ij")
    parts = [
        ndimage.map_coordinates(coarse[..., axis], at, order=3, mode="nearest") for axis in range(3)
    ]
    return _unfolded(np.stack(parts, axis=-1), head.spacing)


def _unfolded(displacement: Array, spacing: tuple[float, ...]) -> Array:
    """Return a displacement that is reduced until its smallest determinant is 0.2."""
    while np.nanmin(smallest_determinant(displacement, spacing)) < _LEAST:
        displacement = 0.9 * displacement
    return displacement


def _places(
    head: Head, rng: np.random.Generator, count: int, depth: float, apart: float
) -> list[Array]:
    """Return random voxels at a depth in the brain, at a distance from each other in mm."""
    inner = np.argwhere(_deeper(head, depth))
    places: list[Array] = []
    while len(places) < count:
        place = inner[rng.integers(len(inner))]
        gaps = [np.linalg.norm((place - other) * head.spacing) for other in places]
        if min(gaps, default=math.inf) > apart:
            places.append(place)
    return places


def _deeper(head: Head, depth: float) -> Array:
    """Return the voxels of the filled brain that are deeper than a depth in mm."""
    filled = ndimage.binary_fill_holes(ndimage.binary_closing(head.brain, iterations=3))
    return np.asarray(ndimage.distance_transform_edt(filled, sampling=head.spacing) > depth)


def _offsets(head: Head, centre: Array) -> Array:
    """Return the offset of each voxel from a voxel, in mm."""
    return (np.moveaxis(np.indices(head.image.shape), 0, -1) - centre) * np.array(head.spacing)

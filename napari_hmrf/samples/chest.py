"""Phantom of a chest in a coronal slice: lungs that slide along the chest wall during a breath.

Formulas define all shapes, so the phantom can have any size. As in radiology, the right side of the
patient, with the liver, is on the left of the image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.checks import Number, convert
from napari_hmrf.samples.phantoms import Phantom, checked_size
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material

FloatArray = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: Smallest size, in pixels, at which every part of the chest has interior pixels.
SMALLEST = 96
#: Size, in pixels, for which the geometry is defined, and size of the sample in napari.
_DRAWN_AT = 256

WALL = Material(1, "wall", 10.0)
RIBS = Material(2, "ribs", 500.0)
LUNGS = Material(3, "lungs", 1.0, slides=True)
HEART = Material(4, "heart", 4.0)
ABDOMEN = Material(5, "abdomen", 5.0)

_TITLE = "Chest with lungs that slide along the wall"
#: Brightness of the outside and of each label.
_GREYS = np.array([0.0, 128.0, 215.0, 42.0, 168.0, 148.0])
#: Brightness of the vessels in the lungs.
_VESSEL = 175.0
#: Row and column of the top of each half of the diaphragm, half of its width, and its height.
_DOMES = ((160.0, -50.0, 44.0, 42.0), (168.0, 55.0, 42.0, 40.0))
#: Radius, in pixels, of the corners of the lungs, as the standard deviation of a blur.
_ROUND = 4.0
#: Root of each tree of vessels (row, column), its direction in degrees, and its length.
_ROOTS = (
    ((100.0, -17.0), 118.0, 24.0),
    ((106.0, -18.0), 160.0, 25.0),
    ((116.0, -20.0), 205.0, 27.0),
    ((122.0, -22.0), 250.0, 22.0),
    ((98.0, 17.0), 60.0, 24.0),
    ((104.0, 25.0), 14.0, 28.0),
    ((112.0, 48.0), -30.0, 20.0),
    ((118.0, 56.0), -72.0, 22.0),
)


def chest_phantom(size: int = 256, *, breath: float = 14.0) -> Phantom:
    """Create the phantom of a chest at any size.

    The ribs and the neck are fixed, and the diaphragm moves down. The lungs are soft and slide
    along all other tissue.

    Parameters
    ----------
    size : int
        Number of pixels along each side, at least 96.
    breath : float
        Distance by which the diaphragm moves down, in pixels at size 256. It scales with the size.
        A negative distance breathes out.

    Returns
    -------
    Phantom

    Raises
    ------
    ArgumentError
        If the size is not a whole number of at least 96, or the breath is not a finite number.
    """
    size = checked_size(size, SMALLEST)
    breath = convert(Number, breath, "breath")
    scale = size / _DRAWN_AT
    index = np.arange(size) / scale
    row, col = np.meshgrid(index, index - (_DRAWN_AT - 1) / 2, indexing="ij")
    tissue = _tissue(row, col, scale)
    held = (tissue == RIBS.label) | ((tissue > 0) & (row < 5.0))
    boundary_labels = held.astype(np.uint8)
    boundary_labels[_diaphragm(row, col, scale) & (tissue == ABDOMEN.label)] = 2
    boundary = (
        BoundaryRule(1, "fixed", name="ribs and neck"),
        BoundaryRule(2, "move", vector=(breath * scale, 0.0), name="diaphragm"),
    )
    image = _image(tissue, row, col, scale)
    for array in (image, tissue, boundary_labels):
        array.setflags(write=False)
    materials = (Material(0, "outside", 0.0), WALL, RIBS, LUNGS, HEART, ABDOMEN)
    return Phantom("chest", _TITLE, image, tissue, materials, boundary_labels, boundary)


def _tissue(row: FloatArray, col: FloatArray, scale: float) -> npt.NDArray[np.uint8]:
    """Return the label of each pixel; positions are in pixels at size 256."""
    tissue = np.zeros(row.shape, np.uint8)
    body = _vault(row, col, top=12.0, half=114.0) | ((np.abs(col) < 30.0) & (row < 60.0))
    body = scipy.ndimage.gaussian_filter(body.astype(float), 7.0 * scale, mode="nearest") > 0.5
    tissue[body] = WALL.label
    cavity = _vault(row, col, top=32.0, half=90.0)
    below = _below_diaphragm(row, col)
    tissue[cavity] = HEART.label
    tissue[cavity & below] = ABDOMEN.label
    lungs = cavity & ~below & ~_middle(row, col)
    lungs = scipy.ndimage.gaussian_filter(lungs.astype(float), _ROUND * scale) > 0.5
    tissue[lungs & cavity] = LUNGS.label
    # Tissue between a rounded corner of a lung and the wall belongs to the wall.
    corner = (tissue == HEART.label) & ~_middle(row, col)
    tissue[corner] = WALL.label
    tissue[_ribs(row, col)] = RIBS.label
    return tissue


def _vault(row: FloatArray, col: FloatArray, *, top: float, half: float) -> Mask:
    """Return the mask of a vault that begins at the row `top` and is `half` wide on each side."""
    base = 165.0
    up = np.clip((base - row) / (base - top), 0.0, None)
    taper = half * (1.0 - 0.0006 * np.clip(row - base, 0.0, None))
    inside: Mask = up**2.6 + np.abs(col / taper) ** 2.6 <= 1.0
    return inside


def _below_diaphragm(row: FloatArray, col: FloatArray) -> Mask:
    """Return the mask of the positions below the two domes of the diaphragm."""
    surface = np.full(row.shape, np.inf)
    for top, centre, half, height in _DOMES:
        away = np.abs(col - centre) / half
        np.minimum(surface, top + height * away**2.4, out=surface)
    # The domes join below the heart.
    surface = np.minimum(surface, np.where(np.abs(col) < 60.0, 184.0, np.inf))
    below: Mask = row >= surface
    return below


def _middle(row: FloatArray, col: FloatArray) -> Mask:
    """Return the mask of the heart and of the tissue between the lungs."""
    column = np.abs(col) < 15.0 + 5.0 * np.clip((row - 90.0) / 90.0, 0.0, 1.0)
    down, along = row - 146.0, col - 20.0
    # The axis of the heart points down and to the left side of the patient.
    one = (0.80 * down + 0.60 * along) / 48.0
    other = (0.80 * along - 0.60 * down) / 36.0
    heart: Mask = column | (one * one + other * other <= 1.0)
    return heart


def _ribs(row: FloatArray, col: FloatArray) -> Mask:
    """Return the mask of the cross-sections of the ribs in the chest wall."""
    found = np.zeros(row.shape, bool)
    base, middle = 165.0, 101.0
    for at in np.arange(52.0, 236.0, 23.0):
        up = max((base - at) / (base - 19.0), 0.0)
        out = middle * (1.0 - up**2.6) ** (1 / 2.6)
        for side in (-1.0, 1.0):
            down, along = row - at, col - side * out
            # Ribs descend outward.
            one = (0.86 * down + side * 0.5 * along) / 6.5
            other = (0.86 * along - side * 0.5 * down) / 4.2
            found |= one * one + other * other <= 1.0
    return found


def _diaphragm(row: FloatArray, col: FloatArray, scale: float) -> Mask:
    """Return the mask of the moved tissue below the top of each dome.

    The mask is thick and has round ends, so that tissue does not fold at its ends.
    """
    moved = np.zeros(row.shape, bool)
    for top, centre, half, height in _DOMES:
        away = np.abs(col - centre) / half
        depth = row - (top + height * away**2.4)
        moved |= (away < 0.62) & (depth >= 2.0) & (depth < 18.0)
    blurred: Mask = scipy.ndimage.gaussian_filter(moved.astype(float), 5.0 * scale) > 0.5
    return blurred


def _image(
    tissue: npt.NDArray[np.uint8], row: FloatArray, col: FloatArray, scale: float
) -> npt.NDArray[np.uint8]:
    """Return a smooth image in which the motion of each tissue is visible."""
    grey = _GREYS[tissue]
    ripple = np.sin(0.20 * row + 2.0 * np.sin(0.075 * col + 0.6)) + np.sin(
        0.23 * col + 1.8 * np.sin(0.066 * row + 1.1)
    )
    fine = np.sin(0.55 * row - 0.41 * col + 1.8 * np.sin(0.14 * col))
    grey += np.where(tissue == LUNGS.label, 2.5, 7.0) * (tissue > 0) * ripple
    grey += (tissue > 0) * 2.5 * fine
    lung, bone = tissue == LUNGS.label, tissue == RIBS.label
    # Marrow is darker than the surface of a rib.
    depth = scipy.ndimage.distance_transform_edt(bone) / scale
    grey -= bone * 45.0 * np.clip((depth - 1.5) / 2.0, 0.0, 1.0)
    # The air in the windpipe, which counts as soft tissue, and the skin.
    pipe = np.exp(-((col / 5.5) ** 4)) / (1.0 + np.exp(row - 94.0))
    grey -= pipe * (tissue > 0) * 95.0
    skin = scipy.ndimage.distance_transform_edt(np.pad(tissue > 0, ((1, 0), (1, 1)), mode="edge"))
    grey += (tissue > 0) * 55.0 * np.exp(-((skin[1:, 1:-1] / scale / 2.5) ** 2))
    vessels = _vessels(row, col)
    grey += lung * vessels * (_VESSEL - grey)
    # Vessels of the liver are dark.
    grey -= (
        (tissue == ABDOMEN.label)
        * 26.0
        * np.clip(
            np.sin(0.11 * row + 1.3 * np.sin(0.05 * col)) * np.sin(0.13 * col + 1.1), 0.0, 1.0
        )
    )
    # No brightness leaks out of the body, where it would stay in place while the skin moves.
    image = scipy.ndimage.gaussian_filter(grey, 0.7 * scale) * (tissue > 0)
    pixels: npt.NDArray[np.uint8] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return pixels


def _vessels(row: FloatArray, col: FloatArray) -> FloatArray:
    """Return the share of vessels at each pixel, from 0 to 1."""
    share = np.zeros(row.shape)
    for begin, end, width in (piece for root in _ROOTS for piece in _branches(*root)):
        near = 4.0 * width
        low, high = np.minimum(begin, end) - near, np.maximum(begin, end) + near
        rows = slice(*np.searchsorted(row[:, 0], (low[0], high[0])))
        cols = slice(*np.searchsorted(col[0], (low[1], high[1])))
        down, along = row[rows, cols] - begin[0], col[rows, cols] - begin[1]
        step = end - begin
        part = np.clip((down * step[0] + along * step[1]) / (step @ step), 0.0, 1.0)
        away = np.hypot(down - part * step[0], along - part * step[1])
        profile = np.exp(-((away / width) ** 2))
        np.maximum(share[rows, cols], profile, out=share[rows, cols])
    return share


def _branches(
    root: tuple[float, float], degrees: float, length: float, width: float = 2.6, order: int = 0
) -> Iterator[tuple[FloatArray, FloatArray, float]]:
    """Yield the pieces of a tree of vessels as (begin, end, width), in pixels at size 256.

    The direction of a vessel is anticlockwise from the positive column axis.
    """
    if order == 5:
        return
    angle = math.radians(degrees)
    begin = np.array(root)
    end = begin + length * np.array([-math.sin(angle), math.cos(angle)])
    yield begin, end, width
    # The branches differ, so that the tree looks grown and not drawn.
    turn = 27.0 + 9.0 * math.sin(5.0 * degrees + order)
    for side in (-1.0, 1.0):
        share = 0.74 + 0.08 * math.sin(3.0 * degrees + 2.0 * side)
        place = float(end[0]), float(end[1])
        yield from _branches(place, degrees + side * turn, share * length, 0.76 * width, order + 1)

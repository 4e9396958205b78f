"""Which way is outward, on the parts of a mask: for what expands."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import scipy

#: How far an outline is smoothed before its normal is taken, in pixels.
_SMOOTHING = 1.5
#: A part so many times longer than it is thick is a line, whatever the brush: it has no inside.
_LINE = 8.0
#: Pixels that touch at a corner belong together, as in a ring one pixel wide.
_EIGHT = np.ones((3, 3), dtype=bool)
#: A part in a box of so few pixels has no hole that matters.
_SPECK = 25


class OpenLine(ValueError):
    """A part is an open line: which of its sides is outside, nobody can say.

    Attributes
    ----------
    length, thickness : float
        About, in the unit of the spacing.
    """

    def __init__(self, length: float, thickness: float) -> None:
        super().__init__(f"an open line, {length:.3g} long and {thickness:.3g} thick")
        self.length, self.thickness = length, thickness


def outward_normals(
    mask: npt.NDArray[np.bool_], spacing: Sequence[float]
) -> npt.NDArray[np.float32]:
    """Unit normals of each part's enclosing outline, at the outline's nearest pixel.

    The outline is that of the filled part, and its normal the slope of the filled part blurred:
    pixel steps average out, and a rim of one pixel needs no inside of its own. Deeper inside, many
    pixels share a nearest one; a second blur, of the normals, undoes that.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.

    Returns
    -------
    ndarray, shape (H, W, 2), float32
        In (row, col) order; 0 outside the mask, and where a part is so small that it has no
        direction.

    Raises
    ------
    OpenLine
        If a part has no inside.
    """
    sizes = np.asarray(spacing, dtype=float)
    sigma = _SMOOTHING * sizes.max() / sizes
    margin = tuple(math.ceil(4 * along) + 1 for along in sigma)
    normals = np.zeros((*mask.shape, 2), dtype=np.float32)
    for box, part in _parts(mask):
        padded = np.pad(part, [(size, size) for size in margin])
        filled = scipy.ndimage.binary_fill_holes(padded)
        _refuse_open_line(filled, sizes)
        blurred = scipy.ndimage.gaussian_filter(filled.astype(float), sigma, mode="constant")
        slope = -np.stack(np.gradient(blurred, *sizes), axis=-1)
        outline = filled & ~scipy.ndimage.binary_erosion(filled)
        nearest = scipy.ndimage.distance_transform_edt(
            ~outline, sampling=sizes, return_distances=False, return_indices=True
        )
        normal = _unit(slope[tuple(nearest)])
        normal = _unit(scipy.ndimage.gaussian_filter(normal, (*sigma, 0.0), mode="nearest"))
        inside = tuple(slice(size, -size) for size in margin)
        normals[box][part] = normal[inside][part]
    return normals


def _unit(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Vectors of length 1, or 0 where there is no direction."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: npt.NDArray[np.float64] = np.divide(
        vectors, length, out=np.zeros_like(vectors), where=length > 1e-6
    )
    return units


def _parts(
    mask: npt.NDArray[np.bool_],
) -> Iterator[tuple[tuple[slice, ...], npt.NDArray[np.bool_]]]:
    """Each connected part, with the box that holds it."""
    numbered, _ = scipy.ndimage.label(mask, structure=_EIGHT)
    for number, box in enumerate(scipy.ndimage.find_objects(numbered), start=1):
        yield box, numbered[box] == number


def _refuse_open_line(filled: npt.NDArray[np.bool_], sizes: npt.NDArray[np.float64]) -> None:
    area = float(filled.sum() * sizes.prod())
    deepest = float(scipy.ndimage.distance_transform_edt(filled, sampling=sizes).max())
    at_least = 2 * deepest - sizes.max()
    if area <= _LINE * at_least**2:
        return
    # At half the pixel size even and odd widths both have a middle, and come out as they are.
    fine = filled.repeat(2, axis=0).repeat(2, axis=1)
    thickness = 2 * float(scipy.ndimage.distance_transform_edt(fine, sampling=sizes / 2).max())
    length = area / thickness
    if length > _LINE * thickness:
        raise OpenLine(length, thickness)


def outer_rim(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Tell the outline of the parts of a mask from those of the holes in them.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)

    Returns
    -------
    ndarray of bool, shape (H, W)
        The pixels of each part beside what is around it, or at the edge of the image.
    """
    rim = mask & ~scipy.ndimage.binary_erosion(mask)
    parts, _ = scipy.ndimage.label(mask, structure=_EIGHT)
    for number, box in enumerate(scipy.ndimage.find_objects(parts), 1):
        if parts[box].size <= _SPECK:
            continue
        part = np.pad(parts[box] == number, 1)
        around, _ = scipy.ndimage.label(~part)
        filled = around != around[0, 0]
        inner = part & scipy.ndimage.binary_erosion(filled)
        rim[box] &= ~inner[1:-1, 1:-1]
    return np.asarray(rim)

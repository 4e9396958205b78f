"""Outward normals of the connected parts of a mask, for boundaries that expand."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError

#: Standard deviation of the Gaussian blur of a part before its normals are computed, in pixels.
_SMOOTHING = 1.5
#: Ratio of length to thickness above which a part is an open line, which has no interior. In a
#: volume, a part is an open sheet if both sides are longer than its thickness by this factor.
_LINE = 8.0
#: Largest number of pixels in the bounding box of a part for which holes are ignored.
_SPECK = 25
#: Fraction of the enclosed area below which holes are ignored: the part is a patch, not a ring.
_HOLES = 0.1
#: Width of the rim of a patch that moves with its outline, in pixels. With a rim of one pixel, the
#: paper's schedule would lose the outline on its coarse levels.
_RIM = 2


def outward_normals(
    mask: npt.NDArray[np.bool_], spacing: Sequence[float], name: str
) -> npt.NDArray[np.float32]:
    """Return the outward unit normal of each pixel, from the outline of its connected part.

    The normal of a pixel is the normal at the nearest pixel of the outline. All pixels of a ring
    have a normal. In a patch, only pixels of the rim have a normal, because an interior that moved
    as far as the rim would tear.

    The outline of a part is its outer outline, with holes filled. The normal of the outline is the
    negative gradient of the blurred, filled part. The blur averages pixel steps, and filling makes
    the gradient valid for thin rings. Far from the outline, many pixels share the same nearest
    outline pixel, so a second blur smooths the jumps between normals.

    Parameters
    ----------
    mask : ndarray of bool, shape ([D,] H, W)
        Pixels that expand.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    name : str
        Name of the expanding boundary, for messages.

    Returns
    -------
    ndarray, shape ([D,] H, W, n), float32
        Unit vectors in the order of the axes; 0 outside the mask, in the interior of a patch, and
        in a part that is too small to have a direction.

    Raises
    ------
    ProblemError
        If a part is an open line, which has no interior.
    """
    sizes = np.asarray(spacing, dtype=float)
    sigma = _SMOOTHING * sizes.max() / sizes
    margin = tuple(math.ceil(4 * along) + 1 for along in sigma)
    normals = np.zeros((*mask.shape, mask.ndim), dtype=np.float32)
    for box, part in parts_of(mask):
        padded = np.pad(part, [(size, size) for size in margin])
        filled = ~outside_of(padded)
        _refuse_open_line(filled, sizes, name)
        blurred = scipy.ndimage.gaussian_filter(filled.astype(float), sigma, mode="constant")
        slope = -np.stack(np.gradient(blurred, *sizes), axis=-1)
        outline = filled & ~scipy.ndimage.binary_erosion(filled)
        nearest = scipy.ndimage.distance_transform_edt(
            ~outline, sampling=sizes, return_distances=False, return_indices=True
        )
        normal = _unit(slope[tuple(nearest)])
        normal = _unit(scipy.ndimage.gaussian_filter(normal, (*sigma, 0.0), mode="nearest"))
        inside = tuple(slice(size, -size) for size in margin)
        is_patch = part.sum() > (1 - _HOLES) * filled.sum()
        rim = filled & ~scipy.ndimage.binary_erosion(filled, iterations=_RIM)
        moves = part & rim[inside] if is_patch else part
        normals[box][moves] = normal[inside][moves]
    return normals


def _unit(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Normalize vectors to length 1; a vector of nearly zero length becomes 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: npt.NDArray[np.float64] = np.divide(
        vectors, length, out=np.zeros_like(vectors), where=length > 1e-6
    )
    return units


def parts_of(
    mask: npt.NDArray[np.bool_],
) -> Iterator[tuple[tuple[slice, ...], npt.NDArray[np.bool_]]]:
    """Yield the bounding box of each connected part, and the part within the box."""
    # Pixels that touch at a corner are connected, so a ring may be one pixel wide.
    numbered, _ = scipy.ndimage.label(mask, structure=np.ones((3,) * mask.ndim, dtype=bool))
    for number, box in enumerate(scipy.ndimage.find_objects(numbered), start=1):
        yield box, numbered[box] == number


def _refuse_open_line(
    filled: npt.NDArray[np.bool_], sizes: npt.NDArray[np.float64], name: str
) -> None:
    n = filled.ndim
    content = float(filled.sum() * sizes.prod())
    deepest = float(scipy.ndimage.distance_transform_edt(filled, sampling=sizes).max())
    at_least = 2 * deepest - sizes.max()
    if content <= _LINE ** (n - 1) * at_least**n:
        return
    # At half the pixel size, a part of even or odd width has pixels at its middle, which makes the
    # measured thickness exact.
    fine = np.kron(filled, np.ones((2,) * n, dtype=bool))
    thickness = 2 * float(scipy.ndimage.distance_transform_edt(fine, sampling=sizes / 2).max())
    if content <= _LINE ** (n - 1) * thickness**n:
        return
    length = (content / thickness) ** (1 / (n - 1))
    shape, closed = ("line", "ring") if n == 2 else ("sheet", "shell")
    raise ProblemError(
        "observed",
        f"lets {name} expand, but a part of it is an open {shape} (about {length:.3g} long and "
        f"{thickness:.3g} thick), which has no inside and would tear along its middle. "
        f"Close the {shape} to form a {closed}, or let it move by a vector instead "
        "(`action='move'`).",
    )


def outer_rim(mask: npt.NDArray[np.bool_], *, diagonal: bool = False) -> npt.NDArray[np.bool_]:
    """Return the outer outline of each part of a mask, without the outlines of its holes.

    Parameters
    ----------
    mask : ndarray of bool, shape ([D,] H, W)
    diagonal : bool
        True to include pixels that touch the outside at an edge or a corner only. As corners of an
        element that is missing, they are on the surface of the elements.

    Returns
    -------
    ndarray of bool, shape ([D,] H, W)
        Pixels of each part that are next to the outside of the part or at the edge of the image.
    """
    near = scipy.ndimage.generate_binary_structure(mask.ndim, mask.ndim if diagonal else 1)
    rim = mask & ~scipy.ndimage.binary_erosion(mask, near)
    for box, part in parts_of(mask):
        if part.size > _SPECK:
            rim[box] &= ~(part & scipy.ndimage.binary_erosion(~outside_of(part), near))
    return np.asarray(rim)


def outside_of(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the pixels outside a mask that are connected to the edge of the image.

    Holes of the mask are not connected to the edge.
    """
    # A margin of one pixel around the image connects all regions that touch its edge.
    pieces, _ = scipy.ndimage.label(np.pad(~mask, 1, constant_values=True))
    outside: npt.NDArray[np.bool_] = (pieces == pieces.flat[0])[(slice(1, -1),) * mask.ndim]
    return outside

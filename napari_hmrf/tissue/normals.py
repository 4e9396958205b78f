"""Outward normals of the parts of a mask, for boundaries that expand."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError

#: Width of the smoothing of an outline before its normal is taken, in pixels.
_SMOOTHING = 1.5
#: A part at least this many times longer than thick is a line, whatever the brush, and has no
#: inside; likewise a sheet in a volume, if both its sides are this many times its thickness.
_LINE = 8.0
#: Size of a bounding box, in pixels, up to which holes of a part are ignored.
_SPECK = 25
#: A part whose holes take up less than this share of the enclosed area is a patch, and no ring.
_HOLES = 0.1
#: Width in pixels of the rim of a patch that moves with its outline: with a single pixel the
#: paper's schedule would lose the outline on its coarse levels.
_RIM = 2


def outward_normals(
    mask: npt.NDArray[np.bool_], spacing: Sequence[float], name: str
) -> npt.NDArray[np.float32]:
    """Return unit normals of each part's enclosing outline, at the outline's nearest pixel.

    All pixels of a ring have a normal. In a patch only the rim along its outline has one: tissue
    deeper inside would be torn if it moved as far.

    The outline is that of the filled part, and its normal the slope of the blurred filled part:
    pixel steps average out, and a rim of one pixel needs no inside of its own. Deeper inside, many
    pixels share their nearest outline pixel; a second blur, of the normals, smooths the jumps.

    Parameters
    ----------
    mask : ndarray of bool, shape ([D,] H, W)
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    name : str
        Name of the expanding boundary, for messages.

    Returns
    -------
    ndarray, shape ([D,] H, W, n), float32
        In the order of the axes; 0 outside the mask, inside a patch, and where a part is too small
        to have a direction.

    Raises
    ------
    ProblemError
        If a part is an open line: it has no outside.
    """
    sizes = np.asarray(spacing, dtype=float)
    sigma = _SMOOTHING * sizes.max() / sizes
    margin = tuple(math.ceil(4 * along) + 1 for along in sigma)
    normals = np.zeros((*mask.shape, mask.ndim), dtype=np.float32)
    for box, part in _parts(mask):
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
    """Return vectors of length 1, or 0 where there is no direction."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: npt.NDArray[np.float64] = np.divide(
        vectors, length, out=np.zeros_like(vectors), where=length > 1e-6
    )
    return units


def _parts(
    mask: npt.NDArray[np.bool_],
) -> Iterator[tuple[tuple[slice, ...], npt.NDArray[np.bool_]]]:
    """Yield each connected part, with its bounding box."""
    # Pixels that touch at a corner belong together, as in a ring one pixel wide.
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
    # At half the pixel size both even and odd widths have a middle, and are measured exactly.
    fine = np.kron(filled, np.ones((2,) * n, dtype=bool))
    thickness = 2 * float(scipy.ndimage.distance_transform_edt(fine, sampling=sizes / 2).max())
    if content <= _LINE ** (n - 1) * thickness**n:
        return
    length = (content / thickness) ** (1 / (n - 1))
    what, closed = ("line", "ring") if n == 2 else ("sheet", "shell")
    raise ProblemError(
        "observed",
        f"lets {name} expand, but a part of it is an open {what} (about {length:.3g} long and "
        f"{thickness:.3g} thick), which has no outside: it would be torn along its middle. "
        f"Close the {what} to a {closed}, or let it move by a vector instead (`action='move'`).",
    )


def outer_rim(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the outer outline of each part of a mask, without the outlines of its holes.

    Parameters
    ----------
    mask : ndarray of bool, shape ([D,] H, W)

    Returns
    -------
    ndarray of bool, shape ([D,] H, W)
        Pixels of each part at its outside, or at the edge of the image.
    """
    rim = mask & ~scipy.ndimage.binary_erosion(mask)
    for box, part in _parts(mask):
        if part.size > _SPECK:
            rim[box] &= ~(part & scipy.ndimage.binary_erosion(~outside_of(part)))
    return np.asarray(rim)


def outside_of(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the pixels around a mask that are connected to the image's edge, without holes."""
    # A ring around the image joins all regions that reach its edge.
    pieces, _ = scipy.ndimage.label(np.pad(~mask, 1, constant_values=True))
    found: npt.NDArray[np.bool_] = (pieces == pieces.flat[0])[(slice(1, -1),) * mask.ndim]
    return found

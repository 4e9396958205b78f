"""NumPy version of `triangle_raster`, used until the compiled loops are ready.

All triangles are drawn together: each pixel in the bounding box of a triangle is tested against
this triangle. If several triangles cover a pixel, the first triangle is used, as if the triangles
were drawn in order.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

# Tolerances as in `triangle_raster`.
_EDGE, _COLLAPSED, _NEAR = 1e-9, 1e-12, 1.0
# States of a pixel: no tissue; inverted triangle; non-inverted triangle; two non-inverted ones.
_EMPTY, _TURNED, KEPT, TWICE = 0, 1, 2, 3
# Number of pixels that are tested together.
_AT_ONCE = 1_000_000


def rasterise(moved: Float64Array, tissue: Mask) -> tuple[Float64Array, npt.NDArray[np.uint8]]:
    """Invert the motion of the sites; see `triangle_raster.rasterise`."""
    height, width = tissue.shape
    source, state = np.zeros((height, width, 2)), np.zeros((height, width), np.uint8)
    corners = _corners(tissue)
    areas = _areas(moved, corners)
    turned = areas * _areas(np.moveaxis(np.indices(tissue.shape, float), 0, -1), corners) < 0
    covers = np.abs(areas) >= _COLLAPSED
    for value, selected in ((KEPT, covers & ~turned), (_TURNED, covers & turned)):
        for pixels, places in _covered(moved, corners[selected], tissue.shape):
            _claim(source, state, pixels, places, value)
    for pixels, places in (_sites(moved, tissue), _strokes(moved, tissue)):
        empty = state.ravel()[pixels] == _EMPTY
        _claim(source, state, pixels[empty], places[empty], KEPT, first_only=True)
    return source, state


def _corners(tissue: Mask) -> Index:
    """Return the corners of the triangles of all cells, (N, 3, 2), in the order of the cells."""
    a, b, c, d = tissue[:-1, :-1], tissue[:-1, 1:], tissue[1:, :-1], tissue[1:, 1:]
    # For each type of triangle: cells with the required tissue, and corners. Cells with tissue at
    # all corners contain the first two types, which share the diagonal from a to d. Cells without d
    # or a contain one of the other two types.
    kinds = (
        (a & d & b, ((0, 0), (0, 1), (1, 1))),
        (a & d & c, ((0, 0), (1, 1), (1, 0))),
        (b & c & a & ~d, ((0, 1), (1, 0), (0, 0))),
        (b & c & d & ~a, ((0, 1), (1, 1), (1, 0))),
    )
    corners, numbers = [], []
    for kind, (exists, offsets) in enumerate(kinds):
        cells = np.argwhere(exists)
        corners.append(cells[:, None] + np.array(offsets))
        numbers.append((cells[:, 0] * exists.shape[1] + cells[:, 1]) * len(kinds) + kind)
    order = np.argsort(np.concatenate(numbers), kind="stable")
    return np.asarray(np.concatenate(corners)[order], np.intp)


def _areas(places: Float64Array, corners: Index) -> Float64Array:
    """Return twice the signed area of each triangle; the sign is its orientation."""
    at = places[corners[..., 0], corners[..., 1]]
    (by, bx), (cy, cx) = (at[:, 1] - at[:, 0]).T, (at[:, 2] - at[:, 0]).T
    return np.asarray(by * cx - bx * cy)


def _covered(
    moved: Float64Array, corners: Index, shape: tuple[int, ...]
) -> Iterator[tuple[Index, Float64Array]]:
    """Yield the pixels that triangles cover, and their origins, in the order of the triangles.

    Pixels are indices of the flattened image, (N,); origins are positions in pixels, (N, 2).
    """
    at = moved[corners[..., 0], corners[..., 1]]
    last = np.array(shape, float) - 1
    low = np.ceil(np.maximum(at.min(axis=1) - _EDGE, 0.0))
    high = np.floor(np.minimum(at.max(axis=1) + _EDGE, last))
    sizes = np.maximum(high - low + 1, 0).astype(np.intp)
    counts = sizes.prod(axis=1)
    ends = np.cumsum(counts)
    begin = 0
    while begin < len(counts):
        before = int(ends[begin - 1]) if begin else 0
        end = max(int(np.searchsorted(ends, before + _AT_ONCE, side="right")), begin + 1)
        owner = np.repeat(np.arange(begin, end), counts[begin:end])
        within = np.arange(len(owner)) - (ends[owner] - counts[owner] - before)
        rows, cols = np.divmod(within, np.maximum(sizes[owner, 1], 1))
        pixel = low[owner] + np.stack([rows, cols], axis=1)
        origin = at[owner, 0]
        (by, bx), (cy, cx) = (at[owner, 1] - origin).T, (at[owner, 2] - origin).T
        y, x = (pixel - origin).T
        area = by * cx - bx * cy
        to_b, to_c = (y * cx - x * cy) / area, (by * x - bx * y) / area
        inside = (to_b >= -_EDGE) & (to_c >= -_EDGE) & (to_b + to_c <= 1 + _EDGE)
        a, b, c = (corners[owner[inside], k].astype(float) for k in range(3))
        place = a + to_b[inside, None] * (b - a) + to_c[inside, None] * (c - a)
        row, col = pixel[inside].astype(np.intp).T
        yield row * shape[1] + col, place
        begin = end


def _claim(
    source: Float64Array,
    state: npt.NDArray[np.uint8],
    pixels: Index,
    places: Float64Array,
    value: int,
    first_only: bool = False,
) -> None:
    """Store the first origin of each pixel; mark pixels with another origin far from the first."""
    flat, states = source.reshape(-1, 2), state.reshape(-1)
    free = states[pixels] < value
    new, first = np.unique(pixels[free], return_index=True)
    flat[new], states[new] = places[free][first], value
    if value == KEPT and not first_only:
        away = np.abs(flat[pixels] - places).max(axis=1) > _NEAR
        states[pixels[away]] = TWICE


def _sites(moved: Float64Array, tissue: Mask) -> tuple[Index, Float64Array]:
    """Return the pixels onto which sites have moved, with the sites as their origins."""
    return _on_pixels(moved[tissue], np.argwhere(tissue).astype(float), tissue.shape)


def _strokes(moved: Float64Array, tissue: Mask) -> tuple[Index, Float64Array]:
    """Return the pixels on moved lines between outermost sites, and their origins.

    The sampled points of a line are at most half a pixel apart.
    """
    height, width = tissue.shape
    padded = np.pad(tissue, 1)
    here, right, below = padded[1:-1, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1]
    across = padded[2:, 2:]
    above, above_right = padded[:-2, 1:-1], padded[:-2, 2:]
    left, below_left = padded[1:-1, :-2], padded[2:, :-2]
    along_row = here & right & ~((above | above_right) & (below | across))
    along_col = here & below & ~((left | below_left) & (right | across))
    starts = np.concatenate([np.argwhere(along_row), np.argwhere(along_col)])
    down = np.repeat([0, 1], [int(along_row.sum()), int(along_col.sum())])
    order = np.lexsort((down, starts[:, 1], starts[:, 0]))
    starts, down = starts[order], down[order]
    ways = np.stack([down, 1 - down], axis=1)
    a = moved[starts[:, 0], starts[:, 1]]
    ends = starts + ways
    b = moved[ends[:, 0], ends[:, 1]] - a
    longest = np.minimum(np.abs(b).max(axis=1, initial=0.0), float(height + width))
    steps = np.ceil(2.0 * longest).astype(np.intp)
    owner = np.repeat(np.arange(len(starts)), steps + 1)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(steps + 1) - (steps + 1), steps + 1)
    part = (step / np.maximum(steps[owner], 1))[:, None]
    return _on_pixels(a[owner] + part * b[owner], starts[owner] + part * ways[owner], tissue.shape)


def _on_pixels(
    places: Float64Array, origins: Float64Array, shape: tuple[int, ...]
) -> tuple[Index, Float64Array]:
    """Return the pixels nearest to positions inside an image, and the origins of these pixels."""
    row, col = np.floor(places + 0.5).T
    inside = (row >= 0) & (row < shape[0]) & (col >= 0) & (col < shape[1])
    pixels = row[inside].astype(np.intp) * shape[1] + col[inside].astype(np.intp)
    return pixels, origins[inside]

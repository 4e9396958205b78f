"""Tissue sites without an equation, and the affine motion by which they follow their tissue.

A model moves the sites of its elements, blocks of two sites along each axis. Tissue at the tip of a
disc, on a ragged edge or in a line that is one site wide is in no element: nothing strains it, and
nothing determines its displacement. Such a site, an *orphan*, moves with its tissue. Let c be the
nearest site with an equation, along a path through orphans of the same part. The orphan follows
the affine function that fits the displacements u around c best,

    minimize  sum over sites j of  w_j |a + H (x_j - x) - u_j|^2,   w_j = 1 / |x_j - x|^2,

where x is the position of the orphan. The sites j are in elements that are connected to c, no
farther from c than the orphan is, or two pixels if that is more. The displacement of the orphan is
a = sum of p_j u_j, and H is its displacement gradient. Both are exact for affine motions: rigid
motions and uniform strains. If several sites are equally near, the orphan follows their mean.

Where the displacement of some of these sites, or of sites beside them, means nothing, because they
have no equation either, derivatives mean nothing: the orphan follows the mean of the others with
the same weights instead (H = 0), which stays within the range of their displacement.

Because the weights p_j add up to one, a force on an orphan that acts on the sites j instead, each
with its share p_j, has the same resultant and the same moment.

Positions are in pixels, so that followers do not depend on the spacing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.field.neighbours import around_sites, in_elements, of_corners
from napari_hmrf.real_arrays import are_equal

Mask = npt.NDArray[np.bool_]
Float64Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

#: Smallest and largest distance from the nearest connected site of the sites in a fit, in pixels.
#: The largest distance limits the memory for long lines in volumes.
_NEAR, _FAR = 2.0, 8.0
# Relative difference up to which two distances are equal.
_TIE = 1e-9
# Eigenvalue, relative to the largest, below which a fit does not determine the gradient.
_FLAT = 1e-9
# Number of sites that are processed at once, which limits the memory for temporary arrays.
_AT_ONCE = 1 << 20
# Number of masks whose followers are cached: those of a solve and of the measures of its solution.
_MOST = 3


@dataclass(frozen=True, eq=False)
class Followers:
    """Orphans, and the linear map from the displacement of connected sites to theirs.

    Attributes
    ----------
    sites : ndarray of int, shape (m,)
        Orphans that are connected to a site with an equation: indices into the flattened grid, in
        ascending order.
    nearest : ndarray of int, shape (m,)
        Nearest connected site of each orphan, in the same numbering.
    sources : ndarray of int, shape (s,)
        Sites that are followed, in the same numbering.
    values : sparse array, shape (m, s)
        Weights p of the sources of each orphan.
    slopes : sparse array, shape (m * axes, s)
        Weights of the sources for the derivatives along the axes, per pixel.
    bridges : int
        Number of orphans that connect pieces of elements with each other.
    """

    sites: Indices
    nearest: Indices
    sources: Indices
    values: Any
    slopes: Any
    bridges: int

    def displacement(self, field: npt.NDArray[Any]) -> Float64Array:
        """Return the displacement of the orphans, shape (m, n), in a field of shape ([D,] H, W, n).

        The last axis may also contain other quantities that vary with the tissue.
        """
        return np.asarray(self.values @ self._of_sources(field))

    def gradient(self, field: npt.NDArray[Any]) -> Float64Array:
        """Return the derivatives of a field at the orphans along the axes, shape (m, n, axes)."""
        slopes = self.slopes @ self._of_sources(field)
        by_axis = slopes.reshape(len(self.sites), -1, field.shape[-1])
        return np.asarray(by_axis.swapaxes(1, 2))

    def carried(self, force: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return forces, shape ([D,] H, W, n), with those on orphans moved to their sources."""
        moved = force.copy()
        flat = moved.reshape(-1, force.shape[-1])
        flat[self.sources] += self.values.T @ flat[self.sites].astype(np.float64)
        flat[self.sites] = 0
        return moved

    def followed_by(self, site: tuple[int, ...], shape: tuple[int, ...]) -> Indices:
        """Return the positions, shape (s, axes), of the sites that an orphan follows, or none."""
        number = np.flatnonzero(self.sites == np.ravel_multi_index(site, shape))
        columns = self.values[number].indices
        return np.stack(np.unravel_index(self.sources[columns], shape), axis=-1)

    def _of_sources(self, field: npt.NDArray[Any]) -> Float64Array:
        flat = field.reshape(-1, field.shape[-1])
        return np.asarray(flat[self.sources], dtype=np.float64)


class _Known(NamedTuple):
    """Masks, with the followers that depend on them only."""

    kind: object
    masks: tuple[npt.NDArray[Any] | None, ...]
    found: Any

    def is_for(self, kind: object, masks: Sequence[npt.NDArray[Any] | None]) -> bool:
        return kind == self.kind and all(map(are_equal, self.masks, masks))


def _frozen(mask: npt.NDArray[Any] | None) -> npt.NDArray[Any] | None:
    return mask.copy() if mask is not None and mask.flags.writeable else mask


# Latest results, of which the newest is the first. Each frame of a drag needs them, on any thread.
_latest: Kept[tuple[_Known, ...]] = Kept(is_large=True)


def remembered(
    kind: object, masks: Sequence[npt.NDArray[Any] | None], find: Callable[[], Any]
) -> Any:
    """Return what `find` returns, from the cache if the masks are the same as before.

    Parameters
    ----------
    kind : object
        Name of the result, with the values on which it depends besides the masks.
    masks : sequence of ndarray or None
    find : callable
    """
    latest = _latest.value or ()
    for each in latest:
        if each.is_for(kind, masks):
            return each.found
    found = find()
    newest = _Known(kind, tuple(map(_frozen, masks)), found)
    _latest.value = (newest, *latest[: _MOST - 1])
    return found


def followers_of(
    tissue: Mask,
    parts: npt.NDArray[Any] | None = None,
    rigid: Mask | None = None,
) -> Followers | None:
    """Return the followers of tissue whose elements are blocks of two sites along each axis.

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W) or (D, H, W)
    parts : ndarray of int, same shape, optional
        Label of the part of each site; parts do not follow each other.
    rigid : ndarray of bool, same shape, optional
        Mask of rigid tissue. A rigid orphan beside a rigid body follows this body alone.

    Returns
    -------
    Followers or None
        None if there are no orphans.
    """

    def find() -> Followers | None:
        elements = in_elements(tissue)
        if parts is not None:
            elements &= of_corners(parts, np.minimum) == of_corners(parts, np.maximum)
        connected = around_sites(elements, np.logical_or)
        return find_followers(tissue, connected, elements, parts=parts, rigid=rigid)

    return remembered("elements", (tissue, parts, rigid), find)  # type: ignore[no-any-return]


def find_followers(
    tissue: Mask,
    connected: Mask,
    elements: Mask,
    sure: Mask | None = None,
    *,
    parts: npt.NDArray[Any] | None = None,
    rigid: Mask | None = None,
) -> Followers | None:
    """Return the followers of given elements.

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W) or (D, H, W)
    connected : ndarray of bool, shape (H, W) or (D, H, W)
        Mask of the sites with an equation.
    elements : ndarray of bool
        Elements that connect sites, shape (H - 1, W - 1) or (D - 1, H - 1, W - 1); or, if the sites
        around a connected site are connected with it in any case, `connected` itself.
    parts, rigid
        As for `followers_of`.
    sure : ndarray of bool, shape (H, W) or (D, H, W), optional
        Mask of the sites whose displacement has a meaning; by default all.
    """
    orphans = np.flatnonzero(tissue & ~connected)
    if not len(orphans) or not connected.any():
        return None
    paths = _Paths.of(tissue, connected, orphans, parts)
    follows = np.isfinite(paths.distance)
    if not follows.any():
        return None
    of, root, share = paths.roots()
    place = np.cumsum(follows) - 1  # number of each orphan among those that follow
    sites = orphans[follows]
    fits = _Fits(tissue.shape, connected, elements, rigid, sure)
    reach = np.clip(paths.distance[of], _NEAR, _FAR)
    found = list(fits.of(orphans[of], root, reach))
    row = np.concatenate([place[of[each.pair]] for each in found])
    source = np.concatenate([each.source for each in found])
    shares = np.concatenate([share[each.pair] for each in found])
    value = np.concatenate([each.value for each in found]) * shares
    slope = np.concatenate([each.slope for each in found]) * shares[:, None]
    sources, column = np.unique(source, return_inverse=True)
    shape = len(sites), len(sources)
    axes = tissue.ndim
    rows = (axes * row[:, None] + np.arange(axes)).ravel()
    # The root with the largest share, which is the first of those that are equally near.
    order = np.lexsort((root, -np.round(share, 6), of))
    first = np.unique(of[order], return_index=True)[1]
    bridges = 0 if elements is connected else paths.bridges(elements)
    return Followers(
        sites,
        root[order][first],
        sources,
        scipy.sparse.csr_array((value, (row, column)), shape=shape),
        scipy.sparse.csr_array(
            (slope.ravel(), (rows, np.repeat(column, axes))), shape=(axes * shape[0], shape[1])
        ),
        bridges,
    )


@cache
def _steps(axes: int) -> tuple[Indices, Float64Array]:
    """Return the steps to the sites around a site, shape (n, axes), and their lengths."""
    steps = np.array([step for step in product((-1, 0, 1), repeat=axes) if any(step)])
    return steps, np.linalg.norm(steps, axis=1)


def around(sites: Indices, shape: tuple[int, ...]) -> tuple[Indices, Mask]:
    """Return the flat indices of sites and those around them, and a mask of those in the grid."""
    steps = np.array([*product((-1, 0, 1), repeat=len(shape))])
    return _moved(sites, steps, shape)


def _moved(sites: Indices, steps: Indices, shape: tuple[int, ...]) -> tuple[Indices, Mask]:
    """Return the flat indices of sites after steps, shape (m, n), and a mask of those inside.

    Sites outside the grid have the index of a site on its border.
    """
    index = np.stack(np.unravel_index(sites, shape), axis=-1)[:, None] + steps
    inside = ((index >= 0) & (index < shape)).all(axis=-1)
    flat = np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), shape, mode="clip")
    return flat.astype(np.intp), np.asarray(inside)


class _Paths(NamedTuple):
    """Shortest paths from orphans to connected sites, through orphans of the same part.

    Attributes
    ----------
    shape : tuple of int
        Shape of the grid.
    orphans : ndarray of int, shape (m,)
    around : ndarray of int, shape (m, n)
        Sites around each orphan.
    direct : ndarray of bool, shape (m, n)
        Mask of those that are connected.
    other : ndarray of int, shape (m, n)
        Number of the orphan there; -1 if there is none.
    distance : ndarray, shape (m,)
        Length of the path, in pixels; infinite if there is none.
    """

    shape: tuple[int, ...]
    orphans: Indices
    around: Indices
    direct: Mask
    other: Indices
    distance: Float64Array

    @classmethod
    def of(
        cls, tissue: Mask, connected: Mask, orphans: Indices, parts: npt.NDArray[Any] | None
    ) -> _Paths:
        steps, lengths = _steps(tissue.ndim)
        around, near = _moved(orphans, steps, tissue.shape)
        near &= tissue.ravel()[around]
        if parts is not None:
            labels = parts.ravel()
            near &= labels[around] == labels[orphans][:, None]
        direct = near & connected.ravel()[around]
        other = np.searchsorted(orphans, around)
        other[other == len(orphans)] = 0
        other = np.where(near & ~direct & (orphans[other] == around), other, -1)
        distance = np.where(direct, lengths, np.inf).min(axis=1)
        while True:
            through = np.where(other >= 0, distance[other] + lengths, np.inf).min(axis=1)
            if not (through < distance).any():
                break
            distance = np.minimum(distance, through)
        return cls(tissue.shape, orphans, around, direct, other, distance)

    def roots(self) -> tuple[Indices, Indices, Float64Array]:
        """Return pairs of an orphan's number and a connected site nearest to it, with its share."""
        count, lengths = len(self.orphans), _steps(len(self.shape))[1]
        longest = self.distance[:, None] * (1 + _TIE)
        ends = self.direct & (lengths <= longest)
        with np.errstate(invalid="ignore"):
            passes = (self.other >= 0) & (self.distance[self.other] + lengths <= longest)
        passes &= np.isfinite(longest)
        share = 1 / np.maximum(1, ends.sum(axis=1) + passes.sum(axis=1))
        of, step = np.nonzero(ends)
        roots, column = np.unique(self.around[of, step], return_inverse=True)
        total = added = scipy.sparse.csr_array((share[of], (of, column)), shape=(count, len(roots)))
        of, step = np.nonzero(passes)
        onwards = scipy.sparse.csr_array(
            (share[of], (of, self.other[of, step])), shape=(count, count)
        )
        while onwards.nnz and added.nnz:  # one step farther along all paths
            added = onwards @ added
            total = total + added
        pairs = total.tocoo()
        order = np.lexsort((pairs.col, pairs.row))
        return pairs.row[order].astype(np.intp), roots[pairs.col[order]], pairs.data[order]

    def bridges(self, elements: Mask) -> int:
        """Return the number of orphans in groups that touch pieces of elements apart."""
        of, step = np.nonzero(self.other >= 0)
        count = len(self.orphans)
        links = scipy.sparse.coo_array(
            (np.ones(len(of)), (of, self.other[of, step])), shape=(count, count)
        )
        groups, group = scipy.sparse.csgraph.connected_components(links, directed=False)
        of, step = np.nonzero(self.direct)
        size = math.prod(self.shape)
        touched = np.unique(group[of].astype(np.int64) * size + self.around[of, step])
        of_touched, site = touched // size, touched % size
        apart = self._are_apart(of_touched, site, groups)
        if not apart.any():
            return 0
        # Elements with a common site move together there.
        pieces, _ = scipy.ndimage.label(elements, np.ones((3,) * elements.ndim))
        piece = around_sites(pieces, np.maximum).ravel()[site]
        most, least = np.zeros(groups, np.intp), np.full(groups, piece.max())
        np.maximum.at(most, of_touched, piece)
        np.minimum.at(least, of_touched, piece)
        return int((apart & (least < most))[group].sum())

    def _are_apart(self, group: Indices, site: Indices, groups: int) -> Mask:
        """Return a mask of the groups whose touched sites are not all beside each other."""
        key, size = group * math.prod(self.shape) + site, math.prod(self.shape)
        around, inside = _moved(site, _steps(len(self.shape))[0], self.shape)
        wanted = group[:, None] * size + around
        other = np.minimum(np.searchsorted(key, wanted), max(0, len(key) - 1))
        of, step = np.nonzero(inside & (key[other] == wanted))
        links = scipy.sparse.coo_array(
            (np.ones(len(of)), (of, other[of, step])), shape=(len(key),) * 2
        )
        pieces, piece = scipy.sparse.csgraph.connected_components(links, directed=False)
        of_piece = np.zeros(pieces, np.intp)
        of_piece[piece] = group
        return np.asarray(np.bincount(of_piece, minlength=groups) > 1)


class _Weights(NamedTuple):
    """Weights of sources for pairs of an orphan and its root."""

    pair: Indices
    source: Indices
    value: Float64Array
    slope: Float64Array


class _Fits:
    """Affine fits around the roots of orphans."""

    def __init__(
        self,
        shape: tuple[int, ...],
        connected: Mask,
        elements: Mask,
        rigid: Mask | None,
        sure: Mask | None,
    ) -> None:
        self._shape, self._connected, self._elements = shape, connected, elements
        self._sure, self._pulled = sure, None
        if sure is not None:
            # Sites beside those without a meaning are pulled towards them.
            beside = np.ones((3,) * len(shape))
            self._pulled = scipy.ndimage.binary_dilation(connected & ~sure, beside)
        self._by_sites = elements is connected
        self._rigid, self._bodies = None, elements
        if rigid is not None and rigid.any() and not self._by_sites:
            self._rigid, self._bodies = rigid, elements & of_corners(rigid, np.logical_or)

    def of(self, orphans: Indices, roots: Indices, reach: Float64Array) -> Iterator[_Weights]:
        """Yield the weights of pairs of an orphan and its root, in blocks.

        Parameters
        ----------
        orphans, roots : ndarray of int, shape (q,)
        reach : ndarray, shape (q,)
            Largest distance of a source from the root, in pixels.
        """
        size = np.ceil(reach).astype(int)
        for radius in np.unique(size):
            mine = np.flatnonzero(size == radius)
            block = max(1, _AT_ONCE // (2 * radius + 1) ** len(self._shape))
            for begin in range(0, len(mine), block):
                pairs = mine[begin : begin + block]
                yield self._block(pairs, orphans[pairs], roots[pairs], reach[pairs], int(radius))

    def _block(
        self, pairs: Indices, orphans: Indices, roots: Indices, reach: Float64Array, radius: int
    ) -> _Weights:
        axes = len(self._shape)
        steps = np.stack(
            np.meshgrid(*[np.arange(-radius, radius + 1)] * axes, indexing="ij"), axis=-1
        ).reshape(-1, axes)
        sites, inside = _moved(roots, steps, self._shape)
        used = inside & (np.linalg.norm(steps, axis=1) <= reach[:, None] * (1 + _TIE))
        used &= self._connected.ravel()[sites]
        used &= self._joined(orphans, roots, radius) | (steps == 0).all(axis=1)
        of_mean = np.zeros(len(roots), np.bool_)
        if self._sure is not None and self._pulled is not None:
            sure = used & self._sure.ravel()[sites]
            of_mean = (used & self._pulled.ravel()[sites]).any(axis=1)
            used = np.where(sure.any(axis=1, keepdims=True), sure, used)
        at = np.stack(np.unravel_index(orphans, self._shape), axis=-1)
        root = np.stack(np.unravel_index(roots, self._shape), axis=-1)
        away = (root - at)[:, None] + steps.astype(np.float64)
        squared = (away**2).sum(axis=-1)
        weight = np.divide(1.0, squared, out=np.zeros(squared.shape), where=used & (squared > 0))
        weight /= weight.sum(axis=1, keepdims=True)
        middle = np.einsum("qk,qki->qi", weight, away)
        away -= middle[:, None]
        spread = np.einsum("qk,qki,qkj->qij", weight, away, away)
        inverse = np.linalg.pinv(spread, rcond=_FLAT, hermitian=True)
        slope = weight[..., None] * (away @ inverse)
        slope[of_mean] = 0
        value = weight - np.einsum("qki,qi->qk", slope, middle)
        of, number = np.nonzero(used)
        return _Weights(pairs[of], sites[of, number], value[of, number], slope[of, number])

    def _joined(self, orphans: Indices, roots: Indices, radius: int) -> Mask:
        """Return a mask of the sites around each root that elements near it join to the root."""
        axes, count = len(self._shape), len(roots)
        if not self._elements.size:  # the grid is one site wide
            return np.zeros((count, (2 * radius + 1) ** axes), np.bool_)
        width = 2 * radius + (1 if self._by_sites else 0)
        steps = np.stack(
            np.meshgrid(*[np.arange(width) - radius] * axes, indexing="ij"), axis=-1
        ).reshape(-1, axes)
        # An element has the index of its first site.
        elements, inside = _moved(roots, steps, self._shape)
        index = np.unravel_index(elements, self._shape)
        inside &= np.logical_and.reduce(
            [along < size for along, size in zip(index, self._elements.shape, strict=True)]
        )
        place = np.ravel_multi_index(index, self._elements.shape, mode="clip")
        exists = inside & self._elements.ravel()[place]
        if self._by_sites:
            start = np.broadcast_to((steps == 0).all(axis=1), exists.shape)
            return _flooded(exists, start, width, axes, corners=True)
        if self._rigid is not None:
            body = exists & self._bodies.ravel()[place]
            touches = (body & _around_root(steps)).any(axis=1)
            alone = touches & self._rigid.ravel()[orphans]
            exists = np.where(alone[:, None], body, exists)
        # At a hinge, the pieces of the nearest elements count.
        at = np.stack(np.unravel_index(orphans, self._shape), axis=-1)
        root = np.stack(np.unravel_index(roots, self._shape), axis=-1)
        away = np.linalg.norm((root - at)[:, None] + steps + 0.5, axis=-1)
        away[~(exists & _around_root(steps))] = np.inf
        start = away <= away.min(axis=1, keepdims=True) * (1 + _TIE)
        start &= np.isfinite(away)
        pieces = _flooded(exists, start, width, axes, corners=False)
        of_elements = pieces.reshape(count, *(width,) * axes)
        sites = np.zeros((count, *(width + 1,) * axes), np.bool_)
        for corner in product((0, 1), repeat=axes):
            sites[:, *(slice(end, end + width) for end in corner)] |= of_elements
        return sites.reshape(count, -1)


def _around_root(steps: Indices) -> Mask:
    """Return a mask of the elements that have the root as a corner."""
    return np.asarray(((steps == 0) | (steps == -1)).all(axis=1))


def _flooded(exists: Mask, start: Mask, width: int, axes: int, *, corners: bool) -> Mask:
    """Return the cells of each window that are connected to its start, through faces or corners."""
    grid = (len(exists), *(width,) * axes)
    reached, open_ = (exists & start).reshape(grid), exists.reshape(grid)
    while True:
        wider = reached.copy()
        for axis in range(1, axes + 1):
            one, two = [slice(None)] * (axes + 1), [slice(None)] * (axes + 1)
            one[axis], two[axis] = slice(1, None), slice(None, -1)
            before = wider.copy() if corners else reached
            wider[tuple(one)] |= before[tuple(two)]
            wider[tuple(two)] |= before[tuple(one)]
        wider &= open_
        if np.array_equal(wider, reached):
            return np.asarray(reached.reshape(exists.shape))
        reached = wider

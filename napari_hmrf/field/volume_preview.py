"""Deformed volume for display in three dimensions during a drag: all of it coarsely, or one cut."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.compile_cache import loader, loops
from napari_hmrf.field.resample import emptiness
from napari_hmrf.field.warp import inverse_raster, moved_sites

Array = npt.NDArray[Any]
#: Distance beyond the thickness of a cut, in voxels, at which voxels are still visible, because the
#: display interpolates between neighbouring voxels.
_BESIDE = 1.0
#: Smallest interpolation weight of known origins at which a voxel moves.
_LEAST_WEIGHT = 0.05


@dataclass(frozen=True)
class CutPlane:
    """Plane that cuts a volume.

    Attributes
    ----------
    position : tuple of float
        Point on the plane, (depth, row, col) in voxels.
    normal : tuple of float
        Vector perpendicular to the plane, in voxels.
    thickness : float
        Thickness of the displayed layer, in voxels.
    """

    position: tuple[float, ...]
    normal: tuple[float, ...]
    thickness: float = 1.0

    def meets(self, start: npt.ArrayLike, step: npt.ArrayLike) -> Array | None:
        """Return the point where a line meets the plane, or None if the line is parallel to it.

        Parameters
        ----------
        start, step : array_like, shape (3,)
            Point and direction of the line, in voxels.
        """
        normal, begin, along = np.array(self.normal), np.asarray(start), np.asarray(step)
        slope = float(along @ normal)
        if abs(slope) < 1e-9 * float(np.linalg.norm(along) * np.linalg.norm(normal)):
            return None
        met: Array = begin + along * float((np.array(self.position) - begin) @ normal) / slope
        return met

    def voxels(self, shape: tuple[int, ...]) -> npt.NDArray[np.intp]:
        """Return the voxels that are displayed, (N, 3), in a volume of a shape; read-only."""
        return _voxels_of(self, tuple(shape))


@lru_cache(maxsize=2)
def _voxels_of(plane: CutPlane, shape: tuple[int, ...]) -> npt.NDArray[np.intp]:
    normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
    main = int(np.abs(normal).argmax())
    others = [axis for axis in range(3) if axis != main]
    # Each line of voxels along the main axis meets the plane at `middle`.
    reach = (plane.thickness / 2 + _BESIDE) / abs(normal[main])
    grid = np.indices([shape[axis] for axis in others]).reshape(2, -1)
    slopes = normal[others] / normal[main]
    away = grid - np.array(plane.position)[others, np.newaxis]
    middle = plane.position[main] - slopes @ away
    levels = np.ceil(middle - reach).astype(np.intp)[:, np.newaxis]
    levels = levels + np.arange(math.ceil(2 * reach) + 1)
    near = (levels <= (middle + reach)[:, np.newaxis]) & (levels >= 0) & (levels < shape[main])
    found = np.empty((int(near.sum()), 3), np.intp)
    found[:, main] = levels[near]
    for axis, along in zip(others, grid, strict=True):
        found[:, axis] = np.broadcast_to(along[:, np.newaxis], near.shape)[near]
    found.setflags(write=False)
    return found


class VolumePreview:
    """Warper of one volume by displacements on a coarse grid.

    Call its methods on the compute thread only.

    Parameters
    ----------
    image : ndarray, shape (D, H, W) or (D, H, W, 3 or 4)
    every : int
        Step between the sites of the coarse grid along each axis, in voxels, from voxel 0.
    spacing : sequence of float, shape (3,)
        Size of a voxel along each axis.
    """

    def __init__(self, image: Array, every: int, spacing: Sequence[float]) -> None:
        self.image, self.every = image, every
        self._spacing = tuple(size * every for size in spacing)
        self._fill = emptiness(image, 3)
        self._values: Array | None = None

    def coarse(self, displacement: Array, tissue: npt.NDArray[np.bool_]) -> Array:
        """Return the deformed volume at the sites of the coarse grid.

        Parameters
        ----------
        displacement : ndarray, shape (d, h, w, 3)
            Material displacement at the sites, in the unit of the spacing.
        tissue : ndarray of bool, shape (d, h, w)
            Sites that move.
        """
        moved, mask = moved_sites(displacement, self._spacing, tissue)
        source, state = inverse_raster(moved, mask)
        picture = self._sampled(source.reshape(-1, 3) * self.every)
        picture = picture.reshape(*mask.shape, *self.image.shape[3:])
        picture[mask & (state == 0)] = self._fill
        return picture

    def cut(self, displacement: Array, tissue: npt.NDArray[np.bool_], plane: CutPlane) -> Array:
        """Return the values of the deformed volume at `CutPlane.voxels` of a plane.

        Origins are interpolated between the sites of the coarse grid.
        """
        moved, mask = moved_sites(displacement, self._spacing, tissue)
        source, state = inverse_raster(moved, mask)
        # Outside tissue there is no motion to interpolate, so only the known motion has a weight.
        weight = (state > 0).astype(np.float32)[..., np.newaxis]
        away = (source - np.moveaxis(np.indices(mask.shape), 0, -1)) * (weight * self.every)
        voxels = plane.voxels(self.image.shape[:3])
        known = _at_points(
            np.concatenate([away, weight], -1, dtype=np.float32), voxels / self.every
        )
        share = known[:, 3:]
        places = voxels + np.where(share > _LEAST_WEIGHT, known[:, :3] / np.maximum(share, 1e-6), 0)
        return self._sampled(places)

    def _sampled(self, places: Array) -> Array:
        """Interpolate the image at points, (N, 3), in voxels."""
        if self._values is None:
            values = np.asarray(self.image, np.float32)
            self._values = values.reshape(*values.shape[:3], -1)
        found = _at_points(self._values, places)
        if self.image.dtype.kind in "iub":
            found = np.rint(found)
        return found.astype(self.image.dtype).reshape(len(places), *self.image.shape[3:])


def _at_points(image: npt.NDArray[np.float32], places: Array) -> npt.NDArray[np.float32]:
    """Interpolate a volume, (D, H, W, channels), linearly at points, (N, 3); return (N, channels).

    The compiled loop for whole volumes is used if it is ready. It takes its points in planes.
    """
    count, channels = len(places), image.shape[-1]
    if not loops.ready_for_volumes():
        order = {"order": 1, "mode": "nearest"}
        found = [
            scipy.ndimage.map_coordinates(each, places.T, **order)
            for each in np.moveaxis(image, -1, 0)
        ]
        return np.stack(found, axis=-1)
    loader.before_numba()
    from napari_hmrf.field.volume_loops import look_up  # heavy: numba

    _, height, width, _ = image.shape
    planes = -(-count // (height * width))
    source = np.zeros((planes * height * width, 3))
    source[:count] = places
    covered = np.zeros((planes, height, width), bool)
    covered.reshape(-1)[:count] = True
    moved = np.empty((planes, height, width, channels), np.float32)
    look_up(
        loops.only_read(image),
        loops.only_read(image),
        False,
        loops.only_read(source.reshape(planes, height, width, 3)),
        loops.only_read(covered),
        False,
        False,
        np.float32(0),
        moved,
        np.ones(planes, bool),
    )
    return moved.reshape(-1, channels)[:count]

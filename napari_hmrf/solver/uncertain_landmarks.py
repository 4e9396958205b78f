"""Landmarks: observed displacements of points between pixels, each with its standard deviation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import require_flag, require_kind
from napari_hmrf.checks import Penalty, TypicalStrain, checked
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import in_elements
from napari_hmrf.real_arrays import as_numbers, first_index

Float64Array = npt.NDArray[np.float64]

#: Range of standard deviations, in pixels. A smaller one should be prescribed.
SD_RANGE = (1e-3, 1e6)
# Largest precision of a landmark relative to the stiffness of the stiffest tissue. An observation
# that is more certain should be prescribed.
_MAX_WEIGHT = 1e12
#: Largest rounding error of a position, in pixels.
ROUNDING = 1e-6
# Default extent of a patch, as a fraction of the longest side of the image.
_PATCH = 0.1


@checked
class StrainScale:
    """Typical strain of tissue before any observation: the scale of the prior.

    The elastic energy has the unit of stiffness times volume. To compare it with the precision of
    a measurement, the energy of a typical deformation must be known. A patch of the given extent
    has strains with a standard deviation of about `strain`; the unit of energy is therefore

        E strain^2 extent^n

    where E is a typical stiffness and n the number of axes. Results do not depend on the unit of
    stiffness.

    Parameters
    ----------
    strain : float
        Standard deviation of the strain of a patch; 0.1 is 10 %.
    extent : float, optional
        Side of a patch, in the unit of `spacing`; by default, a tenth of the longest side of the
        image.
    stiffness : float, optional
        Typical stiffness; by default the median stiffness of all tissue that is not rigid.
    """

    strain: TypicalStrain = 0.1
    _: KW_ONLY
    extent: Penalty | None = None
    stiffness: Penalty | None = None

    def energy(self, stiffness: npt.NDArray[Any], spacing: Sequence[float]) -> float:
        """Return the unit of energy: stiffness times length^n.

        Parameters
        ----------
        stiffness : ndarray, shape (H, W) or (D, H, W)
        spacing : sequence of float
        """
        extent, typical = self._resolved(stiffness, spacing)
        return typical * self.strain**2 * extent**stiffness.ndim

    def resolved(self, stiffness: npt.NDArray[Any], spacing: Sequence[float]) -> StrainScale:
        """Return the scale with the extent and the stiffness that it has for some tissue.

        Parameters
        ----------
        stiffness : ndarray, shape (H, W) or (D, H, W)
        spacing : sequence of float
        """
        extent, typical = self._resolved(stiffness, spacing)
        return replace(self, extent=extent, stiffness=typical)

    def _resolved(
        self, stiffness: npt.NDArray[Any], spacing: Sequence[float]
    ) -> tuple[float, float]:
        longest = max(n * size for n, size in zip(stiffness.shape, spacing, strict=True))
        extent = _PATCH * longest if self.extent is None else self.extent
        typical = typical_stiffness(stiffness) if self.stiffness is None else self.stiffness
        return float(extent), typical


def checked_scale(scale: StrainScale | None) -> StrainScale | None:
    """Return a scale; raise an `ArgumentError` if it is neither a `StrainScale` nor None."""
    if scale is not None:
        require_kind(StrainScale, "scale", scale, "StrainScale(0.1)")
    return scale


def typical_stiffness(stiffness: npt.NDArray[Any]) -> float:
    """Return the median stiffness of tissue that is not rigid, or 1 if there is none."""
    soft = stiffness[(stiffness > 0) & np.isfinite(stiffness)]
    return float(np.median(soft)) if soft.size else 1.0


class Landmarks:
    """Observed displacements of points, with standard deviations; immutable.

    The displacement at a point is interpolated linearly between the sites around it. A landmark
    adds the energy ``T |H d - y|^2 / (2 sd^2)``, where H interpolates, y is the observed
    displacement, sd the standard deviation and T the unit of energy of `scale`.

    Parameters
    ----------
    points, targets : array_like, shape (n, 2) or (n, 3)
        Positions before and after the motion, in pixels, with coordinates in the order of the axes.
        Positions may lie between pixels.
    sd : float or array_like, shape (n,) or (n, 2) or (n, 3)
        Standard deviation of the difference between target and point, in the unit of `spacing`, for
        all landmarks, for each one, or for each of its components.
    scale : StrainScale, optional
        Scale of the prior.
    drift : bool
        True to estimate an affine motion of all tissue together with the landmarks: a uniform
        strain that costs no energy, as growth does, for `ElasticPrior`. Rigid tissue does not
        strain. At least three landmarks that are not on one line are required, or four that are not
        on one plane, unless other observations hold the tissue.

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """

    points: Float64Array
    targets: Float64Array
    sd: Float64Array
    scale: StrainScale
    drift: bool

    def __init__(
        self,
        points: npt.ArrayLike,
        targets: npt.ArrayLike,
        *,
        sd: npt.ArrayLike,
        scale: StrainScale | None = None,
        drift: bool = False,
    ) -> None:
        require_flag("drift", drift)
        before, after = _positions("points", points), _positions("targets", targets)
        if before.shape != after.shape:
            raise ProblemError(
                "targets",
                f"have shape {after.shape}, but points have shape {before.shape}. Pass one target "
                "for each point.",
            )
        spread = np.array(as_numbers("sd", sd), dtype=np.float64)
        if spread.shape not in ((), before.shape[:1], before.shape):
            raise ProblemError(
                "sd",
                f"has shape {spread.shape}, but points have shape {before.shape}. Pass one number, "
                f"or an array of shape {before.shape[:1]} or {before.shape}.",
            )
        if not (np.isfinite(spread) & (spread > 0)).all():
            raise ProblemError(
                "sd", "has values that are not positive, finite numbers. Pass lengths above 0."
            )
        if spread.ndim == 1:
            spread = spread[:, None]
        values = {
            "points": before,
            "targets": after,
            "sd": np.broadcast_to(spread, before.shape).copy(),
            "scale": StrainScale() if scale is None else scale,
            "drift": bool(drift),
        }
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("Landmarks are immutable. Create new Landmarks")

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        low, high = self.sd.min(), self.sd.max()
        spread = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        drift = ", with a drift" if self.drift else ""
        return f"Landmarks({len(self)} points, sd {spread}, {self.scale}{drift})"

    @cached_property
    def without_drift(self) -> Landmarks:
        """The same landmarks without a drift."""
        if not self.drift:
            return self
        return Landmarks(self.points, self.targets, sd=self.sd, scale=self.scale)

    @cached_property
    def at_rest(self) -> Landmarks:
        """The same landmarks with an observed displacement of 0."""
        return Landmarks(self.points, self.points, sd=self.sd, scale=self.scale, drift=self.drift)

    def placed(self, points: Float64Array, scale: StrainScale) -> Landmarks:
        """Return landmarks with the same displacements in pixels at other points."""
        targets = points + (self.targets - self.points)
        return Landmarks(points, targets, sd=self.sd, scale=scale, drift=self.drift)

    def displacement(self, spacing: Sequence[float]) -> Float64Array:
        """Return the observed displacements, shape (n, 2) or (n, 3), in the unit of `spacing`."""
        return np.asarray((self.targets - self.points) * np.asarray(spacing))

    def precision(self, stiffness: npt.NDArray[Any], spacing: Sequence[float]) -> Float64Array:
        """Return the precision of each component, as for `Problem`, shape (n, 2) or (n, 3)."""
        return self.scale.energy(stiffness, spacing) / self.sd**2

    def check_inside(self, grid: tuple[int, ...]) -> None:
        """Raise an error if the points are not positions inside a grid.

        Raises
        ------
        ProblemError
            If the points have another number of axes, or some points are outside the grid.
        """
        axes = len(grid)
        if self.points.shape[1] != axes:
            raise ProblemError(
                "landmarks",
                f"have {self.points.shape[1]} coordinates, but tissue has {axes} axes. Pass "
                "points of the image.",
            )
        outside = are_outside(self.points, grid)
        if outside.any():
            raise ProblemError(
                "landmarks",
                f"have {int(outside.sum())} points outside the image, the first with number "
                f"{first_index(outside)[0]}. Pass positions in pixels, or remove these landmarks.",
            )

    def check(self, stiffness: npt.NDArray[np.float32], spacing: tuple[float, ...]) -> None:
        """Raise an error if the landmarks do not match the tissue of a problem.

        Raises
        ------
        ProblemError
            If a point is outside the image or beside tissue, or a standard deviation is so small
            that the motion should be prescribed.
        """
        self.check_inside(stiffness.shape)
        corner, _ = corners_of(self.points, stiffness.shape)
        beside = ~in_elements(stiffness)[tuple(corner.T)]
        if beside.any():
            raise ProblemError(
                "landmarks",
                f"have {int(beside.sum())} points that are not between pixels of tissue, the first "
                f"with number {first_index(beside)[0]}. Move or remove these landmarks.",
            )
        pixels = self.sd / np.asarray(spacing)
        if pixels.min() < SD_RANGE[0] or pixels.max() > SD_RANGE[1]:
            raise ProblemError(
                "landmarks",
                f"have standard deviations from {self.sd.min():.3g} to {self.sd.max():.3g}. Use "
                f"{SD_RANGE[0]:g} to {SD_RANGE[1]:g} pixels; prescribe what is more certain.",
            )
        stiffest = float(stiffness[np.isfinite(stiffness)].max(initial=0.0)) or 1.0
        pixel = math.prod(spacing) ** (1 - 2 / len(spacing))
        weight = float(self.precision(stiffness, spacing).max()) / (stiffest * pixel)
        if weight > _MAX_WEIGHT:
            raise ProblemError(
                "landmarks",
                f"weigh up to {weight:.2g} times as much as the stiffest tissue. Use a smaller "
                "strain or extent of their StrainScale, or larger standard deviations; prescribe "
                "what is more certain.",
            )


def are_outside(points: Float64Array, grid: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Return which points, shape (n, axes) in pixels, are outside the first and last pixel centres.

    Points in mm that are converted to pixels may be outside by a rounding error.
    """
    beyond = (points < -ROUNDING) | (points > np.array(grid) - 1 + ROUNDING)
    return np.asarray(beyond.any(axis=1))


def corners_of(points: Float64Array, grid: tuple[int, ...]) -> tuple[Any, Float64Array]:
    """Return the element of each point, and the position within it, from 0 to 1 along each axis.

    Parameters
    ----------
    points : ndarray, shape (n, axes)
        Positions inside the grid, in pixels.
    grid : tuple of int

    Returns
    -------
    ndarray of int, shape (n, axes)
        Indices of the element, which is its first corner.
    ndarray, shape (n, axes)
    """
    last = np.array(grid) - 2
    first = np.clip(np.floor(points).astype(np.intp), 0, last)
    return first, points - first


def corner_shares(
    points: Float64Array, grid: tuple[int, ...]
) -> Iterator[tuple[tuple[Any, ...], Float64Array]]:
    """Yield the sites at each corner of the elements of points, and the shares of these corners.

    The linear interpolation of a field at the points is the sum of its values at the corners times
    the shares.

    Parameters
    ----------
    points : ndarray, shape (n, axes)
        Positions inside the grid, in pixels.
    grid : tuple of int

    Yields
    ------
    tuple of ndarray of int, shape (n,)
        Index of a corner, along each axis.
    ndarray, shape (n,)
    """
    elements, within = corners_of(points, grid)
    for corner in np.ndindex(*(2,) * len(grid)):
        shares = np.where(corner, within, 1 - within).prod(axis=1)
        yield tuple((elements + np.array(corner)).T), shares


def interpolated(field: npt.NDArray[Any], points: Float64Array) -> Float64Array:
    """Interpolate a field, shape (H, W, 2) or (D, H, W, 3), linearly at points, (n, axes)."""
    found = np.zeros(points.shape)
    for sites, shares in corner_shares(points, field.shape[:-1]):
        found += shares[:, np.newaxis] * field[sites]
    return found


def _positions(field: str, values: npt.ArrayLike) -> Float64Array:
    array = np.array(as_numbers(field, values), dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in (2, 3) or not len(array):
        raise ProblemError(
            field, f"have shape {array.shape}. Pass an array of shape (n, 2) or (n, 3)."
        )
    if not np.isfinite(array).all():
        raise ProblemError(field, "have values that are NaN or infinite. Pass finite positions.")
    return array

"""Loads of elastic tissue: growth, and forces at sites."""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import reals, shown
from napari_hmrf.checks import LARGEST_GROWTH
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.followers import followers_of
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.real_arrays import (
    FloatArray,
    are_equal,
    as_float32,
    check_finite,
    first_index,
    how_many,
)

# Largest accepted difference between a tensor and its transpose, relative to the largest strain.
_ASYMMETRY = 1e-5
# Relative difference up to which pixel sizes count as equal, because files often round them.
_SAME_SPACING = 1e-4
_AXES = 3


class Loads:
    """Growth of elastic tissue and forces on the tissue, on one grid; immutable.

    Loads can be added: ``growth(0.1 * tumour) + weight(stiffness, (0.01, 0), spacing=1)``. The
    resulting motion is proportional to the forces and inversely proportional to the stiffness, so
    the unit of stiffness matters.

    Parameters
    ----------
    growth : array_like, optional
        Strain that the tissue would have if it were free; 0.1 means a tenth longer. One number for
        each site, shape (H, W) or (D, H, W), means equal growth along all three axes, including the
        axis perpendicular to an image. Alternatively, a symmetric tensor for each site, in the
        order of the axes: shape (H, W, 2, 2), without growth perpendicular to the image;
        (H, W, 3, 3), where the first axis is perpendicular to the image; or (D, H, W, 3, 3). Growth
        perpendicular to an image has an effect in plane strain, where a slice that cannot thicken
        expands in its plane instead, and in large motion, where a thicker slice is proportionally
        stiffer. Values in void are ignored. Rigid tissue must not grow.
    force : array_like, shape (H, W, 2) or (D, H, W, 3), optional
        Force on each site, with components in the order of the axes. In an image, a force per
        thickness, in the unit of stiffness times length; in a volume, a force, in the unit of
        stiffness times length squared. The force stays constant while the site moves (dead load).
    spacing : sequence of float, shape (n,), optional
        Pixel size along each axis for which the forces were computed; set by `pressure`, `traction`
        and `weight`. A `Problem` with a different spacing rejects the loads. By default the spacing
        is unknown and is not checked.

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """

    growth: FloatArray | None
    force: FloatArray | None
    spacing: tuple[float, ...] | None

    def __init__(
        self,
        *,
        growth: npt.ArrayLike | None = None,
        force: npt.ArrayLike | None = None,
        spacing: Sequence[float] | None = None,
    ) -> None:
        for name, given in (("growth", growth), ("force", force)):
            array = None if given is None else as_float32(name, given)
            if array is not None:
                check_finite(name, array)
                array.setflags(write=False)
            object.__setattr__(self, name, array)
        _check_growth(self.growth)
        sizes = (
            None
            if spacing is None
            else reals(spacing, len(spacing) if isinstance(spacing, Sized) else 1)
        )
        if sizes is not None and not all(0 < size < math.inf for size in sizes):
            raise ProblemError(
                "spacing", f"is {shown(spacing)}. Pass positive, finite pixel sizes."
            )
        object.__setattr__(self, "spacing", sizes)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("Loads are immutable. Create new Loads")

    def __add__(self, other: Loads) -> Loads:
        """Add the growth and the forces of two loads."""
        if not isinstance(other, Loads):
            return NotImplemented
        if not _is_close(self.spacing, other.spacing):
            raise ProblemError(
                "loads",
                f"are for pixels of {_sizes(self.spacing)} and of {_sizes(other.spacing)}. "
                "Compute both with the spacing of the problem.",
            )
        return Loads(
            growth=_sum_of_growth(self.growth, other.growth),
            force=_sum_of_forces(self.force, other.force),
            spacing=self.spacing or other.spacing,
        )

    def __repr__(self) -> str:
        parts = []
        if self.growth is not None:
            parts.append(f"growth from {self.growth.min():.3g} to {self.growth.max():.3g}")
        if self.force is not None:
            total = self.force.sum(axis=tuple(range(self.force.ndim - 1)), dtype=np.float64)
            parts.append(f"force of ({', '.join(f'{each:.3g}' for each in total)}) altogether")
        return f"Loads({', '.join(parts) or 'none'})"

    def same_as(self, other: Loads | None) -> bool:
        """Return whether growth and forces equal those of other loads."""
        return self is other or (
            other is not None
            and are_equal(self.growth, other.growth)
            and are_equal(self.force, other.force)
        )

    def check(self, stiffness: FloatArray, spacing: tuple[float, ...]) -> None:
        """Raise an error if the loads do not match the tissue of a problem.

        Parameters
        ----------
        stiffness : ndarray, shape (H, W) or (D, H, W)
        spacing : tuple of float

        Raises
        ------
        ProblemError
            If the grid or its spacing differs, rigid tissue would grow, or a force acts on void.
        """
        grid, axes = stiffness.shape, stiffness.ndim
        if self.growth is not None:
            tensors = [(*grid, size, size) for size in sorted({axes, _AXES})]
            if self.growth.shape not in [grid, *tensors]:
                others = " or ".join(map(str, tensors))
                raise ProblemError(
                    "growth",
                    f"has shape {self.growth.shape}, but stiffness has shape {grid}. Pass one "
                    f"number for each site, or a tensor {others}.",
                )
            grows = self.growth != 0
            stuck = grows.reshape(*grid, -1).any(axis=-1) & np.isinf(stiffness)
            if stuck.any():
                raise ProblemError(
                    "growth",
                    f"has {how_many(stuck)} of rigid tissue, which cannot grow, the first at "
                    f"{first_index(stuck)}. Set them to 0.",
                )
        if not _is_close(self.spacing, spacing):
            raise ProblemError(
                "loads",
                f"are for pixels of {_sizes(self.spacing)}, but the problem has pixels of "
                f"{_sizes(spacing)}. Compute them with the spacing of the problem.",
            )
        if self.force is not None:
            if self.force.shape != (*grid, axes):
                raise ProblemError(
                    "force",
                    f"has shape {self.force.shape}, but stiffness has shape {grid}, so "
                    f"{(*grid, axes)} is needed (one value per axis at each site).",
                )
            nowhere = self.force.any(axis=-1) & ~sites_of_elements(stiffness)
            followers = followers_of(stiffness > 0) if nowhere.any() else None
            if followers is not None:
                nowhere.reshape(-1)[followers.sites] = False
            if nowhere.any():
                raise ProblemError(
                    "force",
                    f"has {how_many(nowhere)} without tissue that is two pixels wide, the first at "
                    f"{first_index(nowhere)}. Set them to 0, or give these pixels a stiffness.",
                )


def growth(strain: npt.ArrayLike, *, along: npt.ArrayLike | None = None) -> Loads:
    """Return the loads due to tissue that grows or shrinks.

    Parameters
    ----------
    strain : array_like, shape (H, W) or (D, H, W)
        Strain that each site would have if it were free: 0.1 means a tenth longer, -0.1 a tenth
        shorter, and 0 no growth. For two tissues, for example,
        ``0.1 * (labels == 2) + 0.02 * (labels == 3)``.
    along : array_like, shape (n,), (H, W, 2) or (D, H, W, 3), optional
        Direction of growth for all sites, or for each site, if tissue grows along fibres; the
        length of the vector is ignored. By default growth is equal in all directions, including the
        direction perpendicular to an image.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        If strain is not an image or volume of numbers above -1, or a direction has length 0.
    """
    amount = as_float32("growth", strain)
    if amount.ndim not in (2, 3):
        raise ProblemError(
            "growth",
            f"has shape {amount.shape}, but one number is needed for each pixel (H, W) or voxel "
            "(D, H, W).",
        )
    if along is None:
        return Loads(growth=amount)
    direction = as_float32("along", along).astype(np.float64)
    if direction.shape not in ((amount.ndim,), (*amount.shape, amount.ndim)):
        raise ProblemError(
            "along",
            f"has shape {direction.shape}. Pass one direction, with {amount.ndim} components in "
            "the order of the axes, or one direction for each site.",
        )
    length = np.linalg.norm(direction, axis=-1)
    bad = ~(np.isfinite(length) & (length > 0)) & (amount != 0)
    if bad.any():
        first = np.broadcast_to(direction, (*amount.shape, amount.ndim))[bad][0]
        raise ProblemError(
            "along",
            f"is {shown(first.tolist())} at {first_index(bad)}, which is not a direction. Pass a "
            "finite, nonzero vector.",
        )
    norm = length[..., None]
    unit = np.divide(direction, norm, out=np.zeros_like(direction), where=norm > 0)
    return Loads(growth=amount[..., None, None] * (unit[..., :, None] * unit[..., None, :]))


def _check_growth(strain: FloatArray | None) -> None:
    """Raise an error if a tensor is not symmetric or tissue would shrink to nothing."""
    if strain is None:
        return
    stretch = strain
    if strain.ndim > _AXES:
        if strain.shape[-1] != strain.shape[-2]:
            raise ProblemError(
                "growth",
                f"has shape {strain.shape}. Pass square tensors.",
            )
        apart = np.abs(strain - strain.swapaxes(-1, -2)).max(initial=0)
        if apart > _ASYMMETRY * np.abs(strain).max(initial=0):
            raise ProblemError("growth", "is not symmetric. Pass the symmetric part of the tensor.")
        stretch = np.diagonal(strain, axis1=-2, axis2=-1)
    least = float(stretch.min(initial=math.inf))
    if least <= -1:
        raise ProblemError(
            "growth",
            f"is {least:.3g} somewhere, but tissue cannot shrink by its whole length. Use strains "
            "above -1; -0.1 means a tenth shorter.",
        )
    most = float(stretch.max(initial=0))
    if most > LARGEST_GROWTH:
        raise ProblemError(
            "growth",
            f"is {most:.3g} somewhere. Use strains up to {LARGEST_GROWTH:g}: 0.2 means a fifth "
            "longer, or 20 %.",
        )


def _sum_of_growth(
    one: FloatArray | None, other: FloatArray | None
) -> npt.NDArray[np.floating] | None:
    if one is None or other is None:
        return other if one is None else one
    if one.shape == other.shape:
        return one + other
    tensors = _tensor(one), _tensor(other)
    if tensors[0].shape != tensors[1].shape:
        raise ProblemError(
            "growth", f"is on grids of {one.shape} and {other.shape}. Use the same grid for both."
        )
    return np.asarray(tensors[0] + tensors[1])


def _tensor(strain: FloatArray) -> FloatArray:
    """Return a 3 x 3 tensor for each site; a number means equal growth along all axes."""
    if strain.ndim <= _AXES:
        return strain[..., None, None] * np.eye(_AXES, dtype=np.float32)
    missing = _AXES - strain.shape[-1]
    return np.pad(strain, [*[(0, 0)] * (strain.ndim - 2), (missing, 0), (missing, 0)])


def _sum_of_forces(
    one: FloatArray | None, other: FloatArray | None
) -> npt.NDArray[np.floating] | None:
    if one is None or other is None:
        return other if one is None else one
    if one.shape != other.shape:
        raise ProblemError(
            "force", f"is on grids of {one.shape} and {other.shape}. Use the same grid for both."
        )
    return np.asarray(one + other)


def _is_close(one: tuple[float, ...] | None, other: tuple[float, ...] | None) -> bool:
    """Return whether two spacings are equal up to rounding errors or at least one is unknown."""
    if one is None or other is None:
        return True
    pairs = zip(one, other, strict=False)
    same = (math.isclose(*sizes, rel_tol=_SAME_SPACING) for sizes in pairs)
    return len(one) == len(other) and all(same)


def _sizes(spacing: tuple[float, ...] | None) -> str:
    """Format a spacing for display: "0.5 x 2"."""
    return " x ".join(f"{size:g}" for size in spacing or ())


def are_same(one: Loads | None, other: Loads | None) -> bool:
    """Return whether two problems have the same loads or both have no loads."""
    return one is other or (one is not None and one.same_as(other))

"""The loads of elastic tissue: growth, and forces at sites."""

from __future__ import annotations

import math
from collections.abc import Sequence, Sized

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import reals, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.neighbours import around_sites, in_elements
from napari_hmrf.solver.real_arrays import (
    FloatArray,
    as_float32,
    check_finite,
    first_index,
    how_many,
)

# By which part of the largest strain a tensor may differ from its transpose.
_ASYMMETRY = 1e-5
# Relative difference up to which pixel sizes, often rounded in files, are equal.
_SAME_SPACING = 1e-4
_AXES = 3


class Loads:
    """Growth of elastic tissue, and forces on it; frozen, and of one grid.

    Loads add up: ``growth(0.1 * tumour) + weight(stiffness, (0.01, 0), spacing=1)``. Motion is
    proportional to forces, and inversely to stiffness, whose unit then matters.

    Parameters
    ----------
    growth : array_like, optional
        The strain that tissue would have if it were free: 0.1 is a tenth longer. One number a
        site, (H, W) or (D, H, W): the same along all three axes, that across an image included. Or
        a symmetric tensor a site, in the order of the axes: (H, W, 2, 2), which is nothing across
        the image; (H, W, 3, 3), whose first axis is across; (D, H, W, 3, 3). Across an image counts
        in plane strain, where a slice that cannot thicken pushes outwards instead; in large motion
        a slice that thickens is as much stiffer, too. In void it does not matter; rigid tissue does
        not grow.
    force : array_like, shape (H, W, 2) or (D, H, W, 3), optional
        What pulls at each site, components in the order of the axes: in an image a force per
        thickness, stiffness times length; in a volume a force, stiffness times length squared. It
        stays as it is, wherever the site gets to.
    spacing : sequence of float, shape (n,), optional
        Size of a pixel along each axis for which the forces were computed, as `pressure`,
        `traction` and `weight` give it. A `Problem` of another spacing refuses the loads. By
        default unknown, and not checked.

    Raises
    ------
    ProblemError
        Naming the input at fault and what to do about it.
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
                "spacing", f"is {shown(spacing)}. Give positive, finite pixel sizes."
            )
        object.__setattr__(self, "spacing", sizes)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("Loads are frozen: make others")

    def __add__(self, other: Loads) -> Loads:
        """Both together."""
        if not isinstance(other, Loads):
            return NotImplemented
        if not _is_close(self.spacing, other.spacing):
            raise ProblemError(
                "loads",
                f"are made for pixels of {_sizes(self.spacing)} and of {_sizes(other.spacing)}. "
                "Make both with the spacing of the problem.",
            )
        return Loads(
            growth=_grown(self.growth, other.growth),
            force=_pulled(self.force, other.force),
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
        """Return whether the values of the other are equal."""
        return self is other or (
            other is not None
            and is_equal(self.growth, other.growth)
            and is_equal(self.force, other.force)
        )

    def check(self, stiffness: FloatArray, spacing: tuple[float, ...]) -> None:
        """Refuse tissue that cannot bear these loads.

        Raises
        ------
        ProblemError
            If the grid or its spacing is another one, if rigid tissue would grow, or if a force
            acts where there is no tissue.
        """
        grid, axes = stiffness.shape, stiffness.ndim
        if self.growth is not None:
            tensors = [(*grid, size, size) for size in sorted({axes, _AXES})]
            if self.growth.shape not in [grid, *tensors]:
                others = " or ".join(map(str, tensors))
                raise ProblemError(
                    "growth",
                    f"has shape {self.growth.shape}, but stiffness has shape {grid}: give one "
                    f"number for each site, or a tensor {others}.",
                )
            grows = self.growth != 0
            stuck = grows.reshape(*grid, -1).any(axis=-1) & np.isinf(stiffness)
            if stuck.any():
                raise ProblemError(
                    "growth",
                    f"has {how_many(stuck)} of rigid tissue, which cannot grow, the first at "
                    f"{first_index(stuck)}. Give 0 there.",
                )
        if not _is_close(self.spacing, spacing):
            raise ProblemError(
                "loads",
                f"are made for pixels of {_sizes(self.spacing)}, but the problem has pixels of "
                f"{_sizes(spacing)}. Make them with the spacing of the problem.",
            )
        if self.force is not None:
            if self.force.shape != (*grid, axes):
                raise ProblemError(
                    "force",
                    f"has shape {self.force.shape}, but stiffness has shape {grid}, so "
                    f"{(*grid, axes)} is needed (one value per axis at each site).",
                )
            nowhere = self.force.any(axis=-1) & ~around_sites(in_elements(stiffness), np.logical_or)
            if nowhere.any():
                raise ProblemError(
                    "force",
                    f"has {how_many(nowhere)} where no tissue two pixels wide could bear it, the "
                    f"first at {first_index(nowhere)}. Give 0 there, or that place a stiffness.",
                )


def growth(strain: npt.ArrayLike, *, along: npt.ArrayLike | None = None) -> Loads:
    """Return loads of tissue that grows, or shrinks, by the strain that it would have if free.

    Parameters
    ----------
    strain : array_like, shape (H, W) or (D, H, W)
        Of each site: 0.1 is a tenth longer, -0.1 a tenth shorter, 0 does not grow. Of two tissues
        ``0.1 * (labels == 2) + 0.02 * (labels == 3)``, say.
    along : array_like, shape (n,) or of one direction for each site, (H, W, 2) or (D, H, W, 3)
        The direction in which it grows, as muscle does; by default all, that across an image
        included.

    Returns
    -------
    Loads

    Raises
    ------
    ProblemError
        If strain is no image or volume of numbers above -1, or a direction has no length.
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
    way = as_float32("along", along).astype(np.float64)
    if way.shape not in ((amount.ndim,), (*amount.shape, amount.ndim)):
        raise ProblemError(
            "along",
            f"has shape {way.shape}. Give one direction, of {amount.ndim} components in the order "
            "of the axes, or one for each site.",
        )
    length = np.linalg.norm(way, axis=-1)
    wanting = ~(np.isfinite(length) & (length > 0)) & (amount != 0)
    if wanting.any():
        raise ProblemError(
            "along",
            f"is {shown(np.broadcast_to(way, (*amount.shape, amount.ndim))[wanting][0].tolist())} "
            f"at {first_index(wanting)}, which is no direction. Give a vector of any length.",
        )
    unit = np.divide(way, length[..., None], out=np.zeros_like(way), where=length[..., None] > 0)
    return Loads(growth=amount[..., None, None] * (unit[..., :, None] * unit[..., None, :]))


def _check_growth(strain: FloatArray | None) -> None:
    """Refuse a tensor that is not symmetric, and tissue that would shrink to nothing."""
    if strain is None:
        return
    stretch = strain
    if strain.ndim > _AXES:
        if strain.shape[-1] != strain.shape[-2]:
            raise ProblemError(
                "growth",
                f"has shape {strain.shape}: a tensor has as many rows as columns.",
            )
        apart = np.abs(strain - strain.swapaxes(-1, -2)).max(initial=0)
        if apart > _ASYMMETRY * np.abs(strain).max(initial=0):
            raise ProblemError("growth", "is not symmetric. Give the symmetric part of the tensor.")
        stretch = np.diagonal(strain, axis1=-2, axis2=-1)
    least = float(stretch.min(initial=math.inf))
    if least <= -1:
        raise ProblemError(
            "growth",
            f"is {least:.3g} somewhere: nothing is left of tissue that shrinks by all its length. "
            "Give strains above -1; -0.1 is a tenth shorter.",
        )


def _grown(one: FloatArray | None, other: FloatArray | None) -> npt.NDArray[np.floating] | None:
    if one is None or other is None:
        return other if one is None else one
    if one.shape == other.shape:
        return one + other
    made = _tensor(one), _tensor(other)
    if made[0].shape != made[1].shape:
        raise ProblemError("growth", f"is on grids of {one.shape} and {other.shape}: use one grid.")
    return np.asarray(made[0] + made[1])


def _tensor(strain: FloatArray) -> FloatArray:
    """A tensor of three axes at each site; a strain of one number is along all of them."""
    if strain.ndim <= _AXES:
        return strain[..., None, None] * np.eye(_AXES, dtype=np.float32)
    missing = _AXES - strain.shape[-1]
    return np.pad(strain, [*[(0, 0)] * (strain.ndim - 2), (missing, 0), (missing, 0)])


def _pulled(one: FloatArray | None, other: FloatArray | None) -> npt.NDArray[np.floating] | None:
    if one is None or other is None:
        return other if one is None else one
    if one.shape != other.shape:
        raise ProblemError("force", f"is on grids of {one.shape} and {other.shape}: use one grid.")
    return np.asarray(one + other)


def _is_close(one: tuple[float, ...] | None, other: tuple[float, ...] | None) -> bool:
    """Return whether two spacings are equal up to rounding, or one is unknown."""
    if one is None or other is None:
        return True
    pairs = zip(one, other, strict=False)
    same = (math.isclose(*sizes, rel_tol=_SAME_SPACING) for sizes in pairs)
    return len(one) == len(other) and all(same)


def _sizes(spacing: tuple[float, ...] | None) -> str:
    """Format a spacing for display: "0.5 x 2"."""
    return " x ".join(f"{size:g}" for size in spacing or ())


def are_same(one: Loads | None, other: Loads | None) -> bool:
    """Return whether two problems have the same loads, or both have none."""
    return one is other or (one is not None and one.same_as(other))


def is_equal(one: FloatArray | None, other: FloatArray | None) -> bool:
    """Return whether two parts of loads have the same values, or both are missing."""
    if one is None or other is None:
        return one is other
    return one is other or np.array_equal(one, other)

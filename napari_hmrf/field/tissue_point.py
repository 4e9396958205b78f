"""What happens to the tissue at one point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.directions import Directions
from napari_hmrf.field.inverse_point import farthest_of, inverse_point
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.field.quantities import area_change, values_of
from napari_hmrf.solver.solution import Solution

#: Said of the Jacobian at a fold, which is 0 or below; elsewhere it is the mean of the corners.
_FOLDS = " (folds: that of the worst corner)"
_FULL = 100


class Probe(NamedTuple):
    """The tissue at a point.

    Attributes
    ----------
    site : tuple of int
        The pixel it lay on before it moved, (row, col), or the voxel, (depth, row, col).
    displacement : tuple of float
        In the order of the axes and the unit of the solution's spacing.
    length : float
        Of the displacement.
    jacobian : float
        By which factor its area, or volume, changes; 0 or below where it folds.
    strain : float
        Its equivalent strain, in per cent, of the kind that `strain_kind` says.
    """

    site: tuple[int, ...]
    displacement: tuple[float, ...]
    length: float
    jacobian: float
    strain: float


def holds(image: npt.NDArray[Any], pixel: tuple[int, ...]) -> bool:
    """Whether an image has a pixel, and is above 0 there."""
    inside = all(0 <= at < size for at, size in zip(pixel, image.shape, strict=True))
    return inside and bool(image[pixel] > 0)


class Points:
    """All points of a solution; made once, and then quick to ask.

    Parameters
    ----------
    solution : Solution
    """

    def __init__(self, solution: Solution) -> None:
        self._solution = solution
        self._farthest = farthest_of(solution.displacement)

    def before(self, place: tuple[float, ...], fraction: float = 1.0) -> tuple[float, ...] | None:
        """Where the tissue that is seen at a place was before it moved; None where there is none.

        Parameters
        ----------
        place : tuple of float
            ([depth,] row, col) in pixels.
        fraction : float
            How much of the displacement it has moved by: 0 to 1.
        """
        solution = self._solution
        field = (solution.displacement, solution.spacing, solution.tissue)
        return inverse_point(place, *field, self._farthest, fraction)

    def after(self, places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Where tissue that was at places, (N, n) in pixels, is seen."""
        return moved_points(places, self._solution.displacement, spacing=self._solution.spacing)

    def at(self, place: tuple[float, ...], fraction: float = 0.0) -> Probe | None:
        """Say what happens to the tissue that is seen at a place.

        Parameters
        ----------
        place : tuple of float
            ([depth,] row, col) in pixels, where the tissue is seen.
        fraction : float
            How much of the displacement it has moved by then: 0 to 1.

        Returns
        -------
        Probe or None
            None where there is no tissue.
        """
        solution, origin = self._solution, self.before(place, fraction)
        site = () if origin is None else tuple(int(np.floor(along + 0.5)) for along in origin)
        if not (site and holds(solution.tissue, site)):
            return None
        step = solution.displacement[site]
        # What happens at a site its neighbours say: of a volume it would take long to know all.
        around = tuple(slice(max(at - 1, 0), at + 2) for at in site)
        near = replace(
            solution,
            displacement=solution.displacement[around],
            tissue=solution.tissue[around],
            elasticity=solution.elasticity
            and solution.elasticity.mapped(lambda values: values[around]),
        )
        middle = tuple(min(at, 1) for at in site)
        return Probe(
            site,
            tuple(step.tolist()),
            float(np.linalg.norm(step)),
            float(area_change(near)[middle]),
            float(values_of(near, "equivalent")[middle]),
        )


def at_point(
    unit: str, found: Probe, ways: Directions, more: Sequence[str] = (), percent: int = _FULL
) -> str:
    """Say what happens at a point, in a line short enough for a status bar.

    It is of the whole deformation, however much of it is seen.

    Parameters
    ----------
    unit : str
        Of lengths.
    found : Probe
    ways : Directions
        Which way rows and columns run.
    more : sequence of str
        What else there is to say.
    percent : int
        How much is seen.
    """
    step = tuple(rounded(part) for part in ways.seen(found.displacement))
    length = rounded(found.length)
    parts = [
        f"moves {length:g} {unit}" + (f" ({ways.step(step)})" if length else ""),
        f"Jacobian {found.jacobian:.3f}" + (_FOLDS if found.jacobian <= 0 else ""),
    ]
    line = ", ".join([*parts, *filter(None, more)])
    return line if percent == _FULL else f"at {_FULL} %: {line}"


def rounded(length: float) -> float:
    """Round to what matters: three digits, and no more than two decimals."""
    return round(float(f"{length:.3g}"), 2) + 0.0  # and no -0

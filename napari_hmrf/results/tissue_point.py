"""Displacement, Jacobian and strain of the tissue at one point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.directions import Directions
from napari_hmrf.field.followers import followers_of
from napari_hmrf.field.inverse_point import farthest_of, inverse_point
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.results.quantities import area_change, values_of
from napari_hmrf.solver.solution import Solution

#: Remark after the area change at a fold, where the displayed value is the smallest determinant of
#: the elements around the site; elsewhere, the displayed value is the mean of these determinants.
_FOLDS = " (folds: value at the worst corner)"
_FULL = 100
#: Distance from the target, in the unit of lengths, below which held tissue has reached it.
_SHORT = 0.1


class Probe(NamedTuple):
    """Displacement and strain of the tissue at a point.

    Attributes
    ----------
    site : tuple of int
        Pixel of the tissue before the motion, (row, col), or voxel, (depth, row, col).
    displacement : tuple of float
        Components in the order of the axes, in the unit of the solution's spacing.
    length : float
        Length of the displacement.
    jacobian : float
        Ratio of the areas, or volumes, after and before the motion; 0 or below at folds.
    strain : float
        Equivalent strain, in per cent, of the kind given by `strain_kind`.
    """

    site: tuple[int, ...]
    displacement: tuple[float, ...]
    length: float
    jacobian: float
    strain: float


def holds(image: npt.NDArray[Any], pixel: tuple[int, ...]) -> bool:
    """Return whether a pixel is inside an image and its value is above 0."""
    inside = all(0 <= at < size for at, size in zip(pixel, image.shape, strict=True))
    return inside and bool(image[pixel] > 0)


class Points:
    """Fast evaluation of a solution at single points.

    Parameters
    ----------
    solution : Solution

    Attributes
    ----------
    farthest : ndarray, shape (n,)
        Largest displacement along each axis, in the unit of the spacing.
    """

    def __init__(self, solution: Solution) -> None:
        self._solution = solution
        self.farthest = farthest_of(solution.displacement)

    def before(self, place: tuple[float, ...], fraction: float = 1.0) -> tuple[float, ...] | None:
        """Return the origin of the tissue at a moved position; None if no tissue is there.

        Parameters
        ----------
        place : tuple of float
            Position after the motion, ([depth,] row, col) in pixels.
        fraction : float
            Fraction of the displacement that is applied, from 0 to 1.

        Returns
        -------
        tuple of float or None
            Position before the motion, in pixels.
        """
        solution = self._solution
        field = (solution.displacement, solution.spacing, solution.tissue)
        return inverse_point(place, *field, self.farthest, fraction)

    def first(
        self, places: npt.NDArray[np.float64], fraction: float = 1.0
    ) -> tuple[float, ...] | None:
        """Return the first of several moved positions that has tissue, or None.

        Parameters
        ----------
        places : ndarray, shape (N, n)
            Positions after the motion, in pixels.
        fraction : float
            Fraction of the displacement that is applied, from 0 to 1.
        """
        reach = 1 + fraction * self.farthest / np.array(self._solution.spacing)
        return first_tissue(
            places,
            self._solution.tissue,
            reach,
            lambda place: self._site_at(place, fraction) is not None,
        )

    def after(self, places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the moved positions, shape (N, n), of tissue points (N, n), in pixels."""
        return moved_points(places, self._solution.displacement, spacing=self._solution.spacing)

    def at(self, place: tuple[float, ...], fraction: float = 0.0) -> Probe | None:
        """Return displacement, Jacobian and strain of the tissue at a displayed position.

        Parameters
        ----------
        place : tuple of float
            Position in the displayed image, ([depth,] row, col) in pixels.
        fraction : float
            Fraction of the displacement that is applied in the displayed image, from 0 to 1.

        Returns
        -------
        Probe or None
            Values for the full displacement; None if no tissue is there.
        """
        solution, site = self._solution, self._site_at(place, fraction)
        if site is None:
            return None
        step = solution.displacement[site]
        # The values at a site depend only on neighbouring sites; computing all sites would be slow.
        around = self._neighbourhood(site)
        near = replace(
            solution,
            displacement=solution.displacement[around],
            tissue=solution.tissue[around],
            parts=None if solution.parts is None else solution.parts[around],
            elasticity=solution.elasticity
            and solution.elasticity.mapped(lambda values: values[around]),
        )
        middle = tuple(at - part.start for at, part in zip(site, around, strict=True))
        return Probe(
            site,
            tuple(step.tolist()),
            float(np.linalg.norm(step)),
            float(area_change(near)[middle]),
            float(values_of(near, "equivalent")[middle]),
        )

    def _neighbourhood(self, site: tuple[int, ...]) -> tuple[slice, ...]:
        """Return the box of the sites that determine the values at a site."""
        tissue = self._solution.tissue
        corners, margin = np.array([site]), 1
        found = followers_of(tissue, self._solution.parts)
        sources = () if found is None else found.followed_by(site, tissue.shape)
        if len(sources):
            # The fit of an orphan also needs the elements of the sites that it follows.
            corners, margin = np.vstack([corners, sources]), 2
        low, high = np.maximum(corners.min(axis=0) - margin, 0), corners.max(axis=0) + margin + 1
        return tuple(map(slice, low.tolist(), high.tolist()))

    def _site_at(self, place: tuple[float, ...], fraction: float) -> tuple[int, ...] | None:
        """Return the undeformed pixel of the tissue at a displayed position, or None."""
        origin = self.before(place, fraction)
        if origin is None:
            return None
        site = tuple(int(np.floor(along + 0.5)) for along in origin)
        return site if holds(self._solution.tissue, site) else None


def first_tissue(
    places: npt.NDArray[np.float64],
    tissue: npt.NDArray[np.bool_],
    reach: npt.NDArray[np.floating],
    has_tissue: Callable[[tuple[float, ...]], bool],
) -> tuple[float, ...] | None:
    """Return the first of several positions that has tissue, or None.

    Parameters
    ----------
    places : ndarray, shape (N, n)
        Positions in pixels.
    tissue : ndarray of bool
        Mask of the undeformed tissue.
    reach : ndarray, shape (n,)
        Largest distance along each axis from a position to the origin of its tissue, in pixels.
    has_tissue : callable
        Returns whether there is tissue at a position. It is only called near the mask.
    """
    low = np.maximum(np.floor(places - reach), 0).astype(np.intp)
    high = np.maximum(np.ceil(places + reach).astype(np.intp) + 1, 0)
    for place, first, past in zip(places.tolist(), low, high, strict=True):
        # Inverting the motion is slow, so positions far from all tissue are skipped first.
        if tissue[tuple(map(slice, first, past))].any() and has_tissue(tuple(place)):
            return tuple(place)
    return None


def at_point(
    unit: str,
    probe: Probe,
    ways: Directions,
    more: Sequence[str] = (),
    percent: int = _FULL,
    held: float = 0.0,
    missing: float = 0.0,
    uncertainty: float | None = None,
) -> str:
    """Describe the deformation at a point in one line for the status bar.

    The values are always those of the full deformation.

    Parameters
    ----------
    unit : str
        Symbol of the unit of lengths.
    probe : Probe
    ways : Directions
        Directions of rows and columns.
    more : sequence of str
        Further parts of the line, appended with commas.
    percent : int
        Percentage of the deformation in the displayed image. If it is below 100, the line starts
        with a remark that the values are those at 100 %.
    held : float
        Confidence with which the position of this tissue is given; 0 if the tissue is free.
    missing : float
        Distance of held tissue from its given position, in `unit`.
    uncertainty : float, optional
        Standard deviation of the displacement, in `unit`.

    Returns
    -------
    str
    """
    step = tuple(rounded(part) for part in ways.to_display(probe.displacement))
    length = rounded(probe.length)
    size = "volume" if len(probe.displacement) == 3 else "area"
    spread = "" if uncertainty is None else f" ± {uncertainty:.2g}"
    distance = f"{length:g}{spread} {unit}" + (f" ({ways.step(step)})" if length else "")
    motion = f"moves {distance}"
    if held >= 1 and (short := rounded(missing)) >= _SHORT:
        motion = f"moved {distance}, {short:g} {unit} short of its target"
    elif held >= 1:
        motion = f"held at its target, moved {distance}" if length else "held in place"
    elif held > 0:
        motion = f"held with confidence {held:.2g}, {motion}"
    parts = [
        motion,
        f"{size} change x {probe.jacobian:.3f}" + (_FOLDS if probe.jacobian <= 0 else ""),
    ]
    line = ", ".join([*parts, *filter(None, more)])
    return line if percent == _FULL else f"at {_FULL} %: {line}"


def rounded(length: float) -> float:
    """Round a length to at most three significant digits and two decimals."""
    return round(float(f"{length:.3g}"), 2) + 0.0  # avoids -0

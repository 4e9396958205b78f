"""Energies of the paper, equation by equation.

This module is the readable reference, in NumPy and float64, for the kernels of both backends; tests
compare the kernels with it. Lengths are in pixels (``Problem.unit``).

Three sites s - t - u in a line, with t in the middle, form a clique. In an image, lines have four
directions (figure 2): vertical, horizontal and the two diagonals. In a volume they have thirteen:
the three axes, the six face diagonals and the four space diagonals. With the stiffness ratios
r_u = m_t / m_u and r_s = m_t / m_s, the potential of a clique (eqs. 9-11) is, summed over the
components to which its line contributes,

    V = (r_u (d_t - d_s) - (d_u - d_t))^2 + (r_s (d_t - d_u) - (d_s - d_t))^2

A clique exists if all three sites are in the image and in tissue.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, asdict, replace
from functools import reduce
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import require_kind
from napari_hmrf.checks import PENALTY_RANGE, Choice, Penalty, PositiveShare, checked
from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.data_term import refuse_data
from napari_hmrf.solver.priors.cliques import (
    Cliques,
    SeilerMaterial,
    Slices,
    cliques,
    line_steps,
    line_weights,
)
from napari_hmrf.solver.problem import Problem, in_pixels
from napari_hmrf.solver.quadtree import levels, sampled

Float64Array = npt.NDArray[np.float64]
Conditional = Literal["centred", "blanket"]

# K in uniform tissue, by number of axes. One pixel of deviation from the observation then has the
# same energy as a difference of 200 pixels from the neighbours.
_UNIFORM_PENALTY = {2: 1e4, 3: 3e4}


class SiteParabola(NamedTuple):
    """Prior energy of a site as a function of its displacement: curvature * (d - lowest)^2."""

    curvature: Float64Array
    lowest: Float64Array


@checked
class SeilerPrior:
    """Prior and observation energy of the paper (eqs. 8-11 and 16-19).

    Parameters
    ----------
    penalty : float, optional
        K of eq. 19: the largest force that an observation of confidence 1 exerts on its site. The
        site slips where the force would exceed this limit. K is the energy of one pixel of
        deviation from the observation. By default, it is 10^4 in uniform tissue (3 x 10^4 in
        volumes, which have three times as many cliques). In other tissue, this value is multiplied
        by a ratio, so that boundaries do not slip in any tissue: the largest curvature of the
        energy of the cliques centred at a site that is observed in any component, in any component
        and on any level, over the largest curvature of a component in uniform tissue. Both
        readings have the same K.
    conditional : {"centred", "blanket"}
        Cliques that determine the displacement of a site (line 8 of the algorithm). ``"centred"``:
        the cliques centred at the site. ``"blanket"``: all cliques that contain the site, which is
        the textbook reading of eq. 7, for images only. docs/method.md compares their accuracy.
    damping : float, optional
        Factor on the step of each site to its best displacement, because all sites move
        simultaneously. The default is 1 for centred cliques and 0.6 for blanket cliques, which
        diverge without damping. Values below 2/3 are safe for any stiffness. With larger values,
        ``ICM(steps=None)`` raises a `ConvergenceError` if the energy of its sweeps rises.
    """

    _: KW_ONLY
    penalty: Penalty | None = None
    conditional: Annotated[Conditional, Choice()] = "centred"
    damping: PositiveShare | None = None

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name (JSON types only)."""
        return {"name": "SeilerPrior", **asdict(self)}

    @property
    def kernels(self) -> str:
        """Key of the kernels that this prior uses: the name of its reading of the paper."""
        return self.conditional

    def rehearsal(self, shape: tuple[int, ...]) -> SeilerPrior:
        """Return a prior that uses the same kernels, for a small problem of the given shape."""
        return self

    @property
    def relaxation(self) -> float:
        """Damping in use: the given value, or the default of the reading."""
        if self.damping is not None:
            return self.damping
        return 1.0 if self.conditional == "centred" else 0.6

    def penalty_for(self, problem: Problem) -> float:
        """Return K for a problem: the given penalty, or a value at which boundaries do not slip."""
        require_kind(Problem, "problem", problem, "Problem(observed, confidence, stiffness)")
        if self.penalty is not None:
            return self.penalty
        weights = line_weights(problem.spacing)
        # Combine the components one by one: NumPy reduces over a short axis ten times more slowly.
        observed = reduce(np.logical_or, np.moveaxis(problem.known, -1, 0))
        steepest = max(
            _steepest(sampled(problem.stiffness, level), sampled(observed, level), weights)
            for level in levels(problem.shape)
        )
        uniform = 8.0 * float(weights.sum(axis=0).max())
        penalty = _UNIFORM_PENALTY[len(problem.shape)] * max(1.0, steepest / uniform)
        return min(penalty, PENALTY_RANGE[1])

    def resolved(self, problem: Problem) -> SeilerPrior:
        """Check that the prior supports the problem, and return the prior with its penalty.

        Raises
        ------
        ProblemError
            If there is rigid tissue, if the blanket reading is used for a volume, or if there are
            loads, a precision or landmarks.
        """
        refuse_data(problem)
        if problem.loads is not None:
            raise ProblemError(
                "loads",
                "are given, but the paper's prior uses only ratios of stiffness and has no forces. "
                "Use ElasticPrior, or remove the loads.",
            )
        if problem.is_volume and self.conditional == "blanket":
            raise ProblemError(
                "stiffness",
                "is a volume, but the blanket reading is for images only. Use SeilerPrior() or "
                "ElasticPrior().",
            )
        if problem.has_rigid:
            raise ProblemError(
                "stiffness",
                "is infinite (rigid) somewhere, but the paper's prior uses ratios of stiffness, "
                "which are undefined there. Use ElasticPrior, or give a finite stiffness.",
            )
        return replace(self, penalty=self.penalty_for(problem))

    def limit(self, problem: Problem) -> Float64Array:
        """Return P = K c for every component, shape (H, W, 2) or (D, H, W, 3)."""
        limit: Float64Array = self.penalty_for(problem) * problem.confidence.astype(np.float64)
        return limit

    def material(self, problem: Problem) -> SeilerMaterial:
        """Return the properties of a problem's tissue that the multigrid kernels require."""
        square = len(set(problem.spacing)) == 1
        blanket = self.conditional == "blanket"
        return SeilerMaterial(problem.stiffness, line_weights(problem.spacing), square, blanket)

    def site_energy(self, problem: Problem, displacement: npt.ArrayLike) -> Float64Array:
        """Return each site's contribution to U_total (eq. 7): centred cliques and data term.

        Parameters
        ----------
        problem : Problem
            Tissue and observations.
        displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
            Displacement, in the unit of ``problem.spacing``.

        Returns
        -------
        ndarray, shape (H, W) or (D, H, W)
            Energies in pixels squared; their sum over all sites is U_total.

        Raises
        ------
        ArgumentError, ProblemError
            If `problem` is not a `Problem`, has rigid tissue or loads, or if the displacement does
            not fit it.
        """
        d = in_pixels(problem, displacement)
        y = problem.observed / np.float64(problem.unit)
        penalty = self.resolved(problem).penalty_for(problem)
        energy: Float64Array = (
            penalty * problem.confidence.astype(np.float64) * np.abs(y - d)
        ).sum(axis=-1)
        energy[~problem.tissue] = 0.0
        energy += self._cliques_of(problem, d).energy[_inside(problem)]
        return energy

    def mean_energy(self, problem: Problem, displacement: npt.ArrayLike) -> float:
        """Return U_total divided by the number of tissue sites, in pixels squared."""
        return float(self.site_energy(problem, displacement).sum() / problem.tissue.sum())

    def site_parabola(self, problem: Problem, displacement: npt.ArrayLike) -> SiteParabola:
        """Return the prior energy that each site minimizes, given its neighbours, without damping.

        Returns
        -------
        SiteParabola
            Two arrays of shape (H, W, 2) or (D, H, W, 3): the curvature A, which is 0 if the site
            is not in any clique, and the minimizer `lowest` in the unit of ``problem.spacing``,
            which is the current displacement of the site if A = 0.
        """
        d = in_pixels(problem, displacement)
        cliques_at_sites = self._cliques_of(problem, d)
        curvature, slope = (
            np.moveaxis(each[:, *_inside(problem)], 0, -1)
            for each in (cliques_at_sites.curvature, cliques_at_sites.slope)
        )
        step = np.divide(slope, curvature, out=np.zeros_like(d), where=curvature > 0)
        return SiteParabola(curvature, (d + step) * problem.unit)

    def _cliques_of(self, problem: Problem, d: Float64Array) -> Cliques:
        """Evaluate the cliques of a problem for a displacement (H, W, 2) in pixels."""
        planes = np.pad(np.moveaxis(d, -1, 0), ((0, 0), *[(2, 2)] * len(problem.shape)))
        weights, blanket = line_weights(problem.spacing), self.conditional == "blanket"
        return cliques(planes, np.pad(problem.stiffness, 2), weights, blanket)


def _inside(problem: Problem) -> Slices:
    """Return the slices that select the grid in a padded array."""
    return (slice(2, -2),) * len(problem.shape)


def in_cliques(
    tissue: npt.NDArray[np.bool_], spacing: tuple[float, ...], *, middle: bool = False
) -> npt.NDArray[np.bool_]:
    """Return, per component, the mask of sites in a clique that contributes to it, (2, H, W).

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W) or (D, H, W)
    spacing : tuple of float
        Size of a pixel along each axis.
    middle : bool
        True for the sites in the middle of a clique only.
    """
    mask = np.zeros((tissue.ndim, *tissue.shape), dtype=np.bool_)
    carried = line_weights(spacing) > 0
    for line, sites in _cliques(tissue.shape):
        exists = np.logical_and.reduce([tissue[at] for at in sites])
        for component in np.flatnonzero(carried[line]):
            for at in sites[1:2] if middle else sites:
                mask[component][at] |= exists
    return mask


def _steepest(
    m: npt.NDArray[np.float32], sites: npt.NDArray[np.bool_], weights: Float64Array
) -> float:
    """Return the largest curvature of the centred energy at any of the given sites."""
    padded, at = np.pad(m, 1), np.argwhere(sites) + 1

    def stiffness(sites: npt.NDArray[np.int_]) -> Float64Array:
        return np.asarray(padded[tuple(sites.T)], dtype=np.float64)

    t = stiffness(at)
    curvature = np.zeros((m.ndim, len(at)))
    for step, weight in zip(line_steps(m.ndim), weights, strict=True):
        s, u = stiffness(at - step), stiffness(at + step)
        exists = (s > 0) & (u > 0)
        steep = (1 + t / np.where(exists, s, 1)) ** 2 + (1 + t / np.where(exists, u, 1)) ** 2
        curvature += weight[:, None] * (exists * steep)
    return float(curvature.max(initial=0.0))


def _cliques(shape: tuple[int, ...]) -> Iterator[tuple[int, tuple[Slices, Slices, Slices]]]:
    """Yield the index of each line, and its cliques as three slices (s, t, u) of equal shape."""
    for line, step in enumerate(line_steps(len(shape))):
        views = [
            tuple(
                slice(abs(along) + end * along, size - abs(along) + end * along)
                for along, size in zip(step, shape, strict=True)
            )
            for end in (-1, 0, 1)
        ]
        if all(size > 2 * abs(along) for along, size in zip(step, shape, strict=True)):
            yield line, (views[0], views[1], views[2])

"""Samples of the posterior of the paper's model, in its blanket reading.

Each clique of three sites s - t - u adds two squares to the energy (eqs. 9-11),

    w (a d)^2 + w (b d)^2,    a = (-r_u, 1 + r_u, -1),  b = (-1, 1 + r_s, -r_s)

where d are the displacements of its sites, r_u and r_s ratios of stiffness, and w the weight of its
line. The matrix of the energy is therefore the sum of ``2 w (a a^T + b b^T)``, and the random force

    sum of sqrt(2 T w) (a x + b z)

with standard normal x and z has T times this matrix as its covariance. It moves the tissue by a
deviation with the covariance of the posterior (see `noise`).

The unit of energy is ``T = (strain / 0.1)^2`` pixels squared: for all sizes of patches, the strains
of two neighbouring patches then differ by about the typical strain. For a strain of 10 %, T is 1,
as in the paper.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.forced import ForcedMultigrid
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.bending_modes import check_bending
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import SeilerPrior, line_steps, line_weights
from napari_hmrf.solver.priors.cliques import ratios
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solve import CancelFlag, Progress, solve
from napari_hmrf.solver.uncertain_landmarks import StrainScale, checked_scale

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

#: Strain for which the unit of energy is 1 pixel squared.
_STRAIN = 0.1
#: Largest error of the most likely field, in pixels.
_TOLERANCE = 1e-3
#: Largest error of a deviation, relative to the root mean square length of its displacements.
_ACCURACY = 0.01


def blanket_samples(
    problem: Problem,
    prior: SeilerPrior,
    n: int,
    scale: StrainScale | None,
    seed: int,
    backend: str,
    progress: Progress | None,
    cancel: CancelFlag | None,
) -> Iterator[Float32Array]:
    """Sample displacement fields of the paper's model in its blanket reading.

    Parameters
    ----------
    problem, prior, n, scale, seed, backend, progress, cancel
        As for `sample_posterior`.

    Raises
    ------
    ArgumentError
        If the scale is neither a `StrainScale` nor None.
    ProblemError
        If the posterior is not a normal distribution, or if tissue can move freely.
    """
    strain = (checked_scale(scale) or StrainScale()).strain
    _check(problem, prior)
    sampler = _Sampler(problem, prior, (strain / _STRAIN) ** 2, seed, backend, cancel)

    def samples() -> Iterator[Float32Array]:
        mean = sampler.mean()
        for number in range(n):
            if progress is not None:
                progress(Monitor(f"sample {number + 1} of {n}", number / n))
            yield np.asarray(mean + sampler.deviation(number), np.float32)

    return samples()


def _check(problem: Problem, prior: SeilerPrior) -> None:
    """Raise an error if the posterior is not a normal distribution."""
    if prior.conditional == "centred":
        raise ProblemError(
            "prior",
            "is the paper's model in its centred reading, which has no energy and therefore no "
            'posterior. Pass ElasticPrior(), or SeilerPrior(conditional="blanket").',
        )
    prior.resolved(problem)
    given = problem.confidence[problem.known]
    if prior.penalty is not None or (given < 1).any():
        raise ProblemError(
            "confidence",
            "is between 0 and 1 somewhere, or the prior has a penalty: such observations may slip, "
            "and the posterior is not a normal distribution. Hold the sites with a confidence of "
            "1, and pass a prior without a penalty.",
        )
    check_bending(problem)


class _Sampler:
    """Most likely field, and random deviations from it."""

    def __init__(
        self,
        problem: Problem,
        prior: SeilerPrior,
        energy: float,
        seed: int,
        backend: str,
        cancel: CancelFlag | None,
    ) -> None:
        self._problem, self._prior = problem, prior
        self._noise = CliqueNoise(problem, energy)
        self._seed, self._backend, self._cancel = seed, backend, cancel
        self._at_rest = variant_of(problem, observed=np.zeros_like(problem.observed))

    def mean(self) -> Float32Array:
        """Return the most likely field, in the unit of `spacing`."""
        force = np.zeros(self._problem.observed.shape)
        return self._solved(self._problem, ForcedMultigrid(_TOLERANCE, force=host.planes(force)))

    def deviation(self, number: int) -> Float32Array:
        """Return a deviation from the most likely field, in the unit of `spacing`.

        Parameters
        ----------
        number : int
            Number of the sample, from 0. The deviation depends on the seed and this number only.
        """
        force = host.planes(self._noise.force(self._seed, number))
        return self._solved(self._at_rest, ForcedMultigrid(force=force, accuracy=_ACCURACY))

    def _solved(self, problem: Problem, optimizer: ForcedMultigrid) -> Float32Array:
        return solve(
            problem,
            self._prior,
            optimizer=optimizer,
            backend=self._backend,
            cancel=self._cancel,
        ).displacement


class CliqueNoise:
    """Random forces on the sites of a problem, in pixels.

    Parameters
    ----------
    problem : Problem
    energy : float
        Unit of energy, T in the equations, in pixels squared.
    """

    def __init__(self, problem: Problem, energy: float) -> None:
        self._m = np.pad(problem.stiffness, 2)
        self._roots = np.sqrt(2 * energy * line_weights(problem.spacing))

    def force(self, seed: int, number: int) -> Float64Array:
        """Return a random force on each site, shape (H, W, 2).

        Parameters
        ----------
        seed, number : int
            Seed, and number of the sample.
        """
        rng = np.random.default_rng((seed, number))
        force = np.zeros((*self._m.shape, self._m.ndim))
        for step, roots in zip(line_steps(self._m.ndim), self._roots, strict=True):
            s, t, u = (
                tuple(
                    slice(2 + way * along, size - 2 + way * along)
                    for along, size in zip(step, self._m.shape, strict=True)
                )
                for way in (-1, 0, 1)
            )
            r_s, r_u, exists = ratios(self._m, s, t, u)
            first, second = roots * exists * rng.standard_normal((2, *force[t].shape))
            force[s] -= r_u * first + second
            force[t] += (1 + r_u) * first + (1 + r_s) * second
            force[u] -= first + r_s * second
        return np.asarray(force[(slice(2, -2),) * self._m.ndim])

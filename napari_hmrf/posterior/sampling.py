"""Fields sampled from the posterior of a problem, by perturb and solve."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from napari_hmrf.checks import Count, Seed, convert
from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.noise import PosteriorNoise
from napari_hmrf.posterior.tissue_box import TissueBox
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.operator import Operator, typical_size
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.priors.elements import lame_ratio
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.rigid_modes import check_held
from napari_hmrf.solver.sliding_parts import refuse_sliding
from napari_hmrf.solver.solve import CancelFlag, Progress, check_arguments
from napari_hmrf.solver.uncertain_landmarks import StrainScale, checked_scale

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

#: Tolerance of a sample, relative to the root mean square length of its displacements. The error
#: estimate of the solver is cautious, above all in the first cycles: errors of samples are about
#: 1 % of their size, and the standard deviations of patches are at most 0.3 % too small. Twice this
#: tolerance makes those of large patches up to 2 % too small, because cycles reduce smooth motions
#: last.
_TOLERANCE = 0.105
#: Tolerance for nearly incompressible tissue, where smooth motions are found late. With the
#: tolerance of other tissue, standard deviations of large patches are up to 5 % too small.
_TOLERANCE_INCOMPRESSIBLE = 0.015
#: Largest ratio lambda / mu of compressible tissue: a Poisson's ratio of 0.46.
_MOST_RATIO = 12.0
#: Tolerance of the first sample, of which only the size is required.
_ROUGH = 0.5


def sample_posterior(
    problem: Problem,
    prior: Prior | None = None,
    n: int = 30,
    *,
    scale: StrainScale | None = None,
    seed: int = 0,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Iterator[Float32Array]:
    """Sample displacement fields of tissue from the posterior distribution.

    The energy of a problem is the negative logarithm of a probability: tissue that is strained
    little is likely, and so are displacements close to uncertain observations. `solve` returns the
    most likely field. The fields of this function are other fields that the tissue may have, each
    with its probability. For held sites and quadratic observations (`precision`, `landmarks`), the
    distribution is normal, and the samples follow it up to an error of the solver, whose root mean
    square is about 1 % of a sample or less. It makes standard deviations of patches up to 0.3 % too
    small; the error of their estimate from 30 samples is 13 %.

    The displacement of a single point in a volume has no finite variance in the limit of small
    voxels, because elastic tissue may strain at any scale. Use means over patches or labels, as
    `uncertainty` does.

    Parameters
    ----------
    problem : Problem
        Problem without doubted observations (a confidence between 0 and 1) and without a drift.
    prior : ElasticPrior, optional
        By default elastic tissue, as for `solve`.
    n : int
        Number of samples.
    scale : StrainScale, optional
        Scale of the prior: the typical strain of tissue before any observation. By default that of
        the landmarks, otherwise a strain of 10 %. It is required if the problem has a `precision`,
        whose unit of energy it defines: the variance of an observation is the energy of the scale
        divided by its precision. In the paper's model, the strains of neighbouring patches differ
        by about this strain.
    seed : int
        Seed of the random numbers. Sample number i depends on the seed and on i only.
    backend : str
        As for `solve`.
    progress : callable, optional
        As for `solve`: called with a message and the fraction of all samples that is complete.
    cancel : threading.Event or similar, optional
        As for `solve`.

    Returns
    -------
    iterator of ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Displacements in the unit of `spacing`. Samples are computed when they are requested.

    Raises
    ------
    ArgumentError
        If an argument is invalid.
    ProblemError
        If the posterior is not a normal distribution (doubted observations, large motion), if it is
        not implemented (the paper's model, drift), or if tissue can move freely.
    Cancelled
        If `cancel` was set.

    References
    ----------
    G. Papandreou, A. Yuille: Gaussian sampling by local perturbations. NIPS 2010.
    """
    check_arguments(problem=problem, prior=prior, backend=backend, progress=progress, cancel=cancel)
    n, seed = convert(Count, n, "n"), convert(Seed, seed, "seed")
    elastic = checked_prior(problem, prior)
    energy = energy_of(problem, scale)

    def samples() -> Iterator[Float32Array]:
        box = TissueBox.of(problem, elastic)
        mean = box.solve(backend, cancel).displacement
        operator = Operator(box.problem, box.prior, backend)
        noise = PosteriorNoise(operator.problem, operator.prior, energy)
        sampler = Sampler(operator, noise, seed, cancel)
        for number in range(n):
            if progress is not None:
                progress(Monitor(f"sample {number + 1} of {n}", number / n))
            field = mean.astype(np.float32)
            field[box.sites] += sampler.deviation(number)
            yield field

    return samples()


def checked_prior(problem: Problem, prior: Prior | None) -> ElasticPrior:
    """Return the elastic prior of a problem whose posterior is a normal distribution.

    Raises
    ------
    ProblemError
        If the posterior is another distribution, or if tissue can move freely.
    """
    if prior is not None and not isinstance(prior, ElasticPrior):
        raise ProblemError(
            "prior",
            f"is a {type(prior).__name__}, whose posterior is not a normal distribution or is not "
            "implemented. Pass ElasticPrior().",
        )
    elastic = prior or ElasticPrior()
    if elastic.can_slip(problem):
        raise ProblemError(
            "confidence",
            "is between 0 and 1 somewhere, or the prior has a penalty: such observations may slip, "
            "and the posterior is not a normal distribution. Pass a precision or landmarks with "
            "standard deviations instead, or hold the sites with a confidence of 1.",
        )
    refuse_sliding(problem.sliding, "a posterior")
    if problem.landmarks is not None and problem.landmarks.drift:
        raise ProblemError(
            "landmarks",
            "have a drift, whose uncertainty is not implemented. Pass landmarks without a drift.",
        )
    check_held(connected(problem, elastic).problem)
    return elastic.in_force(problem)


def energy_of(problem: Problem, scale: StrainScale | None) -> float:
    """Return the unit of energy of a problem's posterior: stiffness times length^n.

    Raises
    ------
    ArgumentError
        If the scale is neither a `StrainScale` nor None.
    ProblemError
        If the scale of the precision is unknown, or the landmarks have another scale.
    """
    scale = checked_scale(scale)
    marks, of_marks = problem.landmarks, None
    if marks is not None:
        of_marks = marks.scale.energy(problem.stiffness, problem.spacing)
    if scale is None:
        if of_marks is not None:
            return of_marks
        if problem.precision is not None:
            raise ProblemError(
                "scale",
                "is required for a problem with a precision: pass the StrainScale from whose "
                "energy the precision was computed.",
            )
        scale = StrainScale()
    energy = scale.energy(problem.stiffness, problem.spacing)
    if of_marks is not None and not math.isclose(energy, of_marks, rel_tol=1e-6):
        raise ProblemError(
            "scale", "differs from the scale of the landmarks. Omit it, or pass the same scale."
        )
    return energy


class Sampler:
    """Random deviations of the tissue from the solution of a problem.

    Parameters
    ----------
    operator : Operator
    noise : PosteriorNoise
        Noise of the problem of the operator.
    seed : int
    cancel : threading.Event or similar, optional
    """

    def __init__(
        self,
        operator: Operator,
        noise: PosteriorNoise,
        seed: int,
        cancel: CancelFlag | None = None,
    ) -> None:
        self._operator, self._noise, self._seed, self._cancel = operator, noise, seed, cancel
        material = operator.material
        incompressible = lame_ratio(material.largest_poisson, material.strain) > _MOST_RATIO
        rough = operator.solve(self._force(0), _ROUGH, cancel=cancel)[operator.moves]
        tolerance = _TOLERANCE_INCOMPRESSIBLE if incompressible else _TOLERANCE
        #: Largest error of a deviation, in the unit of `spacing`.
        self.tolerance = tolerance * typical_size(rough)

    def deviation(self, number: int) -> npt.NDArray[np.floating]:
        """Return the deviation of a sample, shape (H, W, 2) or (D, H, W, 3), in unit of `spacing`.

        Parameters
        ----------
        number : int
            Number of the sample, from 0. The deviation depends on the seed and this number only.
        """
        return self._operator.solve(self._force(number), atol=self.tolerance, cancel=self._cancel)

    def _force(self, number: int) -> Float32Array:
        return self._noise.force(self._seed, number)

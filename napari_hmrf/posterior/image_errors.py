"""Errors of a displacement that images observe, as a distribution.

The posterior of tissue and images says where a displacement is less sure than elsewhere, but not
how sure it is: motions differ in smoothness, and errors of neighbouring pixels are alike. The unit
of energy, which scales the posterior, is therefore measured. In balls of tissue, whose images are
left out, the displacement is predicted from the tissue around them. The unit is proportional to the
ratio of two squares: the distance of the prediction from the displacement that the images observe
there, and that of the deviations of a posterior with a unit of 1.

The factor holds for means over patches as wide as the windows in which a registration compares the
images. Over larger distances, errors are more alike than those of the posterior.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.noise import PosteriorNoise
from napari_hmrf.posterior.sampling import Sampler
from napari_hmrf.solver.operator import Operator
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.solve import CancelFlag, solve, stop_if_cancelled
from napari_hmrf.solver.uncertain_landmarks import StrainScale, typical_stiffness

# The settings were chosen on two random deformations of a brain (seeds 0 and 1), and tested on
# others: docs/validation/registration.md. Lengths are in pixels.

#: Number of pixels along the side of a patch.
PATCH = 7
#: Radius of the held-out balls, distance of their centres, and radius of the sites around the
#: centres at which the prediction is compared. The images of a site outside of a ball show little
#: of the centre: the windows of a registration have a standard deviation of 2.5.
_BALL, _APART, _COMPARED = 6, 16, 1
#: Factor of the precision in the balls. Without any, a ball could contain tissue that moves freely.
_HELD_OUT = 1e-6
#: Standard deviation of the error of a patch, relative to the ratio of both distances, for images
#: and volumes.
_ERROR = {2: 2.7, 3: 9.0}
#: Unit of energy of motions that are predicted exactly, relative to that of a pixel of typical
#: stiffness: noise of the images and their interpolation remain.
_LEAST = 0.4
#: Number of samples from which the distances of deviations are estimated.
_SAMPLES = {2: 8, 3: 2}
#: Tolerance of the prediction, in pixels.
_TOLERANCE = 0.02
_TINY = 1e-300


class ImageErrors(NamedTuple):
    """Distribution of the errors of a displacement that images observe.

    Attributes
    ----------
    problem : Problem
        Problem whose posterior has the covariance of the errors.
    scale : StrainScale
        Scale of its prior.
    """

    problem: Problem
    scale: StrainScale


def image_errors(
    problem: Problem,
    prior: ElasticPrior,
    *,
    backend: str = "auto",
    cancel: CancelFlag | None = None,
) -> ImageErrors:
    """Estimate the distribution of the errors of a displacement that images observe.

    Parameters
    ----------
    problem : Problem
        Tissue with the precision of images. Landmarks keep their standard deviations.
    prior : ElasticPrior
        As returned by `checked_prior`.
    backend, cancel
        As for `solve`.

    Raises
    ------
    ProblemError
        If the images show too little tissue for a held-out ball.
    Cancelled
        If `cancel` was set.
    """
    precision = problem.precision
    assert precision is not None
    balls, centres = _held_out(problem.shape)
    centres &= problem.tissue & ~problem.known.any(axis=-1) & precision.any(axis=(-2, -1))
    if not centres.any():
        raise ProblemError(
            "measured motion",
            f"covers too little tissue to know its errors: a ball of {2 * _BALL + 1} pixels must "
            "fit into it. Use an image with smaller pixels.",
        )
    observed, tensors = problem.observed[centres], precision[centres].astype(np.float64)

    def distance(displacement: npt.NDArray[np.floating]) -> float:
        """Return the mean squared distance at the centres, in units of the precision."""
        away = displacement.astype(np.float64)
        return float(np.einsum("ki,kij,kj->", away, tensors, away)) / len(away)

    share = np.where(balls, np.float32(_HELD_OUT), np.float32(1))
    around = variant_of(problem, precision=precision * share[..., None, None])
    predicted = solve(
        around, prior, optimizer=Multigrid(_TOLERANCE), backend=backend, cancel=cancel
    ).displacement
    missed = distance(predicted[centres] - observed)
    operator = Operator(around, prior, backend)
    sampler = Sampler(operator, PosteriorNoise(operator.problem, prior, 1.0), 0, cancel)
    count, expected = _SAMPLES[len(problem.shape)], 0.0
    for number in range(count):
        stop_if_cancelled(cancel)
        expected += distance(sampler.deviation(number)[centres]) / count
    energy = _LEAST * typical_stiffness(problem.stiffness) * math.prod(problem.spacing)
    energy += _ERROR[len(problem.shape)] ** 2 * missed / max(expected, _TINY)
    scale, marks = _scale_of(energy, problem), problem.landmarks
    if marks is not None:
        problem = variant_of(problem, landmarks=marks.placed(marks.points, scale))
    return ImageErrors(problem, scale)


def _held_out(
    shape: tuple[int, ...],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return the masks of balls on a regular lattice, and of the sites around their centres."""
    square: npt.NDArray[np.floating] = np.zeros((1,) * len(shape), np.float32)
    for axis, count in enumerate(shape):
        apart = min(_APART, count)  # one ball in the middle of a short axis
        first = (count - (count // apart - 1) * apart) // 2
        offset = (np.arange(count) - first + apart // 2) % apart - apart // 2
        along = [1] * len(shape)
        along[axis] = count
        square = square + np.asarray(offset, np.float32).reshape(along) ** 2
    return square <= _BALL**2, square <= _COMPARED**2


def _scale_of(energy: float, problem: Problem) -> StrainScale:
    """Return the scale with a unit of energy: stiffness times length^n."""
    scale = StrainScale().resolved(problem.stiffness, problem.spacing)
    unit = scale.energy(problem.stiffness, problem.spacing)
    return replace(scale, strain=scale.strain * math.sqrt(energy / unit))

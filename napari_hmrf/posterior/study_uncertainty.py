"""Uncertainty of the solution of a study."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import LayerError, ProblemError
from napari_hmrf.posterior.image_errors import PATCH
from napari_hmrf.posterior.uncertainty import (
    Uncertainty,
    checked_labels,
    image_uncertainty,
    uncertainty,
)
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solve import CancelFlag, Progress
from napari_hmrf.solver.uncertain_landmarks import StrainScale
from napari_hmrf.study.ground import Ground, Statement, at_place_of
from napari_hmrf.study.study import Study
from napari_hmrf.study.support import refuse_model, refuse_sliding_parts


def study_uncertainty(
    study: Study,
    n: int = 30,
    *,
    patch: float | None = None,
    labels: npt.ArrayLike | None = None,
    seed: int = 0,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Uncertainty:
    """Estimate how sure the displacement of the tissue of a study is.

    The scale of the prior is `Motion.typical_strain`, or after a registration that of held-out
    images (`image_uncertainty`). The result includes the mean displacement of each label.

    Parameters
    ----------
    study : Study
        Study with the elastic model, and without doubted observations or a drift. A measured motion
        must be that of a registration.
    n, patch, seed, backend, progress, cancel
        As for `uncertainty`.
    labels : array_like of int, shape (H, W) or (D, H, W), optional
        Labels whose mean displacements are returned, including 0; by default those of the tissue,
        or the label 1 for all tissue if it has no labels.

    Returns
    -------
    Uncertainty

    Raises
    ------
    ProblemError
        If the study is invalid, or if its uncertainty is not defined or not implemented.
    Cancelled
        If `cancel` was set.
    """
    ground = Ground.of(study)
    return ground_uncertainty(
        ground,
        ground.statement(),
        n,
        patch=patch,
        labels=labels,
        seed=seed,
        backend=backend,
        progress=progress,
        cancel=cancel,
    )


def ground_uncertainty(
    ground: Ground,
    stated: Statement,
    n: int = 30,
    *,
    patch: float | None = None,
    labels: npt.ArrayLike | None = None,
    where: npt.NDArray[np.bool_] | None = None,
    seed: int = 0,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Uncertainty:
    """Estimate the uncertainty of a study whose problem is known.

    Parameters
    ----------
    ground : Ground
        Interpretation of the study.
    stated : Statement
        Problem of the study.
    where : ndarray of bool, shape (H, W) or (D, H, W), optional
        Sites that count in the mean displacement of a label; by default all tissue, without its
        dark surroundings if it has no labels.
    n, patch, labels, seed, backend, progress, cancel
        As for `study_uncertainty`.
    """
    study, problem = ground.study, stated.problem
    refuse_unknown(study, problem)
    assert isinstance(stated.prior, ElasticPrior)
    image, sites = _labels_of(ground, stated) if labels is None else (labels, problem.tissue)
    image, sites = checked_labels(image, problem), sites if where is None else where
    # `uncertainty` ignores the label 0, which is a tissue of a study.
    shift = 1 - min(0, int(image.min(initial=0)))
    shifted = np.where(sites, image.astype(np.int64) + shift, 0)
    estimate: Callable[..., Uncertainty] = image_uncertainty
    if study.motion.measured is None:
        scale = None  # landmarks have their own
        if problem.landmarks is None:
            scale = StrainScale(study.motion.typical_strain, stiffness=ground.typical_stiffness)
        estimate = partial(uncertainty, patch=patch, scale=scale)
    elif patch is not None:
        raise ProblemError(
            "patch",
            "has no effect after a registration, whose errors are known for patches of "
            f"{PATCH} pixels. Leave it out.",
        )
    found = estimate(
        problem,
        stated.prior,
        n,
        labels=shifted,
        seed=seed,
        backend=backend,
        progress=progress,
        cancel=cancel,
    )
    means = {label - shift: mean for label, mean in found.labels.items()}
    return replace(found, solution=at_place_of(study, found.solution), labels=means)


def refuse_unknown(study: Study, problem: Problem) -> None:
    """Raise an error if the uncertainty of a study is unknown.

    Raises
    ------
    ProblemError
        If the study has a measured motion of unknown origin, another model, or parts that slide.
    """
    measured = study.motion.measured
    if measured is not None and not measured.is_of_images:
        raise LayerError(
            "measured motion",
            "has no known precision, because it is not that of a registration: remove it "
            "(`measured=None`), or use landmarks with a standard deviation.",
        )
    refuse_model(study, "uncertainty")
    refuse_sliding_parts(study, problem, "uncertainty")


def _labels_of(
    ground: Ground, stated: Statement
) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.bool_]]:
    """Return the labels of the tissue, or 1 at each site, and the sites that count."""
    own = ground.study.tissue.labels if stated.labels is None else stated.labels
    if own is None:
        return np.ones(stated.problem.shape, np.int64), ground.body
    return own, stated.problem.tissue

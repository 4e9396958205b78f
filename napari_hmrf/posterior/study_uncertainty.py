"""Uncertainty of the solution of a study."""

from __future__ import annotations

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.uncertainty import Uncertainty, uncertainty
from napari_hmrf.solver.solve import CancelFlag, Progress
from napari_hmrf.solver.uncertain_landmarks import StrainScale
from napari_hmrf.study.ground import Ground, Statement
from napari_hmrf.study.study import Study


def study_uncertainty(
    study: Study,
    n: int = 30,
    *,
    patch: float | None = None,
    seed: int = 0,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Uncertainty:
    """Estimate how sure the displacement of the tissue of a study is.

    The scale of the prior is `Motion.typical_strain`. If the tissue has labels, the result includes
    the mean displacement of each label.

    Parameters
    ----------
    study : Study
        Study with the elastic model, and without measured motion, doubted observations or a drift.
    n, patch, seed, backend, progress, cancel
        As for `uncertainty`.

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
    n, patch, seed, backend, progress, cancel
        As for `study_uncertainty`.
    """
    study, problem = ground.study, stated.problem
    if study.motion.measured is not None:
        raise ProblemError(
            "measured motion",
            "has a precision that is relative to the similarity of two images, so its uncertainty "
            "is unknown. Remove the measured motion, or use landmarks with a standard deviation.",
        )
    scale = None  # landmarks have their own
    if problem.landmarks is None:
        scale = StrainScale(study.motion.typical_strain, stiffness=ground.typical_stiffness)
    return uncertainty(
        problem,
        stated.prior,
        n,
        patch=patch,
        labels=study.tissue.labels if stated.labels is None else stated.labels,
        scale=scale,
        seed=seed,
        backend=backend,
        progress=progress,
        cancel=cancel,
    )

"""Uncertainty of the solution of a study."""

from __future__ import annotations

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.uncertainty import Uncertainty, uncertainty
from napari_hmrf.solver.solve import CancelFlag, Progress
from napari_hmrf.solver.uncertain_landmarks import StrainScale, typical_stiffness
from napari_hmrf.study.ground import Ground, Statement
from napari_hmrf.study.study import Study


def study_uncertainty(
    study: Study,
    n: int = 30,
    *,
    patch: float | None = None,
    seed: int = 0,
    stated: Statement | None = None,
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
    stated : Statement, optional
        Result of `build_problem` for this study; computed by default.

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
    if study.motion.measured is not None:
        raise ProblemError(
            "measured motion",
            "has a precision that is relative to the similarity of two images, so its uncertainty "
            "is unknown. Remove the measured motion, or use landmarks with a standard deviation.",
        )
    ground = Ground.of(study)
    stated = stated or ground.statement()
    problem, scale = stated.problem, None
    if problem.landmarks is None:
        typical = typical_stiffness(ground.stiffness[ground.body])
        scale = StrainScale(study.motion.typical_strain, stiffness=typical)
    labels = study.tissue.labels if stated.labels is None else stated.labels
    return uncertainty(
        problem,
        stated.prior,
        n,
        patch=patch,
        labels=labels,
        scale=scale,
        seed=seed,
        backend=backend,
        progress=progress,
        cancel=cancel,
    )

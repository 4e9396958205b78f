"""Test of the landmarks of a study: their agreement with the tissue, and the strain they show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.posterior.agreement import Agreement, agreement_in
from napari_hmrf.posterior.data_space import data_space
from napari_hmrf.posterior.sampling import checked_prior, energy_of
from napari_hmrf.posterior.scale_fit import ScaleFit, scale_in
from napari_hmrf.posterior.study_uncertainty import refuse_unknown
from napari_hmrf.solver.solve import CancelFlag, Progress
from napari_hmrf.study.ground import Ground, Statement

#: Probability below which landmarks do not agree with the tissue.
_LEVEL = 0.05


@dataclass(frozen=True, eq=False)
class LandmarkTest:
    """Agreement of the uncertain landmarks of a study with its tissue, and the strain they show.

    Attributes
    ----------
    points : ndarray, shape (n, 2) or (n, 3)
        Positions of the landmarks before the motion, in pixels.
    agreement : Agreement
    scale : ScaleFit or str
        Typical strain that makes the landmarks most likely, or the reason why it is unknown.
    """

    points: npt.NDArray[np.float64]
    agreement: Agreement
    scale: ScaleFit | str

    def described(self) -> tuple[str, ...]:
        """Describe the results, as clauses for the user."""
        p_value, values = self.agreement.p_value, self.agreement.landmark_p_values
        agree = "agree" if p_value >= _LEVEL else "do not agree"
        clauses = [f"the landmarks {agree} with the tissue ({_in_words(p_value)})"]
        for number in np.flatnonzero(values < _LEVEL / len(values)):
            place = ", ".join(f"{along:.0f}" for along in self.points[number])
            clauses.append(
                f"the landmark at pixel ({place}) does not agree with the other landmarks "
                f"({_in_words(values[number])})"
            )
        if isinstance(self.scale, str):
            return *clauses, f"the typical strain is unknown, because {self.scale}"
        strain, low, high = (
            f"{100 * each:.3g}" for each in (self.scale.scale.strain, *self.scale.strain_interval)
        )
        return *clauses, f"their most likely typical strain is {strain} % ({low} to {high} %)"


def examine_landmarks(
    ground: Ground,
    stated: Statement,
    *,
    backend: str = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> LandmarkTest:
    """Test the landmarks of a study that have a standard deviation.

    Parameters
    ----------
    ground : Ground
        Interpretation of the study.
    stated : Statement
        Problem of the study.
    backend, progress, cancel
        As for `check_agreement`.

    Raises
    ------
    ProblemError
        If there are no landmarks with a standard deviation; or as for `check_agreement` and
        `study_uncertainty`.
    Cancelled
        If `cancel` was set.
    """
    problem, marks = stated.problem, stated.problem.landmarks
    refuse_unknown(ground.study, problem)
    if marks is None:
        raise ProblemError(
            "landmarks",
            "are missing, or have no standard deviation. Give those of the study one.",
        )
    elastic, energy = checked_prior(problem, stated.prior), energy_of(problem, None)
    space = data_space(problem, elastic, energy, backend, progress, cancel)
    agreement = agreement_in(space, energy, len(marks), len(problem.shape))
    try:
        return LandmarkTest(marks.points, agreement, scale_in(space, energy, marks.scale, problem))
    except ProblemError as error:
        return LandmarkTest(marks.points, agreement, f"{error.field} {error.message}")


def _in_words(p_value: float) -> str:
    return "p < 0.0001" if p_value < 1e-4 else f"p = {p_value:.2g}"

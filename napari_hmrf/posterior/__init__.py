"""Uncertainty of a solution: fields and standard deviations of the posterior distribution.

`uncertainty` estimates how sure the displacement of each patch of tissue is::

    from napari_hmrf.landmarks import StrainScale
    from napari_hmrf.posterior import uncertainty

    result = uncertainty(problem, scale=StrainScale(0.05), labels=labels)
    result.along  # error bar of the length of the displacement of each patch
    result.labels[2].sd  # error bars of the mean displacement of label 2

`study_uncertainty` does the same for a study, and `image_uncertainty` for the result of a
registration. `sample_posterior` returns whole fields.
`fit_scale` finds the typical strain from landmarks, and `check_agreement` tests whether landmarks
agree with the model. `fit` finds the growth and the stiffness of tissue from its measured motion or
from two images, and `fit_study` those of the tissues of a study.
"""

from napari_hmrf.posterior.agreement import Agreement, check_agreement
from napari_hmrf.posterior.fit import Fit, FittedProperty, fit
from napari_hmrf.posterior.sampling import sample_posterior
from napari_hmrf.posterior.scale_fit import ScaleFit, fit_scale
from napari_hmrf.posterior.study_fit import StudyFit, fit_study
from napari_hmrf.posterior.study_uncertainty import study_uncertainty
from napari_hmrf.posterior.uncertainty import (
    MeanDisplacement,
    Uncertainty,
    image_uncertainty,
    uncertainty,
)

__all__ = [
    "Agreement",
    "Fit",
    "FittedProperty",
    "MeanDisplacement",
    "ScaleFit",
    "StudyFit",
    "Uncertainty",
    "check_agreement",
    "fit",
    "fit_scale",
    "fit_study",
    "image_uncertainty",
    "sample_posterior",
    "study_uncertainty",
    "uncertainty",
]

"""Registration: the displacement of tissue between two images.

`register` moves elastic tissue until one image matches the other::

    from napari_hmrf.registration import register

    registration = register(before, after, spacing=(2.0, 2.0, 2.0))
    moved = registration.solution.warp(before)  # looks like `after`
    aligned = registration.resample(after)  # looks like `before`

Tissue may be stiff, rigid or absent, landmarks may guide the registration, and the result may be
edited as a study::

    study = Study(grid, tissue, registration.motion())
"""

from napari_hmrf.registration.matching import Step
from napari_hmrf.registration.register import register
from napari_hmrf.registration.result import Registration
from napari_hmrf.study.measured_motion import MeasuredMotion

__all__ = ["MeasuredMotion", "Registration", "Step", "register"]

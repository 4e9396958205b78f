"""Random deformations for data augmentation and for the validation of registrations.

Example::

    from napari_hmrf.random import RandomDeformation

    deformation = RandomDeformation(labels, materials, spacing=(1, 1))
    sample = deformation.sample(seed=0)
    moved = sample.image(image)

`RandPhysicalDeformationd` wraps `RandomDeformation` as a MONAI transform; it requires MONAI.
"""

from typing import Any

from napari_hmrf.augmentation.ground_truth import Truth, write_truth
from napari_hmrf.augmentation.random_deformation import RandomDeformation, RandomSample

__all__ = ["RandomDeformation", "RandomSample", "Truth", "write_truth"]


def __getattr__(name: str) -> Any:
    if name == "RandPhysicalDeformationd":
        from napari_hmrf.augmentation import monai_transforms  # optional: monai

        return monai_transforms.RandPhysicalDeformationd
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

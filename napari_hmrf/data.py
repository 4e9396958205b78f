"""Sample data: phantoms of any size, and reference solutions.

Example::

    from napari_hmrf import solve
    from napari_hmrf.data import phantom

    solution = solve(phantom("mass-effect", size=100).problem)
"""

from napari_hmrf.samples.chest import chest_phantom
from napari_hmrf.samples.head import HeadPhantom, head_phantom
from napari_hmrf.samples.phantoms import (
    PHANTOM_NAMES,
    Phantom,
    image_pair,
    phantom,
    reference_displacement,
    sample,
)

__all__ = [
    "PHANTOM_NAMES",
    "HeadPhantom",
    "Phantom",
    "chest_phantom",
    "head_phantom",
    "image_pair",
    "phantom",
    "reference_displacement",
    "sample",
]

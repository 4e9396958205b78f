"""Tissue: materials with published stiffness, stiffness from labels and intensities, boundaries.

::

    from napari_hmrf import Problem, solve
    from napari_hmrf.tissue import materials_by_name, stiffness_image

    found = materials_by_name({1: "brain", 2: "skull"})
    stiffness = stiffness_image(labels, found.materials)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from napari_hmrf.field.brightness import edge_confidence, luminance
    from napari_hmrf.io.segmentation_tables import read_label_names
    from napari_hmrf.io.tables import read_preset, write_preset
    from napari_hmrf.solver.sliding_parts import SlidingParts
    from napari_hmrf.tissue.boundary_rules import (
        RIGID,
        boundary_images,
        poisson_image,
        stiffness_image,
    )
    from napari_hmrf.tissue.material_presets import PRESETS, Preset
    from napari_hmrf.tissue.sliding import sliding_precision
    from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
    from napari_hmrf.tissue.tissue_names import (
        KnownTissue,
        NamedMaterials,
        lookup_tissue,
        materials_by_name,
    )

__all__ = [
    "PRESETS",
    "RIGID",
    "KnownTissue",
    "NamedMaterials",
    "Preset",
    "SlidingParts",
    "StiffnessCurve",
    "boundary_images",
    "edge_confidence",
    "lookup_tissue",
    "luminance",
    "materials_by_name",
    "poisson_image",
    "read_label_names",
    "read_preset",
    "sliding_precision",
    "stiffness_image",
    "write_preset",
]

#: Module of each public name. Names are imported on first use, because some of these modules import
#: other modules of this package.
_HOMES = {
    "PRESETS": "napari_hmrf.tissue.material_presets",
    "RIGID": "napari_hmrf.tissue.boundary_rules",
    "KnownTissue": "napari_hmrf.tissue.tissue_names",
    "NamedMaterials": "napari_hmrf.tissue.tissue_names",
    "Preset": "napari_hmrf.tissue.material_presets",
    "SlidingParts": "napari_hmrf.solver.sliding_parts",
    "StiffnessCurve": "napari_hmrf.tissue.stiffness_curve",
    "boundary_images": "napari_hmrf.tissue.boundary_rules",
    "edge_confidence": "napari_hmrf.field.brightness",
    "lookup_tissue": "napari_hmrf.tissue.tissue_names",
    "luminance": "napari_hmrf.field.brightness",
    "materials_by_name": "napari_hmrf.tissue.tissue_names",
    "poisson_image": "napari_hmrf.tissue.boundary_rules",
    "read_label_names": "napari_hmrf.io.segmentation_tables",
    "read_preset": "napari_hmrf.io.tables",
    "sliding_precision": "napari_hmrf.tissue.sliding",
    "stiffness_image": "napari_hmrf.tissue.boundary_rules",
    "write_preset": "napari_hmrf.io.tables",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

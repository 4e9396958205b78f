"""From a study to layers: the inverse of `read`, for studies that were saved."""

from __future__ import annotations

from typing import Any

import numpy as np
from napari.layers import Image, Labels, Layer, Vectors

from napari_hmrf.field.displacement_field import DisplacementField
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.field_layer import field_layer
from napari_hmrf.layers.label_colours import boundary_colours
from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, METADATA, TISSUE, described
from napari_hmrf.study.study import Study

#: More arrows than this are a field, of which some are drawn.
_MANY = 2000


def study_layers(study: Study) -> dict[str, Any]:
    """Make the layers that are read as a study, where it lies, or from the origin on.

    Parameters
    ----------
    study : Study
        Of which all but its drawing, its model and what holds the edge becomes layers.

    Returns
    -------
    dict of str to napari.layers.Layer
        By "image", "tissue", "boundary" and "confidence", those there are; in the order in which
        they lie above each other.
    """
    grid, tissue, motion = study.grid, study.tissue, study.motion
    frame = grid.place or Frame.at(grid.spacing, (grid.unit,) * 2)
    place, names = frame.placement(image=True), study.names
    made: dict[str, Any] = {}

    def name(part: str, usual: str) -> str:
        return names[part].name if part in names else usual

    if (image := study.pictures.image) is not None:
        look = {"rgb": image.ndim > 2, "metadata": described(IMAGE), **study.pictures.look}
        title = study.pictures.name or "image"
        made["image"] = Image(frame.put_image(image), name=title, **look, **place)
    if tissue.labels is not None:
        known = described(TISSUE, tissue.materials, tissue.unit)
        look = {"opacity": 0.3, **study.pictures.labels_look, "metadata": known}
        labels = frame.put_image(tissue.labels)
        made["tissue"] = Labels(labels, name=name("tissue", "Tissue"), **look, **place)
    elif tissue.stiffness is not None:
        known = described(TISSUE, unit=tissue.unit)
        values, title = frame.put_image(tissue.stiffness), name("tissue", "Stiffness")
        made["tissue"] = Image(values, name=title, metadata=known, opacity=0.3, **place)
    if motion.labels is not None:
        look = {"colormap": boundary_colours(), "metadata": described(BOUNDARY, motion.rules)}
        labels = frame.put_image(motion.labels)
        made["boundary"] = Labels(labels, name=name("boundary", "Boundary"), **look, **place)
    elif motion.observed is not None and motion.confidence is not None:
        counts = (
            motion.confidence if motion.confidence.ndim == 2 else motion.confidence.max(axis=-1)
        )
        starts = np.argwhere(counts > 0)
        steps = motion.observed[tuple(starts.T)] / study.grid.spacing
        known, title = {METADATA: {"role": BOUNDARY}}, name("boundary", "Observed")
        if len(starts) > _MANY:
            steps = frame.put_field(motion.observed / study.grid.spacing)
            field = DisplacementField.in_pixels(steps)
            made["boundary"] = Layer.create(*field_layer(field, place, title, BOUNDARY))
        else:
            arrows = frame.put_vectors(np.stack([starts, steps], axis=1))
            made["boundary"] = Vectors(arrows, name=title, metadata=known, **frame.placement())
        values, title = frame.put_image(counts), name("confidence", "How sure")
        look = {"contrast_limits": (0, 1), "opacity": 0.3}
        made["confidence"] = Image(values, name=title, **look, **place)
    for part, layer in made.items():  # paint would tint the picture that has moved
        layer.visible = part == ("image" if "image" in made else "tissue")
    return made

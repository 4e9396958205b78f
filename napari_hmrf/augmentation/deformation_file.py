"""File format for unit solutions, from which samples can be drawn without solving again."""

from __future__ import annotations

import math

import numpy as np

from napari_hmrf import array_file
from napari_hmrf.array_file import Arrays, Header, Invalid, Kind
from napari_hmrf.augmentation.unit_solutions import MovableTissue, UnitSolutions
from napari_hmrf.io.study_file import LABEL_TYPES
from napari_hmrf.study.study import Grid
from napari_hmrf.tissue.boundary_rules import MATERIALS

_NUMBERS = "smoothness", "weight", "least_jacobian"


def _describe(solutions: UnitSolutions) -> tuple[Header, Arrays]:
    case = solutions.case
    header = {
        "spacing": list(case.grid.spacing),
        "unit": case.grid.unit,
        "materials": MATERIALS.dump_python(case.materials, mode="json"),
        "hold_edge": case.hold_edge,
        "amplitude": list(case.amplitude),
        **{name: getattr(case, name) for name in _NUMBERS},
    }
    return header, {
        "labels": case.labels,
        "patches": case.patches,
        "centres": case.centres,
        "displacements": solutions.displacements,
        "tissue": solutions.tissue,
    }


def _check_shapes(_: Header, arrays: Arrays) -> None:
    """Raise `Invalid` if the shapes of the arrays do not match."""
    labels, displacements = arrays["labels"], arrays["displacements"]
    for name in ("patches", "tissue"):
        if arrays[name].shape != labels.shape:
            raise Invalid(f"its labels {labels.shape} and {name} {arrays[name].shape} do not match")
    if displacements.shape[1] > labels.size or displacements.shape[2] != labels.ndim:
        raise Invalid(f"its labels {labels.shape} and solutions {displacements.shape} do not match")


def _parse(header: Header, arrays: Arrays) -> UnitSolutions:
    labels, patches, centres = (arrays[name] for name in ("labels", "patches", "centres"))
    displacements, tissue, n = arrays["displacements"], arrays["tissue"], labels.ndim
    spacing = tuple(float(size) for size in header["spacing"])
    low, high = (float(far) for far in header["amplitude"])
    smoothness, weight, least = (float(header[name]) for name in _NUMBERS)
    numbers = (*spacing, low, high, smoothness, weight, least)
    if not (all(map(math.isfinite, numbers)) and min(*spacing, high, smoothness) > 0):
        raise Invalid("it has invalid lengths")
    if not (0 <= low <= high and weight >= 0 and 0 < least < 1):
        raise Invalid("it has an invalid amplitude, weight or smallest Jacobian")
    if len(spacing) != n or centres.shape[1] != n or not np.isfinite(centres).all():
        raise Invalid("its labels, spacing and patches do not match")
    _check_shapes(header, arrays)
    case = MovableTissue(
        Grid(labels.shape, spacing, str(header["unit"])),
        labels,
        MATERIALS.validate_python(header["materials"]),
        bool(header["hold_edge"]),
        patches,
        centres,
        (low, high),
        smoothness,
        weight,
        least,
    )
    needed = (len(case.units), int(tissue.sum()), n)
    if displacements.shape != needed or not len(centres):
        raise Invalid(f"its solutions have shape {displacements.shape}, not {needed}")
    if not array_file.is_finite(displacements):
        raise Invalid("its solutions contain NaN or infinite values")
    return UnitSolutions(case, displacements, tissue)


#: Format of the files that `RandomDeformation.write` writes.
DEFORMATION_FORMAT: array_file.Format[UnitSolutions] = array_file.Format(
    name="napari-hmrf random deformation",
    schema=1,
    kind_name="napari-hmrf random deformation",
    arrays={
        "labels": Kind(LABEL_TYPES, (2, 3)),
        "patches": Kind(("<i4",), (2, 3)),
        "centres": Kind(("<f8",), (2,)),
        "displacements": Kind(("<f4",), (3,)),
        "tissue": Kind(("|b1",), (2, 3)),
    },
    describe=_describe,
    parse=_parse,
    precheck=_check_shapes,
)

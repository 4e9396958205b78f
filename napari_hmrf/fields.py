"""Displacement fields: image warping, strain, folds, inverse fields and files.

The functions accept a displacement field from any method, such as a registration, and its pixel
size `spacing`. For a `Solution`, use its methods `warp`, `jacobian`, `strain` and `at` instead, and
the functions `measure` and `export_field`::

    from napari_hmrf.fields import jacobian_determinant, read_field

    field = read_field("registration.nii.gz")
    change = jacobian_determinant(field.displacement, spacing=field.spacing)
"""

from napari_hmrf.field.deformation import (
    arrows,
    count_folds,
    deformation_grid,
    jacobian_determinant,
    magnitude,
    rmsd,
)
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import resample
from napari_hmrf.field.strain import (
    deformation_gradient,
    equivalent_strain,
    fold_mask,
    green_lagrange_strain,
    principal_strains,
    small_strain,
    strain_through_slice,
)
from napari_hmrf.field.warp import inverse_map
from napari_hmrf.io.fields import export_field, read_field, write_field
from napari_hmrf.io.image_grid import grid_of_image
from napari_hmrf.io.moving_pictures import write_movie
from napari_hmrf.io.study_file import is_study_file
from napari_hmrf.io.uncertainty_files import write_uncertainty
from napari_hmrf.results.measurement import Measurement, measure
from napari_hmrf.solver.solution import is_solution_file
from napari_hmrf.solver.stress import hydrostatic_pressure, von_mises_stress

__all__ = [
    "Field",
    "Frame",
    "Measurement",
    "Picture",
    "Warper",
    "arrows",
    "count_folds",
    "deformation_gradient",
    "deformation_grid",
    "equivalent_strain",
    "export_field",
    "fold_mask",
    "green_lagrange_strain",
    "grid_of_image",
    "hydrostatic_pressure",
    "inverse_map",
    "is_solution_file",
    "is_study_file",
    "jacobian_determinant",
    "magnitude",
    "measure",
    "principal_strains",
    "read_field",
    "resample",
    "rmsd",
    "small_strain",
    "strain_through_slice",
    "von_mises_stress",
    "write_field",
    "write_movie",
    "write_uncertainty",
]

"""napari-hmrf: how soft tissue moves, computed on the pixels of an image.

Paint the inputs, or make them, then::

    from napari_hmrf import Problem, solve

    solution = solve(Problem(observed, confidence, stiffness))
    solution.displacement  # (H, W, 2): the tissue at X moves to X + d(X)

Importing this package imports neither napari nor Qt, OpenGL or numba, nor any part of SciPy.
"""

from napari_hmrf.augmentation.random_deformation import RandomDeformation, RandomSample
from napari_hmrf.errors import (
    ArgumentError,
    BackendError,
    Cancelled,
    ConvergenceError,
    FileFormatError,
    HmrfError,
    ProblemError,
)
from napari_hmrf.field.brightness import at_edges, luminance
from napari_hmrf.field.deformation import (
    arrows,
    count_folds,
    deformation_grid,
    jacobian_determinant,
    magnitude,
)
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.measurement import Measurement, measure
from napari_hmrf.field.resample import resample
from napari_hmrf.field.strain import (
    deformation_gradient,
    equivalent_strain,
    folds,
    green_lagrange_strain,
    principal_strains,
    small_strain,
    strain_through_slice,
)
from napari_hmrf.field.warp import inverse_map, warp
from napari_hmrf.io.batch import BatchProgress, solve_cases
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.case_records import CaseOutcome
from napari_hmrf.io.case_tables import NamedCase, read_cases
from napari_hmrf.io.fields import Field, export_field, read_field, write_field
from napari_hmrf.io.landmark_files import LandmarkFile, load_points, save_points
from napari_hmrf.io.moving_pictures import save_moving_picture
from napari_hmrf.io.segmentation_tables import read_label_names
from napari_hmrf.io.study_file import is_study_file, load_study, replay, save_study
from napari_hmrf.io.tissue_names import (
    KnownTissue,
    NamedMaterials,
    known_tissue,
    materials_by_name,
)
from napari_hmrf.samples.head import HeadPhantom, head_phantom
from napari_hmrf.samples.phantoms import (
    PHANTOM_NAMES,
    Phantom,
    phantom,
    reference_displacement,
    sample,
)
from napari_hmrf.solver.body_forces import pressure, traction, weight
from napari_hmrf.solver.live_solver import LiveSolver
from napari_hmrf.solver.loads import Loads, growth
from napari_hmrf.solver.optimizers import ICM, Monitor, Multigrid
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, SeilerPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.reactions import reactions
from napari_hmrf.solver.solution import Provenance, Solution, is_solution_file
from napari_hmrf.solver.solve import solve
from napari_hmrf.study.ground import solve_study, statement_of
from napari_hmrf.study.study import Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.tissue.boundary_rules import (
    RIGID,
    BoundaryRule,
    Material,
    boundary_images,
    poisson_image,
    stiffness_image,
)
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Stroke
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve

__version__ = "0.1.0"

__all__ = [
    "ICM",
    "PHANTOM_NAMES",
    "RIGID",
    "ArgumentError",
    "Arrow",
    "BackendError",
    "BatchProgress",
    "BoundaryRule",
    "Cancelled",
    "Case",
    "CaseOutcome",
    "ConvergenceError",
    "Drawing",
    "ElasticPrior",
    "Field",
    "FileFormatError",
    "Frame",
    "Grid",
    "HeadPhantom",
    "HmrfError",
    "KnownTissue",
    "Landmark",
    "LandmarkFile",
    "LiveSolver",
    "Loads",
    "Material",
    "Measurement",
    "Monitor",
    "Motion",
    "Multigrid",
    "NamedCase",
    "NamedMaterials",
    "NeoHookeanPrior",
    "Phantom",
    "Picture",
    "Pictures",
    "Problem",
    "ProblemError",
    "Provenance",
    "RandomDeformation",
    "RandomSample",
    "SeilerPrior",
    "Solution",
    "StiffnessCurve",
    "Stroke",
    "Study",
    "Tissue",
    "Warper",
    "__version__",
    "arrows",
    "at_edges",
    "boundary_images",
    "count_folds",
    "deformation_gradient",
    "deformation_grid",
    "equivalent_strain",
    "export_field",
    "folds",
    "green_lagrange_strain",
    "growth",
    "head_phantom",
    "inverse_map",
    "is_solution_file",
    "is_study_file",
    "jacobian_determinant",
    "known_tissue",
    "load_points",
    "load_study",
    "luminance",
    "magnitude",
    "materials_by_name",
    "measure",
    "phantom",
    "poisson_image",
    "pressure",
    "principal_strains",
    "reactions",
    "read_cases",
    "read_field",
    "read_label_names",
    "reference_displacement",
    "replay",
    "resample",
    "sample",
    "save_moving_picture",
    "save_points",
    "save_study",
    "small_strain",
    "solve",
    "solve_cases",
    "solve_study",
    "statement_of",
    "stiffness_image",
    "strain_through_slice",
    "traction",
    "warp",
    "weight",
    "write_field",
]

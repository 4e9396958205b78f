"""napari-hmrf: how soft tissue moves, computed on the pixels of an image.

Paint the inputs, or make them, then::

    from napari_hmrf import Problem, solve

    solution = solve(Problem(observed, confidence, stiffness))
    solution.displacement  # (H, W, 2): the tissue at X moves to X + d(X)

Importing this package imports neither napari nor Qt, OpenGL or numba, nor any part of SciPy.
"""

from napari_hmrf.errors import (
    BackendError,
    Cancelled,
    ConvergenceError,
    FileFormatError,
    HmrfError,
    ProblemError,
)
from napari_hmrf.field.deformation import (
    arrows,
    count_folds,
    deformation_grid,
    jacobian_determinant,
    magnitude,
)
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.resample import resample
from napari_hmrf.field.warp import inverse_map, warp
from napari_hmrf.samples.phantoms import (
    PHANTOM_NAMES,
    Phantom,
    phantom,
    reference_displacement,
    sample,
)
from napari_hmrf.solver.live_solver import LiveSolver
from napari_hmrf.solver.optimizers import ICM, Monitor, Multigrid
from napari_hmrf.solver.priors import ElasticPrior, SeilerPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Provenance, Solution, is_solution_file
from napari_hmrf.solver.solve import solve

__version__ = "0.1.0"

__all__ = [
    "ICM",
    "PHANTOM_NAMES",
    "BackendError",
    "Cancelled",
    "ConvergenceError",
    "ElasticPrior",
    "FileFormatError",
    "HmrfError",
    "LiveSolver",
    "Monitor",
    "Multigrid",
    "Phantom",
    "Picture",
    "Problem",
    "ProblemError",
    "Provenance",
    "SeilerPrior",
    "Solution",
    "Warper",
    "__version__",
    "arrows",
    "count_folds",
    "deformation_grid",
    "inverse_map",
    "is_solution_file",
    "jacobian_determinant",
    "magnitude",
    "phantom",
    "reference_displacement",
    "resample",
    "sample",
    "solve",
    "warp",
]

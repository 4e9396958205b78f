from . import cases as cases
from . import data as data
from . import fields as fields
from . import landmarks as landmarks
from . import loads as loads
from . import posterior as posterior
from . import random as random
from . import registration as registration
from . import tissue as tissue
from .errors import (
    ArgumentError,
    BackendError,
    Cancelled,
    ConvergenceError,
    FileFormatError,
    HmrfError,
    NoteWarning,
    ProblemError,
)
from .field.warp import warp
from .io.study_file import read_study, write_study
from .note_warnings import replay, solve, solve_study
from .solver.live_solver import LiveSolver, Update
from .solver.optimizers import ICM, Monitor, Multigrid
from .solver.priors import ElasticPrior, NeoHookeanPrior, SeilerPrior
from .solver.problem import Problem
from .solver.solution import Provenance, Solution
from .study.ground import build_problem
from .study.study import Grid, Motion, Pictures, Study, Tissue
from .tissue.boundary_rules import BoundaryRule, Material
from .tissue.cavity import Cavity
from .tissue.drawing import Arrow, Drawing, Landmark, Stroke

__version__: str

__all__ = [
    "ICM",
    "ArgumentError",
    "Arrow",
    "BackendError",
    "BoundaryRule",
    "Cancelled",
    "Cavity",
    "ConvergenceError",
    "Drawing",
    "ElasticPrior",
    "FileFormatError",
    "Grid",
    "HmrfError",
    "Landmark",
    "LiveSolver",
    "Material",
    "Monitor",
    "Motion",
    "Multigrid",
    "NeoHookeanPrior",
    "NoteWarning",
    "Pictures",
    "Problem",
    "ProblemError",
    "Provenance",
    "SeilerPrior",
    "Solution",
    "Stroke",
    "Study",
    "Tissue",
    "Update",
    "__version__",
    "build_problem",
    "read_study",
    "replay",
    "solve",
    "solve_study",
    "warp",
    "write_study",
]

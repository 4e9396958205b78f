"""Soft-tissue deformation, computed on the pixel grid of an image.

A `Study` defines the tissue of each pixel and the constraints and loads on the tissue;
`solve_study` computes the displacement field. Images are arrays of shape ([D,] H, W). Displacements
d have shape ([D,] H, W, 2 or 3) and the unit of `spacing`, the pixel size: the tissue at X moves to
X + d(X). In this example, a ball of tissue in a volume grows by a fifth in every direction, and an
image is deformed accordingly:

>>> import numpy as np
>>> from napari_hmrf import Grid, Material, Motion, Study, Tissue, solve_study
>>> away = np.linalg.norm(np.indices((24, 24, 24)) - 11.5, axis=0)
>>> brain, tumour = Material(1, "brain", 1.0), Material(2, "tumour", 4.0, growth=0.2)
>>> tissue = Tissue(labels=np.where(away < 5, 2, 1), materials=(brain, tumour))
>>> study = Study(Grid(away.shape, (1, 1, 1), "mm"), tissue, Motion(hold_edge=True))
>>> solution = solve_study(study)
>>> deformed = solution.warp(away)
>>> f"{solution.at([(11.5, 11.5, 16.5)])[0, 2]:.1f} mm"
'0.8 mm'

`solve` accepts a `Problem`, which consists of arrays. `LiveSolver` updates the solution while a
problem is being edited. A `Solution` evaluates and exports its displacement field with the methods
`warp`, `at`, `jacobian`, `strain`, `measure` and `export`. The names of functions that read files
begin with ``read_``, and those of functions that write files begin with ``write_``.

======================== =========================================================================
package                  contents
======================== =========================================================================
napari_hmrf              problems, studies, models, solvers, results, errors
napari_hmrf.fields       image warping, strain, folds, inverse fields, field files, movies
napari_hmrf.tissue       materials with published stiffness; stiffness from labels and intensities
napari_hmrf.loads        growth, weight, pressure, traction, cavities, reaction forces
napari_hmrf.landmarks    landmark files
napari_hmrf.cases        batches of cases, solved in parallel
napari_hmrf.random       random deformations for data augmentation and registration validation
napari_hmrf.registration registration of two images, with elastic tissue between them
napari_hmrf.posterior    uncertainty of a displacement; fields sampled from the posterior
napari_hmrf.data         phantoms and reference solutions
======================== =========================================================================

For more, see ``help(napari_hmrf.solve_study)``, ``help(napari_hmrf.Study)`` and
``help(napari_hmrf.fields)``, and the folders ``examples`` and ``docs`` of the repository. To use
the graphical interface, start ``napari`` and choose *Plugins > Soft tissue*.

Names are imported on first use; importing the packages does not import napari, Qt, OpenGL, numba or
SciPy.
"""

import lazy_loader

__version__ = "0.1.0"

#: Names of the public submodules.
_PACKAGES = (
    "cases",
    "data",
    "fields",
    "landmarks",
    "loads",
    "posterior",
    "random",
    "registration",
    "tissue",
)
# The stub, `__init__.pyi`, states the module of each public name.
__getattr__, _, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["__version__", *(name for name in _names if name not in _PACKAGES)]


def __dir__() -> list[str]:
    return sorted({*globals(), *_names})

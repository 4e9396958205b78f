"""Demonstration of a volume: solution, measurements and pictures of a tumour in a head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from napari_hmrf.compute.compile_cache.sets import EVERYTHING
from napari_hmrf.io.figures import write_volume_pictures
from napari_hmrf.io.study_file import write_study
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.results.measurement import Measurement, measure
from napari_hmrf.samples.head import GROWTH, TUMOUR, HeadPhantom, head_phantom
from napari_hmrf.solver.model_names import in_words
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.preparation import provide_loops
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.ground import solve_study
from napari_hmrf.study.study import Grid, Motion, Pictures, Study, Tissue
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON

#: One millilitre in cubic millimetres.
_MILLILITRE = 1000.0


@dataclass(frozen=True, eq=False)
class VolumeDemonstration:
    """Phantom of a head with its solution and measurements.

    Attributes
    ----------
    head : HeadPhantom
    study : Study
        Study of the head.
    solution : Solution
    tumour : Measurement
        Measurement of the tumour.
    folds : int
        Number of voxels where the tissue folds.
    """

    head: HeadPhantom
    study: Study
    solution: Solution
    tumour: Measurement
    folds: int

    @property
    def note(self) -> str:
        """Warning about folded voxels, with a remedy; "" if there are no folded voxels."""
        if not self.folds:
            return ""
        return (
            f"the tissue folds over itself at {self.folds} voxels, which real tissue cannot do: "
            f"the growth of the tumour ({self.head.growth:g} mm) is too large. In Python, use "
            f"head_phantom({self.head.image.shape[1]}, growth={self.head.growth / 2:g}) instead."
        )

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Return the name and value of each measurement."""
        solution, run = self.solution, self.solution.provenance
        size = f"{grid_in_words(solution.tissue.shape)} voxels of {solution.spacing[0]:.3g} mm"
        before = self.tumour.size / _MILLILITRE
        after = before * (1 + self.tumour.size_change / 100)
        near = solution.convergence
        return (
            ("sample", f"{self.head.title}, {size}"),
            ("growth", f"by {self.head.growth:g} mm in all directions"),
            ("model", in_words(run.parameters)),
            ("renderer", f"{run.renderer} ({run.backend})"),
            ("iterations", f"{solution.iterations}"),
            ("seconds", f"{run.seconds:.2f} (plus {run.preparation_seconds:.2f} to prepare)"),
            ("estimated error", "-" if near is None else f"{near.error:.1g} voxels"),
            ("folds", f"{self.folds} voxels"),
            ("tumour before", f"{before:.1f} ml"),
            ("tumour after", f"{after:.1f} ml"),
        )


def demonstrate_volume(
    size: int,
    *,
    backend: str,
    progress: Callable[[Monitor], None],
    model: str = "elastic",
    poisson: float = USUAL_POISSON,
    growth: float = GROWTH,
) -> VolumeDemonstration:
    """Solve the phantom of a head with a growing tumour.

    Parameters
    ----------
    size : int
        As for `head_phantom`.
    backend, progress
        As for `demonstrate`.
    model : {"elastic", "paper", "paper, converged"}
        Model of the tissue.
    poisson : float
        Poisson's ratio of all elastic tissue.
    growth : float
        As for `head_phantom`.

    Returns
    -------
    VolumeDemonstration

    Raises
    ------
    ArgumentError
        If the size is invalid.
    BackendError
        If the requested backend cannot run.
    """
    head = head_phantom(size, growth=growth)
    materials = tuple(replace(row, poisson=poisson) for row in head.materials)
    study = Study(
        Grid(head.image.shape, head.spacing, "millimeter", head.frame),
        Tissue(labels=head.tissue_labels, materials=materials),
        Motion(hold_edge=False, labels=head.boundary_labels, rules=head.boundary),
        model=model,
        pictures=Pictures(head.image, head.tissue_labels, "head"),
    )
    if backend == "auto":
        # Compile all loops now, so that napari does not have to wait for the compiler later.
        provide_loops(EVERYTHING, progress)
    solution = solve_study(study, backend=backend, progress=progress)
    measured = measure(solution, head.tissue_labels)
    return VolumeDemonstration(
        head,
        study,
        solution,
        tumour=next(each for each in measured if each.label == TUMOUR),
        folds=solution.count_folds(),
    )


def write_volume_results(demonstration: VolumeDemonstration, folder: Path) -> list[Path]:
    """Write the study with its solution, and pictures of slices through the tumour's centre.

    Parameters
    ----------
    demonstration : VolumeDemonstration
    folder : Path
        Existing folder.

    Returns
    -------
    list of Path
        Written files.
    """
    head, solution = demonstration.head, demonstration.solution
    path = write_study(folder / "head.study", demonstration.study, solution)
    middle = np.argwhere(head.tissue_labels == TUMOUR).mean(axis=0).round().astype(int).tolist()
    return [path, *write_volume_pictures(folder, head.image, solution, middle, unit="mm")]

"""Demonstration: solution of a sample, comparison with finite elements, and pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_hmrf.field.deformation import rmsd as deviation
from napari_hmrf.io.figures import write_pictures
from napari_hmrf.samples.phantoms import Phantom, phantom, reference_displacement, sample
from napari_hmrf.solver.model_names import in_words
from napari_hmrf.solver.optimizers import Monitor, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.solve import solve

if TYPE_CHECKING:
    from napari_hmrf.samples.volume_demo import VolumeDemonstration

#: Size of the phantoms and finite-element fields in `sample_data`, in pixels.
SAMPLE_SIZE = 300
#: Material of the finite-element fields.
FEM = ElasticPrior(poisson=0.3, plane="stress")


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Phantom with its solution and measurements.

    Attributes
    ----------
    phantom : Phantom
    solution : Solution
    rmsd : float or None
        Root mean square deviation from the finite-element displacement over the tissue, in pixels
        (eq. 20); None if there is no finite-element field of this size.
    rmsd_of_fem : float or None
        The same deviation for a second solution with the material of the finite elements, in
        pixels. None unless `solution` has a different elastic material.
    folds : int
        Number of sites where the tissue folds, from `count_folds`.
    """

    phantom: Phantom
    solution: Solution
    rmsd: float | None
    rmsd_of_fem: float | None
    folds: int

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Return the name and value of each measurement."""
        solution = self.solution
        run = solution.provenance
        size = " x ".join(str(pixels) for pixels in solution.tissue.shape)
        return (
            ("sample", f"{self.phantom.title}, {size}"),
            ("model", in_words(run.parameters)),
            ("renderer", f"{run.renderer} ({run.backend})"),
            ("levels", f"{len(solution.levels)}"),
            ("iterations", f"{solution.iterations}"),
            ("seconds", f"{run.seconds:.2f} (plus {run.preparation_seconds:.2f} to prepare)"),
            ("mean energy", f"{solution.mean_energy:.4g} px^2 per site"),
            *self._distances(),
            ("folds", f"{self.folds}"),
        )

    def _distances(self) -> tuple[tuple[str, str], ...]:
        """Return the rows for the deviations from finite elements, for both materials."""
        name, other = f"RMSD from FEM, nu {FEM.poisson}", "with another material"
        if self.rmsd is None:
            return (name, "-"), (other, "-")
        if self.rmsd_of_fem is None:
            return (name, _in_pixels(self.rmsd)), (other, "-")
        prior = self.solution.provenance.parameters["prior"]
        own = f"nu {prior['poisson']}, plane {prior['plane']}"
        same = f"{_in_pixels(self.rmsd_of_fem)}, solved with nu {FEM.poisson}"
        return (name, same), (other, f"{_in_pixels(self.rmsd)}, {own}")


def _in_pixels(rmsd: float) -> str:
    return f"{rmsd:.2f} px" if rmsd >= 0.1 else f"{rmsd:.1g} px"


def table(*shown: Demonstration | VolumeDemonstration) -> str:
    """Format the measurements, one per line, with a column for each demonstration."""
    rows = [demonstration.rows() for demonstration in shown]
    columns = [[name for name, _ in rows[0]], *([value for _, value in each] for each in rows)]
    widths = [max(map(len, column)) for column in columns]
    lines = zip(*columns, strict=True)
    return "\n".join(
        "  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def demonstrate(
    name: str,
    size: int,
    *,
    backend: str,
    progress: Callable[[Monitor], None],
    prior: Prior | None = None,
    optimizer: Optimizer | None = None,
) -> Demonstration:
    """Solve a phantom, and compare the solution with finite elements.

    Parameters
    ----------
    name : str
        One of `PHANTOM_NAMES`.
    size : int
        Number of pixels along each side.
    backend : str
        One of `BACKEND_NAMES`; "auto" selects the fastest backend that is ready, as in napari.
    progress : callable
        Function called repeatedly with a `Monitor`.
    prior, optimizer : optional
        As for `solve`.

    Returns
    -------
    Demonstration

    Raises
    ------
    ArgumentError
        If the name or the size is invalid.
    BackendError
        If the requested backend cannot run.
    """
    subject = sample(name) if size == SAMPLE_SIZE else phantom(name, size)
    options: dict[str, Any] = {"optimizer": optimizer, "backend": backend, "progress": progress}
    solution = solve(subject.problem, prior, **options)
    rmsd = rmsd_of_fem = None
    if size == SAMPLE_SIZE:
        reference = reference_displacement(name)
        rmsd = deviation(solution.displacement, reference, solution.tissue)
        if isinstance(prior, ElasticPrior) and prior != FEM:
            same = solve(subject.problem, FEM, **options)
            rmsd_of_fem = deviation(same.displacement, reference, same.tissue)
    return Demonstration(
        phantom=subject,
        solution=solution,
        rmsd=rmsd,
        rmsd_of_fem=rmsd_of_fem,
        folds=solution.count_folds(),
    )


def write_results(demonstration: Demonstration, folder: Path) -> list[Path]:
    """Write the solution and its pictures to an existing folder; return the written files."""
    path = folder / "solution.npz"
    demonstration.solution.write(path)
    subject = demonstration.phantom
    pictures = write_pictures(folder, subject.image, subject.problem, demonstration.solution)
    return [path, *pictures]

"""Result of a solve: the displacement, its convergence, and its provenance."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import FailFast, Field, PositiveFloat

from napari_hmrf.archive import STORED, Archive
from napari_hmrf.arguments import is_one_of, refuse_unless, require_flag, shown
from napari_hmrf.errors import ProblemError
from napari_hmrf.field import deformation, moved_points
from napari_hmrf.field import warp as warping
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.resample import without_removed
from napari_hmrf.field.strain import green_lagrange_strain, small_strain
from napari_hmrf.field.units import unit_symbol
from napari_hmrf.real_arrays import FiniteArray, grid_in_words
from napari_hmrf.solver.elastic_strain import elastic_strain
from napari_hmrf.solver.elasticity import Elasticity
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.model_names import model_name
from napari_hmrf.solver.optimizers.base import Convergence, LevelRun, Reach
from napari_hmrf.solver.stress import hydrostatic_pressure, stress_values, von_mises_stress

#: Backend in the record of a sum of solutions, as of a random deformation; no solve has it.
SUM = "sum"


@dataclass(frozen=True)
class Provenance:
    """Record of a run: backend, device, times, parameters and versions.

    Attributes
    ----------
    backend : str
        "cpu", "opengl:fragment" or "opengl:compute"; `SUM` for a sum of solutions.
    renderer : str
        Description of the device.
    reason : str
        Reason for the choice of the backend.
    seconds : float
        Wall time of the schedule, including uploads and downloads.
    preparation_seconds : float
        Wall time before the schedule, for loading or compiling kernels and creating an OpenGL
        context. Usually zero after the first solve of a process. The first solve on a machine
        compiles the kernels.
    parameters : mapping
        Prior, optimizer and their parameters, and the strain tensor of a drift; JSON types only.
    versions : mapping
        Versions of this package and its dependencies.
    model : str
        Name of the model, such as "elastic" or "paper, converged"; by default derived from the
        parameters.
    inputs : mapping
        SHA-256 digests of the bytes of observed, confidence and stiffness, and of growth and force
        if there are loads.
    """

    backend: str
    renderer: str
    reason: str = ""
    seconds: float = 0.0
    preparation_seconds: float = 0.0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    model: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "model", self.model or model_name(self.parameters))

    def __repr__(self) -> str:
        return f"Provenance({self.model or 'no model'}, {self.backend}, {self.seconds:.3g} s)"


@dataclass(frozen=True, eq=False)
class Solution:
    """Displacement field, with the record of its solve.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Components in (row, col) order, in the unit of `spacing`. Material displacement
        (push-forward): tissue at X moves to X + d(X). Zero where there is no tissue. The type is
        float64, also in files, if float32 would exceed the tolerance or fold a crushed pixel.
        Read-only.
    energy : ndarray, shape (iterations,), float64
        Mean total energy per site of tissue after each iteration, coarse to fine, in pixels
        squared, minus the work of loads; one value if no iteration was needed. For multigrid with
        the centred update, which does not minimize an energy, all values are the final value.
    levels : tuple of LevelRun
        Levels in the order in which they ran. Their numbers of iterations show which values of
        `energy` belong to which level.
    tissue : ndarray, shape (H, W), bool
        Mask of tissue.
    spacing : tuple of float
        Size of a pixel along each axis, in (row, col) order.
    provenance : Provenance
    convergence : Convergence, optional
        Distance from the converged field, if the optimizer measures it.
    reach : Reach, optional
        For large motion, the smallest Jacobian and the extent to which observations are satisfied.
    frame : mapping, optional
        Position of the field in world coordinates, for code that created the problem from layers;
        JSON types only. The solver neither reads nor writes this attribute.
    loads : Loads, optional
        Loads of the problem, and the growth of a drift, for warm starts from this solution. Files
        contain only the digest of the loads.
    elasticity : Elasticity, optional
        Stiffness, Poisson's ratios and growth of elastic tissue, from which `strain`, `stress` and
        `measure` compute elastic strain and stress. None for the paper's model.
    notes : tuple of str
        Clauses for the user about input without effect, assumptions and shortcomings. In scripts,
        each is also a `NoteWarning`.
    unit : str
        Unit of `spacing` and `displacement`, such as "mm", as in the `Grid` of a study; "" if
        unknown, as for a `Problem`.
    removed : ndarray of bool, shape (H, W) or (D, H, W), optional
        Mask of the tissue that a study removes, before the motion. It is not part of `tissue`, and
        images of the result do not show it. None if no tissue is removed.
    parts : ndarray of int, shape (H, W) or (D, H, W), optional
        Label of the part of each site, if parts of the tissue slide along each other; see
        `SlidingParts`. Strain and folds are those within each part. None if all tissue is
        connected.

    Raises
    ------
    ProblemError
        If the displacement, the tissue and the spacing do not have the same grid.
    """

    __pydantic_config__ = STORED

    displacement: FiniteArray
    energy: npt.NDArray[np.float64]
    levels: Annotated[tuple[LevelRun, ...], FailFast()]
    tissue: npt.NDArray[np.bool_]
    spacing: Annotated[tuple[PositiveFloat, ...], FailFast()]
    provenance: Provenance
    convergence: Convergence | None = None
    frame: Mapping[str, Any] | None = None
    loads: Annotated[Loads | None, Field(exclude=True)] = None
    reach: Reach | None = None
    elasticity: Elasticity | None = None
    notes: tuple[str, ...] = ()
    unit: str = ""
    removed: npt.NDArray[np.bool_] | None = None
    parts: npt.NDArray[np.int32] | None = None

    def __post_init__(self) -> None:
        shape = self.tissue.shape
        if self.displacement.shape != (*shape, len(shape)) or len(self.spacing) != len(shape):
            raise ProblemError(
                "solution",
                f"has a displacement of shape {self.displacement.shape}, tissue of shape {shape} "
                f"and the spacing {shown(self.spacing)}. Use the same grid for all three.",
            )
        if self.tissue.dtype != bool or self.displacement.dtype not in (np.float32, np.float64):
            raise ProblemError(
                "solution",
                f"has a displacement of type {self.displacement.dtype} and tissue of type "
                f"{self.tissue.dtype}. Pass float32 or float64, and bool.",
            )
        if self.energy.shape != (max(1, self.iterations),):
            raise ProblemError(
                "solution",
                f"has energies of shape {self.energy.shape}, but {self.iterations} iterations. "
                "Pass an energy for each iteration.",
            )
        images: dict[str, npt.NDArray[Any] | None] = {
            "removed tissue": self.removed,
            "parts": self.parts,
        }
        if (elastic := self.elasticity) is not None:
            images |= {"stiffness": elastic.stiffness, "growth": elastic.growth}
            images |= {} if isinstance(elastic.poisson, float) else {"poisson": elastic.poisson}
        for name, image in images.items():
            if image is not None and image.shape[: len(shape)] != shape:
                raise ProblemError(
                    "solution",
                    f"has {name} of shape {image.shape}, but tissue of shape {shape}. Use the same "
                    "grid for both.",
                )
        if self.displacement.flags.writeable:
            field = self.displacement.view()
            field.setflags(write=False)
            object.__setattr__(self, "displacement", field)

    def __repr__(self) -> str:
        unit = self._unit_in_words
        farthest = float(np.linalg.norm(self.displacement, axis=-1).max(initial=0.0))
        run = self.provenance
        near = "" if self.convergence is None else f", within {self.convergence.error:.1g} px"
        count = len(self.notes)
        noted = f", {count} note{'s' * (count > 1)}" if count else ""
        return (
            f"Solution({grid_in_words(self.tissue.shape)} sites of {grid_in_words(self.spacing)}"
            f"{unit or ' (unit unknown)'}, {run.model or 'unknown model'}, moved up to "
            f"{farthest:.3g}{unit}, {self.iterations} iterations in {run.seconds:.2g} s on "
            f"{run.backend}{near}{noted})"
        )

    @property
    def place(self) -> Frame:
        """Frame of the solution; if it has none, a frame at the origin, in its unit.

        Raises
        ------
        ValueError
            As for `Frame.from_dict`, or if the frame has another number of axes.
        """
        n = self.tissue.ndim
        if not self.frame:
            return Frame.at(self.spacing, (self.unit or "pixel",) * n, volume=n == 3)
        frame = Frame.from_dict(self.frame)
        if len(frame.plane) != n:
            raise ValueError(f"its plane {frame.plane} does not match a solution with {n} axes")
        return frame

    @property
    def _unit_in_words(self) -> str:
        """Unit of length, preceded by a space; "" if the unit is unknown."""
        if self.unit not in ("", "pixel"):
            return f" {unit_symbol(self.unit)}"
        even = all(size == 1 for size in self.spacing)
        return " pixels" if self.unit or even else ""

    @property
    def iterations(self) -> int:
        """Total number of iterations on all levels."""
        return sum(level.iterations for level in self.levels)

    @property
    def mean_energy(self) -> float:
        """Final mean total energy per site of tissue, in pixels squared."""
        return float(self.energy[-1])

    # These methods pass on spacing, tissue and parts, so that the caller cannot forget them.

    def warp(
        self, image: npt.ArrayLike, *, order: int = 1, fill: float = 0
    ) -> npt.NDArray[np.generic]:
        """Move an image with the tissue, without removed tissue; use ``order=0`` for labels.

        Parameters
        ----------
        image : array_like, shape ([D,] H, W) or ([D,] H, W, channels)
        order, fill
            As for the function `warp`; removed tissue also has the value `fill`.

        Returns
        -------
        ndarray
            Moved image, with the shape and dtype of `image`.

        Raises
        ------
        ProblemError
            If the image does not have the pixel grid of the solution.
        """
        remaining = without_removed(image, self.removed, fill)
        return warping.warp(remaining, self.displacement, order=order, fill=fill, **self.on_grid)

    def jacobian(self) -> npt.NDArray[np.float32]:
        """Return the factor by which area or volume changes at each site.

        Returns
        -------
        ndarray, shape ([D,] H, W), float32
            As for `jacobian_determinant`.
        """
        return deformation.jacobian_determinant(self.displacement, **self.on_grid)

    def count_folds(self) -> int:
        """Count the sites at which tissue folds over itself or collapses."""
        return deformation.count_folds(self.displacement, **self.on_grid)

    def strain(
        self, kind: Literal["elastic", "total", "small"] = "elastic"
    ) -> npt.NDArray[np.float32]:
        """Return the strain at each site.

        Parameters
        ----------
        kind : {"elastic", "total", "small"}
            "elastic" is the strain of the model along all three axes, without growth. "total" is
            the `green_lagrange_strain` of the displacement, including growth. "small" is the
            `small_strain` of the displacement.

        Returns
        -------
        ndarray, float32
            Symmetric tensors in the order of the axes; NaN where there is no tissue. Elastic strain
            has shape ([D,] H, W, 3, 3); for an image, the first axis is perpendicular to the image.
            The other kinds have shape (H, W, 2, 2) or (D, H, W, 3, 3).

        Raises
        ------
        ArgumentError
            If `kind` is not one of these values.
        ProblemError
            If the model has no elastic strain, such as the paper's model.
        """
        known = is_one_of(kind, ("elastic", "total", "small"))
        refuse_unless(known, "kind", kind, '"elastic", "total" or "small"')
        if kind == "elastic":
            return elastic_strain(self)
        of_field = green_lagrange_strain if kind == "total" else small_strain
        return of_field(self.displacement, **self.on_grid)

    def stress(self, at: Literal["sites", "elements"] = "sites") -> npt.NDArray[np.float32]:
        """Return the Cauchy stress of elastic tissue, without growth.

        Parameters
        ----------
        at : {"sites", "elements"}
            "elements" is the stress of the model at the centre of each block of 2 x 2 (2 x 2 x 2)
            sites. "sites" is the mean over the elements around each site.

        Returns
        -------
        ndarray, float32
            Symmetric tensors, shape ([D,] H, W, 3, 3), or one less along each axis of the grid for
            elements, in `stress_unit`; positive in tension. For an image, the first axis is
            perpendicular to the image. NaN outside tissue, in rigid tissue and at sites without
            an element.

        Raises
        ------
        ArgumentError
            If `at` is not one of these values.
        ProblemError
            If the model has no stress, such as the paper's model.
        """
        return stress_values(self, at=at)

    def von_mises(self, at: Literal["sites", "elements"] = "sites") -> npt.NDArray[np.float32]:
        """Return the von Mises stress, as `von_mises_stress` of `stress`.

        Parameters
        ----------
        at : {"sites", "elements"}
            As for `stress`.

        Returns
        -------
        ndarray, shape ([D,] H, W), or one less along each axis for elements, float32

        Raises
        ------
        ArgumentError, ProblemError
            As for `stress`.
        """
        return stress_values(self, von_mises_stress, at=at)

    def pressure(self, at: Literal["sites", "elements"] = "sites") -> npt.NDArray[np.float32]:
        """Return the pressure in the tissue, minus a third of the trace of `stress`.

        Parameters
        ----------
        at : {"sites", "elements"}
            As for `stress`.

        Returns
        -------
        ndarray, shape ([D,] H, W), or one less along each axis for elements, float32
            Positive where the tissue is compressed.

        Raises
        ------
        ArgumentError, ProblemError
            As for `stress`.
        """
        return stress_values(self, hydrostatic_pressure, at=at)

    @property
    def stress_unit(self) -> str:
        """Unit of stress and stiffness, such as "kPa"; "" if the stiffness is relative."""
        tissue = self.provenance.parameters.get("tissue", {})
        return str(tissue.get("unit", ""))

    def at(self, points: npt.ArrayLike, *, extend: bool = False) -> npt.NDArray[np.float64]:
        """Return the displacement at points of the tissue, interpolated linearly.

        Parameters
        ----------
        points : array_like, shape (N, n)
            Positions before the motion, in pixels, in the order of the axes; `Grid.to_pixels`
            converts points in mm. Points outside the grid move like the nearest point on its edge.
        extend : bool
            True to move points without tissue, or beside it, like the nearest tissue. By default,
            the displacement is zero where there is no tissue, and linear between pixels.

        Returns
        -------
        ndarray, shape (N, n), float64
            Displacements, in the unit of `spacing`.

        Raises
        ------
        ProblemError
            If the points and the field have different numbers of axes or all points are outside the
            grid.
        """
        moved = self.move(points, extend=extend) - np.asarray(points)
        step: npt.NDArray[np.float64] = moved * np.array(self.spacing)
        return step

    def move(self, points: npt.ArrayLike, *, extend: bool = False) -> npt.NDArray[np.float64]:
        """Return the positions of points of the tissue after the motion.

        Parameters
        ----------
        points : array_like, shape (N, n)
            Positions before the motion, in pixels, in the order of the axes; `Grid.to_pixels`
            converts points in mm. Points outside the grid move like the nearest point on its edge.
        extend : bool
            As for `at`.

        Returns
        -------
        ndarray, shape (N, n), float64
            Positions after the motion, in pixels.

        Raises
        ------
        ProblemError
            If the points and the field have different numbers of axes or all points are outside the
            grid.
        """
        require_flag("extend", extend)
        moved_points.refuse_outside(points, self.tissue.shape)
        moved = moved_points.moved_points(points, self.displacement, spacing=self.spacing)
        if not extend:
            return moved
        at = np.asarray(points, np.float64)
        step = moved_points.interpolate_in_tissue(
            self.displacement, self.tissue, at, spacing=self.spacing
        )
        return np.asarray(at + step / np.array(self.spacing))

    @property
    def on_grid(self) -> dict[str, Any]:
        """Spacing, tissue and parts, as arguments of functions that derive the displacement."""
        return {"spacing": self.spacing, "tissue": self.tissue, "parts": self.parts}

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the solution to one .npz file, atomically.

        Parameters
        ----------
        path : str or path-like
            Path of the file; ".npz" is added only if the name has no suffix. An existing file is
            replaced only when the new file is complete.

        Returns
        -------
        Path
            Path of the written file.

        Raises
        ------
        OSError
            If the folder is missing or the file cannot be written; the message names the file.
        TypeError, ValueError
            If frame or parameters contain a value that is not a JSON type, or the shapes of the
            arrays differ.
        """
        return SOLUTIONS.write(path, self)

    @staticmethod
    def read(path: str | os.PathLike[str]) -> Solution:
        """Read a file written by `write`.

        Returns
        -------
        Solution
            The saved solution, without loads. Sequences in parameters and frame are read as lists.

        Raises
        ------
        FileFormatError
            If the file does not contain a solution or is damaged.
        OSError
            If the file cannot be opened.
        """
        return SOLUTIONS.read(path)


def is_solution_file(path: str | os.PathLike[str]) -> bool:
    """Return whether the first bytes of a file mark it as a saved solution.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    bool
    """
    return bool(SOLUTIONS.header(path))


#: Kind of the files that `Solution.write` writes.
SOLUTIONS = Archive("napari-hmrf result", Solution)

"""The result of a solve: the displacement, how it was reached, and what was run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf import array_file
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.model_names import model_name
from napari_hmrf.solver.optimizers.base import Convergence, LevelRun, Reach
from napari_hmrf.solver.problem import grid_in_words


@dataclass(frozen=True)
class Provenance:
    """What was run, where, and how long it took.

    Attributes
    ----------
    backend : str
        "cpu", "opengl:fragment" or "opengl:compute".
    renderer : str
        The device, in words.
    reason : str
        Why this backend was taken.
    seconds : float
        Wall time of the schedule, uploads and read-back included.
    preparation_seconds : float
        Wall time before it: loading or compiling kernels, making an OpenGL context. Mostly zero
        after the first solve of a process; the first ever on a machine compiles.
    parameters : mapping
        Prior, optimizer and their parameters; JSON types only.
    versions : mapping
        Of this package and of what the result depends on.
    model : str
        Its name: "elastic", "paper" or "paper, converged"; of these parameters, if not given.
    inputs : mapping
        SHA-256 of the bytes of observed, confidence and stiffness, and of growth and force if
        there are loads.
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


@dataclass(frozen=True, eq=False)
class Solution:
    """A displacement field and its history.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Components in (row, col) order, in the unit of `spacing`. Material (push-forward): the
        tissue at X moves to X + d(X). Zero where there is no tissue. In float64 where tissue moves
        so far that float32 does not carry the tolerance; files keep float32.
    energy : ndarray, shape (iterations,), float64
        Mean total energy per site of tissue after each iteration, coarse to fine, in pixels
        squared, less the work of loads; one value where none was needed. Of multigrid for the
        centred update, which no energy leads, the last throughout.
    levels : tuple of LevelRun
        The levels in the order they were run, with their iterations: the boundaries in `energy`.
    tissue : ndarray, shape (H, W), bool
        Where there is tissue.
    spacing : tuple of float
        Size of a pixel in (row, col) direction.
    provenance : Provenance
    convergence : Convergence, optional
        How close to the converged field it is, where the optimizer knows.
    reach : Reach, optional
        Of large motion: the least Jacobian, and how far it got.
    frame : mapping, optional
        Where the field lies in the world, for whoever made the problem from layers; JSON types
        only. The solver neither reads nor writes it.
    loads : Loads, optional
        What pulled at it, for solves that begin with it. Files keep its digest only.
    notes : tuple of str
        Clauses for people: input without effect, and guesses. Files do not keep them.
    """

    displacement: npt.NDArray[np.floating]
    energy: npt.NDArray[np.float64]
    levels: tuple[LevelRun, ...]
    tissue: npt.NDArray[np.bool_]
    spacing: tuple[float, ...]
    provenance: Provenance
    convergence: Convergence | None = None
    frame: Mapping[str, Any] | None = None
    loads: Loads | None = None
    reach: Reach | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        farthest = float(np.linalg.norm(self.displacement, axis=-1).max(initial=0.0))
        run = self.provenance
        near = "" if self.convergence is None else f", within {self.convergence.error:.1g} px"
        return (
            f"Solution({grid_in_words(self.tissue.shape)} sites of {grid_in_words(self.spacing)}, "
            f"{run.model or 'no model told'}, moved up to {farthest:.3g}, {self.iterations} "
            f"iterations in {run.seconds:.2g} s on {run.backend}{near})"
        )

    @property
    def iterations(self) -> int:
        """Sweeps over all levels together."""
        return sum(level.iterations for level in self.levels)

    @property
    def mean_energy(self) -> float:
        """Mean total energy per site of tissue at the end, in pixels squared."""
        return float(self.energy[-1])

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Save to one .npz file, whole or not at all.

        Parameters
        ----------
        path : str or path-like
            Taken as it is; ".npz" is added only if the name has no suffix. A file of that name is
            replaced in the moment the new one is complete.

        Returns
        -------
        Path
            The file that was written.

        Raises
        ------
        OSError
            If the folder is missing or the file cannot be written; the message names the file.
        TypeError, ValueError
            If frame or parameters hold something that is not of a JSON type, or parts disagree.
        """
        return array_file.write(path, SOLUTION_FORMAT, self)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Solution:
        """Read back what `save` wrote, in this or an earlier version.

        Returns
        -------
        Solution
            Exactly what was saved, but for loads (sequences in parameters and frame come back as
            lists).

        Raises
        ------
        FileFormatError
            If it is anything else, or damaged.
        OSError
            If it cannot be opened.
        """
        return array_file.read(path, SOLUTION_FORMAT)


def is_solution_file(path: str | os.PathLike[str]) -> bool:
    """Tell, by reading little of it, whether a file says that it is a saved solution."""
    return array_file.claims_to_be(path, SOLUTION_FORMAT)


def _describe(solution: Solution) -> tuple[array_file.Header, array_file.Arrays]:
    reached = solution.convergence
    got = solution.reach
    header = {
        "spacing": [float(size) for size in solution.spacing],
        "levels": [asdict(run) for run in solution.levels],
        "provenance": asdict(solution.provenance),
        "frame": solution.frame,
        "convergence": None if reached is None else asdict(reached),
        "reach": None if got is None else asdict(got),
    }
    return header, {name: getattr(solution, name) for name in SOLUTION_FORMAT.arrays}


def _parse(header: array_file.Header, arrays: array_file.Arrays) -> Solution:
    levels = tuple(
        LevelRun(
            int(run["number"]), tuple(int(size) for size in run["shape"]), int(run["iterations"])
        )
        for run in header["levels"]
    )
    spacing = tuple(float(size) for size in header["spacing"])
    displacement, energy, tissue = (arrays[name] for name in SOLUTION_FORMAT.arrays)
    if displacement.shape != (*tissue.shape, tissue.ndim) or displacement.size == 0:
        raise array_file.Invalid(
            f"its displacement {displacement.shape} and tissue {tissue.shape} disagree"
        )
    if len(spacing) != tissue.ndim or not all(0 < size < float("inf") for size in spacing):
        raise array_file.Invalid(f"its pixel spacing is {spacing}")
    if not np.isfinite(displacement).all():
        raise array_file.Invalid("its displacement holds values that are not numbers")
    if len(energy) != max(1, sum(run.iterations for run in levels)):
        raise array_file.Invalid("its energies and iterations disagree")
    frame = header["frame"]
    if frame is not None and not isinstance(frame, dict):
        raise array_file.Invalid("its frame is not a table")
    reached = header.get("convergence")
    given, known = header["provenance"], {field.name for field in fields(Provenance)}
    return Solution(
        displacement=displacement.astype(np.float32, copy=False),
        energy=energy.astype(np.float64, copy=False),
        levels=levels,
        tissue=tissue,
        spacing=spacing,
        provenance=Provenance(**{field: given[field] for field in known & given.keys()}),
        convergence=reached
        if reached is None
        else Convergence(
            float(reached["error"]), float(reached["residual"]), str(reached.get("way", "cycles"))
        ),
        frame=frame,
        reach=_reach(header.get("reach")),
    )


def _reach(given: Mapping[str, Any] | None) -> Reach | None:
    """How far large motion got, as a header has it; older files do not."""
    if given is None:
        return None
    where = given["where"]
    return Reach(
        float(given["least_jacobian"]),
        float(given["part"]),
        float(given["missing"]),
        None if where is None else tuple(int(index) for index in where),
        int(given["sites"]),
        float(given.get("grown", 1.0)),
    )


#: The file that `Solution.save` writes.
SOLUTION_FORMAT: array_file.Format[Solution] = array_file.Format(
    name="napari-hmrf solution",
    schema=1,
    what="napari-hmrf result",
    arrays={
        "displacement": array_file.Kind(("<f4",), (3, 4)),
        "energy": array_file.Kind(("<f8",), (1,)),
        "tissue": array_file.Kind(("|b1",), (2, 3)),
    },
    describe=_describe,
    parse=_parse,
)

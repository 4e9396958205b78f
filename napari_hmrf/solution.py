"""The result of a solve: the displacement, how it was reached, and what was run."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.optimizers.base import LevelRun


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
    inputs : mapping
        SHA-256 of the bytes of y, c and m.
    """

    backend: str
    renderer: str
    reason: str = ""
    seconds: float = 0.0
    preparation_seconds: float = 0.0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Solution:
    """A displacement field and its history.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2), float32
        Components in (row, col) order, in the unit of `spacing`. Material (push-forward): the
        tissue at X moves to X + d(X). Zero where there is no tissue.
    energy : ndarray, shape (iterations,), float64
        Mean total energy per site of tissue after each iteration, coarse to fine, in pixels
        squared.
    levels : tuple of LevelRun
        The levels in the order they were run, with their iterations: the boundaries in `energy`.
    tissue : ndarray, shape (H, W), bool
        Where there is tissue.
    spacing : tuple of float
        Size of a pixel in (row, col) direction.
    provenance : Provenance
    frame : mapping, optional
        Where the field lies in the world, for whoever made the problem from layers; JSON types
        only. The solver neither reads nor writes it.
    """

    displacement: npt.NDArray[np.float32]
    energy: npt.NDArray[np.float64]
    levels: tuple[LevelRun, ...]
    tissue: npt.NDArray[np.bool_]
    spacing: tuple[float, ...]
    provenance: Provenance
    frame: Mapping[str, Any] | None = None

    @property
    def iterations(self) -> int:
        """Sweeps over all levels together."""
        return sum(level.iterations for level in self.levels)

    @property
    def mean_energy(self) -> float:
        """Mean total energy per site of tissue at the end, in pixels squared."""
        return float(self.energy[-1])

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Save to one .npz file; see `napari_hmrf.files.save_solution`."""
        from napari_hmrf.files import save_solution

        return save_solution(self, path)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Solution:
        """Read back what `save` wrote; see `napari_hmrf.files.load_solution`."""
        from napari_hmrf.files import load_solution

        return load_solution(path)

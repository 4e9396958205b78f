"""Schedules of kernels over the levels of the hierarchy, written once for every backend."""

from napari_hmrf.solver.optimizers.base import LevelRun, Monitor, Optimizer, Outcome
from napari_hmrf.solver.optimizers.icm import ICM
from napari_hmrf.solver.optimizers.multigrid import Multigrid

__all__ = ["ICM", "LevelRun", "Monitor", "Multigrid", "Optimizer", "Outcome"]

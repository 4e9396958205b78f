"""Progress of a solve in stages."""

from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.staged_progress import StagedProgress


def test_progress_never_decreases_within_a_stage_or_after_a_preview():
    said: list[Monitor] = []
    progress = StagedProgress(said.append)
    progress.begin(preview=True)
    for fraction in 0.0, 0.6, 0.2, 1.0:
        progress(Monitor("cycle", fraction))
    progress.begin(preview=False)
    for fraction in 0.0, 0.5, 1.0:
        progress(Monitor("cycle", fraction))
    assert [each.fraction for each in said] == [0.0, 0.3, 0.3, 0.5, 0.5, 0.75, 1.0]


def test_reports_of_the_compiler_are_no_progress_of_the_solve():
    said: list[Monitor] = []
    progress = StagedProgress(said.append)
    for message, fraction in (f"{PREPARING}: about 5 s left", 0.9), ("cycle 1", 0.1):
        progress(Monitor(message, fraction))
    assert [each.fraction for each in said] == [0.9, 0.1]

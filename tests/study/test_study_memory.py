"""Tests of volumes that do not fit into memory: they are refused before any of their arrays."""

import tracemalloc

import numpy as np
import psutil
import pytest

from napari_hmrf import Grid, Motion, Pictures, ProblemError, Study, Tissue, solve_study
from napari_hmrf.registration import register
from napari_hmrf.solver import volume_memory
from napari_hmrf.solver.volume_memory import STUDY, WARP, make_room, require_memory
from napari_hmrf.study.ground import Ground

HUGE = (20000, 20000, 20000)


def huge(dtype):
    return np.broadcast_to(dtype(0), HUGE)


@pytest.mark.parametrize(
    "call",
    [
        lambda study: solve_study(study),
        lambda study: Ground.of(study),
        lambda study: register(study.pictures.image, study.pictures.image, spacing=1),
    ],
    ids=["solve", "live", "register"],
)
def test_a_volume_beyond_the_memory_is_refused_before_its_first_array(call):
    tissue = Tissue(labels=huge(np.uint8))
    study = Study(
        Grid(HUGE, 1.0, "mm"), tissue, Motion(hold_edge=True), pictures=Pictures(huge(np.uint8))
    )
    tracemalloc.start()
    try:
        with pytest.raises(ProblemError):
            call(study)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_the_memory_of_the_study_before_counts_as_free(monkeypatch):
    class Memory:
        available = 100 * STUDY

    monkeypatch.setattr(psutil, "virtual_memory", Memory)
    monkeypatch.setattr(volume_memory, "_used", lambda: 0)
    require_memory((4, 4, 5), STUDY)
    require_memory((1000, 1000), STUDY)  # an image
    with pytest.raises(ProblemError) as error:
        require_memory((4, 5, 5), STUDY, "scan.nii")
    assert error.value.field == "scan.nii"
    monkeypatch.setattr(volume_memory, "_used", lambda: 100 * STUDY)
    require_memory((4, 5, 5), STUDY)


def test_caches_of_a_solve_make_room_for_the_moved_image(monkeypatch):
    cleared = []
    monkeypatch.setattr(volume_memory, "clear_large", lambda: cleared.append(1))
    make_room((10, 10, 10), WARP)
    assert not cleared
    make_room(HUGE, WARP)
    assert cleared


@pytest.mark.skipif(not hasattr(volume_memory, "resource"), reason="the system has no limits")
def test_the_limit_of_a_process_counts(monkeypatch):
    vms = psutil.Process().memory_info().vms
    monkeypatch.setattr(volume_memory.resource, "getrlimit", lambda _: (vms + 2**20, -1))
    assert volume_memory.fits((10, 10, 10), 100)
    assert not volume_memory.fits((100, 100, 100), 100)

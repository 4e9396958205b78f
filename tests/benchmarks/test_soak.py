"""Short soak test; ``benchmarks/soak.py`` runs a long one."""

import pytest
from soak import soak


@pytest.mark.campaign
def test_many_solves_and_cancels_leave_no_threads_and_no_changes(make_napari_viewer):
    found = soak(solves=4, cancels=4, size=48, viewer=make_napari_viewer(show=True))
    assert (found.finished, found.cancelled) == (4, 4)
    assert found.wrong == 0
    assert found.threads_left == []
    assert not found.picture_changed

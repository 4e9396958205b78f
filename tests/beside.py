"""Docks beside a viewer without a window, and somebody who pulls there."""

import numpy as np
import pytest
from napari.components import ViewerModel
from person import Touch
from screen import Screen

from napari_hmrf.ui.soft_tissue import SoftTissue


@pytest.fixture
def open_beside(qtbot, at_rest):
    """Open a dock beside an image in a viewer without a window."""

    def opened(data=None, **place):
        viewer = ViewerModel()
        if data is None:
            rows, cols = np.indices((64, 64))
            data = (120 + 60 * ((rows // 8 + cols // 8) % 2)).astype(np.uint8)
        viewer.add_image(data, name="MR", **place)
        dock = SoftTissue(viewer)
        qtbot.addWidget(dock.native)
        at_rest(thread=False)
        return Touch(viewer), dock

    return opened


@pytest.fixture
def pulling_beside(open_beside, settle):
    """Somebody with *Pull* in the hand, and no window."""
    hand, dock = open_beside()
    if not dock.active:
        Screen(dock).press("Pull")
    assert dock.active
    settle(dock)
    return hand, dock

"""Fixtures of the tests of the dock."""

import pytest

from tests.support.napari_caches import (
    check_callbacks_once,
    check_widgets_once,
    inspect_functions_once,
    set_sliders_once,
    skip_thumbnails,
)


@pytest.fixture
def thumbnails():
    """Draw the thumbnails of layers without a window, too."""


@pytest.fixture(autouse=True)
def _quick_docks(request, monkeypatch):
    """Open docks without work that is repeated for each dock, or that has no effect."""
    check_widgets_once()
    check_callbacks_once()
    inspect_functions_once()
    set_sliders_once()
    if not {"make_napari_viewer", "thumbnails"} & set(request.fixturenames):
        skip_thumbnails(monkeypatch)

"""Fixtures of the backend tests."""

import pytest

from tests.support.opengl import require_opengl


@pytest.fixture(params=["fragment", "compute"])
def stage(request) -> str:
    """Return the shader stage; skip the test if the stage is not available."""
    require_opengl(request.param)
    return request.param

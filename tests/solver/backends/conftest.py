"""Fixtures of the backends' tests."""

import pytest

from tests.support.opengl import require_opengl


@pytest.fixture(params=["fragment", "compute"])
def stage(request) -> str:
    """Stage that the shaders run in; the test is skipped where it is missing."""
    require_opengl(request.param)
    return request.param

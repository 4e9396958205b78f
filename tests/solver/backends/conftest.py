"""Fixtures of the backend tests."""

import pytest

from tests.support.opengl import require_opengl


@pytest.fixture(params=["compute", pytest.param("fragment", marks=pytest.mark.campaign)])
def stage(request) -> str:
    """Return the shader stage; skip the test if the stage is not available.

    Both stages run the same text of a kernel, so the fragment stage is a campaign. A test that
    names the stages in its parameters runs the fragment stage with the other tests.
    """
    require_opengl(request.param)
    return request.param

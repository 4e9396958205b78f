"""Fixtures of the tests of files."""

import pytest


@pytest.fixture
def child_process():
    """Read DICOM and HDF5 in a child process, as outside of tests."""


@pytest.fixture(autouse=True)
def _without_child(request):
    """Start no child process to read or write a file, unless a test is about it."""
    if "child_process" not in request.fixturenames:
        request.getfixturevalue("without_child")

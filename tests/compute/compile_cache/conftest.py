"""Fixtures of the tests of the compile cache."""

import pytest

from napari_hmrf.compute.compile_cache import compiler, disk_cache, loader, loops


@pytest.fixture
def cold(monkeypatch, tmp_path):
    """Remove all loops, replace the compiler, and return the commands it would run."""
    started = []

    class Compiler:
        def __init__(self, command):
            started.append(command)

        def poll(self):
            """Return None: the process never ends."""

        def terminate(self):
            """Do nothing: there is no process."""

    monkeypatch.delenv("NAPARI_HMRF_COMPILE")
    monkeypatch.setattr(disk_cache, "folder", lambda: tmp_path)
    for name in ("in_use", "begun_without", "alone"):
        monkeypatch.setattr(loops._State, name, False)
    monkeypatch.setattr(loops._State, "used", set())
    monkeypatch.setattr(compiler._State, "compiler", None)
    monkeypatch.setattr(compiler, "_start_process", Compiler)
    monkeypatch.setattr(loader, "_loader", loader._Loader())
    return started

"""Fixtures of the tests of the compile cache."""

import pytest

from napari_hmrf.solver.backends.compile_cache import compiler, disk_cache, loader, loops


@pytest.fixture
def cold(monkeypatch, tmp_path):
    """No loops yet, and nobody who compiles them; the commands that would be started."""
    started = []

    class Compiler:
        def __init__(self, command):
            started.append(command)

        def poll(self):
            """It goes on for ever."""

        def terminate(self):
            """Nothing runs."""

    monkeypatch.delenv("NAPARI_HMRF_COMPILE")
    monkeypatch.setattr(disk_cache, "folder", lambda: tmp_path)
    monkeypatch.setattr(loops._State, "solver", loops._Part())
    monkeypatch.setattr(loops._State, "pictures", loops._Part())
    monkeypatch.setattr(loops._State, "alone", False)
    monkeypatch.setattr(compiler._State, "compiler", None)
    monkeypatch.setattr(compiler, "_start_process", Compiler)
    monkeypatch.setattr(loader, "_loader", loader._Loader())
    return started

"""Opening of a sample and of the dock in steps, between which the window is painted."""

from __future__ import annotations

import importlib
import logging
import sys
import threading
from collections.abc import Callable
from typing import Any

from qtpy.QtCore import QEventLoop, QThread, QTimer

from napari_hmrf.ui.jobs import Repainted

_log = logging.getLogger("napari_hmrf")
#: Module of the dock.
_DOCK = "napari_hmrf.ui.soft_tissue"
#: Modules that take long to import: those that napari imports for a layer, and the dock.
_HEAVY = ("pandas", "scipy.ndimage", "scipy.linalg", "skimage.color", "skimage.exposure", _DOCK)
# Callbacks that wait for a painting; Qt holds no reference to them.
_waiting: list[Any] = []
# Interval at which the window looks whether they are imported, in milliseconds.
_POLL = 10


def __getattr__(name: str) -> Any:
    """Return the class of the dock, for the menu of napari, which asks this module for it."""
    if name != "SoftTissue":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    load()
    return importlib.import_module(_DOCK).SoftTissue


def is_interactive() -> bool:
    """Return whether the user has caused this call, in a running event loop."""
    return bool(QThread.currentThread().loopLevel() > 0)


def load() -> None:
    """Import what the dock needs on another thread, and paint the window meanwhile.

    Mouse and keyboard are handled afterwards, so that nothing else begins in between. In a script,
    there is no window to paint, and nothing is done.
    """
    if _DOCK in sys.modules or not is_interactive():
        return
    loop, poll = QEventLoop(), QTimer()
    imports = threading.Thread(target=_import_all, name="napari-hmrf imports", daemon=True)
    poll.timeout.connect(lambda: imports.is_alive() or loop.quit())
    imports.start()
    poll.start(_POLL)
    loop.exec(QEventLoop.ProcessEventsFlag.ExcludeUserInputEvents)
    poll.stop()


def after_painting(call: Callable[[], object]) -> None:
    """Call a function once the window has painted what has changed."""

    def finish() -> None:
        _waiting.remove(painted)
        painted.release()
        call()

    painted = Repainted(finish)
    _waiting.append(painted)
    painted.schedule()


def _import_all() -> None:
    try:
        for name in _HEAVY:
            importlib.import_module(name)
    except ImportError:  # the GUI thread then raises the error for the user
        _log.debug("the dock could not be imported in the background", exc_info=True)

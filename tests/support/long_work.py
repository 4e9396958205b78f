"""Work that occupies the compute thread for as long as a test needs."""

import threading
from contextlib import contextmanager

from napari_hmrf.compute.thread import compute_thread
from tests.support.timeouts import LONG


@contextmanager
def long_work():
    """Occupy the compute thread, as a long compilation or solve would.

    Yields the event that releases the thread; the end of the context releases it, too.
    """
    release = threading.Event()
    job = compute_thread.submit(lambda: release.wait(LONG))
    yield release
    release.set()
    job.result(timeout=LONG)

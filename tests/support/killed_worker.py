"""Cases of a batch for a worker process, which ends itself at one of them."""

import os
import signal

from napari_hmrf.io.case_records import CaseOutcome

#: Name of the case at which the process ends.
KILLER = "killer"


def solve_or_end(case):
    """Return the outcome of a case, unless the process is killed by it."""
    if case.name == KILLER:
        os.kill(os.getpid(), signal.SIGKILL)
    return CaseOutcome(case.name, "done")

"""Sets of loops: each is compiled by the job of `napari_hmrf.compiling` with its name."""

from __future__ import annotations

#: All sets but those in `ON_REQUEST`.
EVERYTHING = ""
#: Loops that move pictures.
PICTURES = "pictures"
#: Loops that solve elastic volumes.
VOLUMES = "volume"
#: Loops for hard tissue, which a solve compiles in its middle if it needs them; no job has them.
HARDER = "harder"
#: Sets that are compiled only when a solve waits for them.
ON_REQUEST = (VOLUMES, "volume-schedule", "volume-converged")
#: Approximate number of loops of each set by itself, for the progress of its compilation.
COUNTS = {
    "elastic": 22,
    PICTURES: 5,
    "schedule": 3,
    "converged": 22,
    "slipping": 23,
    "rigid": 26,
    "schedule-oblong": 3,
    "converged-oblong": 22,
    "blanket-schedule": 3,
    "blanket-converged": 19,
    "exact-steps": 3,
    "large-motion": 24,
    VOLUMES: 22,
    "volume-schedule": 2,
    "volume-converged": 15,
    HARDER: 8,
}
#: Approximate number of different loops in `EVERYTHING`, and in all sets.
USUAL_COUNT, FULL_COUNT = 64, 89

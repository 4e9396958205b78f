"""Sets of loops. For each set, `napari_hmrf.compiling` has a job of the same name."""

from __future__ import annotations

#: All sets except those in `ON_REQUEST`.
EVERYTHING = ""
#: Loops that warp pictures.
PICTURES = "pictures"
#: Loops that solve elastic volumes.
VOLUMES = "volume"
#: Loops that solve volumes in large motion.
LARGE_VOLUMES = "volume-large-motion"
#: Loops for a quadratic data term in an image.
DATA = "data"
#: Same in a volume.
VOLUME_DATA = "volume-data"
#: Loops for a quadratic data term, such as uncertain landmarks, in large motion of an image.
LARGE_DATA = "large-motion-data"
#: Same in a volume.
LARGE_VOLUME_DATA = "volume-large-motion-data"
#: Loops for tissue on which cycles converge slowly. No job compiles this set, so a solve compiles
#: the loops when it requires them.
HARDER = "harder"
#: Sets that are compiled only when a solve requests them.
ON_REQUEST = (
    VOLUMES,
    LARGE_VOLUMES,
    "volume-schedule",
    "volume-converged",
    DATA,
    VOLUME_DATA,
    LARGE_DATA,
    LARGE_VOLUME_DATA,
)
#: Approximate number of loops in each set, used to report compilation progress.
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
    LARGE_VOLUMES: 24,
    "volume-schedule": 2,
    "volume-converged": 15,
    DATA: 25,
    VOLUME_DATA: 25,
    LARGE_DATA: 34,
    LARGE_VOLUME_DATA: 34,
    HARDER: 8,
}
#: Approximate number of distinct loops in `EVERYTHING`, and in all sets.
USUAL_COUNT, FULL_COUNT = 67, 128

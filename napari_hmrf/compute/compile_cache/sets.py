"""Sets of loops, in the order in which they are usually needed.

For each set, `napari_hmrf.compiling` has a job of the same name. The preparation of a computer
compiles all of them, one after the other; a set that is requested comes next.
"""

from __future__ import annotations

from typing import NamedTuple

#: All sets.
EVERYTHING = ""
#: Loops that warp pictures.
PICTURES = "pictures"
#: Loops that solve elastic volumes.
VOLUMES = "volume"
#: Loops that solve images and volumes in large motion.
LARGE_IMAGES, LARGE_VOLUMES = "large-motion", "volume-large-motion"
#: Loops for a quadratic data term in an image, as registration has.
DATA = "data"
#: Same in a volume.
VOLUME_DATA = "volume-data"
#: Loops for a quadratic data term, such as uncertain landmarks, in large motion of an image.
LARGE_DATA = "large-motion-data"
#: Same in a volume.
LARGE_VOLUME_DATA = "volume-large-motion-data"


class Cost(NamedTuple):
    """Cost of a set, if the sets before it are compiled; it is used to estimate the time left.

    Attributes
    ----------
    loops : int
        Number of loops that the set adds to the sets before it, at least 1.
    seconds : float
        Time to compile these loops, on one core of an AMD EPYC.
    """

    loops: int
    seconds: float


#: Cost of each set.
COSTS = {
    "elastic": Cost(25, 24.6),
    PICTURES: Cost(5, 8.1),
    "slipping": Cost(2, 1.5),
    "rigid": Cost(4, 1.7),
    LARGE_IMAGES: Cost(12, 16.6),
    DATA: Cost(11, 16.0),
    VOLUMES: Cost(19, 27.9),
    LARGE_VOLUMES: Cost(16, 40.4),
    VOLUME_DATA: Cost(7, 13.8),
    LARGE_DATA: Cost(3, 4.3),
    LARGE_VOLUME_DATA: Cost(1, 0.2),
    "schedule": Cost(2, 2.3),
    "converged": Cost(10, 5.3),
    "schedule-oblong": Cost(1, 1.2),
    "converged-oblong": Cost(2, 1.5),
    "blanket-schedule": Cost(1, 1.8),
    "blanket-converged": Cost(3, 3.0),
    "exact-steps": Cost(1, 0.7),
    "volume-schedule": Cost(2, 5.2),
    "volume-converged": Cost(4, 7.8),
}

"""Number of docks built and windows opened in a run of the tests, printed at its end."""

from collections import Counter
from functools import cache, wraps

#: Docks and windows of this process; the process that prints also adds those of its workers.
opened: Counter[str] = Counter()
#: Beginning of the names under which discarded docks are counted.
DISCARDED = "discarded: "
#: Name under which a worker sends its numbers.
KEY = "napari_hmrf_opened"


@cache
def count_new(kind, name):
    """Count the objects of a class that are created from now on."""
    create = kind.__init__

    @wraps(create)
    def counted(self, *args, **kwargs):
        opened[name] += 1
        create(self, *args, **kwargs)

    kind.__init__ = counted


def summary():
    """Return the lines that are printed at the end of a run."""
    lines = [f"{opened['docks']} docks built, {opened['windows']} windows opened"]
    reasons = Counter({name: n for name, n in opened.items() if name.startswith(DISCARDED)})
    return lines + [f"    {number} {name}" for name, number in reasons.most_common()]

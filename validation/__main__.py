"""Run studies: ``python -m validation NAME``, or without a name for the list of names."""

from __future__ import annotations

import importlib
import shlex
import sys
from collections.abc import Sequence

from validation.study import STUDIES, parser, run

#: Modules with studies by group; imported when they are chosen.
MODULES = {
    "paper": "validation.studies.paper",
    "elasticity": "validation.studies.elasticity",
    "volumes": "validation.studies.elasticity",
    "loads": "validation.studies.loads",
    "resection": "validation.studies.loads",
    "large-motion": "validation.studies.large_motion",
    "large-volumes": "validation.studies.large_motion",
    "sliding": "validation.studies.sliding",
    "data-term": "validation.studies.sliding",
    "landmarks": "validation.studies.landmarks",
    "sections": "validation.studies.landmarks",
    "registration": "validation.studies.registration",
    "real": "validation.studies.real_pairs",
    "uncertainty": "validation.studies.uncertainty",
    "hard": "validation.studies.hard",
    "hardware": "validation.studies.hardware",
    "robustness": "validation.studies.robustness",
    "damaged": "validation.studies.damaged",
    "speed": "validation.studies.peers",
    "peers": "validation.studies.peers",
}
#: Studies of `make report`. Speed is first, before the machine becomes warm.
REPORT = ("speed", "paper", "elasticity", "registration.figure-4c", "volumes", "loads", "resection")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the chosen studies, or print the names of all studies."""
    reader = parser()
    given = reader.parse_args(arguments)
    names = list(REPORT) if given.names == ["report"] else given.names
    if given.quick and given.write:
        reader.error("the numbers of a quick run do not belong on a page")
    for name in names:
        if name.partition(".")[0] not in MODULES:
            reader.error(f"unknown study {name}; known: report, {', '.join(MODULES)}")
    # A page states the commit of all its studies, so all are known before it is written.
    groups = MODULES if given.write else [name.partition(".")[0] for name in names]
    for group in groups or MODULES:
        importlib.import_module(MODULES[group])
    if not names:
        for one in STUDIES.values():
            print(f"{one.name:28} {(one.compare.__doc__ or '').splitlines()[0]}")
        return 0
    chosen = []
    for name in names:
        found = [
            one
            for one in STUDIES.values()
            if one.name == name or (one.name.startswith(f"{name}.") and not one.on_request)
        ]
        if not found:
            known = (one for one in STUDIES if one.startswith(name.partition(".")[0]))
            reader.error(f"unknown study {name}; known: {', '.join(known)}")
        chosen += found
    words = sys.argv[1:] if arguments is None else arguments
    return run(chosen, given, f"python -m validation {shlex.join(words)}")


if __name__ == "__main__":
    sys.exit(main())

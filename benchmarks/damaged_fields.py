"""Fields and landmarks that were cut short, or of which bits were flipped: what reading them takes.

    python benchmarks/damaged_fields.py [--files 2000] [--seed 0]

Each version is read in a process of its own, so that the memory of SimpleITK counts and a crash is
seen. Half of the flips are in the file's beginning, where it says what it holds. Exits with 1 if a
field that was cut was read as another, an error was none of this package's, or one took more than
2 s of the processor or 100 MB. Flips in numbers that no checksum covers cannot be told, and count
as read.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from damaged import MOST_BYTES, MOST_SECONDS, cut, flipped

from napari_hmrf import HmrfError, load_points, read_field, save_points, write_field
from napari_hmrf.io.fields import FIELD_SUFFIXES
from napari_hmrf.io.landmark_files import POINT_SUFFIXES

#: What comes of a version: it is read as another, as the same, refused, or what must not be.
_READ, _SAME, _REFUSED, _FAILED, _SLOW, _LARGE = range(6)
_WORDS = ("read", "the same", "refused", "another error", "took too long", "took too much memory")
_HEAD = 400


def make_field(path: Path) -> None:
    """Write a field of one slice in a volume."""
    rows, cols = np.indices((40, 48)) / 40
    d = 2 * np.stack([np.sin(3 * rows), np.cos(2 * cols)], axis=-1)
    if path.suffix == ".tfm":
        import SimpleITK as sitk

        image = sitk.GetImageFromArray(d, isVector=True)
        sitk.WriteTransform(sitk.DisplacementFieldTransform(image), str(path))
    else:
        write_field(path, d, spacing=(3.0, 1.3, 0.7), forward=path.suffix != ".h5")


def make_landmarks(path: Path) -> None:
    """Write pairs of landmarks, or one list where a file holds no pairs."""
    points = np.random.default_rng(0).normal(size=(40, 3))
    save_points(path, points, points + 1 if path.suffix == ".csv" else None)


def read_vectors(path: Path) -> bytes:
    """Read a field, to be compared."""
    return read_field(path, forward=True).displacement.tobytes()


def look(path: Path, read: Callable[[Path], object], original: object = None) -> int:
    """Read a version in a process of its own, and tell what came of it."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    import resource  # of POSIX alone

    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    code = _FAILED
    try:
        code = _SAME if read(path) == original else _READ
    except HmrfError:
        code = _REFUSED
    finally:
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
        code = _SLOW if time.process_time() - started > MOST_SECONDS else code
        os._exit(_LARGE if grown > MOST_BYTES else code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Read all versions and print what came of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=2000, help="of each format")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    # What the libraries of formats print of their own on damage is no error of ours.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    kinds: dict[str, tuple[Callable[[Path], None], Callable[[Path], object]]] = {
        **dict.fromkeys((*FIELD_SUFFIXES, ".tfm"), (make_field, read_vectors)),
        **dict.fromkeys(POINT_SUFFIXES, (make_landmarks, load_points)),
    }
    wrong = False
    for suffix, (make, read) in kinds.items():
        dice, outcomes = random.Random(options.seed), Counter[tuple[str, str]]()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"whole{suffix}")
            make(path)
            content = path.read_bytes()
            text = suffix in POINT_SUFFIXES  # of which each line is whole
            original = None if text else read(path)
            path.unlink()
            path = Path(folder, f"damaged{suffix}")
            for number in range(options.files):
                if number % 2:
                    kind, version = "cut", cut(content, dice)
                else:
                    kind, whole = "flipped", number % 4 == 0
                    head = len(content) if whole else _HEAD
                    version = flipped(content[:head], dice) + content[head:]
                path.write_bytes(version)
                code = look(path, read, original)
                word = _WORDS[code] if code >= 0 else f"killed by signal {-code}"
                outcomes[kind, word] += 1
                cut_as_another = kind == "cut" and code == _READ and not text
                bad = code not in (_READ, _SAME, _REFUSED) or cut_as_another
                if bad:
                    wrong = True
                    print(f"{suffix}: version {number}, {kind}: {word}", flush=True)
        told = ", ".join(f"{kind} {word} {n}" for (kind, word), n in sorted(outcomes.items()))
        print(f"{suffix:<10}{told}", flush=True)
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())

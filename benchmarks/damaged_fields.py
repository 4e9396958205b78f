"""Robustness of reading damaged exchange files and landmarks.

    python benchmarks/damaged_fields.py [--files 5000] [--seed 0] [--page PAGE]

Each version is read in this process, which must survive. Flipped bits in numbers without a checksum
cannot be detected, so reading these files is not an error. Exits with 1 if a truncated field was
read as another field, if an error was not one of the package's errors, if a version took more than
3 s, or if this process grew by more than 20 MB over all versions of a kind.
"""

from __future__ import annotations

import argparse
import platform
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from damaged import cut, flipped, torn

from napari_hmrf import FileFormatError
from napari_hmrf.fields import read_field, write_field
from napari_hmrf.io.fields import FIELD_SUFFIXES
from napari_hmrf.io.landmark_files import POINT_SUFFIXES
from napari_hmrf.landmarks import read_points, write_points

MOST_SECONDS = 3.0
MOST_MEGABYTES = 20.0
#: Size of the start of a file, in bytes, which describes its contents; a third of flips are there.
_HEAD = 600
#: Number of versions read before memory is measured, because libraries allocate memory once.
_WARM_UP = 50


class Kind(NamedTuple):
    """Kind of file: functions that write and read it."""

    suffix: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    is_text: bool = False


class Tally(NamedTuple):
    """Results for all versions of a kind."""

    outcomes: Counter[str]
    slowest: float
    grown: float
    wrong: int


def _displacement() -> np.ndarray:
    rows, cols = np.indices((40, 48)) / 40
    return 2 * np.stack([np.sin(3 * rows), np.cos(2 * cols)], axis=-1)


def make_field(path: Path) -> None:
    """Write a field of one slice in a volume; .tfm files are written by SimpleITK instead."""
    if path.suffix == ".tfm":
        make_foreign(path)
    else:
        turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
        write_field(
            path,
            _displacement(),
            spacing=(3.0, 1.3, 0.7),
            origin=(-10.0, 20.0, 5.0),
            direction=turn,
            forward=path.suffix != ".h5",
        )


def make_foreign(path: Path) -> None:
    """Write a field with SimpleITK only."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(_displacement(), isVector=True)
    image.SetSpacing((0.7, 1.3))
    if path.suffix in (".h5", ".tfm"):
        sitk.WriteTransform(sitk.DisplacementFieldTransform(image), str(path))
    else:
        sitk.WriteImage(image, str(path), useCompression=True)


def make_landmarks(path: Path) -> None:
    """Write pairs of landmarks, or a single list if the format does not support pairs."""
    points = np.random.default_rng(0).normal(size=(40, 3))
    write_points(path, points, points + 1 if path.suffix == ".csv" else None)


def read_all(path: Path) -> tuple[Any, ...]:
    """Return the vectors and geometry of a field, for comparison."""
    found = read_field(path, forward=True)
    field = found.field
    vectors = field.vectors
    place = (found.spacing, found.origin, found.direction.tobytes(), field.back)
    return vectors.dtype.str, vectors.shape, vectors.tobytes(), *place


def read_landmarks(path: Path) -> tuple[Any, ...]:
    """Return the contents of a landmark file, for comparison."""
    found = read_points(path)
    targets = b"" if found.targets is None else found.targets.tobytes()
    return found.points.tobytes(), targets, found.names, found.unit


KINDS = (
    *(Kind(suffix, make_foreign, read_all) for suffix in (*FIELD_SUFFIXES, ".tfm")),
    *(Kind(suffix, make_landmarks, read_landmarks, is_text=True) for suffix in POINT_SUFFIXES),
)


def damaged_version(content: bytes, number: int, dice: random.Random) -> tuple[str, bytes]:
    """Return the kind of damage and the damaged version of a file."""
    kind = ("flips", "flips in the head", "flips", "cut", "torn")[number % 5]
    if kind == "flips":
        return kind, flipped(content, dice)
    if kind == "flips in the head":
        return kind, flipped(content[:_HEAD], dice) + content[_HEAD:]
    return kind, (cut if kind == "cut" else torn)(content, dice)


def look(kind: Kind, path: Path, original: Any) -> str:
    """Read a version, and return "the same", "another" or "refused"."""
    try:
        found = kind.read(path)
    except FileFormatError:
        return "refused"
    return "the same" if found == original else "another"


def try_kind(kind: Kind, files: int, seed: int) -> Tally:
    """Read all versions of a kind and return the tally."""
    dice, outcomes, wrong, slowest = random.Random(seed), Counter[str](), 0, 0.0
    process, start, most = psutil.Process(), 0, 0
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder, f"whole{kind.suffix}")
        kind.make(whole)
        content, original = whole.read_bytes(), kind.read(whole)
        for number in range(files):
            damage, version = damaged_version(content, number, dice)
            path = Path(folder, f"{number}{kind.suffix}")
            path.write_bytes(version)
            started = time.perf_counter()
            try:
                found = look(kind, path, original)
            except Exception as error:  # noqa: BLE001 - unexpected errors are findings
                found, wrong = "another error", wrong + 1
                print(f"{kind.suffix} {number}: {type(error).__name__}: {error}"[:300])
            taken = time.perf_counter() - started
            slowest = max(slowest, taken)
            path.unlink()
            size = process.memory_info().rss
            start, most = (size, size) if number < _WARM_UP else (start, max(most, size))
            outcomes[found] += 1
            if found == "another" and damage == "cut" and not kind.is_text:
                wrong += 1
                print(f"{kind.suffix} {number}, {damage}: read as another field")
            if taken > MOST_SECONDS:
                wrong += 1
                print(f"{kind.suffix} {number}, {damage}: took {taken:.1f} s")
    grown = (most - start) / 1e6
    return Tally(outcomes, slowest, grown, wrong + (grown > MOST_MEGABYTES))


def main(arguments: Sequence[str] | None = None) -> int:
    """Read all versions and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=5000, help="number of versions of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="suffix, such as .h5")
    parser.add_argument("--page", type=Path, help="path of a Markdown page to write")
    options = parser.parse_args(arguments)
    titles = "kind", "refused", "the same", "another", "other errors", "slowest, s", "grown by, MB"
    lines = [f"| {' | '.join(titles)} |", "| --- " * len(titles) + "|"]
    wrong = 0
    for kind in KINDS:
        if options.only not in (None, kind.suffix):
            continue
        tally = try_kind(kind, options.files, options.seed)
        wrong += tally.wrong
        words = ("refused", "the same", "another", "another error")
        counts = " | ".join(str(tally.outcomes[word]) for word in words)
        lines.append(f"| {kind.suffix} | {counts} | {tally.slowest:.2f} | {tally.grown:.1f} |")
        print(lines[-1], flush=True)
    print(f"{wrong} went wrong")
    if options.page:
        intro = (
            f"# Damaged exchange files\n\nMade by `make damaged`: {options.files} versions of each "
            f"kind, seed {options.seed}, {platform.system()}, Python {platform.python_version()}. "
            "Two fifths have bits flipped anywhere, a fifth in the first 600 bytes, and a fifth "
            "are cut short. In the last fifth a block is missing, blank, noise, doubled or from "
            "elsewhere in the file. One process reads all of them and survives: libraries that "
            "crash or hang run in a separate process. The fields are written by SimpleITK. Flips "
            "in numbers without a checksum cannot be detected.\n\n"
        )
        options.page.write_text(intro + "\n".join(lines) + "\n", encoding="utf-8")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())

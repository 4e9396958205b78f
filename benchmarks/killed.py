"""Test of atomic writing: a process is killed while it overwrites a study or a field.

    python benchmarks/killed.py [--of .mha] [--packing 300] [--every 1] [--half 100] [--seed 0]

A child process saves the second study and kills itself (SIGKILL) before or after the n-th call into
the system or a library. All n after writing starts are tested, and a sample of the calls during
compression. Other children save a large study and are killed by their parent as soon as a given
part is on the disk. Afterwards, the file must contain either the first or the second study.
Requires an operating system with fork. Exits with 1 if the file contains anything else, or if more
than a temporary file is left.
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from damaged import plain

from napari_hmrf import (
    Arrow,
    Drawing,
    Grid,
    HmrfError,
    Motion,
    Pictures,
    Study,
    Tissue,
    read_study,
    solve_study,
    write_study,
)
from napari_hmrf.fields import read_field, write_field

Save = Callable[[], Any]
#: Contents that the file may have afterwards.
_KNOWN = ("first", "second", "large")


def study(pull: float, size: int = 24) -> Study:
    """Return a study of noise, which cannot be compressed, with a pull."""
    image = np.random.default_rng(size).integers(1, 255, (size, size), dtype=np.uint8)
    drawing = Drawing((Arrow((size / 2, size / 2), (0.0, pull), 2.0),))
    grid, tissue = Grid(image.shape, (1.0, 1.0)), Tissue(stiffness=np.ones(image.shape))
    return Study(grid, tissue, Motion(hold_edge=True, drawing=drawing), pictures=Pictures(image))


class _Steps:
    """Profiler that counts the steps of a save, and kills the process at a given step."""

    def __init__(self, last: int = 0) -> None:
        self._last = last
        self.count = 0
        self.written_from = 0

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_name == "write_whole":
            self.written_from = self.count + 1
        if event in ("c_call", "c_return"):
            self.count += 1
            if self.count == self._last:
                os.kill(os.getpid(), signal.SIGKILL)


def steps_of(save: Save) -> tuple[int, int]:
    """Return the first step at which the file is written, and the number of steps of a save."""
    steps = _Steps()
    sys.setprofile(steps)
    try:
        save()
    finally:
        sys.setprofile(None)
    return steps.written_from, steps.count


def killed_at(step: int, save: Save) -> bool:
    """Save in a child that kills itself at a step; return True if the step was reached."""
    child = os.fork()
    if not child:
        try:
            sys.setprofile(_Steps(step))
            save()
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def killed_at_size(size: int, folder: Path, save: Save) -> bool:
    """Save in a child, kill it at a temporary file size, and return True if this was reached."""
    child = os.fork()
    if not child:
        try:
            save()
        finally:
            os._exit(0)
    while not os.waitpid(child, os.WNOHANG)[0]:
        if any(half >= size for half in _sizes(folder)):
            os.kill(child, signal.SIGKILL)
            return os.WIFSIGNALED(os.waitpid(child, 0)[1])
    return False


def _field(pull: float) -> np.ndarray:
    return np.random.default_rng(int(pull)).normal(size=(12, 14, 2))


def _vectors(path: Path) -> bytes:
    """Return the vectors of a field, for comparison."""
    return np.round(read_field(path, forward=True).field.vectors, 6).tobytes()


def _study_of(path: Path) -> Any:
    """Return the contents of a study, for comparison."""
    return plain(read_study(path).study)


def _sizes(folder: Path) -> Iterator[int]:
    for path in folder.glob("*.tmp"):
        try:
            yield path.stat().st_size
        except FileNotFoundError:  # the file has been renamed meanwhile
            continue


def left(path: Path, known: dict[str, Any], read: Callable[[Path], Any] = _study_of) -> str:
    """Read the remaining file, remove temporary files, and return the name of its contents."""
    others = [each for each in path.parent.iterdir() if each != path]
    for each in others:
        if ".tmp" not in each.suffixes:
            return f"another file was left: {each.name}"
        each.unlink()
    try:
        found = read(path)
    except (HmrfError, OSError) as error:
        return f"broken: {error}"
    return next((name for name, one in known.items() if one == found), "another one")


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill at all steps and print the remaining contents."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--of", default="study", help="study, or the suffix of a field")
    parser.add_argument("--packing", type=int, default=300, help="kills before writing starts")
    parser.add_argument("--every", type=int, default=1, help="interval between steps of writing")
    parser.add_argument("--half", type=int, default=100, help="kills of a half-written large file")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    dice = random.Random(options.seed)
    studies = options.of == "study"
    outcomes = _kill_studies(options, dice) if studies else _kill_fields(options)
    for (when, what), number in sorted(outcomes.items()):
        print(f"killed while {when:<26}{number:>6} times; the file: {what}")
    return int(any(what not in _KNOWN for _, what in outcomes))


def _kill_fields(options: argparse.Namespace) -> Counter[tuple[str, str]]:
    """Kill at the steps of writing a field."""
    outcomes = Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as folder:
        path, known = Path(folder, f"field{options.of}"), {}
        way = {"spacing": (1.0, 1.0), "forward": options.of != ".h5"}
        for name, pull in (("second", 2.0), ("first", 1.0)):
            write_field(path, _field(pull), **way)
            known[name] = _vectors(path)

        def save() -> None:
            write_field(path, _field(2.0), **way)

        # A child starts its own decoder, so it runs more steps than would be counted here.
        for step in itertools.count(1, options.every):
            write_field(path, _field(1.0), **way)
            came = killed_at(step, save)
            outcomes["writing" if came else "writing, not killed", left(path, known, _vectors)] += 1
            if not came:
                break
    return outcomes


def _kill_studies(options: argparse.Namespace, dice: random.Random) -> Counter[tuple[str, str]]:
    """Kill at the steps of saving a study, and while a large study is written."""
    outcomes = Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "case.study")
        first, second = study(1.0), study(2.0)
        solution = solve_study(second, backend="cpu")
        known = {"first": plain(first), "second": plain(second)}

        def save() -> None:
            write_study(path, second, solution)

        write_study(path, first)
        start, count = steps_of(save)
        before = dice.sample(range(1, start), min(options.packing, start - 1))
        for step in (*sorted(before), *range(start, count + 1, options.every)):
            write_study(path, first)
            when = "packing" if step < start else "writing"
            came = killed_at(step, save)
            outcomes[when if came else f"{when}, not killed", left(path, known)] += 1
        if options.half:
            large = study(1.0, 2000)
            known["large"] = plain(large)
            size = write_study(path, large).stat().st_size

            def save_large() -> None:
                write_study(path, large)

        for _ in range(options.half):
            write_study(path, first)
            came = killed_at_size(dice.randrange(size), path.parent, save_large)
            outcomes["half written" if came else "half written, not killed", left(path, known)] += 1
    return outcomes


if __name__ == "__main__":
    sys.exit(main())

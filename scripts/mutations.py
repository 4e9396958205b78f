"""Mutation tests of the package: a test must fail for each mutation.

    python scripts/mutations.py [file ...]

Each mutation in `mutations.toml` changes a sign, an index, a weight or a constant, with an effect
that a user would notice. The mutations are applied one at a time to copies of the checkout. Names
of files, or beginnings of names such as ``solver/priors``, select the mutations of these files.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fnmatch import filter as matching
from pathlib import Path

from napari_hmrf.compute.compile_cache import disk_cache

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "napari_hmrf"
#: Files and folders that no test reads.
_LEFT_OUT = (".*", "build", "dist", "docs", "*-output")
#: Files in which numba stores compiled loops.
_COMPILED = "*.nb[ic]"
#: Number of mutations that are tested in parallel.
_AT_ONCE = os.cpu_count() or 1
#: Exit statuses of pytest if all tests pass, and if a test fails. Any other status means that no
#: test was run.
_PASSED, _FAILED = 0, 1


@dataclass(frozen=True)
class Mutation:
    """Error in a source file, and the tests that must detect it.

    Attributes
    ----------
    file : str
        Path of the file, relative to the package.
    right, wrong : str
        Correct text, which must occur exactly once in the file, and its replacement.
    tests : list of str
        Files or folders of tests, relative to `tests`.
    """

    file: str
    right: str
    wrong: str
    tests: list[str]

    @property
    def is_outdated(self) -> bool:
        """True if the text to replace does not occur exactly once."""
        return (ROOT / PACKAGE / self.file).read_text(encoding="utf-8").count(self.right) != 1


def survives(mutation: Mutation) -> bool:
    """Return whether all tests pass despite a mutation.

    Raises
    ------
    SystemExit
        If the tests could not be run.
    """
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / "checkout"
        copy_checkout(copy, mutation.file)
        file = copy / PACKAGE / mutation.file
        text = file.read_text(encoding="utf-8")
        file.write_text(text.replace(mutation.right, mutation.wrong), encoding="utf-8")
        tests = [f"tests/{each}" for each in mutation.tests]
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests],
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
        )
    if done.returncode not in (_PASSED, _FAILED):
        raise SystemExit(f"{mutation.file}: no test was run\n{done.stdout}{done.stderr}")
    return done.returncode == _PASSED


def copy_checkout(copy: Path, file: str) -> None:
    """Copy this checkout and its compiled loops, except those that a change of a file may affect.

    A compiled loop contains functions of other modules, whose changes numba does not notice.
    """
    module = f"{PACKAGE}.{file.removesuffix('.py').replace('/', '.')}"
    stale = (ROOT / PACKAGE / file).parent / "__pycache__"
    has_loops = module in disk_cache.modules()

    def left_out(folder: str, names: list[str]) -> Collection[str]:
        patterns = [*_LEFT_OUT, _COMPILED] if has_loops and Path(folder) == stale else _LEFT_OUT
        return {name for pattern in patterns for name in matching(names, pattern)}

    # Times of files are kept: older versions of numba recognise the source of a loop by its time.
    shutil.copytree(ROOT, copy, ignore=left_out)


def main(wanted: list[str]) -> int:
    """Test all mutations, or those of the given files; return the number that survive."""
    listed = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    every = [Mutation(**each) for each in listed["mutation"]]
    chosen = [each for each in every if not wanted or each.file.startswith(tuple(wanted))]
    if outdated := [each for each in chosen if each.is_outdated]:
        raise SystemExit(
            "\n".join(f"{each.file} must have this text once: {each.right}" for each in outdated)
        )
    survivors = 0
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for mutation, is_alive in zip(chosen, pool.map(survives, chosen), strict=True):
            survivors += is_alive
            verdict = "SURVIVES" if is_alive else "detected"
            print(f"{verdict} {mutation.file}: {mutation.wrong.strip()}", flush=True)
    print(f"{survivors} of {len(chosen)} survive")
    return survivors


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

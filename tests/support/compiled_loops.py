"""Compiled loops that all checkouts of a user with equal sources share.

Numba stores compiled loops beside their sources, where a new checkout has none, and recognises them
by the content of the sources. They are therefore copied from and to a folder of the user's cache
whose name depends on this content and on the versions of the compiler.
"""

from __future__ import annotations

import glob
import hashlib
import os
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

from napari_hmrf.compute.compile_cache import disk_cache

try:
    import fcntl
except ImportError:  # without such file locks, a copy may be incomplete
    fcntl = None  # type: ignore[assignment]

#: Compiled loops that no test has used for this time are deleted, in seconds.
_EXPIRY = 30 * 86400
_ROOT = Path(__file__).resolve().parents[2]
_CACHES = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
_SHARED = _CACHES / "napari_hmrf" / "compiled-loops"


def fetch() -> None:
    """Copy compiled loops into a checkout that has none."""
    shared = _SHARED / _digest()
    if shared.is_dir() and not any(_loops(_ROOT)):
        with suppress(OSError), _alone(shared):
            os.utime(shared)
            _copy(_loops(shared), shared, _ROOT)


def share() -> None:
    """Copy the compiled loops of this checkout to the user's cache, and delete old ones there."""
    shared = _SHARED / _digest()
    with suppress(OSError):  # the cache may be full or read-only
        shared.mkdir(parents=True, exist_ok=True)
        with _alone(shared):
            _copy(_loops(_ROOT), _ROOT, shared)
    for folder in _SHARED.iterdir() if _SHARED.is_dir() else ():
        if time.time() - folder.stat().st_mtime > _EXPIRY:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Run the block in at most one process at a time."""
    with folder.joinpath("lock").open("w") as held:
        if fcntl is not None:
            fcntl.flock(held, fcntl.LOCK_EX)
        yield


@cache
def _digest() -> str:
    """Return a digest of the sources of all loops, and of the versions of the compiler."""
    compiler = (sys.version, *map(version, ("numba", "llvmlite", "numpy")))
    made = hashlib.sha256("\n".join(compiler).encode())
    for name in disk_cache.modules():
        made.update(_ROOT.joinpath(*name.split(".")).with_suffix(".py").read_bytes())
    return made.hexdigest()[:32]


def _loops(root: Path) -> Iterable[Path]:
    """Return numba's index of each loop in a checkout, or in a folder with its structure."""
    return (root / "napari_hmrf").rglob("*.nbi")


def _codes(index: Path) -> list[Path]:
    """Return the files with the code of a loop for different types, which its index lists."""
    return [*index.parent.glob(f"{glob.escape(index.stem)}.*.nbc")]


def _copy(indices: Iterable[Path], root: Path, target: Path) -> None:
    """Copy loops that another folder lacks, or has for fewer types.

    Checkouts number the types of a loop in the order in which they need them, so an index is of use
    with its own files only.
    """
    for index in indices:
        copied = target / index.relative_to(root)
        if not copied.exists() or len(_codes(copied)) < len(_codes(index)):
            copied.parent.mkdir(parents=True, exist_ok=True)
            copied.unlink(missing_ok=True)
            for file in (*_codes(index), index):
                shutil.copy2(file, copied.with_name(file.name))

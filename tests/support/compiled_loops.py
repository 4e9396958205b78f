"""Compiled loops that all checkouts of a user with equal sources share.

Numba stores compiled loops beside their sources, where a new checkout has none, and recognises them
by the content of the sources. They are therefore copied from and to a folder of the user's cache
whose name depends on this content and on the versions of the compiler.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

from napari_hmrf.solver.backends.compile_cache import disk_cache

#: Compiled loops that no test has used for this time are deleted, in seconds.
_EXPIRY = 30 * 86400
_ROOT = Path(__file__).resolve().parents[2]
_CACHES = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
_SHARED = _CACHES / "napari_hmrf" / "compiled-loops"


def fetch() -> None:
    """Copy compiled loops into a checkout that has none."""
    shared = _SHARED / _digest()
    if shared.is_dir() and not any(_compiled(_ROOT)):
        os.utime(shared)
        _copy(_compiled(shared), shared, _ROOT)


def share() -> None:
    """Copy the compiled loops of this checkout to the user's cache, and delete old ones there."""
    _copy(_compiled(_ROOT), _ROOT, _SHARED / _digest())
    for folder in _SHARED.iterdir() if _SHARED.is_dir() else ():
        if time.time() - folder.stat().st_mtime > _EXPIRY:
            shutil.rmtree(folder, ignore_errors=True)


@cache
def _digest() -> str:
    """Return a digest of the sources of all loops, and of the versions of the compiler."""
    compiler = (sys.version, *map(version, ("numba", "llvmlite", "numpy")))
    made = hashlib.sha256("\n".join(compiler).encode())
    for name in disk_cache.modules():
        made.update(_ROOT.joinpath(*name.split(".")).with_suffix(".py").read_bytes())
    return made.hexdigest()[:32]


def _compiled(root: Path) -> Iterable[Path]:
    """Return the files of numba in a checkout, or in a folder with its structure."""
    return (root / "napari_hmrf").rglob("*.nb[ci]")


def _copy(files: Iterable[Path], root: Path, target: Path) -> None:
    """Copy files that another folder lacks, or has in an older version, each as a whole."""
    with suppress(OSError):  # the cache may be full or read-only
        for file in files:
            copied = target / file.relative_to(root)
            if not copied.exists() or copied.stat().st_mtime < file.stat().st_mtime:
                copied.parent.mkdir(parents=True, exist_ok=True)
                part = copied.with_suffix(f".{os.getpid()}")
                shutil.copy2(file, part)
                part.replace(copied)

"""Compiled loops that checkouts with equal sources share.

Numba stores compiled loops beside their source, and discards them if the modification time of the
source has changed, as in each new checkout. It also keeps a loop whose callee in another file has
changed. Here each source gets a modification time that depends on its content and on the content of
the loops that it imports, and compiled loops are copied from and to a folder of the user's cache.
"""

from __future__ import annotations

import ast
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
#: Modification times of sources are between these times, in seconds since 1970.
_FIRST, _LAST = 10**9, 1_600_000_000
#: Versions on which compiled code depends.
_VERSIONS = (sys.version, *(version(name) for name in ("numba", "llvmlite", "numpy")))
_CACHES = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
_SHARED = _CACHES / "napari_hmrf" / "compiled-loops"
_ROOT = Path(__file__).resolve().parents[2]


def fetch() -> None:
    """Set the modification times of all sources of loops, and copy their compiled loops here."""
    for source in _sources():
        digest = _digest(source)
        stamp = _FIRST + int(digest, 16) % (_LAST - _FIRST)
        if source.stat().st_mtime != stamp:
            os.utime(source, (stamp, stamp))
        shared = _SHARED / digest
        if shared.is_dir() and not any(_compiled(source)):
            os.utime(shared)
            _copy(shared.iterdir(), source.parent / "__pycache__")


def share() -> None:
    """Copy the compiled loops of this checkout to the user's cache; delete those of old sources."""
    for source in _sources():
        _copy(_compiled(source), _SHARED / _digest(source))
    for folder in _SHARED.iterdir() if _SHARED.is_dir() else ():
        if time.time() - folder.stat().st_mtime > _EXPIRY:
            shutil.rmtree(folder, ignore_errors=True)


def _sources() -> list[Path]:
    """Return the sources of all loops."""
    return [_path(name) for name in disk_cache.modules()]


def _path(module: str) -> Path:
    return _ROOT.joinpath(*module.split(".")).with_suffix(".py")


@cache
def _digest(source: Path) -> str:
    """Return a digest of a source, the sources of loops that it imports, and the compiler."""
    made = hashlib.sha256("\n".join(_VERSIONS).encode())
    for path in sorted(_closure(source)):
        made.update(path.read_bytes())
    return made.hexdigest()[:32]


def _closure(source: Path) -> set[Path]:
    """Return a source and all sources of loops that it imports, directly or not."""
    sources, found, waiting = set(_sources()), set(), [source]
    while waiting:
        path = waiting.pop()
        if path in found:
            continue
        found.add(path)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{each.name}" for each in node.names)]
                waiting += sources & set(map(_path, names))
    return found


def _compiled(source: Path) -> list[Path]:
    """Return the files of numba for the loops of a source."""
    return list((source.parent / "__pycache__").glob(f"{source.stem}.*.nb[ci]"))


def _copy(files: Iterable[Path], folder: Path) -> None:
    """Copy files that a folder lacks, or has in an older version, each as a whole."""
    with suppress(OSError):  # the cache may be full or read-only
        for file in files:
            folder.mkdir(parents=True, exist_ok=True)
            target = folder / file.name
            if not target.exists() or target.stat().st_mtime < file.stat().st_mtime:
                part = folder / f"{file.name}.{os.getpid()}"
                shutil.copy2(file, part)
                part.replace(target)

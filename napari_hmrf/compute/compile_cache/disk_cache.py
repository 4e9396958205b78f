"""Disk cache of compiled loops: cache folder, and files that mark loops as compiled."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import sys
import tempfile
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGE = "napari_hmrf"
#: Package that contains the loops of the solver, and its folder.
_SOLVER = f"{_PACKAGE}.solver.backends.cpu"
_LOOPS = Path(__file__).parents[2].joinpath("solver", "backends", "cpu")
#: Texts of which each file with compiled functions contains one: modules of their decorators.
_SOURCES_OF_DECORATORS = b"numba", b"cpu.compiled"
#: Modules of loops that warp pictures.
PICTURES = (f"{_PACKAGE}.field.interpolation", f"{_PACKAGE}.field.triangle_raster")
#: Environment variable that sets numba's cache folder.
_CACHE_VARIABLE = "NUMBA_CACHE_DIR"
#: Free space required in a cache folder, and size of the file used to test writing, in bytes.
_ROOM, _PROBE = 2**27, 2**16
#: Modules through which all loops are compiled.
_DECORATORS = tuple(
    f"{_PACKAGE}.compute.compile_cache.{name}" for name in ("decorators", "threaded")
)
#: Modules of loops that are not in the solver's folder of loops.
_OTHERS = (
    *_DECORATORS,
    *PICTURES,
    f"{_PACKAGE}.field.tetrahedron_raster",
    f"{_PACKAGE}.field.volume_loops",
)


@cache
def modules() -> tuple[str, ...]:
    """Return the names of all modules that may contain loops."""
    return (
        *_OTHERS,
        *(f"{_SOLVER}.{path.stem}" for path in _files(_LOOPS) if path.stem != "__init__"),
    )


def _files(folder: Path) -> list[Path]:
    """Return the source files in a folder that contain loops, or functions that loops call."""
    return [
        path
        for path in sorted(folder.glob("*.py"))
        if any(source in path.read_bytes() for source in _SOURCES_OF_DECORATORS)
    ]


@cache
def sources(folder: Path = _LOOPS) -> bytes:
    """Return a digest of all source files in a folder that contain loops."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in _files(folder))).digest()


def stamp(compiled: Any, digest: bytes) -> None:
    """Invalidate the cache of a compiled function also when a digest of other sources changes."""
    with suppress(AttributeError):  # some versions of numba lack these attributes
        file = compiled._cache._cache_file
        file._source_stamp = (file._source_stamp, digest)


def mark(job: str = "") -> Path:
    """Return the file that marks the loops of this version as compiled on this machine.

    Parameters
    ----------
    job : str
        Job of `napari_hmrf.compiling` that compiled the loops; by default, all jobs.
    """
    return folder() / f"loops-{_key()}-{job or 'all'}.compiled"


def compiled(job: str) -> bool:
    """Return whether the loops of a job are compiled, by that job or by the job of all loops."""
    return mark().exists() or mark(job).exists()


@cache
def folder() -> Path:
    """Return the cache folder; redirect numba if its default folder is full or read-only."""
    configured, beside = os.environ.get(_CACHE_VARIABLE, ""), _LOOPS / "__pycache__"
    caches = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    places = [*([Path(configured)] if configured else []), beside, caches / _PACKAGE]
    found = next(filter(_writable, places), None) or _temporary()
    chosen = "" if found == beside else str(found)  # the default is next to the source files
    if chosen != configured:
        _redirect_numba(chosen)
    return found


def _redirect_numba(folder: str) -> None:
    """Set numba's cache folder for this process and its child processes."""
    os.environ[_CACHE_VARIABLE] = folder
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = folder


def _writable(folder: Path) -> bool:
    """Return whether a folder is writable and has enough free space; create it if needed."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_PROBE))
        return shutil.disk_usage(folder).free > _ROOM
    except OSError:
        return False


def _temporary() -> Path:
    """Return a temporary folder to which only the current user can write.

    Other users must not be able to write to the folder, because numba executes the cached code.
    """
    user = getattr(os, "getuid", lambda: "user")()
    found = Path(tempfile.gettempdir()) / f"napari-hmrf-{user}"
    with suppress(OSError):
        found.mkdir(mode=0o700, exist_ok=True)
        status = found.lstat()
        if not found.is_symlink() and status.st_uid == user and not status.st_mode & 0o077:
            return found
    return Path(tempfile.mkdtemp(prefix="napari-hmrf-"))


@cache
def _key() -> str:
    """Return a digest of the source files of all loops, the compiler versions and the system."""
    made = hashlib.sha256(sources())
    for name in _OTHERS:
        made.update(_LOOPS.parents[3].joinpath(*name.split(".")).with_suffix(".py").read_bytes())
    for package in ("numba", "llvmlite", "numpy"):
        with suppress(PackageNotFoundError):
            made.update(version(package).encode())
    # The optimization flag matters because optimization removes docstrings and assertions.
    system = (sys.version, str(sys.flags.optimize), platform.machine(), platform.node())
    made.update("\n".join((*system, str(_LOOPS))).encode())
    return made.hexdigest()[:16]

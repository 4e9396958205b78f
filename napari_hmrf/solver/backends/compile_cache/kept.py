"""Cache of compiled loops on disk: its folder, and the marks of loops that are compiled."""

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

from napari_hmrf.solver.backends.compile_cache import sets

_PACKAGE = "napari_hmrf"
#: Package of the loops of the solver, and its folder.
_SOLVER = f"{_PACKAGE}.solver.backends.cpu"
_LOOPS = Path(__file__).parents[1] / "cpu"
#: Modules of loops that move pictures.
PICTURES = (f"{_PACKAGE}.field.interpolation", f"{_PACKAGE}.field.triangle_raster")
#: Environment variable with numba's cache folder.
_TOLD = "NUMBA_CACHE_DIR"
#: Free bytes that are enough for all loops, and bytes that are written to test a folder.
_ROOM, _PROBE = 2**27, 2**16
#: Modules of all loops that move anything.
_MOTION = (
    *PICTURES,
    f"{_PACKAGE}.field.tetrahedron_raster",
    f"{_PACKAGE}.field.volume_loops",
)


@cache
def modules() -> tuple[str, ...]:
    """Return the names of all modules that may have loops."""
    return (
        *_MOTION,
        *(f"{_SOLVER}.{path.stem}" for path in _files(_LOOPS) if path.stem != "__init__"),
    )


def _files(folder: Path) -> list[Path]:
    """Return the source files of loops in a folder."""
    return [path for path in sorted(folder.glob("*.py")) if b"numba" in path.read_bytes()]


@cache
def sources(folder: Path = _LOOPS) -> bytes:
    """Return a digest of all source files of loops."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in _files(folder))).digest()


def mark(job: str = "") -> Path:
    """Return the file that marks the loops of this version as compiled, for this machine.

    Parameters
    ----------
    job : str
        The loops of one job of `napari_hmrf.compiling`; by default, all of them.
    """
    return folder() / f"loops-{_key()}{job and '-'}{job}.compiled"


def compiled(job: str) -> bool:
    """Return whether the loops of a job are compiled, by the job itself or by a full run."""
    return (job not in sets.ON_REQUEST and mark().exists()) or mark(job).exists()


@cache
def folder() -> Path:
    """Return numba's cache folder; redirect numba if it would choose a place without room."""
    told, beside = os.environ.get(_TOLD, ""), _LOOPS / "__pycache__"
    caches = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    places = [*([Path(told)] if told else []), beside, caches / _PACKAGE]
    found = next(filter(_writable, places), None) or _temporary()
    chosen = "" if found == beside else str(found)  # numba's own first choice is beside the source
    if chosen != told:
        _redirect_numba(chosen)
    return found


def _redirect_numba(folder: str) -> None:
    """Let numba keep loops in a folder, in this process and in its child processes."""
    os.environ[_TOLD] = folder
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = folder


def _writable(folder: Path) -> bool:
    """Return whether a folder, which is created if needed, can be written to and has room."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_PROBE))
        return shutil.disk_usage(folder).free > _ROOM
    except OSError:
        return False


def _temporary() -> Path:
    """Return a folder for this user alone: loops that others could write would be executed."""
    who = getattr(os, "getuid", lambda: "user")()
    found = Path(tempfile.gettempdir()) / f"napari-hmrf-{who}"
    with suppress(OSError):
        found.mkdir(mode=0o700, exist_ok=True)
        about = found.lstat()
        if not found.is_symlink() and about.st_uid == who and not about.st_mode & 0o077:
            return found
    return Path(tempfile.mkdtemp(prefix="napari-hmrf-"))


@cache
def _key() -> str:
    """Return a digest of the sources of loops, their compiler and the system."""
    made = hashlib.sha256(sources())
    for name in _MOTION:
        made.update(_LOOPS.parents[3].joinpath(*name.split(".")).with_suffix(".py").read_bytes())
    for package in ("numba", "llvmlite", "numpy"):
        with suppress(PackageNotFoundError):
            made.update(version(package).encode())
    # The flag is part of the key: without docstrings the code of a loop differs.
    system = (sys.version, str(sys.flags.optimize), platform.machine(), platform.node())
    made.update("\n".join((*system, str(_LOOPS))).encode())
    return made.hexdigest()[:16]

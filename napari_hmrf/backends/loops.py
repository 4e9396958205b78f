"""The loops for the processor: whether they are compiled, and having that done meanwhile.

To compile them all takes a minute or more, and beside a window it competes for the interpreter's
lock. So another process does it, at low priority. Numba keeps on disk what it has made, and a mark
beside it says that all of it is there. Until then shaders solve, and `napari_hmrf.backends.arrays`
does the host's part.

With ``NAPARI_HMRF_COMPILE=here`` in the environment no other process is started: whoever needs a
loop compiles it, and waits. That is for batches, and for tests.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

from napari_hmrf.backends.thread import in_child_of_fork

_HERE = "NAPARI_HMRF_COMPILE"
_LOOPS = Path(__file__).parent / "cpu"
#: What the other process runs.
COMPILER = "napari_hmrf.compiling"


class _State:
    """What this process knows."""

    in_use = False
    compiler: subprocess.Popen[bytes] | None = None


@cache
def sources(folder: Path = _LOOPS) -> bytes:
    """A digest of all files of loops."""
    contents = (path.read_bytes() for path in sorted(folder.glob("*.py")))
    return hashlib.sha256(b"".join(each for each in contents if b"numba" in each)).digest()


def in_use() -> bool:
    """Whether this process computes with loops, or would compile them itself."""
    return _State.in_use or os.environ.get(_HERE) == "here"


def use() -> None:
    """Compute with loops from now on, compiled or not."""
    _State.in_use = True


def ready() -> bool:
    """Whether loops can be computed with at once; if so, they are from now on."""
    if not in_use() and mark().exists():
        use()
    return in_use()


def mark() -> Path:
    """The file that says that all loops of this version are compiled, for this machine."""
    return _folder() / f"loops-{_key()}.compiled"


def compile_meanwhile() -> None:
    """Have another process compile the loops, unless one does."""
    if in_use() or _State.compiler is not None or _someone_compiles():
        return
    with suppress(OSError):  # then there will be no loops
        _State.compiler = _started([sys.executable, "-m", COMPILER])
        atexit.register(_State.compiler.terminate)


def _started(command: list[str]) -> subprocess.Popen[bytes]:
    """Start a process that says nothing."""
    silent = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent)


def begin() -> bool:
    """Say that this process is the one that compiles; False if another is."""
    if _someone_compiles():
        return False
    try:
        _folder().mkdir(parents=True, exist_ok=True)
        number = os.getpid()
        _compiler_file().write_text(f"{number} {_begun(number)}", encoding="utf-8")
    except OSError:
        return False
    with suppress(psutil.Error, OSError):
        idle = getattr(psutil, "IDLE_PRIORITY_CLASS", 19)
        psutil.Process().nice(idle)
    return True


def end(compiled: bool) -> None:
    """Say that this process has done with compiling."""
    with suppress(OSError):
        if compiled:
            mark().touch()
        _compiler_file().unlink(missing_ok=True)


def _someone_compiles() -> bool:
    """Whether the process that last began to compile is still there, and no other by its number."""
    try:
        number, begun = _compiler_file().read_text(encoding="utf-8").split()
        return number != str(os.getpid()) and _begun(int(number)) == begun
    except (OSError, ValueError, psutil.Error):
        return False


def _begun(number: int) -> str:
    """When a process began."""
    return f"{psutil.Process(number).create_time():.0f}"


def _compiler_file() -> Path:
    return _folder() / f"loops-{_key()}.compiler"


def _folder() -> Path:
    """Where numba is told to keep loops, or keeps them by itself."""
    told = os.environ.get("NUMBA_CACHE_DIR")
    if told:
        return Path(told)
    beside = _LOOPS / "__pycache__"
    if os.access(beside if beside.exists() else _LOOPS, os.W_OK):
        return beside
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "napari-hmrf"


@cache
def _key() -> str:
    """What loops are compiled from, by and for."""
    made = hashlib.sha256(sources())
    for package in ("numba", "llvmlite", "numpy"):
        with suppress(PackageNotFoundError):
            made.update(version(package).encode())
    about = (sys.version, platform.machine(), platform.node(), str(_LOOPS))
    made.update("\n".join(about).encode())
    return made.hexdigest()[:16]


def _forget_compiler() -> None:
    """In the child of a fork: the compiler is the parent's."""
    _State.compiler = None


in_child_of_fork(_forget_compiler)

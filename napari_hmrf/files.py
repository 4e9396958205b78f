"""Saving a solution to one file, and reading it back without trusting the file.

The file is a NumPy archive (.npz) of plain arrays and one text: a header in JSON that says what was
run. Nothing in it can run code. Before anything is read the archive's own table and each array's
header are checked against what a solution may hold, so that a damaged, foreign or hostile file
costs one clear error and no memory.
"""

from __future__ import annotations

import errno
import io
import json
import os
import secrets
import time
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import FileFormatError
from napari_hmrf.optimizers.base import LevelRun
from napari_hmrf.solution import Provenance, Solution

FORMAT = "napari-hmrf solution"
#: Raised when a file of this format could be misread by an older version; older files stay valid.
SCHEMA = 1
#: No member may be larger, in bytes: a field of 16384 x 16384 sites.
MAX_BYTES = 2 * 16384**2 * 4
#: A field of one value packs 1000 to 1. Up to this size that is harmless, beyond it a trap.
_HARMLESS_BYTES = 256 * 2**20
_MAX_RATIO = 100

# What a solution holds: the dtype and number of axes of each member.
_ARRAYS: dict[str, tuple[np.dtype[Any], int]] = {
    "displacement": (np.dtype("<f4"), 3),
    "energy": (np.dtype("<f8"), 1),
    "tissue": (np.dtype("?"), 2),
}
_HEADER = "header"
_HEADER_BYTES = 2**20
_TEMPORARY = ".napari-hmrf-"
_ABANDONED_AFTER = 3600.0

# What zipfile, zlib, NumPy and JSON raise on bytes that are not what they claim to be.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    AttributeError,
    OverflowError,
    NotImplementedError,
    RecursionError,
    RuntimeError,
    MemoryError,
    SyntaxError,
)


def save_solution(solution: Solution, path: str | os.PathLike[str]) -> Path:
    """Save a solution to one .npz file.

    The file is complete or not there: it is written beside its destination, read back, and only
    then given its name. A file that was there before survives until that moment.

    Parameters
    ----------
    solution : Solution
    path : str or path-like
        Taken as it is; ".npz" is added only if the name has no suffix.

    Returns
    -------
    Path
        The file that was written.

    Raises
    ------
    OSError
        If the folder is missing or the file cannot be written (`FileNotFoundError`,
        `PermissionError`...); the message names the file.
    TypeError, ValueError
        If the solution could not be read back: its frame or parameters hold something that is not
        of a JSON type, or its parts disagree.
    """
    target = Path(os.path.realpath(path))
    if not target.suffix:
        target = target.with_name(target.name + ".npz")
    if target.is_dir():
        raise IsADirectoryError(f"cannot save {target.name!r}: it is a folder")
    content = _packed(solution)
    temporary = target.with_name(f"{_TEMPORARY}{secrets.token_hex(8)}.tmp")
    try:
        _remove_abandoned(target.parent)
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if temporary.read_bytes() != content:
            raise OSError(f"cannot save {target.name!r}: the disk did not keep what was written")
        _rename(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        if error.errno is None:
            raise
        raise type(error)(
            error.errno, f"cannot save the result: {error.strerror}", str(target)
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
    return target


def load_solution(path: str | os.PathLike[str]) -> Solution:
    """Read a solution back.

    Parameters
    ----------
    path : str or path-like
        A file written by `save_solution`, of this or an earlier version.

    Returns
    -------
    Solution
        Exactly what was saved (sequences in parameters and frame come back as lists).

    Raises
    ------
    FileFormatError
        If it is anything else, or damaged.
    OSError
        If it cannot be opened (`FileNotFoundError`, `PermissionError`).
    """
    if os.path.isdir(path):
        raise _refusal(path, "it is a folder")
    with open(path, "rb") as file:
        try:
            return _unpacked(file)
        except _Invalid as error:
            raise _refusal(path, str(error)) from None
        except _DAMAGE:
            raise _refusal(path, "it is damaged or incomplete") from None
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            # The archive's table points to before the beginning of the file.
            raise _refusal(path, "it is damaged or incomplete") from None


def _refusal(path: str | os.PathLike[str], reason: str) -> FileFormatError:
    return FileFormatError(f"{Path(path).name}: not a valid napari-hmrf result: {reason}")


def is_solution_file(path: str | os.PathLike[str]) -> bool:
    """Tell, by reading little of it, whether a file says that it is a saved solution.

    True too for one that is damaged elsewhere or written by a later version: `load_solution` then
    says what is wrong.
    """
    try:
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            return bool(_header(archive)["format"] == FORMAT)
    except (OSError, *_DAMAGE):
        return False


class _Invalid(ValueError):
    """The reason why a file is not a solution, in words for its user."""


def _packed(solution: Solution) -> bytes:
    header = {
        "format": FORMAT,
        "schema": SCHEMA,
        "spacing": [float(size) for size in solution.spacing],
        "levels": [
            {"number": run.number, "shape": list(run.shape), "iterations": run.iterations}
            for run in solution.levels
        ],
        "provenance": asdict(solution.provenance),
        "frame": solution.frame,
    }
    file = io.BytesIO()
    np.savez_compressed(
        file,
        header=np.array(json.dumps(header, ensure_ascii=False)),
        displacement=_of_kind("displacement", solution.displacement),
        energy=_of_kind("energy", solution.energy),
        tissue=_of_kind("tissue", solution.tissue),
    )
    content = file.getvalue()
    try:
        _unpacked(io.BytesIO(content))
    except _Invalid as error:  # what could not be read back must not replace what could
        raise ValueError(f"this solution cannot be saved: {error}") from None
    return content


def _of_kind(member: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.asarray(array).astype(_ARRAYS[member][0])


def _unpacked(file: BinaryIO) -> Solution:
    with zipfile.ZipFile(file) as archive:
        header = _header(archive)
        if header["format"] != FORMAT:
            raise _Invalid("it is another kind of file")
        schema = header["schema"]
        if not isinstance(schema, int) or schema < 1:
            raise _Invalid(f"its version is {schema!r}")
        if schema > SCHEMA:
            raise _Invalid(
                f"it was written by a later version (format {schema}, this one reads up to "
                f"{SCHEMA}); update napari-hmrf"
            )
        _check_members(archive)
        arrays = {member: _array(archive, member, *kind) for member, kind in _ARRAYS.items()}
    return _solution(header, **arrays)


def _solution(
    header: Mapping[str, Any],
    displacement: npt.NDArray[Any],
    energy: npt.NDArray[Any],
    tissue: npt.NDArray[Any],
) -> Solution:
    levels = tuple(
        LevelRun(
            int(run["number"]), tuple(int(size) for size in run["shape"]), int(run["iterations"])
        )
        for run in header["levels"]
    )
    spacing = tuple(float(size) for size in header["spacing"])
    if displacement.shape != (*tissue.shape, tissue.ndim) or displacement.size == 0:
        raise _Invalid(f"its displacement {displacement.shape} and tissue {tissue.shape} disagree")
    if len(spacing) != tissue.ndim or not all(0 < size < float("inf") for size in spacing):
        raise _Invalid(f"its pixel spacing is {spacing}")
    if not np.isfinite(displacement).all():
        raise _Invalid("its displacement holds values that are not numbers")
    if len(energy) != sum(run.iterations for run in levels):
        raise _Invalid("its energies and iterations disagree")
    frame = header["frame"]
    if frame is not None and not isinstance(frame, dict):
        raise _Invalid("its frame is not a table")
    given, known = header["provenance"], {field.name for field in fields(Provenance)}
    return Solution(
        displacement=displacement.astype(np.float32, copy=False),
        energy=energy.astype(np.float64, copy=False),
        levels=levels,
        tissue=tissue,
        spacing=spacing,
        provenance=Provenance(**{field: given[field] for field in known & given.keys()}),
        frame=frame,
    )


def _header(archive: zipfile.ZipFile) -> Mapping[str, Any]:
    """What the file says about itself: the one member that tells a foreign file from a damaged."""
    if f"{_HEADER}.npy" not in archive.namelist():
        raise _Invalid("it is another kind of file")
    header = json.loads(_array(archive, _HEADER, None, 0).item())
    if not isinstance(header, dict) or "format" not in header:
        raise _Invalid("it is another kind of file")
    return header


def _check_members(archive: zipfile.ZipFile) -> None:
    """No member may lack, be there twice, or be one that no solution has."""
    names = sorted(archive.namelist())
    expected = sorted(f"{member}.npy" for member in (_HEADER, *_ARRAYS))
    if names != expected:
        missing, odd = set(expected) - set(names), set(names) - set(expected)
        what = [f"lacks {name!r}" for name in sorted(missing)]
        what += [f"holds {name!r}, which no solution does" for name in sorted(odd)]
        raise _Invalid(f"it {what[0]}" if what else "it holds one thing twice")


def _array(
    archive: zipfile.ZipFile, member: str, dtype: np.dtype[Any] | None, ndim: int
) -> npt.NDArray[Any]:
    """One array, read only after its header said that it is what a solution holds.

    Without a `dtype` it must be text, of at most a mebibyte.
    """
    info = archive.getinfo(f"{member}.npy")
    cap = MAX_BYTES if dtype is not None else _HEADER_BYTES
    ratio = info.file_size / max(1, info.compress_size)
    if info.file_size > cap or (info.file_size > _HARMLESS_BYTES and ratio > _MAX_RATIO):
        raise _Invalid(
            f"its {member} claims {info.file_size} bytes from {info.compress_size}, more than a "
            "solution may hold"
        )
    with archive.open(info) as stream:
        shape, found, offset = _peek(stream)
    right = found.kind == "U" if dtype is None else found == dtype
    if not right or found.hasobject or len(shape) != ndim:
        wanted = "text" if dtype is None else f"{dtype} on {ndim} axes"
        raise _Invalid(f"its {member} is {found} of shape {shape}, not {wanted}"[:200])
    size = found.itemsize
    for length in shape:
        size *= int(length)
    if size + offset != info.file_size:
        raise _Invalid(f"its {member} claims a shape of {shape}, which is not what it holds")
    # Reading the member whole compares its checksum, which reading just the array does not.
    array: npt.NDArray[Any] = np.lib.format.read_array(
        io.BytesIO(archive.read(info)), allow_pickle=False
    )
    return array


def _peek(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """The shape and dtype an array claims, and where its values begin."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise _Invalid(f"its arrays are of format {version}")
    if any(length < 0 for length in shape):
        raise _Invalid(f"it claims a shape of {shape}")
    return shape, dtype, stream.tell()


def _rename(temporary: Path, target: Path) -> None:
    """Replace in one step; on Windows whoever has the old file open makes that fail for a while."""
    for attempt in range(6):
        try:
            os.replace(temporary, target)
            return
        except PermissionError:
            if attempt == 5:
                raise
            time.sleep(0.1)


def _sync_folder(folder: Path) -> None:
    """Have the new name itself on disk, where the system knows how."""
    if os.name != "posix":
        return
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _remove_abandoned(folder: Path) -> None:
    """Remove what a process that was killed while saving left behind."""
    for path in folder.glob(f"{_TEMPORARY}*.tmp"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _ABANDONED_AFTER:
                path.unlink()

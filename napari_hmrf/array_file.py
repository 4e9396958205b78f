"""Archive of plain arrays and a header, written atomically and validated when it is read.

The file is a NumPy archive (.npz) with a header in JSON. Reading a file never executes code from
the file. Before any array is decompressed, the table of contents, the header, and the declared
types and shapes of all arrays are checked against the format. A damaged, foreign or malicious file
is therefore rejected with an error before memory is allocated for its arrays.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path, checked_target
from napari_hmrf.atomic_write import is_stream, write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.regular_file import refuse_irregular

T = TypeVar("T")
Header = Mapping[str, Any]
Arrays = Mapping[str, npt.NDArray[Any]]

#: Largest size of an array, in bytes: two components on 16384 x 16384 sites.
MAX_BYTES = 2 * 16384**2 * 4
#: Largest size, in bytes, of an array with an unrestricted compression ratio; the ratio of a
#: constant field is about 1000. A larger array with a ratio above `_MAX_RATIO` is rejected as a
#: decompression bomb.
_HARMLESS_BYTES = 256 * 2**20
#: Largest compression ratio of an array larger than `_HARMLESS_BYTES`.
_MAX_RATIO = 100
#: Number of bytes decompressed at a time.
_PIECE = 2**20
#: Largest possible compression ratio of deflate, which is 1032, plus a margin.
_MOST_PACKED = 1100
#: Largest total size of all arrays of a file, in bytes.
_MAX_TOTAL = 4 * MAX_BYTES


def is_finite(array: npt.NDArray[Any]) -> bool:
    """Return whether all values are finite, without a temporary array of the full size."""
    if array.size and not any(array.strides):  # a broadcast scalar
        return bool(np.isfinite(array[(0,) * array.ndim]))
    return all(np.isfinite(part).all() for part in array)


class Kind(NamedTuple):
    """Requirements for one of the arrays in a file.

    Attributes
    ----------
    dtypes : tuple of str
        Allowed dtypes in NumPy's notation, little-endian. If only one dtype is allowed, the array
        is converted to it when it is saved; otherwise its dtype is preserved.
    axes : tuple of int
        Allowed numbers of axes.
    optional : bool
        True if the array may be missing.
    """

    dtypes: tuple[str, ...]
    axes: tuple[int, ...]
    optional: bool = False


_HEADER = "header"
#: Requirements for the header, a 0-dimensional array of text.
_TEXT = Kind(("U",), (0,))
#: Largest size of the header, in bytes: 2 million characters, or about 50,000 points of strokes.
_HEADER_BYTES = 2**23
#: Largest nesting depth of lists and dictionaries in the header.
_DEEPEST = 32

# First bytes of an archive.
_ZIP = b"PK"
# First bytes of an array in NumPy's format: https://numpy.org/neps/nep-0001-npy-format.html
_NPY = b"\x93NUMPY"
_NPY_HEADER = re.compile(
    rb"\{'descr': '([<>|][biufcmMOSUV]\d{0,9})', 'fortran_order': (True|False), "
    rb"'shape': \(([\d, ]{0,99})\), \} *\n"
)

# Errors that zipfile, zlib, NumPy and JSON raise on invalid bytes.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
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
)


class Invalid(ValueError):
    """Error raised for a file that violates its format; the message states the reason."""


class _TooLarge(Invalid):
    """Error raised for a member of a file that is larger than the format allows.

    Attributes
    ----------
    advice : str
        Reason and remedy, for the message of a writer.
    """

    def __init__(self, member: str, info: zipfile.ZipInfo) -> None:
        size = info.file_size
        super().__init__(
            f"its {member} declares {size} bytes ({info.compress_size} compressed), more than such "
            "a file may contain"
        )
        if member == _HEADER:
            self.advice = (
                f"its drawing, tables and notes take {size / 1e6:.1f} MB of text, and a file can "
                f"contain {_HEADER_BYTES / 1e6:.1f} MB. Remove marks or rows of tables, then save "
                "it again."
            )
        else:
            self.advice = (
                f"its {member}, of {size / 1e6:.0f} MB, is too large for a file. Use a smaller or "
                "coarser image."
            )


@dataclass(frozen=True)
class Format(Generic[T]):
    """Definition of a file format.

    Attributes
    ----------
    name : str
        Identifier of the format, stored in each file.
    schema : int
        Version number of the format. It is increased when earlier versions of the package could
        misread new files. Files with a lower version number can still be read.
    kind_name : str
        Name of the kind of file in error messages: "<file>: not a valid <kind>: <reason>".
    arrays : mapping of str to Kind
        Requirements for each array that a file may contain, by name.
    describe : callable
        Converts the object to a header of JSON types and a mapping of arrays.
    parse : callable
        Creates the object from the header and the arrays. Raises `Invalid` if they are
        inconsistent.
    precheck : callable, optional
        Called before any array is decompressed. Its arguments are the header and arrays of zeros
        that have the declared types and shapes but occupy almost no memory. Raises the same errors
        as `parse`, and may be the same function.
    """

    name: str
    schema: int
    kind_name: str
    arrays: Mapping[str, Kind]
    describe: Callable[[T], tuple[Header, Arrays]]
    parse: Callable[[Header, Arrays], T]
    precheck: Callable[[Header, Arrays], object] | None = None


def write(path: str | os.PathLike[str], form: Format[T], value: T) -> Path:
    """Write an object to a file, atomically.

    An existing file is replaced only when the new file is complete; see `write_whole`.

    Parameters
    ----------
    path : str or path-like
        Path of the file. ".npz" is appended if the name has no suffix, except for FIFOs and
        devices.
    form : Format
        Format of the file.
    value : object
        Object that `form` can describe.

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    OSError
        If the folder does not exist or the file cannot be written; the message names the file.
    TypeError
        If the header contains a value that is not of a JSON type.
    ValueError
        If the object violates the format, so that the file could not be read again.
    """
    target = Path(checked_target(path))
    if not is_stream(target):
        target = Path(os.path.realpath(target))
        if not target.suffix:
            target = target.with_name(target.name + ".npz")
    write_whole(target, _packed(form, value))
    return target


def read(path: str | os.PathLike[str], form: Format[T]) -> T:
    """Read an object from a file.

    Parameters
    ----------
    path : str or path-like
    form : Format
        Expected format of the file.

    Returns
    -------
    object
        Object created by `form.parse`.

    Raises
    ------
    FileFormatError
        If the file is damaged, or does not have this format.
    OSError
        If the file cannot be opened.
    """
    path = checked_path(path)

    def refusal(reason: str) -> FileFormatError:
        return FileFormatError(f"{Path(path).name}: not a valid {form.kind_name}: {reason}")

    if os.path.isdir(path):
        raise refusal("it is a folder")
    refuse_irregular(path)
    if is_foreign(path):
        raise refusal("it is another kind of file")
    with open(path, "rb") as file:
        try:
            return _unpacked(file, form)
        except Invalid as error:
            raise refusal(str(error)) from None
        except _DAMAGE:
            raise refusal("it is damaged or incomplete") from None
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            # The table of contents refers to a negative offset.
            raise refusal("it is damaged or incomplete") from None


def claims_to_be(path: str | os.PathLike[str], form: Format[Any]) -> bool:
    """Return whether the header of a file states a given format.

    Only the header is read. The result is therefore also True if the arrays are damaged, or if the
    file was written by a later version of the package; `read` then raises an error.
    """
    return header_of(path).get("format") == form.name


def is_foreign(path: str | os.PathLike[str]) -> bool:
    """Return whether the first bytes of a file show that it is not an archive.

    The result is False if the file is empty or cannot be read.
    """
    path = checked_path(path)
    try:
        refuse_irregular(path)
        with open(path, "rb") as file:
            start = file.read(len(_ZIP))
    except (OSError, FileFormatError):
        return False
    return not _ZIP.startswith(start)


def header_of(path: str | os.PathLike[str]) -> Header:
    """Return the header of a file of any format, or {} if the header cannot be read."""
    path = checked_path(path)
    try:
        refuse_irregular(path)
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            return _header(archive)
    except (OSError, FileFormatError, *_DAMAGE):
        return {}


def _packed(form: Format[T], value: T) -> bytes:
    header, arrays = form.describe(value)
    whole = {"format": form.name, "schema": form.schema, **header}
    members: dict[str, Any] = {
        name: _as_written(np.asarray(array), form.arrays[name]) for name, array in arrays.items()
    }
    file = io.BytesIO()
    np.savez_compressed(file, header=np.array(json.dumps(whole, ensure_ascii=False)), **members)
    content = file.getvalue()
    try:
        _unpacked(io.BytesIO(content), form)
    except _TooLarge as error:
        raise ValueError(f"this {form.kind_name} cannot be saved: {error.advice}") from None
    except Invalid as error:  # do not replace a valid file with an invalid one
        raise ValueError(f"this {form.kind_name} cannot be saved: {error}") from None
    return content


def _as_written(array: npt.NDArray[Any], kind: Kind) -> npt.NDArray[Any]:
    only = len(kind.dtypes) == 1
    return array.astype(kind.dtypes[0] if only else array.dtype.newbyteorder("<"))


def _unpacked(file: BinaryIO, form: Format[T]) -> T:
    with zipfile.ZipFile(file) as archive:
        header = _header(archive)
        if header["format"] != form.name:
            raise Invalid("it is another kind of file")
        schema = header["schema"]
        if not isinstance(schema, int) or schema < 1:
            raise Invalid(f"its format version is {schema!r}")
        if schema > form.schema:
            raise Invalid(
                f"it was written by a later version (format {schema}, this one reads up to "
                f"{form.schema}); update napari-hmrf"
            )
        _check_members(archive, form)
        members = archive.namelist()
        claims = {
            name: _claim(archive, name, kind)
            for name, kind in form.arrays.items()
            if f"{name}.npy" in members
        }
        if sum(claim.info.file_size for claim in claims.values()) > _MAX_TOTAL:
            raise Invalid("its arrays declare more bytes than such a file may contain")
        if form.precheck is not None:
            form.precheck(header, {name: claim.zeros() for name, claim in claims.items()})
        arrays = {name: claim.read(archive) for name, claim in claims.items()}
    return form.parse(header, arrays)


def _header(archive: zipfile.ZipFile) -> Header:
    """Read the header; raise `Invalid` if it was not written by this package."""
    if f"{_HEADER}.npy" not in archive.namelist():
        raise Invalid("it is another kind of file")
    header = json.loads(_claim(archive, _HEADER, _TEXT).read(archive).item())
    if not isinstance(header, dict) or "format" not in header:
        raise Invalid("it is another kind of file")
    if _is_deep(header):  # copying or saving it could exceed the recursion limit
        raise Invalid(f"its header has more than {_DEEPEST} levels of nesting")
    return header


def _is_deep(value: Any, levels: int = _DEEPEST) -> bool:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return levels < 0 or any(_is_deep(part, levels - 1) for part in parts)


def _check_members(archive: zipfile.ZipFile, form: Format[Any]) -> None:
    """Raise an error if an archive has missing, duplicate or unknown members."""
    names = archive.namelist()
    known = {f"{name}.npy": kind.optional for name, kind in form.arrays.items()}
    needed = {f"{_HEADER}.npy", *(name for name, optional in known.items() if not optional)}
    missing, odd = needed - set(names), set(names) - {f"{_HEADER}.npy", *known}
    if missing or odd or len(names) != len(set(names)):
        faults = [f"lacks {name!r}" for name in sorted(missing)]
        faults += [
            f"contains {name!r}, which does not belong to a {form.kind_name}"
            for name in sorted(odd)
        ]
        raise Invalid(f"it {faults[0]}" if faults else "two of its members have the same name")


class _Claim(NamedTuple):
    """Declared properties of an array, from its header and the archive's table of contents."""

    info: zipfile.ZipInfo
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    order: Literal["C", "F"]
    offset: int

    def zeros(self) -> npt.NDArray[Any]:
        """Return an array of zeros with the declared type and shape, using almost no memory."""
        return np.broadcast_to(np.zeros((), self.dtype), self.shape)

    def read(self, archive: zipfile.ZipFile) -> npt.NDArray[Any]:
        """Read the values of the array and verify its checksum."""
        values = np.empty(self.shape, self.dtype, self.order)
        flat = values.ravel(order="K").view(np.uint8) if values.size else np.empty(0, np.uint8)
        with archive.open(self.info) as stream:
            stream.read(self.offset)
            left = memoryview(flat.data)
            while left:
                count = stream.readinto(left[:_PIECE])  # type: ignore[attr-defined]
                if not count:
                    raise EOFError
                left = left[count:]
            stream.read(1)  # zipfile verifies the checksum at the end of the stream
        return values


def _claim(archive: zipfile.ZipFile, member: str, kind: Kind) -> _Claim:
    """Return the declared type, shape and order of an array, after checking them."""
    info = archive.getinfo(f"{member}.npy")
    cap = _HEADER_BYTES if kind is _TEXT else MAX_BYTES
    ratio = info.file_size / max(1, info.compress_size)
    if info.file_size > cap or (info.file_size > _HARMLESS_BYTES and ratio > _MAX_RATIO):
        raise _TooLarge(member, info)
    if info.header_offset + info.compress_size > archive.start_dir:
        # Otherwise, zipfile would allocate memory for the declared size.
        raise Invalid("it is damaged or incomplete")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        # Other methods allocate memory for the declared size before any data are read.
        raise Invalid(f"its {member} is compressed by a method that napari-hmrf does not support")
    if info.file_size > max(1, info.compress_size) * _MOST_PACKED:
        raise Invalid("it is damaged or incomplete")
    with archive.open(info) as stream:
        dtype, order, shape, offset = _peek(stream)
    is_allowed = dtype.kind == "U" if kind is _TEXT else dtype in map(np.dtype, kind.dtypes)
    if not is_allowed or dtype.hasobject or len(shape) not in kind.axes:
        axes = " or ".join(map(str, kind.axes))
        expected = "text" if kind is _TEXT else f"{' or '.join(kind.dtypes)} on {axes} axes"
        raise Invalid(f"its {member} is {dtype} of shape {shape}, not {expected}"[:200])
    if dtype.itemsize * math.prod(shape) + offset != info.file_size:
        raise Invalid(f"its {member} declares a shape of {shape}, which does not match its size")
    return _Claim(info, dtype, shape, order, offset)


def _peek(stream: IO[bytes]) -> tuple[np.dtype[Any], Literal["C", "F"], tuple[int, ...], int]:
    """Return the declared dtype, order and shape of an array, and the offset of its values."""
    # NumPy's reader parses the header as Python code, which can emit warnings and raise
    # undocumented errors. The headers of plain arrays always have the form of `_NPY_HEADER`.
    start = stream.read(len(_NPY) + 4)
    version = tuple(start[len(_NPY) : -2])
    if start.startswith(_NPY) and version != (1, 0):
        raise Invalid(f"its arrays have the unsupported format version {version}")
    length = int.from_bytes(start[-2:], "little")
    header = _NPY_HEADER.fullmatch(stream.read(length))
    if not start.startswith(_NPY) or header is None:
        raise Invalid("it is damaged or incomplete")
    kind, by_columns, sizes = (each.decode() for each in header.groups())
    shape = tuple(int(size) for size in sizes.split(",") if size)
    return np.dtype(kind), "F" if by_columns == "True" else "C", shape, len(start) + length

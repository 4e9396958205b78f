"""Files of one dataclass: its arrays and a header, in a NumPy archive that is replaced atomically.

The header is JSON text with everything but the arrays; in place of each array, it names a member of
the archive. Reading a file never executes code from the file.
"""

from __future__ import annotations

import errno
import io
import json
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar, Union, get_args

import numpy as np
import numpy.typing as npt
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Discriminator,
    GetCoreSchemaHandler,
    Tag,
    TypeAdapter,
    ValidationError,
    WrapSerializer,
)

from napari_hmrf.arguments import checked_path, checked_target, shown
from napari_hmrf.atomic_write import is_stream, write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.regular_file import refuse_irregular

T = TypeVar("T")
Header = Mapping[str, Any]
Arrays = dict[str, npt.NDArray[Any]]

#: Configuration of the dataclass of a file, its attribute ``__pydantic_config__``.
STORED = ConfigDict(arbitrary_types_allowed=True, extra="forbid")

#: First bytes of an archive.
_ZIP = b"PK"
_HEADER = "header"
#: Size of arrays, in bytes, that any file may contain.
_HARMLESS = 2**30
#: Largest ratio of larger arrays to the size of their file. Images of a scan have a ratio below 10,
#: constant images, as in decompression bombs, of 1000.
_MOST_PACKED = 100
#: Largest nesting depth of a header.
_DEEPEST = 32
#: Errors that zipfile, NumPy and JSON raise on invalid bytes.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    LookupError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    ValueError,
    tokenize.TokenError,
)


class _Invalid(ValueError):
    """Error for content that violates the format; the message follows "not a valid <name>: "."""


class _Foreign(_Invalid):
    """Error for another kind of file."""

    def __init__(self) -> None:
        super().__init__("it is another kind of file")


class ByClass:
    """Annotation of a union of dataclasses: values are stored with the name of their class."""

    def __get_pydantic_core_schema__(self, union: Any, handler: GetCoreSchemaHandler) -> Any:
        """Return the schema of the union."""
        kinds = tuple(
            Annotated[kind, BeforeValidator(_without_class), Tag(kind.__name__)]
            for kind in get_args(union)
        )
        return handler.generate_schema(
            Annotated[
                Union[kinds],  # noqa: UP007 - "|" does not take a tuple
                Discriminator(_class_name),
                WrapSerializer(_with_class),
            ]
        )


def _class_name(value: Any) -> Any:
    return value.get("class") if isinstance(value, Mapping) else type(value).__name__


def _with_class(value: Any, store: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
    return {"class": type(value).__name__, **store(value)}


def _without_class(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: each for key, each in value.items() if key != "class"}
    return value


@dataclass(frozen=True)
class Archive(Generic[T]):
    """Kind of file that contains one object.

    Attributes
    ----------
    name : str
        Name of the kind of file, in each file and in error messages.
    content : type
        Dataclass of the object, with the attribute ``__pydantic_config__ = STORED``. Its fields and
        those of its parts are what a file contains.
    version : int
        Version of the format; files of other versions are refused.
    """

    name: str
    content: type[T]
    version: int = 1

    @cached_property
    def _type(self) -> TypeAdapter[T]:
        return TypeAdapter(self.content)

    def write(self, path: str | os.PathLike[str], value: T) -> Path:
        """Write an object to a file, atomically.

        Parameters
        ----------
        path : str or path-like
            Path of the file. ".npz" is appended if the name has no suffix, except for FIFOs and
            devices.
        value : object

        Returns
        -------
        Path
            The written file.

        Raises
        ------
        OSError
            If the folder does not exist or the file cannot be written; the message names the file.
        TypeError
            If the object contains a value that is neither an array nor of a JSON type.
        ValueError
            If a file with this object could not be read again.
        """
        target = Path(checked_target(path))
        if not target.suffix and not is_stream(target):
            target = target.with_name(f"{target.name}.npz")
        arrays: Arrays = {}

        def store(value: Any, name: str) -> Any:
            if not hasattr(value, "__array__") or isinstance(value, np.generic):
                return value
            arrays[name] = np.asarray(value)
            return {"array": name}

        try:
            fields = _replaced(self._type.dump_python(value, warnings=False), store)
            header = {"format": self.name, "version": self.version, **fields}
            text = json.dumps(header, ensure_ascii=False)
            self._object(json.loads(text), dict(arrays))
        except ValueError as error:  # an earlier file is not replaced by one that is unreadable
            raise ValueError(f"this {self.name} cannot be saved: {error}") from None
        file = io.BytesIO()
        members: dict[str, Any] = {_HEADER: np.array(text), **arrays}
        np.savez_compressed(file, **members)
        if _is_suspicious(sum(each.nbytes for each in members.values()), file.tell()):
            file = io.BytesIO()  # such as a field that moves in a small part of a large volume
            np.savez(file, **members)
        write_whole(target, file.getvalue())
        return target

    def read(self, path: str | os.PathLike[str]) -> T:
        """Read an object from a file.

        Raises
        ------
        FileFormatError
            If the file is damaged, or is another kind of file.
        OSError
            If the file cannot be opened.
        """
        path = Path(checked_path(path))
        reason = "it is damaged or incomplete"
        try:
            if path.is_dir():
                raise _Invalid("it is a folder")
            if is_foreign(path):
                raise _Foreign
            return self._object(*_read(path))
        except _Invalid as error:
            reason = str(error)
        except FileFormatError:
            raise
        except _DAMAGE:
            pass
        except OSError as error:
            if error.errno != errno.EINVAL:  # a negative position in the table of contents
                raise
        raise FileFormatError(f"{path.name}: not a valid {self.name}: {reason}")

    def header(self, path: str | os.PathLike[str]) -> Header:
        """Return the header of a file; {} if it cannot be read, or is of another kind of file.

        The arrays are not read, so that they may be damaged. A file of another version of the
        format has a header.
        """
        path = Path(checked_path(path))
        try:
            header, _ = _read(path, only_header=True)
        except (OSError, FileFormatError, *_DAMAGE):
            return {}
        return header if header["format"] == self.name else {}

    def _object(self, header: Header, arrays: Arrays) -> T:
        """Create the object of a header, and of the arrays that it names."""
        fields = dict(header)
        if fields.pop("format") != self.name:
            raise _Foreign
        if (version := fields.pop("version", None)) != self.version:
            raise _Invalid(
                f"its format has version {shown(version)}, but this version of napari-hmrf reads "
                f"version {self.version}. Use the version of napari-hmrf that wrote it"
            )

        def restore(value: Any, name: str) -> Any:
            if value != {"array": name}:
                return value
            if name not in arrays:
                raise _Invalid(f"it lacks the array {name!r}")
            if arrays[name].dtype.kind not in "biuf":
                raise _Invalid(f"{name}: an array of {arrays[name].dtype}, not of real numbers")
            return arrays.pop(name)

        fields = _replaced(fields, restore)
        if arrays:
            raise _Invalid(f"it contains {min(arrays)!r}, which does not belong to a {self.name}")
        try:
            return self._type.validate_python(fields)
        except ValidationError as error:
            raise _Invalid(first_fault(error)) from None


def first_fault(error: ValidationError) -> str:
    """Return the place and the message of the first error of a validation."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    parts = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
    return ": ".join(filter(None, parts))


def is_foreign(path: str | os.PathLike[str]) -> bool:
    """Return whether the first bytes of a file show that it is not an archive.

    The result is False if the file is empty.

    Raises
    ------
    FileFormatError
        If the path is a pipe or a device.
    OSError
        If the file cannot be opened.
    """
    path = checked_path(path)
    refuse_irregular(path)
    with open(path, "rb") as file:
        return not _ZIP.startswith(file.read(len(_ZIP)))


def is_damaged(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is an archive whose kind is unknown, because its header is damaged."""
    try:
        _read(Path(checked_path(path)), only_header=True)
    except (_Foreign, OSError, FileFormatError):
        return False
    except _DAMAGE:
        return not is_foreign(path)
    return False


def _replaced(value: Any, change: Callable[[Any, str], Any], path: tuple[str, ...] = ()) -> Any:
    """Return nested mappings and lists with values replaced by a function of value and name."""
    if isinstance(value, float):  # most values are coordinates of strokes
        return value
    if len(path) > _DEEPEST:  # pydantic and JSON could exceed the recursion limit
        raise _Invalid(f"{'.'.join(path[:3])}: more than {_DEEPEST} levels of nesting")
    if (changed := change(value, ".".join(path))) is not value:
        return changed
    if isinstance(value, Mapping):
        return {key: _replaced(each, change, (*path, str(key))) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_replaced(each, change, (*path, str(n))) for n, each in enumerate(value)]
    return value


def _is_suspicious(size: int, packed: int) -> bool:
    """Return whether so many bytes in a file of `packed` bytes may be meant to fill the memory."""
    return size > max(_HARMLESS, _MOST_PACKED * packed)


def _read(path: Path, *, only_header: bool = False) -> tuple[Header, Arrays]:
    """Read the header and the arrays of a file."""
    refuse_irregular(path)
    with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if _HEADER not in names:
            raise _Foreign
        if len(set(names)) < len(names):
            raise _Invalid("two of its members have the same name")
        size = sum(info.file_size for info in archive.infolist())
        if _is_suspicious(size, path.stat().st_size):
            raise _Invalid(f"it declares {size} bytes, more than such a file may contain")
        header = json.loads(str(_array(archive, _HEADER).item()))
        if not isinstance(header, dict) or "format" not in header:
            raise _Foreign
        others = [] if only_header else [name for name in names if name != _HEADER]
        return header, {name: _array(archive, name) for name in others}


def _array(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    """Read an array, after comparing its declared size with that of the member."""
    member = archive.getinfo(f"{name}.npy")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        # Other methods allocate memory for the declared size before any data are read.
        raise _Invalid(f"its {name} is compressed by a method that napari-hmrf does not support")
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise _Invalid(f"its {name} has the unsupported format version {version}")
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        if stream.tell() + dtype.itemsize * math.prod(shape) != member.file_size:
            raise _Invalid(f"its {name} declares a shape of {shape}, which does not match its size")
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)

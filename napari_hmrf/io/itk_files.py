"""Reading and writing of NIfTI, MetaImage, NRRD, DICOM and ITK transforms.

nibabel reads NIfTI, SimpleITK the other formats. Damaged files make SimpleITK's readers of HDF5 and
DICOM crash or hang, so these formats are read in a child process, as are formats whose readers were
not tried on damaged files.
"""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

from napari_hmrf.atomic_write import raise_for_space, raise_if_full, temporary_beside
from napari_hmrf.errors import HmrfError
from napari_hmrf.io import itk_reader
from napari_hmrf.io.child_process import ChildDied, call_in_child
from napari_hmrf.io.decoded import Decoded, Unreadable, missing_package
from napari_hmrf.io.nifti import is_nifti, read_nifti, read_nifti_header
from napari_hmrf.regular_file import refuse_irregular

T = TypeVar("T")

#: Held while SimpleITK is used: its library for NRRD keeps errors in a global variable.
_LOCK = threading.Lock()
_HDF5 = (".h5", ".hdf5")
#: Suffixes of formats whose readers in SimpleITK neither crash nor hang on damaged files.
_ROBUST = (".mha", ".mhd", ".nrrd", ".nhdr", *itk_reader.TEXTS)
#: Suffixes of transforms.
_TRANSFORMS = (*_HDF5, *itk_reader.TEXTS, ".mat")
#: Name of the group of transforms in an HDF5 file.
_GROUP = b"TransformGroup"
#: Size of the start of an HDF5 file that contains the names of groups, in bytes.
_START = 2**20


def read_itk_image(source: Path) -> Decoded:
    """Read an image.

    Raises
    ------
    Unreadable
        If the file is not an image, is truncated, or contains fewer pixels than its header states.
    HmrfError
        If nibabel or SimpleITK is required but not installed.
    OSError
        If the file cannot be opened.
    """
    _check_openable(source)
    read = read_nifti if is_nifti(source) else partial(_call, itk_reader.read_pixels)
    return read(source)


def itk_shape(source: Path) -> tuple[int, ...]:
    """Return the number of pixels along each axis, ([z,] y, x), from the header of an image.

    The result is () for a file that is read in a child process, which is started once for each
    file.

    Raises
    ------
    Unreadable, HmrfError, OSError
        As for `read_itk_image`.
    """
    return _head(source)[0] if is_nifti(source) or _is_robust(source) else ()


def read_itk_series(folder: Path) -> Decoded:
    """Read the only series in a folder of DICOM files.

    Raises
    ------
    Unreadable
        As for `read_itk_image`; or if the folder does not contain exactly one series.
    HmrfError
        If SimpleITK is not installed.
    """
    return _call(itk_reader.read_series, folder)


def read_itk_vectors(source: Path) -> Decoded:
    """Read an image of vectors, or the displacement field of a transform.

    Raises
    ------
    Unreadable
        As for `read_itk_image`; or if the numbers of a text file do not match its header.
    HmrfError, OSError
        As for `read_itk_image`.
    """
    if source.suffix.lower() not in _TRANSFORMS:
        return read_itk_image(source)
    _check_openable(source)
    return _call(itk_reader.read_transform, source)


def holds_vectors(source: Path) -> bool:
    """Return whether a file contains a displacement field, from its header alone.

    The result is also True for any transform in an HDF5 file, so that reading the file reports the
    error. It is False if the package that reads the file is not installed.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """
    if source.suffix.lower() in _HDF5:
        _check_openable(source)
        with open(source, "rb") as file:
            return _GROUP in file.read(_START)
    try:
        return _head(source)[1]
    except (Unreadable, HmrfError):
        return False


def encode(target: Path, image: Decoded, suffix: str, *, transform: bool = False) -> bytes:
    """Return the bytes of an image file, which SimpleITK writes to a temporary file.

    Parameters
    ----------
    target : Path
        Target file. The temporary file is created in its folder, so that space is only required on
        one disk.
    image : Decoded
    suffix : str
        Suffix that selects the format.
    transform : bool
        True to write a displacement field as a transform.

    Returns
    -------
    bytes

    Raises
    ------
    HmrfError
        If SimpleITK is not installed.
    OSError
        If the disk is full.
    ValueError
        If SimpleITK does not support such pixels in this format.
    """
    require_simpleitk()
    with temporary_beside(target, suffix) as file:
        try:
            if suffix in _HDF5:
                call_in_child(
                    image.pixels.nbytes, itk_reader.write, file, image, transform=transform
                )
            else:
                with _LOCK:
                    itk_reader.write(file, image, transform=transform)
        except (RuntimeError, NotImplementedError, TypeError, ChildDied):
            file.unlink(missing_ok=True)
            raise_for_space(target, image.pixels.nbytes)
            raise ValueError(f"such pixels cannot be written as {suffix}") from None
        content = file.read_bytes()
        raise_if_full(target, file)
        return content


def require_simpleitk() -> None:
    """Raise an error if SimpleITK is not installed, without importing SimpleITK.

    Raises
    ------
    HmrfError
        If SimpleITK is not installed.
    """
    if not has_simpleitk():
        raise missing_package("SimpleITK")


def has_simpleitk() -> bool:
    """Return whether SimpleITK is installed, without importing SimpleITK."""
    try:
        return importlib.util.find_spec("SimpleITK") is not None
    except ValueError:  # the entry in `sys.modules` has no spec
        return False


def _call(function: Callable[[Path], T], source: Path) -> T:
    """Call a function of `itk_reader`, in a child process if the file may crash or hang it."""
    require_simpleitk()
    try:
        if _is_robust(source):
            with _LOCK:
                return function(source)
        return call_in_child(_bytes_in(source), function, source)
    except RuntimeError:
        raise Unreadable("") from None
    except (ChildDied, MemoryError):
        raise Unreadable(
            "decoding it crashes, does not finish or takes too much memory, so it is probably "
            "damaged"
        ) from None


def _is_robust(source: Path) -> bool:
    return source.suffix.lower() in _ROBUST and not source.is_dir()


def _bytes_in(source: Path) -> int:
    """Return the size of a file, or of the files in a folder, in bytes."""
    files = source.iterdir() if source.is_dir() else [source]
    return sum(file.stat().st_size for file in files if file.is_file())


def _head(source: Path) -> tuple[tuple[int, ...], bool]:
    """Return the number of pixels along each axis, and whether pixels may be displacements."""
    _check_openable(source)
    if is_nifti(source):
        header = read_nifti_header(source)
        return header.shape, header.is_field
    return _call(itk_reader.read_head, source)


def _check_openable(source: Path) -> None:
    """Raise the operating system's error if a file cannot be opened."""
    refuse_irregular(source)
    with open(source, "rb"):
        pass

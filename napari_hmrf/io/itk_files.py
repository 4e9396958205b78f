"""Reading and writing of NIfTI, MetaImage, NRRD, DICOM and ITK transforms with SimpleITK.

SimpleITK runs in the decoder process, because a damaged file can make SimpleITK crash or hang. New
content is first written to a temporary file, read back and compared.
"""

from __future__ import annotations

import errno
import importlib.util
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.atomic_write import raise_for_space, temporary_beside
from napari_hmrf.errors import CANNOT_SAVE, HmrfError
from napari_hmrf.field.units import unit_factor
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.decoder_process import Decoded, Undecodable, decoder, missing_simpleitk
from napari_hmrf.io.nifti import (
    fault_in_nifti,
    geometry_in_nifti,
    holds_positions,
    is_cut_short,
    not_finite,
)
from napari_hmrf.regular_file import refuse_irregular

#: Suffixes of transforms in text files.
_TEXTS = (".tfm", ".txt")
_NIFTI = (".nii", ".nii.gz")
_NRRD = (".nrrd", ".nhdr")
_METAIMAGE = (".mha", ".mhd")
#: First words of headers of NRRD and MetaImage, the last word of the latter, and the longest line.
_FIRST_WORDS, _LAST_WORD, _LONGEST = ("NRRD", "ObjectType", "NDims"), "ElementDataFile", 10_000
#: Spacing in these headers.
_SPACING = re.compile(
    r"^(?:space directions:|(?:spacings:|Element(?:Spacing|Size) *=)(.*))", re.MULTILINE
)
_NIFTI_HEADERS = (*_NIFTI, ".hdr", ".img")
_FIELD = "DisplacementFieldTransform_"
#: Reason for rejecting a NIfTI file with fewer bytes than its header states, or a damaged .gz.
_CUT_SHORT = "it is damaged or truncated"


class Unreadable(Exception):
    """Error for a file that could not be read; the message is the reason, as a clause, or ""."""


class Damaged(Unreadable):
    """Error for a file that could not be read because it is certainly damaged."""


class ItkImage(NamedTuple):
    """Image, or field of vectors along the axes x, y[, z] of LPS.

    Attributes
    ----------
    pixels : ndarray, shape ([D,] H, W[, components])
    components : int
        Number of values per pixel.
    geometry : Geometry
    metadata : dict of str to str
        Metadata in the file.
    """

    pixels: npt.NDArray[Any]
    components: int
    geometry: Geometry
    metadata: dict[str, str]

    @property
    def ndim(self) -> int:
        """Number of spatial axes."""
        return self.geometry.ndim


def read_itk_image(source: Path) -> ItkImage:
    """Read an image.

    Raises
    ------
    Unreadable
        If the file is not an image, is truncated, contains fewer pixels than its header states, or
        crashes the decoder.
    HmrfError
        If SimpleITK is not installed.
    OSError
        If the file cannot be opened.
    """
    _check_openable(source)
    _refuse_faults(source)
    _check_length(source)
    image = _right_angled(_in_millimetres(_image(_decode(source, "pixels")), source))
    _restore_unknown(image, source)
    return image


def itk_shape(source: Path) -> tuple[int, ...]:
    """Return the number of pixels along each axis, ([z,] y, x), from the header of an image.

    Raises
    ------
    Unreadable, HmrfError, OSError
        As for `read_itk_image`.
    """
    _check_openable(source)
    return tuple(_decode(source, "head").header["size"][::-1])


def read_itk_series(folder: Path) -> ItkImage:
    """Read the only series in a folder of DICOM files.

    Raises
    ------
    Unreadable
        As for `read_itk_image`; or if the folder does not contain exactly one series.
    HmrfError
        If SimpleITK is not installed.
    """
    decoded = _decode(folder, "series")
    if (count := decoded.header.get("series")) is not None:
        content = f"{count} series" if count else "no DICOM file"
        raise Unreadable(f"the folder contains {content}. Give a folder with one series")
    return _image(decoded)


def read_itk_vectors(source: Path) -> ItkImage:
    """Read an image of vectors, or the displacement field of a transform.

    Raises
    ------
    Unreadable
        As for `read_itk_image`; or if the numbers of a text file do not match its header.
    HmrfError, OSError
        As for `read_itk_image`.
    """
    _check_openable(source)
    if source.name.lower().endswith(_TEXTS):
        _check_text(source)
    _refuse_faults(source)
    _check_length(source)
    image = _in_millimetres(_image(_decode(source, "pixels", vectors=True)), source)
    if image.ndim == 2 and image.components == 3:
        image = _in_volume(image, source)
    image = _right_angled(image)
    if _is_real_nifti(source, image):
        if not_finite(source) is not None:
            raise Unreadable("it contains NaN or infinite values")
        image = _as_displacements(image, source)
    return image


def holds_vectors(source: Path) -> bool:
    """Return whether a file contains a displacement field.

    The result is also True for a damaged file, so that reading the file reports the error. It is
    False if SimpleITK is not installed.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """
    try:
        header = _decode(source, "head", vectors=True).header
    except Damaged:
        return True
    except Unreadable as error:  # a transform without a field has a reason
        return source.suffix.lower() == ".h5" and bool(str(error))
    except HmrfError:
        return False
    return len(header["spacing"]) == header["components"] and "float" in header["pixel"]


def encode(target: Path, image: ItkImage, suffix: str, *, transform: bool = False) -> bytes:
    """Return the bytes of an image file.

    SimpleITK writes the image to a temporary file, which is read back for comparison.

    Parameters
    ----------
    target : Path
        Target file. The temporary file is created in its folder, so that space is only required on
        one disk.
    image : ItkImage
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
        If the disk is full, or the content read back differs; the message names the target.
    ValueError
        If SimpleITK does not support such pixels in this format.
    """
    with temporary_beside(target, suffix) as file:
        try:
            decoder.write(file, _header(image), image.pixels, vectors=transform)
            is_written = True
        except Undecodable:
            is_written = False
        if not (is_written and _reads_back(file, image, transform=transform)):
            file.unlink(missing_ok=True)
            raise_for_space(target, image.pixels.nbytes)
            if not is_written:
                raise ValueError(f"such pixels cannot be written as {suffix}")
            raise OSError(errno.EIO, f"{CANNOT_SAVE}{os.strerror(errno.EIO)}", str(target))
        return file.read_bytes()


def require_simpleitk() -> None:
    """Raise an error if SimpleITK is not installed, without importing SimpleITK.

    Raises
    ------
    HmrfError
        If SimpleITK is not installed.
    """
    if not has_simpleitk():
        raise missing_simpleitk()


def has_simpleitk() -> bool:
    """Return whether SimpleITK is installed, without importing SimpleITK."""
    try:
        return importlib.util.find_spec("SimpleITK") is not None
    except ValueError:  # the entry in `sys.modules` has no spec
        return False


def _decode(source: Path, kind: str, *, vectors: bool = False) -> Decoded:
    try:
        return decoder.decode(source, kind, vectors=vectors)
    except Undecodable as error:
        raise (Damaged if error.fatal else Unreadable)(str(error)) from None


def _refuse_faults(source: Path) -> None:
    """Raise an error for a file that ITK would read wrongly, or not at all."""
    name = source.name.lower()
    if name.endswith(_NIFTI_HEADERS) and (fault := fault_in_nifti(source)):
        raise Unreadable(fault)
    if name.endswith((*_METAIMAGE, *_NRRD)):
        _require_spacing(source)


def _require_spacing(source: Path) -> None:
    """Raise an error for a MetaImage or NRRD file without a spacing, which ITK reads as 1 mm."""
    header = "\n".join(_text_header(source))
    stated = _SPACING.search(header)
    if stated is None and header.startswith(_FIRST_WORDS):
        raise Unreadable(
            "its header states no spacing. Save it with its spacing, or as a .tif, whose lengths "
            "are in pixels"
        )
    spacing = (stated and stated[1]) or ""
    try:
        is_positive = not any(float(size) <= 0 for size in spacing.split())
    except ValueError:
        return  # the text is damaged
    if not is_positive:
        raise Unreadable(f"its header states the spacing{spacing}. Give positive lengths")


def _text_header(source: Path) -> Iterator[str]:
    """Yield the lines of the header of a MetaImage or NRRD file."""
    with open(source, "rb") as file:
        while line := file.readline(_LONGEST).decode("latin-1").strip():
            yield line
            if line.startswith(_LAST_WORD):
                return


def _in_millimetres(image: ItkImage, source: Path) -> ItkImage:
    """Return an image of an NRRD file with its lengths in mm; ITK ignores the unit of the file."""
    if source.suffix.lower() not in _NRRD:
        return image
    lines = _text_header(source)
    stated = next((line for line in lines if line.lower().startswith("space units:")), "")
    units = {unit for unit in re.findall(r'"([^"]*)"', stated) if unit}
    factors = {unit_factor(unit, "millimeter") for unit in units} or {1.0}
    if len(factors) > 1 or not all(map(math.isfinite, factors)):
        raise Unreadable(
            f"its space units are {' and '.join(sorted(units))}. Set one unit of length for all "
            "axes, such as mm"
        )
    (factor,) = factors
    return image._replace(geometry=image.geometry.scaled(factor))


def _is_real_nifti(source: Path, image: ItkImage) -> bool:
    return source.name.lower().endswith(_NIFTI) and image.pixels.dtype.kind == "f"


def _as_displacements(image: ItkImage, source: Path) -> ItkImage:
    """Convert the positions or displacements of SPM and NiftyReg to displacements in LPS."""
    try:
        positions = holds_positions(source)
    except ValueError as error:
        raise Unreadable(str(error)) from None
    if positions is None or image.ndim != image.components:
        return image
    vectors = image.pixels * np.array([-1.0, -1.0, 1.0])[: image.ndim]
    if positions:
        indices = np.moveaxis(np.indices(vectors.shape[:-1]), 0, -1)
        vectors -= image.geometry.to_world(indices)[..., ::-1]
    return image._replace(pixels=vectors)


def _check_openable(source: Path) -> None:
    """Raise the operating system's error if a file cannot be opened."""
    refuse_irregular(source)
    with open(source, "rb"):
        pass


def _check_length(source: Path) -> None:
    """Raise an error if a NIfTI file is truncated, because ITK would read arbitrary values."""
    if source.name.lower().endswith(_NIFTI) and is_cut_short(source):
        raise Unreadable(_CUT_SHORT)


def _image(decoded: Decoded) -> ItkImage:
    header, pixels = decoded.header, decoded.pixels
    assert pixels is not None
    spacing = header["spacing"][::-1]
    shape = pixels.shape[: len(spacing)]
    geometry = Geometry.of_itk(shape, spacing, header["origin"], header["direction"])
    return ItkImage(pixels, header["components"], geometry, header["metadata"])


def _right_angled(image: ItkImage) -> ItkImage:
    try:
        return image._replace(geometry=image.geometry.right_angled())
    except ValueError as error:
        raise Unreadable(str(error)) from None


def _header(image: ItkImage) -> dict[str, Any]:
    """Return the header of an image in the format of decoder requests."""
    geometry = image.geometry
    return {
        "components": image.components,
        "metadata": image.metadata,
        "spacing": geometry.spacing[::-1],
        "origin": geometry.origin,
        "direction": geometry.direction.ravel().tolist(),
    }


def _restore_unknown(image: ItkImage, source: Path) -> None:
    """Restore NaN and infinite values of NIfTI in place, which ITK has replaced by 0."""
    values = not_finite(source) if _is_real_nifti(source, image) else None
    if values is not None:
        stored = values.reshape(image.components, -1).T.reshape(image.pixels.shape)
        unknown = ~np.isfinite(stored)
        image.pixels[unknown] = stored[unknown]


def _reads_back(file: Path, image: ItkImage, *, transform: bool) -> bool:
    """Return whether the content of a written file is equal to the image."""
    try:
        read = _image(_decode(file, "pixels", vectors=transform))
        _restore_unknown(read, file)
    except (Unreadable, OSError):
        return False
    read_pixels, pixels = read.pixels, np.asarray(image.pixels)
    # The shapes can differ, because NIfTI drops axes of length 1.
    if read_pixels.dtype != pixels.dtype or read_pixels.size != pixels.size:
        return False
    is_same = np.array_equal(
        read_pixels.ravel(), pixels.ravel(), equal_nan=pixels.dtype.kind in "fc"
    )
    return is_same and (read.ndim != image.ndim or read.geometry.same_as(image.geometry))


def _in_volume(plane: ItkImage, source: Path) -> ItkImage:
    """Restore the third axis, which SimpleITK drops when reading a one-slice field from NIfTI."""
    geometry = geometry_in_nifti(source)
    if geometry is None:
        return plane
    if math.isclose(float(np.linalg.det(geometry.directions)), 0.0, abs_tol=1e-9):
        raise Unreadable("its axes lie in one plane")
    return plane._replace(pixels=plane.pixels[np.newaxis], geometry=geometry)


def _check_text(source: Path) -> None:
    """Raise an error if a field in a text file is incomplete.

    ITK would fill missing numbers with arbitrary values.
    """
    try:
        text = source.read_text(encoding="ascii")
        n, count = 0, -1
        for line in text.splitlines():
            key, _, value = line.partition(":")
            if key == "Transform":
                n = int(value.rsplit("_", 1)[-1]) if value.strip().startswith(_FIELD) else 0
            elif key == "Parameters":
                count = len(value.split())
            elif key == "FixedParameters" and n:
                fixed = np.array(value.split(), float)
                if len(fixed) != n * (n + 3) or n * fixed[:n].prod() != count:
                    raise Unreadable(
                        "it does not contain the number of values that its header states"
                    )
                n = 0
    except ValueError:
        raise Unreadable("it is damaged") from None
    if n or not text.endswith("\n"):
        raise Unreadable("it is truncated")

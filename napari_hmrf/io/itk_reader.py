"""Reading and writing of single files with SimpleITK, in the current process.

All functions may also raise `RuntimeError`, with messages that cite ITK's source files.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.resample import emptiness
from napari_hmrf.field.units import unit_factor
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.decoded import CUT_SHORT, Decoded, Unreadable, check_size, missing_package
from napari_hmrf.io.dicom_slices import (
    Slice,
    Step,
    is_dicom,
    ordered,
    refuse_damaged,
    tilt_of_frames,
)

#: ITK's readers by suffix. Without a name, ITK tries all its readers.
READERS = {
    ".mha": "MetaImageIO",
    ".mhd": "MetaImageIO",
    ".nrrd": "NrrdImageIO",
    ".nhdr": "NrrdImageIO",
    ".dcm": "GDCMImageIO",
}
#: Suffixes of transforms in text files.
TEXTS = (".tfm", ".txt")
_NRRD, _META = (".nrrd", ".nhdr"), (".mha", ".mhd")
#: Fields of the spacing in headers of NRRD and MetaImage.
_SPACING = ("spacings", "elementspacing", "elementsize")
#: Vector of a header of NRRD that is neither NaN nor 0.
_VECTOR = re.compile(r"\([^)]*[1-9]")
#: Suffixes of header files with the pixels in another file of the same folder.
_PARTED = (".mhd", ".nhdr", ".hdr")
#: Characters that are not in a text.
_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
#: Field of a MetaImage header with more than nine axes, or with another value than a number.
_MANY_AXES = re.compile(rb"NDims(?!\s*=\s*\d\s*$)")
#: Values of fields for compressed pixels, and zlib's flag for both headers of compressed content.
_PACKED, _ZLIB_OR_GZIP = ("true", "gz", "gzip"), 32
#: Number of bytes that are decompressed at a time.
_PIECE = 2**16
_FIELD = "DisplacementFieldTransform"
#: DICOM keys of the size of pixels: in the patient, and at the detector.
_PIXEL_SIZES = {"0028|0030", "0018|1164", "0018|2010"}
#: DICOM keys of the position of a slice, and of its rescale slope and intercept.
_POSITION, _RESCALE = "0020|0032", ("0028|1053", "0028|1052")


def _simpleitk() -> Any:
    try:
        import SimpleITK  # optional: SimpleITK
    except ImportError:
        raise missing_package("SimpleITK") from None
    return SimpleITK


def read_head(path: Path) -> tuple[tuple[int, ...], bool]:
    """Return the number of pixels along each axis, ([z,] y, x), and whether pixels are vectors.

    Raises
    ------
    Unreadable
        As for `read_pixels`.
    """
    reader, _ = _checked_reader(path, _suffix_of(path))
    kind = _simpleitk().GetPixelIDValueAsString(reader.GetPixelID())
    is_field = reader.GetNumberOfComponents() == reader.GetDimension() and "float" in kind
    return reader.GetSize()[::-1], is_field


def read_pixels(path: Path, suffix: str = "") -> Decoded:
    """Read an image, by default in the format of its suffix.

    Raises
    ------
    Unreadable
        If the file is not an image, is damaged, or is too small for its pixels.
    HmrfError
        If SimpleITK is not installed.
    """
    suffix = suffix or _suffix_of(path)
    step = tilt_of_frames(path) if suffix == ".dcm" else None
    reader, unit = _checked_reader(path, suffix)
    image = _tilted(_image(reader.Execute()), step)
    return image._replace(geometry=image.geometry.scaled(unit))


def read_transform(path: Path) -> Decoded:
    """Read the displacement field of a transform.

    Raises
    ------
    Unreadable
        If the file is not a transform with a displacement field, or is damaged or truncated.
    HmrfError
        If SimpleITK is not installed.
    """
    sitk = _simpleitk()
    if path.suffix.lower() in TEXTS:
        _check_text(path)
    transform = sitk.ReadTransform(str(path))
    if transform.GetName() == _FIELD:
        return _image(sitk.DisplacementFieldTransform(transform).GetDisplacementField())
    # ANTs stores a displacement field and an affine transform in one file. Because the last
    # transform is applied first, the grid of the last field is that of the image.
    is_chain = transform.GetName() == "CompositeTransform"
    chain = sitk.CompositeTransform(transform if is_chain else [transform])
    parts = [chain.GetNthTransform(number) for number in range(chain.GetNumberOfTransforms())]
    last = [part for part in parts if part.GetName() == _FIELD][-1:]
    if not last:
        names = ", ".join(part.GetName() for part in parts)
        raise Unreadable(
            f"it contains no field, but {names}. Convert it to a field on the grid of the image, "
            "as with SimpleITK.TransformToDisplacementField"
        )
    field = sitk.DisplacementFieldTransform(last[0]).GetDisplacementField()
    if len(parts) > 1:
        grid = (field.GetSize(), field.GetOrigin(), field.GetSpacing(), field.GetDirection())
        field = sitk.TransformToDisplacementField(chain, sitk.sitkVectorFloat64, *grid)
    return _image(field)


def read_series(folder: Path) -> Decoded:
    """Read the only series in a folder of DICOM files.

    Raises
    ------
    Unreadable
        If the folder does not contain exactly one series, or the slices are not those of one
        volume on a regular grid.
    HmrfError
        If SimpleITK is not installed.
    """
    sitk = _simpleitk()
    reader = sitk.ImageSeriesReader()
    series = {
        each: reader.GetGDCMSeriesFileNames(str(folder), each)
        for each in reader.GetGDCMSeriesIDs(str(folder))
    }
    if not series:
        raise Unreadable("the folder contains no DICOM image. Give a folder with one series")
    if len(series) > 1:
        content = ", ".join(_series_in_words(names) for names in series.values())
        raise Unreadable(
            f"the folder contains {len(series)} series ({content}). Give a folder with one series; "
            "dcm2niix separates them"
        )
    [(identifier, names)] = series.items()
    refuse_damaged(folder, identifier, names)
    if len(names) == 1:
        return read_pixels(Path(names[0]), ".dcm")
    slices, step = ordered([*map(_slice, names)])
    reader.SetFileNames([each.path for each in slices])
    if len({each.rescale for each in slices}) > 1:  # the type of the first slice is too narrow
        reader.SetOutputPixelType(sitk.sitkFloat32)
    return _tilted(_image(reader.Execute()), step)


def resampled(image: Decoded, geometry: Geometry, *, labels: bool) -> Decoded:
    """Resample an image to another grid; pixels outside of it are empty; see `emptiness`.

    Parameters
    ----------
    image : Decoded
    geometry : Geometry
    labels : bool
        True to use the nearest pixel instead of linear interpolation, and 0 outside.
    """
    sitk, pixels = _simpleitk(), image.pixels
    method, fill = sitk.sitkNearestNeighbor, 0.0
    if not labels:
        method, fill = sitk.sitkLinear, float(emptiness(pixels, pixels.ndim))
    is_rounded = not labels and pixels.dtype.kind in "iu"
    if is_rounded:  # ITK rounds down
        pixels = pixels.astype(np.float64)
    moved = sitk.Resample(
        _itk_image(image._replace(pixels=pixels)),
        geometry.shape[::-1],
        sitk.Transform(),
        method,
        geometry.origin,
        geometry.spacing[::-1],
        geometry.direction.ravel().tolist(),
        fill,
    )
    values = sitk.GetArrayFromImage(moved)
    if is_rounded:
        values = np.rint(values).astype(image.pixels.dtype)
    return image._replace(pixels=values, geometry=geometry)


def write(path: Path, image: Decoded, *, transform: bool) -> None:
    """Write an image, or a displacement field as a transform.

    Raises
    ------
    RuntimeError, NotImplementedError, TypeError
        If SimpleITK does not support such pixels in this format, or if the disk is full; some
        formats do not report a full disk.
    HmrfError
        If SimpleITK is not installed.
    """
    sitk, made = _simpleitk(), _itk_image(image)
    for key, text in image.metadata.items():
        made.SetMetaData(key, text)
    if transform:
        sitk.WriteTransform(sitk.DisplacementFieldTransform(made), str(path))
    else:
        sitk.WriteImage(made, str(path), useCompression=True)


def _series_in_words(names: Sequence[str]) -> str:
    first = min(Path(name).name for name in names)
    return first if len(names) == 1 else f"{first} and {len(names) - 1} more"


def _itk_image(image: Decoded) -> Any:
    values = np.ascontiguousarray(image.pixels, image.pixels.dtype.newbyteorder("="))
    made = _simpleitk().GetImageFromArray(values, isVector=image.components > 1)
    made.SetSpacing(image.geometry.spacing[::-1])
    made.SetOrigin(image.geometry.origin)
    made.SetDirection(image.geometry.direction.ravel().tolist())
    return made


def _tilted(image: Decoded, step: Step | None) -> Decoded:
    """Return an image with the step from a slice to the next, if ITK ignored a part of it."""
    if step is None:
        return image
    affine = image.geometry.affine.copy()
    affine[:3, 0] = step[::-1]
    return image._replace(geometry=replace(image.geometry, affine=affine))


def _image(image: Any) -> Decoded:
    pixels: npt.NDArray[Any] = _simpleitk().GetArrayFromImage(image)
    spacing = image.GetSpacing()[::-1]
    shape = pixels.shape[: len(spacing)]
    geometry = Geometry.of_itk(shape, spacing, image.GetOrigin(), image.GetDirection())
    metadata = {}
    for key in image.GetMetaDataKeys():
        try:
            metadata[key] = image.GetMetaData(key)
        except (UnicodeError, TypeError):  # the text or its key is damaged
            continue
    return Decoded(pixels, image.GetNumberOfComponentsPerPixel(), geometry, metadata)


def _suffix_of(path: Path) -> str:
    """Return the suffix of a file; ".dcm" for a DICOM file without one, as on a CD."""
    suffix = path.suffix.lower()
    return ".dcm" if suffix not in READERS and is_dicom(path) else suffix


def _checked_reader(path: Path, suffix: str) -> tuple[Any, float]:
    """Return a reader whose file can contain its pixels, and its unit of length in mm."""
    sitk, unit = _simpleitk(), 1.0
    fields, end = _text_header(path) if suffix in (*_NRRD, *_META) else ({}, 0)
    if suffix in _NRRD:
        unit = _unit_of(fields.get("space units", ""))
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO(READERS.get(suffix, ""))
    reader.ReadImageInformation()
    if fields:
        _require_spacing(fields, reader.GetDimension())
    if suffix == ".dcm":
        _require_pixel_size(reader)
    files = path.parent.iterdir() if suffix in _PARTED else [path]
    largest = max(filter(Path.is_file, files), key=lambda file: file.stat().st_size)
    needed = _bytes_of(reader)
    check_size(needed, largest)
    _check_packed(path, fields, end, needed)
    return reader, unit


def _bytes_of(reader: Any) -> int:
    """Return the size of the pixels that a header states, in bytes."""
    pixel = _simpleitk().Image([1, 1], reader.GetPixelID(), reader.GetNumberOfComponents())
    size = pixel.GetSizeOfPixelComponent() * pixel.GetNumberOfComponentsPerPixel()
    return int(math.prod(reader.GetSize()) * size)


def _text_header(path: Path) -> tuple[dict[str, str], int]:
    """Return the fields of a NRRD or MetaImage header, and its length in bytes.

    ITK crashes if an NRRD header is not text, as where the blank line at its end is damaged, and
    loops over any number of dimensions of a MetaImage.
    """
    is_nrrd = path.suffix.lower() in _NRRD
    fields = {}
    with open(path, "rb") as file:
        for line in file:
            if _CONTROL.search(line) or _MANY_AXES.search(line):
                raise Unreadable("its header is damaged")
            key, _, value = line.decode("latin-1").partition(":" if is_nrrd else "=")
            fields[key.strip().lower()] = value.strip()
            if not line.strip(b"\r\n") if is_nrrd else "elementdatafile" in fields:
                break
        return fields, file.tell()


def _require_spacing(fields: dict[str, str], ndim: int) -> None:
    """Raise an error for an NRRD or MetaImage header without a spacing, which ITK reads as 1 mm.

    Parameters
    ----------
    fields : dict of str to str
        Fields of the header.
    ndim : int
        Number of axes without those of channels; only these may have the direction "none".
    """
    if "space directions" in fields:
        directions = fields["space directions"]
        if len(_VECTOR.findall(directions)) < min(ndim, 3):
            raise Unreadable(
                f"its header states the space directions {directions}, so the spacing of an axis "
                'is unknown. Give a vector for each axis in space; "none" is for channels only'
            )
        return
    stated = next((fields[key] for key in _SPACING if key in fields), None)
    if stated is None:
        raise Unreadable(
            "its header states no spacing. Save it with its spacing, or as a .tif, whose lengths "
            "are in pixels"
        )
    try:
        is_positive = all(float(size) > 0 for size in stated.split())
    except ValueError:
        is_positive = False
    if not is_positive:
        raise Unreadable(f"its header states the spacing {stated}. Give positive lengths")


def _unit_of(space_units: str) -> float:
    """Return the unit of length of an NRRD file, in mm, which ITK ignores."""
    units = set(re.findall(r'"([^"]+)"', space_units))
    factors = {unit_factor(unit, "millimeter") for unit in units} or {1.0}
    if len(factors) > 1 or not all(map(math.isfinite, factors)):
        raise Unreadable(
            f"its space units are {' and '.join(sorted(units))}. Set one unit of length for all "
            "axes, such as mm"
        )
    return factors.pop()


def _check_packed(path: Path, fields: dict[str, str], start: int, needed: int) -> None:
    """Raise an error if compressed pixels are damaged or too few; ITK ignores their checksum.

    Parameters
    ----------
    path : Path
        NRRD or MetaImage file.
    fields : dict of str to str
        Fields of its header.
    start : int
        Length of the header, in bytes.
    needed : int
        Size of the pixels, in bytes.
    """
    is_packed = fields.get("compresseddata", fields.get("encoding", "")).lower() in _PACKED
    if not is_packed or any(key.startswith(("byte", "line")) for key in fields):
        return  # the pixels start elsewhere in their file
    names = (fields.get(key, "") for key in ("elementdatafile", "data file", "datafile"))
    name = next(filter(None, names), "LOCAL")
    file, start = (path, start) if name == "LOCAL" else (path.parent / name, 0)
    if not file.is_file():  # a list or a pattern of names
        return
    unpacker, count = zlib.decompressobj(zlib.MAX_WBITS | _ZLIB_OR_GZIP), 0
    with open(file, "rb") as stream:
        stream.seek(start)
        while not unpacker.eof and (piece := stream.read(_PIECE)):
            try:
                count += len(unpacker.decompress(piece))
            except zlib.error:
                raise Unreadable(CUT_SHORT) from None
    if not unpacker.eof or count < needed:
        raise Unreadable(CUT_SHORT)


def _slice(path: str) -> Slice:
    reader = _simpleitk().ImageFileReader()
    reader.SetFileName(path)
    reader.SetImageIO(READERS[".dcm"])
    reader.ReadImageInformation()
    check_size(_bytes_of(reader), Path(path))
    _require_pixel_size(reader)
    keys = reader.GetMetaDataKeys()
    return Slice(
        path,
        reader.GetSize(),
        reader.GetSpacing(),
        reader.GetDirection(),
        reader.GetOrigin() if _POSITION in keys else None,
        tuple(reader.GetMetaData(key).strip() if key in keys else "" for key in _RESCALE),
    )


def _require_pixel_size(reader: Any) -> None:
    """Raise an error for a DICOM slice without a pixel size, for which ITK assumes 1 mm."""
    if math.prod(reader.GetSize()[2:]) == 1 and not _PIXEL_SIZES & {*reader.GetMetaDataKeys()}:
        raise Unreadable(
            "its header does not state the size of its pixels. Save it as a picture, such as a "
            ".tif, whose lengths are in pixels"
        )


def _check_text(path: Path) -> None:
    """Raise an error if a field in a text file is incomplete.

    ITK would fill missing numbers with arbitrary values.
    """
    try:
        text = path.read_text(encoding="ascii")
        n, count = 0, -1
        for line in text.splitlines():
            key, _, value = line.partition(":")
            if key == "Transform":
                is_field = value.strip().startswith(f"{_FIELD}_")
                n = int(value.rsplit("_", 1)[-1]) if is_field else 0
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

"""Reading and writing of image files: pictures, and medical images with their place.

Pictures (.png, .jpg, .bmp) are read with scikit-image and written with Pillow; .tif files are read
and written with tifffile. NIfTI, MetaImage, NRRD and folders of DICOM files are handled by nibabel
and SimpleITK, which the extra ``medical`` installs.
"""

from __future__ import annotations

import io
import math
import os
from contextlib import suppress
from itertools import combinations, permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path, checked_target
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError, HmrfError, ProblemError
from napari_hmrf.field.units import is_length, unit_factor
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.decoded import Decoded, Unreadable
from napari_hmrf.io.dicom_slices import is_contents, is_dicom
from napari_hmrf.io.itk_files import encode, itk_shape, read_itk_image, read_itk_series
from napari_hmrf.io.itk_reader import resampled
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.regular_file import refuse_irregular
from napari_hmrf.solver.solution import is_solution_file

#: Axes of .tif files that are not axes of space, with their content, and the unit of OME's sizes.
_NO_SPACE, _OME_UNIT = {"C": "channels", "T": "times"}, "µm"
#: Names of the unit of images without a known size of pixels.
_PIXELS = ("pixel", "pixels", "px")
#: Units of length in .tif files, which have several names there.
_UNITS = ("µm", "nm", "mm", "cm", "inch")
#: Units of the resolution of a .tif by the value of its tag; the others are no lengths.
_RESOLUTIONS = {2: "inch", 3: "cm"}
#: Resolution that programs write for no reason, and that ImageJ therefore ignores, per inch.
_NO_RESOLUTION = 72
#: Types of pixels in files of ImageJ.
_IMAGEJ = ("uint8", "uint16", "float32")
#: Suffixes of .tif files, and of all pictures.
TIFF = (".tif", ".tiff")
PICTURE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
#: Suffix of segmentations of 3D Slicer.
_SEGMENTS = ".seg.nrrd"
#: Suffixes of other files that have a name of their own.
_OTHER_SUFFIXES = (".study", ".npz", ".csv", ".fcsv", ".mrk.json", ".h5", ".tfm", ".txt")
#: Suffixes of medical images.
MEDICAL_SUFFIXES = (*(".nii.gz", ".nii", ".hdr", ".img", ".mha", ".mhd", ".nrrd", ".nhdr", ".dcm"),)
_FREESURFER = (".mgz", ".mgh")
#: Suffixes of medical images that are also written: neither DICOM, nor formats with two files.
_WRITTEN = (".nii.gz", ".nii", ".mha", ".nrrd")


class ImageFile(NamedTuple):
    """Image with its place: the content of an image file.

    Attributes
    ----------
    pixels : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    geometry : Geometry or None
        Grid in patient coordinates, in mm; None for a picture.
    colours : bool
        True if the last axis contains colour channels.
    stack : str
        Content of the first of three axes, such as "channels", if it is not depth; "" if it is.
    sizes : tuple of float
        Size of a pixel along each axis of a picture, as programs for microscopy store it in .tif
        files; empty if it is unknown.
    unit : str
        Unit of `sizes`.
    order : tuple of int
        Axis of the file for each axis of the volume, if its axes were reordered.
    resampled : str
        Note, a clause, on the grid to which the pixels were resampled; "" for those of the file.
    resolution : str
        Note, a clause, on `sizes` from the resolution of a .tif, which may be that of a print; ""
        if they are stated as sizes, or unknown.
    """

    pixels: npt.NDArray[Any]
    geometry: Geometry | None = None
    colours: bool = False
    stack: str = ""
    sizes: tuple[float, ...] = ()
    unit: str = "pixel"
    order: tuple[int, ...] = ()
    resampled: str = ""
    resolution: str = ""

    @property
    def pixels_in_place(self) -> npt.NDArray[Any]:
        """Pixels with all axes of the grid; a slice of a volume gets a first axis of length 1."""
        more = 0 if self.geometry is None else self.geometry.ndim - self.ndim
        return self.pixels[(np.newaxis,) * more]

    @property
    def is_of_volume(self) -> bool:
        """True for a volume with a place, and for one of its slices."""
        return self.geometry is not None and self.geometry.ndim == 3

    @property
    def upright(self) -> ImageFile:
        """Image with the axes of a volume in the order of the nearest world axes.

        Scanners acquire slices in any orientation, but napari shows slices perpendicular to world
        axes.
        """
        geometry = self.geometry
        if geometry is None or geometry.ndim != 3:
            return self
        turn = geometry.directions

        def nearness(order: tuple[int, ...]) -> float:
            return sum(abs(float(turn[world, axis])) for world, axis in enumerate(order))

        order = max(permutations(range(3)), key=nearness)
        return self if order == (0, 1, 2) else self.reordered(order)

    @property
    def laid_out(self) -> ImageFile:
        """Image as it is solved: upright, or the only slice of a volume along any axis."""
        shape = self.pixels.shape
        if self.ndim != 3:
            return self
        if self.geometry is None or 1 not in shape[:3]:
            return self.upright
        across = shape.index(1)
        image = self.reordered((across, *(axis for axis in range(3) if axis != across)))
        return image._replace(pixels=image.pixels[0])

    def reordered(self, order: tuple[int, ...]) -> ImageFile:
        """Return a view of a volume with its axes reordered; the volume must have a place."""
        assert self.geometry is not None
        return ImageFile(
            self.pixels_in_place.transpose(*order, *range(3, 3 + self.colours)),
            self.geometry.reordered(order),
            self.colours,
            order=() if order == (0, 1, 2) else order,
            resampled=self.resampled,
        )

    def laid_as(
        self, geometry: Geometry | None, file_axes: tuple[int, ...] = (0, 1, 2)
    ) -> ImageFile:
        """Return the image with its axes reordered and reversed to match another grid.

        A volume without a place has the axes of the file that the other image comes from. The image
        itself is returned if no order and no directions of its axes match.

        Parameters
        ----------
        geometry : Geometry or None
            Grid of the other image.
        file_axes : tuple of int
            Axis of its file for each axis of the other image.
        """
        own = self.geometry
        if own is None and self.ndim == 3:
            return self._replace(
                pixels=self.pixels.transpose(*file_axes, *range(3, self.pixels.ndim))
            )
        if own is None or own.ndim != 3 or geometry is None or own.same_as(geometry):
            return self
        axes = range(3)
        turned = (
            self.reordered(order).reversed_along(reverse)
            for order in permutations(axes)
            for count in range(4)
            for reverse in combinations(axes, count)
        )
        return next((each for each in turned if geometry.same_as(each.geometry)), self)

    def reversed_along(self, axes: tuple[int, ...]) -> ImageFile:
        """Return a view of a volume with some axes reversed; the volume must have a place."""
        assert self.geometry is not None
        turned = self.geometry.reversed_along(axes)
        return self._replace(pixels=np.flip(self.pixels, axes), geometry=turned)

    def refuse_elsewhere(self, geometry: Geometry | None, name: str, what: str) -> None:
        """Raise an error if the image is not in the same place as another image of equal size.

        Parameters
        ----------
        geometry : Geometry or None
            Grid of the other image; None disables the check.
        name : str
            Name of the image file, for the error message.
        what : str
            Description of the other image, for the error message.

        Raises
        ------
        ProblemError
            If the places differ.
        """
        own = self.geometry
        if own is None or geometry is None or own.ndim != geometry.ndim:
            return
        if not own.same_as(geometry):
            raise ProblemError(
                name,
                f"is not in the same place as {what}, although it has the same size. Give a file "
                "in the same place. If only the header is wrong, save the image as a .tif, which "
                "does not store a place.",
            )

    def refuse_as_volume(self, name: str) -> None:
        """Raise an error for a stack of slices that is not a volume.

        Parameters
        ----------
        name : str
            Name of the image file, for the error message.

        Raises
        ------
        ProblemError
            If the first of three axes is not depth, or the distance of the slices is unknown.
        """
        if self.ndim == 3 and 0.0 in self.sizes:
            raise ProblemError(
                name,
                "states the size of its pixels, but not the distance of its slices. Set it, in "
                "Fiji by Image > Properties, or give --spacing.",
            )
        if self.ndim == 3 and self.stack:
            raise ProblemError(
                name,
                f"is a stack of {len(self.pixels)} {self.stack}, not a volume. Give one of them "
                "(`slice=N`), or save the image without the others.",
            )

    @property
    def grid(self) -> Geometry:
        """Grid of the pixels; that of a picture starts at the origin."""
        shape = self.pixels.shape[: self.ndim]
        return self.geometry or Geometry.at_origin(shape, self.sizes[-self.ndim :], self.unit)

    @property
    def ndim(self) -> int:
        """Number of spatial axes."""
        return self.pixels.ndim - self.colours


def read_image(
    path: str | os.PathLike[str], *, resample: bool = False, labels: bool = False
) -> ImageFile:
    """Read an image file, or a folder with the DICOM files of one series.

    A volume with a single slice is returned as a 2-D image with its place in the volume.

    Parameters
    ----------
    path : str or path-like
    resample : bool
        True to resample an image whose axes are not at right angles, which is refused by default.
    labels : bool
        True if the image contains labels, which must not be interpolated.

    Returns
    -------
    ImageFile

    Raises
    ------
    FileFormatError
        If the file is not a readable image, or a folder does not contain exactly one series.
    HmrfError
        If SimpleITK is required but not installed.
    OSError
        If the file cannot be opened.
    """
    source = Path(checked_path(path))
    if not source.is_dir():
        refuse_irregular(source)
        with open(source, "rb"):
            pass  # raises the operating system's error if the file cannot be opened
        if source.name.lower().endswith(PICTURE_SUFFIXES):
            return _read_picture(source)
    try:
        image = read_itk_series(source) if source.is_dir() else read_itk_image(source)
    except Unreadable as error:
        if source.is_dir():
            reason = str(error) or "the folder contains a damaged series"
            raise FileFormatError(f"{source.name}: {reason}.") from None
        raise _unreadable(source, str(error)) from error
    n, count, pixels = image.ndim, image.components, image.pixels
    if count > 1 and is_segmentation(source):
        raise FileFormatError(
            f"{source.name}: the segmentation has {count} layers, because segments overlap. Export "
            "it in 3D Slicer as a labelmap, in which every voxel has one label."
        )
    if n == 4 and count == 1:
        raise FileFormatError(
            f"{source.name}: the image has 4 axes, as a series over time or a field of FSL. "
            "Extract one volume, or convert the field, as with wb_command -convert-warpfield."
        )
    if n not in (2, 3) or count not in (1, n, 3, 4):
        raise FileFormatError(
            f"{source.name}: the image has {n} axes and {count} values per pixel. Give a grey or "
            "colour image with 2 or 3 axes."
        )
    if n == count and pixels.dtype.kind == "f":
        raise FileFormatError(
            f"{source.name}: the file contains a displacement field. Give an image instead."
        )
    image, note = _at_right_angles(image, source.name, resample, labels)
    is_slice = n == 3 and len(pixels) == 1
    pixels = image.pixels[0] if is_slice else image.pixels
    return ImageFile(pixels, image.geometry, count > 1, resampled=note)


def _at_right_angles(
    image: Decoded, name: str, resample: bool, labels: bool
) -> tuple[Decoded, str]:
    """Return an image on a grid at right angles, and a note if it was resampled."""
    try:
        return image._replace(geometry=image.geometry.right_angled()), ""
    except ValueError as error:
        reason = str(error)
    if not resample:
        raise FileFormatError(
            f"{name}: {reason}. Resample it: napari-hmrf resample {name} -o resampled. The "
            "commands solve, register, apply and measure also do so with --resample."
        )
    try:
        grid = image.geometry.covering()
    except ValueError as error:
        raise FileFormatError(f"{name}: cannot be resampled: {error}.") from None
    outside = "0" if labels else "its smallest value"
    return resampled(image, grid, labels=labels), (
        f"{name} was resampled from {grid_in_words(image.geometry.shape)} to "
        f"{grid_in_words(grid.shape)} pixels, on a grid at right angles of "
        f"{grid_in_words(grid.spacing)} mm, and filled with {outside} outside: {reason}"
    )


def shape_of(path: str | os.PathLike[str]) -> tuple[int, ...]:
    """Return the shape of a volume in a medical image file, from its header alone.

    Returns
    -------
    tuple of int
        Shape (D, H, W); () for other files, for DICOM, and for files that `read_image` refuses.
    """
    source = Path(checked_path(path))
    if source.is_dir() or not source.name.lower().endswith(MEDICAL_SUFFIXES):
        return ()
    try:
        shape = itk_shape(source)
    except (Unreadable, HmrfError, OSError):
        return ()
    return shape if len(shape) == 3 and shape[0] > 1 else ()


def _unreadable(source: Path, reason: str = "") -> FileFormatError:
    """Return the error for a file that cannot be read as an image, with the likely reason."""
    if is_solution_file(source):
        return FileFormatError(
            f"{source.name}: it is a saved result, not an image. Give an image, or use the result "
            "with export, apply, measure or play."
        )
    if is_contents(source):
        return FileFormatError(
            f"{source.name}: it is the table of contents of DICOM files, without pixels. Give a "
            "folder with the files of one series, which are in folders beside it."
        )
    if reason:
        return FileFormatError(f"{source.name}: cannot be read as an image: {reason}.")
    if source.name.lower().endswith(_FREESURFER):
        return FileFormatError(
            f"{source.name}: cannot be read as an image: it is a volume of FreeSurfer. Convert it: "
            f"mri_convert {source.name} {source.stem}.nii.gz."
        )
    reason = "damaged, or has another format" if source.stat().st_size else "empty"
    kinds = ", ".join((*PICTURE_SUFFIXES, *MEDICAL_SUFFIXES))
    return FileFormatError(
        f"{source.name}: cannot be read as an image: it is {reason}. Supported suffixes are "
        f"{kinds}."
    )


def stem_of(path: str | os.PathLike[str]) -> str:
    """Return the name of a file without the suffix of its format; other dots belong to the name."""
    name = Path(path).name
    kinds = (*PICTURE_SUFFIXES, *MEDICAL_SUFFIXES, _SEGMENTS, *_OTHER_SUFFIXES)
    longest = max((len(each) for each in kinds if name.lower().endswith(each)), default=0)
    return name[: len(name) - longest] or name


def result_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix for images computed from an image file: its own, if it is written."""
    name = Path(path).name.lower()
    if name.endswith(PICTURE_SUFFIXES):
        return ".tif"
    return next((each for each in _WRITTEN if name.endswith(each)), ".nrrd")


def is_segmentation(path: str | os.PathLike[str]) -> bool:
    """Return whether a path has the suffix of a segmentation of 3D Slicer."""
    return Path(path).name.lower().endswith(_SEGMENTS)


def is_scan(path: str | os.PathLike[str]) -> bool:
    """Return whether a path has the suffix of a medical image, or is a folder with DICOM files.

    The folder may contain other files, such as those in which systems store thumbnails.
    """
    source = Path(path)
    if not source.is_dir():
        return source.name.lower().endswith((*MEDICAL_SUFFIXES, "dicomdir"))
    return any(is_dicom(each) for each in sorted(source.iterdir()) if each.is_file())


def write_image(path: str | os.PathLike[str], image: ImageFile) -> Path:
    """Write an image atomically, in the format given by the suffix of the path.

    Parameters
    ----------
    path : str or path-like
    image : ImageFile

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FileFormatError
        If the suffix is unknown, or the format does not support such pixels.
    HmrfError, OSError
        As for `read_image`.
    """
    target = Path(checked_target(path))
    name = target.name.lower()
    kinds = (*PICTURE_SUFFIXES, *_WRITTEN)
    suffix = next((each for each in kinds if name.endswith(each)), "")
    if not suffix:
        raise FileFormatError(
            f"{target.name}: images cannot be written in this format. Use one of the suffixes "
            f"{', '.join(kinds)}."
        )
    try:
        content = _encode(target, image, suffix)
    except (HmrfError, OSError):
        raise
    except (ValueError, TypeError, KeyError) as error:
        raise FileFormatError(
            f"{target.name}: {image.pixels.dtype} pixels of shape {image.pixels.shape} cannot be "
            f"written as {suffix}. Use .tif or .nrrd."
        ) from error
    write_whole(target, content)
    return target


def _read_picture(source: Path) -> ImageFile:
    try:
        image = (_read_tiff if source.suffix.lower() in TIFF else _read_photo)(source)
    except Exception as error:
        raise _unreadable(source) from error
    pixels = image.pixels
    if pixels.dtype.kind not in "biuf":
        raise FileFormatError(
            f"{source.name}: the image has {pixels.dtype} values. Give an image of real numbers."
        )
    if image.ndim not in (2, 3):
        raise FileFormatError(
            f"{source.name}: the image has shape {pixels.shape}. Give an image with 2 or 3 axes: "
            "of several channels or times, save one, in Fiji by Image > Duplicate."
        )
    if not is_length(image.unit):
        raise FileFormatError(
            f"{source.name}: the size of its pixels is in {image.unit!r}, which is not a unit of "
            "length. Set the unit, in Fiji by Image > Properties."
        )
    return image


def _read_photo(source: Path) -> ImageFile:
    from PIL import Image  # heavy: PIL
    from skimage.io import imread  # heavy: skimage

    with Image.open(source) as picture:
        if picture.mode == "CMYK":
            return ImageFile(np.asarray(picture.convert("RGB")), colours=True)
    pixels = np.asarray(imread(source))
    if pixels.ndim == 3 and pixels.shape[-1] == 2:  # grey and opacity
        pixels = pixels[..., 0]
    return ImageFile(pixels, colours=pixels.ndim == 3)


def _read_tiff(source: Path) -> ImageFile:
    import tifffile  # heavy: tifffile

    with tifffile.TiffFile(source) as file:
        first = file.series[0]
        pixels, axes = np.asarray(first.asarray()), first.axes
        colours = axes.endswith("S") and pixels.shape[-1] in (3, 4)
        sizes, unit = _pixel_size(file, axes)
        image = ImageFile(pixels, None, colours, _NO_SPACE.get(axes[0], ""), sizes, unit)
        if not sizes or file.ome_metadata or file.imagej_metadata:
            return image
        return image._replace(
            resolution=f"the resolution of {source.name} is read as pixels of "
            f"{grid_in_words(sizes[-2:])} {unit}, as in Fiji: give --spacing if it is that of a "
            "print or screen"
        )


def axes_of_tiff(path: str | os.PathLike[str]) -> tuple[tuple[str, ...], tuple[float, ...], str]:
    """Return the axes of a .tif file, without colours, and the size of a pixel along them.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    contents : tuple of str
        Content of each axis, such as "channels" or "times"; "" for axes of space.
    sizes : tuple of float
        1 for axes that are not axes of space, and 0 if the distance of slices is unknown; empty if
        no size is known.
    unit : str
    """
    import tifffile  # heavy: tifffile

    with tifffile.TiffFile(checked_path(path)) as file:
        axes = file.series[0].axes
        contents = (_NO_SPACE.get(axis, "") for axis in axes.rstrip("S"))
        return tuple(contents), *_pixel_size(file, axes)


def _pixel_size(file: Any, axes: str) -> tuple[tuple[float, ...], str]:
    """Return the size of a pixel as ImageJ reads it, or as OME stores it; see `axes_of_tiff`."""
    with suppress(KeyError, TypeError, ValueError, ArithmeticError):  # invalid metadata
        if file.ome_metadata:
            sizes, unit = _ome_size(file)
        elif file.imagej_metadata:
            sizes, unit = _imagej_size(file)
        else:
            sizes, unit = _resolution(file)
        if min(sizes["Y"], sizes["X"]) > 0 and (unit != "pixel" or sizes["Z"] != 1):
            sides = tuple(sizes.get(axis, 1.0) for axis in axes.rstrip("S"))
            return sides, length_unit(unit)
    return (), "pixel"


def length_unit(name: str) -> str:
    """Return the usual symbol of a unit of length, such as "µm" for "micron", or its name."""
    if name.casefold() in _PIXELS:  # otherwise "px" would be 1/96 inch
        return "pixel"
    return next((each for each in _UNITS if math.isclose(unit_factor(name, each), 1.0)), name)


def read_picture_as(
    path: str | os.PathLike[str],
    spacing: tuple[tuple[float, ...], str] | None,
    resample: bool = False,
) -> ImageFile:
    """Read an image, and give the pixels of a picture a size.

    Parameters
    ----------
    path : str or path-like
    spacing : (tuple of float, str) or None
        Size of a pixel along each axis of the file, and its unit; None for the size in the file.
    resample : bool
        As for `read_image`.

    Raises
    ------
    HmrfError
        If the file states the size of its pixels, other than as a resolution, or has another number
        of axes; or as for `read_image`.
    OSError
        If the file cannot be opened.
    """
    image, name = read_image(path, resample=resample), Path(path).name
    if spacing is None:
        return image
    sizes, unit = spacing
    is_stated = image.sizes and 0.0 not in image.sizes and not image.resolution
    if image.geometry is not None or is_stated:
        raise HmrfError(f"{name} states the size of its pixels. Leave out --spacing.")
    if len(sizes) != image.ndim:
        raise HmrfError(
            f"--spacing has {len(sizes)} sizes, but {name} has {image.ndim} axes. Give one size "
            "for each axis."
        )
    return image._replace(sizes=sizes, unit=unit, resolution="")


def _ome_size(file: Any) -> tuple[dict[str, float], str]:
    import tifffile  # heavy: tifffile

    images = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
    stated = (images[0] if isinstance(images, list) else images)["Pixels"]
    units = {axis: stated.get(f"PhysicalSize{axis}Unit", _OME_UNIT) for axis in "ZYX"}
    sizes = {
        axis: float(stated.get(f"PhysicalSize{axis}", 0)) * unit_factor(unit, units["X"])
        for axis, unit in units.items()
    }
    return sizes, units["X"]


def _imagej_size(file: Any) -> tuple[dict[str, float], str]:
    stated, tags = file.imagej_metadata, file.pages[0].tags
    unit = stated.get("unit", "").replace("\\u00B5", "µ") or "pixel"
    sizes = {"Z": float(stated.get("spacing", 1.0)), "Y": 1.0, "X": 1.0}
    if length_unit(unit) == "pixel":
        return sizes, "pixel"
    return sizes | _sides(tags), unit


def _resolution(file: Any) -> tuple[dict[str, float], str]:
    """Return the size of a pixel from the resolution of a .tif of another program than ImageJ."""
    tags = file.pages[0].tags
    unit, sides = _RESOLUTIONS.get(tags["ResolutionUnit"].value, "pixel"), _sides(tags)
    if unit == "pixel" or (unit == "inch" and sides["X"] == 1 / _NO_RESOLUTION):
        return {"Z": 1.0, **sides}, "pixel"
    return {**dict.fromkeys("ZQI", 0.0), **sides}, unit  # the distance of pages is unknown


def _sides(tags: Any) -> dict[str, float]:
    """Return the inverse of the resolution of a .tif along its rows and columns."""
    stated = {axis: tags[f"{axis}Resolution"].value for axis in "YX"}
    return {axis: below / above for axis, (above, below) in stated.items()}


def _encode(target: Path, image: ImageFile, suffix: str) -> bytes:
    if suffix in TIFF:
        return _encode_tiff(image)
    if suffix in PICTURE_SUFFIXES:
        return _encode_picture(image.pixels, suffix)
    pixels = image.pixels_in_place
    geometry = image.geometry or Geometry.at_origin(pixels.shape[: image.ndim])
    components = pixels.shape[-1] if image.colours else 1
    return encode(target, Decoded(pixels, components, geometry, {}), suffix)


def _encode_tiff(image: ImageFile) -> bytes:
    """Return the bytes of a .tif, with the size of its pixels for ImageJ, or else as OME."""
    import tifffile  # heavy: tifffile

    pixels, unit = image.pixels, image.unit
    first = next((axis for axis, content in _NO_SPACE.items() if content == image.stack), "Z")
    options: dict[str, Any] = {"photometric": "rgb" if image.colours else "minisblack"}
    if image.sizes or image.stack:
        depth, *sides = (1.0, *image.sizes)[-3:] if image.sizes else (1.0, 1.0, 1.0)
        axes = f"{first}YX"[-image.ndim :] + "S" * image.colours
        is_colour = image.colours and pixels.dtype != np.uint8
        if pixels.dtype in _IMAGEJ and not is_colour:
            about = {"axes": axes, "spacing": depth, "unit": unit.replace("µ", "u")}
            options |= {"imagej": True, "resolution": tuple(1 / side for side in sides[::-1])}
        else:
            along = dict(zip("ZYX", (depth, *sides), strict=True))
            about = {f"PhysicalSize{axis}": size for axis, size in along.items()}
            about |= {f"PhysicalSize{axis}Unit": unit for axis in along} | {"axes": axes}
            options["ome"] = True
        options["metadata"] = about
    file = io.BytesIO()
    tifffile.imwrite(file, pixels, **options)
    return file.getvalue()


def _encode_picture(pixels: npt.NDArray[Any], suffix: str) -> bytes:
    """Return the bytes of a picture file."""
    from PIL import Image  # heavy: PIL

    file = io.BytesIO()
    values = pixels.astype(np.uint8) * 255 if pixels.dtype == bool else pixels
    try:
        Image.fromarray(values).save(file, Image.registered_extensions()[suffix])
    except OSError as error:  # the format does not support these values
        raise ValueError(str(error)) from error
    return file.getvalue()

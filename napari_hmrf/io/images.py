"""Image files: pictures, and medical images with their place.

scikit-image reads and Pillow writes pictures (.png, .jpg, .bmp), tifffile does both for .tif.
SimpleITK, in the extra ``medical``, handles NIfTI, MetaImage, NRRD and folders of DICOM.
"""

from __future__ import annotations

import io
import os
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError, HmrfError, ProblemError
from napari_hmrf.io.fields import Place
from napari_hmrf.io.itk_files import ItkImage, Unreadable, encode, read_itk_image, read_itk_series
from napari_hmrf.regular_file import refuse_irregular

#: Largest distance between two grids that count as the same, in pixels.
SAME = 0.01
#: Endings of the files of pictures, and of medical images.
PICTURE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp")
MEDICAL_SUFFIXES = (".nii.gz", ".nii", ".mha", ".mhd", ".nrrd", ".nhdr", ".dcm")


class ImageFile(NamedTuple):
    """Image with its place, as read from a file or to be written.

    Attributes
    ----------
    pixels : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    place : Place or None
        Place in the patient, in mm; None for a picture.
    colours : bool
        True if the last axis holds colours.
    """

    pixels: npt.NDArray[Any]
    place: Place | None = None
    colours: bool = False

    @property
    def pixels_in_place(self) -> npt.NDArray[Any]:
        """Pixels on all axes of the place; a slice of a volume has an axis of length 1."""
        more = 0 if self.place is None else len(self.place.spacing) - self.ndim
        return self.pixels[(np.newaxis,) * more]

    @property
    def upright(self) -> ImageFile:
        """Volume with its axes in the order of the nearest axes of the world.

        Scanners acquire slices in any orientation, while napari shows slices across world axes.
        """
        place = self.place
        if place is None or len(place.spacing) != 3:
            return self
        turn = place.direction[::-1, ::-1]

        def nearness(order: tuple[int, ...]) -> float:
            return sum(abs(float(turn[world, axis])) for world, axis in enumerate(order))

        return self.reordered(max(permutations(range(3)), key=nearness))

    def reordered(self, order: tuple[int, ...]) -> ImageFile:
        """Return a view of a volume with a place, with its axes in another order."""
        place = self.place
        assert place is not None
        turn = place.direction[::-1, ::-1]
        return ImageFile(
            self.pixels_in_place.transpose(*order, *range(3, 3 + self.colours)),
            Place(
                tuple(place.spacing[axis] for axis in order),
                place.origin,
                turn[:, list(order)][::-1, ::-1],
            ),
            self.colours,
        )

    def laid_as(self, place: Place | None) -> ImageFile:
        """Return the image with its axes in the order of another place, if both can coincide."""
        if self.place is None or len(self.place.spacing) != 3 or apart(self.place, place) <= SAME:
            return self
        reordered = map(self.reordered, permutations(range(3)))
        return next((each for each in reordered if apart(each.place, place) <= SAME), self)

    def refuse_elsewhere(self, place: Place | None, name: str, what: str) -> None:
        """Refuse an image that lies elsewhere than another image of the same size.

        Parameters
        ----------
        place : Place or None
            Place of the other image; no image is refused if it is None.
        name : str
            Name of the file.
        what : str
            Description of the other image, for the message.

        Raises
        ------
        ProblemError
            Naming the file.
        """
        if apart(self.place, place, self.ndim) > SAME:
            raise ProblemError(
                name,
                f"lies elsewhere than {what}, although it has the same size. Give one with the "
                "same place; if only its header is wrong, save it as a .tif, which has no place.",
            )

    @property
    def ndim(self) -> int:
        """Number of axes in space."""
        return self.pixels.ndim - self.colours


def apart(one: Place | None, other: Place | None, axes: int = 3) -> float:
    """Return the largest distance between two grids, in pixels of the first.

    The first pixels and the unit steps along the axes are compared.

    Parameters
    ----------
    one, other : Place or None
    axes : int
        Number of last axes whose steps are compared; for a slice, the axes in its plane.

    Returns
    -------
    float
        0 if one of the grids has no place, or only one of them lies in a volume.
    """
    if one is None or other is None or len(one.spacing) != len(other.spacing):
        return 0.0
    n = len(one.spacing)
    corners = np.concatenate([np.zeros((1, n)), np.eye(n)[-axes:]])
    return float(np.abs(one.to_pixels(other.to_space(corners)) - corners).max())


def read_image(path: str | os.PathLike[str]) -> ImageFile:
    """Read an image, or a folder with the DICOM files of one series.

    A volume of one slice is read as that slice, with its place in the volume.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    ImageFile

    Raises
    ------
    FileFormatError
        If the file is not a readable image; or if a folder holds no series, or several.
    HmrfError
        If SimpleITK is needed but not installed.
    OSError
        If the file cannot be opened.
    """
    source = Path(checked_path(path))
    if not source.is_dir():
        refuse_irregular(source)
        with open(source, "rb"):
            pass  # a file that cannot be opened raises the error of the system
        if source.name.lower().endswith(PICTURE_SUFFIXES):
            return _read_picture(source)
    try:
        image = read_itk_series(source) if source.is_dir() else read_itk_image(source)
    except Unreadable as error:
        if source.is_dir():
            reason = str(error) or "the folder holds a damaged series"
            raise FileFormatError(f"{source.name}: {reason}.") from None
        raise _unreadable(source) from error
    n, count, pixels = image.ndim, image.components, image.pixels
    if n not in (2, 3) or count not in (1, n, 3, 4):
        raise FileFormatError(
            f"{source.name}: an image of {n} axes with {count} values per pixel. Give one of 2 or "
            "3 axes, grey or in colours."
        )
    place = Place(image.spacing[::-1], image.origin, image.direction)
    if n == count and pixels.dtype.kind == "f":
        raise FileFormatError(
            f"{source.name}: the file holds a displacement field. Give the image that it moves."
        )
    return ImageFile(pixels[0] if n == 3 and len(pixels) == 1 else pixels, place, count > 1)


def _unreadable(source: Path) -> FileFormatError:
    """Return the error for a file that cannot be read as an image, with the likely reason."""
    reason = "damaged, or of another format" if source.stat().st_size else "empty"
    kinds = ", ".join((*PICTURE_SUFFIXES, *MEDICAL_SUFFIXES))
    return FileFormatError(
        f"{source.name}: not an image that can be read: it is {reason}. Images end in {kinds}."
    )


def is_scan(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a medical image by its ending, or a folder of only DICOM files."""
    source = Path(path)
    if not source.is_dir():
        return source.name.lower().endswith(MEDICAL_SUFFIXES)
    files = [each for each in source.iterdir() if each.is_file()]
    return bool(files) and all(map(_is_dicom, files))


def _is_dicom(file: Path) -> bool:
    with open(file, "rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def write_image(path: str | os.PathLike[str], image: ImageFile) -> Path:
    """Write an image, atomically, in the format given by the ending of the name.

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
        If the ending is unknown, or the format cannot hold such pixels.
    HmrfError, OSError
        As for `read_image`.
    """
    target = Path(checked_path(path))
    name = target.name.lower()
    kinds = (*PICTURE_SUFFIXES, *(each for each in MEDICAL_SUFFIXES if each not in _PARTED))
    suffix = next((each for each in kinds if name.endswith(each)), "")
    if not suffix:
        raise FileFormatError(
            f"{target.name}: images are not written in such a format. End the name in one of "
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


_TIFF = (".tif", ".tiff")
#: Formats that are read but not written: those in two files, and DICOM.
_PARTED = (".mhd", ".nhdr", ".dcm")


def _read_picture(source: Path) -> ImageFile:
    try:
        pixels, colours = (_read_tiff if source.suffix.lower() in _TIFF else _read_photo)(source)
    except Exception as error:
        raise _unreadable(source) from error
    if pixels.dtype.kind not in "biuf":
        raise FileFormatError(
            f"{source.name}: an image of {pixels.dtype} values. Give an image of real numbers."
        )
    if pixels.ndim - colours not in (2, 3):
        raise FileFormatError(
            f"{source.name}: an image of shape {pixels.shape}. Give an image of 2 or 3 axes."
        )
    return ImageFile(pixels, None, colours)


def _read_photo(source: Path) -> tuple[npt.NDArray[Any], bool]:
    from skimage.io import imread  # heavy: skimage

    pixels = np.asarray(imread(source))
    return pixels, pixels.ndim == 3


def _read_tiff(source: Path) -> tuple[npt.NDArray[Any], bool]:
    import tifffile  # heavy: tifffile

    with tifffile.TiffFile(source) as file:
        first = file.series[0]
        pixels = np.asarray(first.asarray())
        return pixels, first.axes.endswith("S") and pixels.shape[-1] in (3, 4)


def _encode(target: Path, image: ImageFile, suffix: str) -> bytes:
    if suffix in _TIFF:
        import tifffile  # heavy: tifffile

        file = io.BytesIO()
        tifffile.imwrite(file, image.pixels, photometric="rgb" if image.colours else "minisblack")
        return file.getvalue()
    if suffix in PICTURE_SUFFIXES:
        return _encode_picture(image.pixels, suffix)
    pixels, place = image.pixels_in_place, image.place
    if place is None:
        n = image.ndim
        place = Place((1.0,) * n, (0.0,) * n, np.eye(n))
    components = pixels.shape[-1] if image.colours else 1
    itk_image = ItkImage(pixels, components, place.spacing[::-1], place.origin, place.direction, {})
    return encode(target, itk_image, suffix)


def _encode_picture(pixels: npt.NDArray[Any], suffix: str) -> bytes:
    """Encode a picture in memory."""
    from PIL import Image  # heavy: PIL

    file = io.BytesIO()
    values = pixels.astype(np.uint8) * 255 if pixels.dtype == bool else pixels
    try:
        Image.fromarray(values).save(file, Image.registered_extensions()[suffix])
    except OSError as error:  # the format cannot hold these values
        raise ValueError(str(error)) from error
    return file.getvalue()

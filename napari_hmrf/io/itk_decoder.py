"""Decoder process: runs SimpleITK, so that a damaged file cannot crash the calling process.

`decoder_process` runs this file as a program. It does not import other modules of this package, so
that it starts within a tenth of a second. Standard input receives the module search path and then
requests: one line of JSON each, followed by the pixels if an image is to be written. Standard
output returns one line of JSON per request, followed by the pixels if an image was read.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

if sys.platform != "win32":
    import resource

#: Largest compression ratio of a file: the limit of deflate.
MOST_PACKED = 1032
#: Suffixes of header files with the pixels in another file of the same folder.
PARTED = (".mhd", ".nhdr", ".hdr")
#: Suffixes of files that are read as transforms.
TRANSFORMS = (".h5", ".hdf5", ".tfm", ".txt", ".mat")
#: Largest distance between a pixel and its place on a regular grid, in pixels.
_OFF = 0.1
#: Largest difference between the cosines of two directions that are considered equal.
_TURNED = 1e-3
#: DICOM keys of the position of a slice, and of its rescale slope and intercept.
_POSITION, _RESCALE = "0020|0032", ("0028|1053", "0028|1052")
#: Positions, directions and number of frames in a file of several frames, with explicit or implicit
#: types, and the tag that precedes the pixels. SimpleITK does not give the positions.
_FRAME_POSITIONS, _FRAME_DIRECTIONS, _FRAME_COUNT = (
    re.compile(rb"%b\x00(?:[DI]S..|.\x00\x00\x00)([-+.0-9eE \\]+)" % tag, re.DOTALL)
    for tag in (rb"\x20\x00\x32", rb"\x20\x00\x37", rb"\x28\x00\x08")
)
_PIXELS = b"\xe0\x7f\x10\x00"
#: Time without a request after which the process exits, in seconds.
_IDLE = 60.0
#: CPU time beyond the limit of the request, in seconds, after which the operating system ends the
#: process.
_GRACE = 2


class Refused(Exception):
    """Error for a file that was rejected; the message is the reason, as a clause."""


class Decoder:
    """Reader and writer of files with SimpleITK.

    The last transform is cached, because its pixels are often requested after its header.
    """

    def __init__(self, sitk: Any) -> None:
        self._sitk = sitk
        self._last: tuple[Any, Any] = (None, None)

    def answer(self, request: dict[str, Any]) -> tuple[dict[str, Any], Any]:
        """Return the header for a request, and the image to send (None if there is no image)."""
        source, kind = Path(request["path"]), request["kind"]
        if kind == "series":
            return self._read_series(source)
        if source.suffix.lower() in TRANSFORMS and request["vectors"]:
            image = self._field_of(source)
            self._last = (None, None) if kind == "pixels" else (_identity(source), image)
        elif kind == "head":
            reader = self._checked_reader(source)
            return self._head(reader, reader.GetNumberOfComponents()), None
        else:
            self._checked_reader(source)
            image = self._sitk.ReadImage(str(source))
        return self._head(image), image if kind == "pixels" else None

    def write(self, request: dict[str, Any], pixels: Any) -> None:
        """Write an image, or a displacement field as a transform."""
        sitk = self._sitk
        image = sitk.GetImageFromArray(pixels, isVector=request["components"] > 1)
        image.SetSpacing(request["spacing"])
        image.SetOrigin(request["origin"])
        image.SetDirection(request["direction"])
        for key, text in request["metadata"].items():
            image.SetMetaData(key, text)
        if request["vectors"]:
            sitk.WriteTransform(sitk.DisplacementFieldTransform(image), request["path"])
        else:
            sitk.WriteImage(image, request["path"], useCompression=True)

    def _head(self, image: Any, components: int = 0) -> dict[str, Any]:
        """Return the header of an image or an image reader.

        Parameters
        ----------
        image : SimpleITK.Image or SimpleITK.ImageFileReader
        components : int
            Number of values per pixel, required for a reader.
        """
        metadata = {}
        for key in image.GetMetaDataKeys():
            with suppress(UnicodeError, RuntimeError):  # the text is damaged
                metadata[key] = image.GetMetaData(key)
        return {
            "components": components or image.GetNumberOfComponentsPerPixel(),
            "size": image.GetSize(),
            "spacing": image.GetSpacing(),
            "origin": image.GetOrigin(),
            "direction": image.GetDirection(),
            "pixel": self._sitk.GetPixelIDValueAsString(image.GetPixelID()),
            "metadata": metadata,
        }

    def _read_series(self, folder: Path) -> tuple[dict[str, Any], Any]:
        reader = self._sitk.ImageSeriesReader()
        series = reader.GetGDCMSeriesIDs(str(folder))
        if len(series) != 1:
            return {"series": len(series)}, None
        slices = [*map(self._slice, reader.GetGDCMSeriesFileNames(str(folder), series[0]))]
        if len(slices) > 1:
            slices = ordered(slices)
        reader.SetFileNames([each.path for each in slices])
        if len({each.rescale for each in slices}) > 1:  # the type of the first slice is too narrow
            reader.SetOutputPixelType(self._sitk.sitkFloat32)
        image = reader.Execute()
        return self._head(image), image

    def _slice(self, path: str) -> Slice:
        reader = self._sitk.ImageFileReader()
        reader.SetFileName(path)
        reader.ReadImageInformation()
        keys = reader.GetMetaDataKeys()
        return Slice(
            path,
            reader.GetSize(),
            reader.GetSpacing(),
            reader.GetDirection(),
            reader.GetOrigin() if _POSITION in keys else None,
            tuple(reader.GetMetaData(key).strip() if key in keys else "" for key in _RESCALE),
        )

    def _checked_reader(self, source: Path) -> Any:
        """Return a reader for an image, after checking that the file can contain its pixels."""
        if source.suffix.lower() == ".dcm":
            _check_frames(source)
        reader = self._sitk.ImageFileReader()
        reader.SetFileName(str(source))
        reader.ReadImageInformation()
        pixel = self._sitk.Image([1, 1], reader.GetPixelID(), reader.GetNumberOfComponents())
        pixel_size = pixel.GetSizeOfPixelComponent() * pixel.GetNumberOfComponentsPerPixel()
        files = source.parent.iterdir() if source.suffix.lower() in PARTED else [source]
        largest = max((file.stat().st_size for file in files if file.is_file()), default=0)
        expansion = 1 if source.suffix.lower() == ".nii" else MOST_PACKED
        if math.prod(reader.GetSize()) * pixel_size > largest * expansion:
            raise Refused("it contains fewer pixels than its header states")
        return reader

    def _field_of(self, source: Path) -> Any:
        """Read the displacement field of a transform."""
        identity, cached = self._last
        if identity is not None and identity == _identity(source):
            return cached
        sitk = self._sitk
        transform = sitk.ReadTransform(str(source))
        if transform.GetName() == "DisplacementFieldTransform":
            return sitk.DisplacementFieldTransform(transform).GetDisplacementField()
        # ANTs stores a displacement field and an affine transform in one file. Because the last
        # transform is applied first, the grid of the last field is that of the image.
        is_chain = transform.GetName() == "CompositeTransform"
        chain = sitk.CompositeTransform(transform if is_chain else [transform])
        parts = [chain.GetNthTransform(number) for number in range(chain.GetNumberOfTransforms())]
        last = [part for part in parts if part.GetName() == "DisplacementFieldTransform"][-1:]
        if not last:
            names = ", ".join(part.GetName() for part in parts)
            raise Refused(
                f"it contains no field, but {names}. Convert it to a field on the grid of the "
                "image, as with SimpleITK.TransformToDisplacementField"
            )
        field = sitk.DisplacementFieldTransform(last[0]).GetDisplacementField()
        if len(parts) == 1:
            return field
        grid = (field.GetSize(), field.GetOrigin(), field.GetSpacing(), field.GetDirection())
        return sitk.TransformToDisplacementField(chain, sitk.sitkVectorFloat64, *grid)


class Slice(NamedTuple):
    """Slice of a DICOM series: size, spacing, direction and position as in ITK, and rescaling."""

    path: str
    size: tuple[int, ...]
    spacing: tuple[float, ...]
    direction: tuple[float, ...]
    origin: tuple[float, ...] | None
    rescale: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the file."""
        return Path(self.path).name


def ordered(slices: list[Slice]) -> list[Slice]:
    """Return the slices of a volume in the order of their positions.

    Slices without positions keep their order.

    Raises
    ------
    Refused
        If the slices are not those of one volume on a regular grid at right angles.
    """
    if any(math.prod(each.size[2:]) > 1 for each in slices):
        raise Refused("the folder contains files of several frames. Give one of these files")
    _check_alike(slices)
    if all(each.origin is None for each in slices):
        return slices
    lost = [each.name for each in slices if each.origin is None]
    if lost:
        raise Refused(f"{_listed(lost)} {_have(lost)} no position. Give a folder with one volume")
    normal = slices[0].direction[2::3]
    slices = sorted(slices, key=lambda each: _dot(normal, each.origin or ()))
    names = [each.name for each in slices]
    check_regular([each.origin or () for each in slices], normal, slices[0].spacing, names)
    return slices


def _dot(one: Iterable[float], other: Iterable[float]) -> float:
    return math.fsum(a * b for a, b in zip(one, other, strict=True))


def _cross(u: Sequence[float], v: Sequence[float]) -> tuple[float, ...]:
    return (
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    )


def _check_alike(slices: list[Slice]) -> None:
    """Raise an error if some slices differ from most in size, pixels or direction."""

    def alike(one: Slice, other: Slice) -> bool:
        turned = max(abs(a - b) for a, b in zip(one.direction, other.direction, strict=True))
        sizes = zip(one.spacing[:2], other.spacing[:2], strict=True)
        same = all(math.isclose(*pair, rel_tol=1e-3) for pair in sizes)
        return same and turned <= _TURNED and one.size[:2] == other.size[:2]

    groups: list[list[Slice]] = []
    for each in slices:
        group = next((group for group in groups if alike(group[0], each)), None)
        if group is None:
            groups.append([each])
        else:
            group.append(each)
    groups.sort(key=len)
    others = [each.name for group in groups[:-1] for each in group]
    if others:
        raise Refused(
            f"{_listed(others)} {_have(others)} another direction, size or pixel size than the "
            "other slices, as scouts have. Move these files to another folder"
        )


def check_regular(
    positions: Sequence[Sequence[float]],
    normal: Sequence[float],
    spacing: Sequence[float],
    names: Sequence[str],
) -> None:
    """Raise an error if slices are not one above the other, at equal distances.

    Parameters
    ----------
    positions : sequence of sequence of float
        Position of each slice, in the order of the slices.
    normal : sequence of float
        Direction perpendicular to the slices.
    spacing : sequence of float
        Pixel size along each axis of a slice.
    names : sequence of str
        Names of the slices, for messages.

    Raises
    ------
    Refused
        If slices share a position, are missing, or are shifted along each other.
    """
    depths = [_dot(normal, at) for at in positions]
    steps = [after - before for before, after in itertools.pairwise(depths)]
    step = sorted(map(abs, steps))[len(steps) // 2]
    doubled = sum(abs(each) <= _OFF * abs(step) for each in steps)
    if doubled or step == 0:
        raise Refused(
            f"{doubled} of {len(depths)} slices are at the position of another slice, so there is "
            "more than one volume. Keep the files of one volume"
        )
    mean = (depths[-1] - depths[0]) / len(steps)
    off = max(abs(at - depths[0] - number * mean) for number, at in enumerate(depths))
    if off > _OFF * abs(mean):
        far = max(range(len(steps)), key=lambda number: abs(abs(steps[number]) - step))
        raise Refused(
            f"the distances of its slices differ: most are {step:.4g} mm apart, but {names[far]} "
            f"and {names[far + 1]} are {abs(steps[far]):.4g} mm apart. Add the missing slices, or "
            "resample the volume to equal distances"
        )
    depth = abs(depths[-1] - depths[0])
    across = [b - a for a, b in zip(positions[0], positions[-1], strict=True)]
    height = _dot(normal, across)
    shift = math.hypot(*(c - height * n for c, n in zip(across, normal, strict=True)))
    if shift > _OFF * min(spacing[:2]):
        raise Refused(
            f"its slices are shifted along each other, by {shift:.3g} mm from the first to the "
            f"last (a gantry tilt of {math.degrees(math.atan2(shift, depth)):.3g} degrees). "
            "Convert it with dcm2niix, which corrects the tilt, and give the corrected file"
        )


def _check_frames(source: Path) -> None:
    """Raise an error if the frames of a DICOM file are not in the order of their positions."""
    header = source.read_bytes().partition(_PIXELS)[0]
    try:
        positions, directions, counts = (
            [[*map(float, text.split(b"\\"))] for text in found.findall(header)]
            for found in (_FRAME_POSITIONS, _FRAME_DIRECTIONS, _FRAME_COUNT)
        )
    except ValueError:
        return  # the bytes have another meaning
    across = directions[0] if directions else [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    is_volume = len(positions) > 1 and [len(positions)] in counts
    if not is_volume or len(across) != 6 or any(len(at) != 3 for at in positions):
        return
    normal = _cross(across[:3], across[3:])
    depths = [_dot(normal, at) for at in positions]
    if depths not in (sorted(depths), sorted(depths, reverse=True)):
        raise Refused(
            "its frames are not stored in the order of their positions. Convert it with dcm2niix, "
            "which sorts them"
        )
    names = [f"frame {number}" for number in range(1, len(positions) + 1)]
    check_regular(positions, normal, (1.0, 1.0), names)


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{', '.join(names[:3])}{more}"


def _have(names: list[str]) -> str:
    return "has" if len(names) == 1 else "have"


def _identity(source: Path) -> tuple[str, int, int]:
    status = source.stat()
    return str(source), status.st_mtime_ns, status.st_size


def _limit_processor_time(seconds: float) -> None:
    """Limit the CPU time of this process, in case its client has ended and cannot kill it."""
    if sys.platform == "win32":
        return
    with suppress(ValueError, OSError):
        used = resource.getrusage(resource.RUSAGE_SELF)
        limit = math.ceil(used.ru_utime + used.ru_stime + seconds) + _GRACE
        _, most = resource.getrlimit(resource.RLIMIT_CPU)
        limit = limit if most == resource.RLIM_INFINITY else min(limit, most)
        resource.setrlimit(resource.RLIMIT_CPU, (limit, most))


def _send(out: BinaryIO, header: dict[str, Any], pixels: Any = None) -> None:
    out.write(json.dumps(header).encode() + b"\n")
    if pixels is not None:
        out.write(memoryview(pixels).cast("B") if pixels.size else b"")
    out.flush()


def _receive(stream: BinaryIO, header: dict[str, Any]) -> Any:
    """Receive the pixels that follow a request."""
    import numpy as np  # heavy: numpy

    kind = np.dtype(header["dtype"])
    content = stream.read(math.prod(header["shape"]) * kind.itemsize)
    return np.frombuffer(content, kind).reshape(header["shape"])


def main() -> None:
    """Serve requests until standard input is closed or no request has arrived for a minute."""
    with suppress(ValueError, OSError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent process
    out = os.fdopen(os.dup(1), "wb")
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # libraries print warnings about damaged files to these streams
        os.dup2(silent, stream)
    sys.path[:] = json.loads(sys.stdin.buffer.readline())
    # Without it, ITK refuses a NIfTI sform whose axes are at right angles only up to rounding, or
    # reads the qform instead, which may state another place.
    os.environ["ITK_NIFTI_SFORM_PERMISSIVE"] = "ON"
    try:
        import SimpleITK  # optional: SimpleITK
    except ImportError:
        _send(out, {"missing": True})
        return
    sitk: Any = SimpleITK
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    decoder = Decoder(sitk)
    _send(out, {"ready": True})
    while True:
        idle = threading.Timer(_IDLE, os._exit, (0,))
        idle.daemon = True
        idle.start()
        line = sys.stdin.buffer.readline()
        idle.cancel()
        if not line:
            return
        request = json.loads(line)
        _limit_processor_time(request["seconds"])
        if request["kind"] == "write":
            try:
                decoder.write(request, _receive(sys.stdin.buffer, request))
            except Exception:  # noqa: BLE001 - the libraries raise many types of errors
                _send(out, {"refused": ""})
                os._exit(0)  # after an error, HDF5 would not close the file
            _send(out, {"written": True})
            continue
        try:
            header, image = decoder.answer(request)
            pixels = None if image is None else sitk.GetArrayViewFromImage(image)
        except Refused as error:
            _send(out, {"refused": str(error)})
            continue
        except Exception:  # noqa: BLE001 - SimpleITK's own messages cite its source files
            _send(out, {"refused": ""})
            continue
        if pixels is not None:
            header |= {"dtype": pixels.dtype.str, "shape": pixels.shape}
        _send(out, header, pixels)
        del image, pixels


if __name__ == "__main__":
    main()

"""Decoder process: runs SimpleITK, so that a damaged file cannot crash the calling process.

`decoder_process` runs this file as a program. It does not import other modules of this package, so
that it starts within a tenth of a second. Standard input receives the module search path and then
requests: one line of JSON each, followed by the pixels if an image is to be written. Standard
output returns one line of JSON per request, followed by the pixels if an image was read.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

if sys.platform != "win32":
    import resource

#: Largest compression ratio of a file: the limit of deflate.
MOST_PACKED = 1032
#: Suffixes of header files with the pixels in another file of the same folder.
PARTED = (".mhd", ".nhdr", ".hdr")
#: Suffixes of files that are read as transforms.
TRANSFORMS = (".h5", ".hdf5", ".tfm", ".txt")
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
        reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder), series[0]))
        image = reader.Execute()
        return self._head(image), image

    def _checked_reader(self, source: Path) -> Any:
        """Return a reader for an image, after checking that the file can contain its pixels."""
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
        if transform.GetName() != "CompositeTransform":
            return sitk.DisplacementFieldTransform(transform).GetDisplacementField()
        # ANTs stores a displacement field and an affine transform in one file. Because the last
        # transform is applied first, the grid of the last field is that of the image.
        chain = sitk.CompositeTransform(transform)
        parts = [chain.GetNthTransform(number) for number in range(chain.GetNumberOfTransforms())]
        last = [part for part in parts if part.GetName() == "DisplacementFieldTransform"][-1:]
        if not last:
            raise Refused("none of its transforms is a displacement field")
        field = sitk.DisplacementFieldTransform(last[0]).GetDisplacementField()
        if len(parts) == 1:
            return field
        grid = (field.GetSize(), field.GetOrigin(), field.GetSpacing(), field.GetDirection())
        return sitk.TransformToDisplacementField(chain, sitk.sitkVectorFloat64, *grid)


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

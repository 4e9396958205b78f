"""Decoder process: runs SimpleITK, so that a damaged file cannot crash the calling process.

`decoder_process` starts this file as a program. It imports nothing from this package, so that it
starts in a tenth of a second. Standard input carries the search path and then one request per line,
as JSON, followed by the pixels of an image to write; standard output carries one line of JSON for
each request, followed by the pixels of an image that was read.
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

#: Largest expansion of a compressed file: the limit of deflate.
MOST_PACKED = 1032
#: Suffixes of headers whose pixels are in another file of the same folder.
PARTED = (".mhd", ".nhdr", ".hdr")
#: Suffixes of files that are read as transforms.
TRANSFORMS = (".h5", ".hdf5", ".tfm", ".txt")
#: Time without a request after which the process exits, in seconds.
_IDLE = 60.0
#: Processor time beyond that of the request before the system ends this process, in seconds.
_GRACE = 2


class Refused(Exception):
    """A file was not read; the message is the reason, as the end of a sentence."""


class Decoder:
    """Reader and writer of files with SimpleITK.

    The last transform is cached, because its header and its pixels are often requested in turn.
    """

    def __init__(self, sitk: Any) -> None:
        self._sitk = sitk
        self._last: tuple[Any, Any] = (None, None)

    def answer(self, request: dict[str, Any]) -> tuple[dict[str, Any], Any]:
        """Return the header for a request, and the image to send with it, or None."""
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
        """Write an image, or the transform of a field."""
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
        """Describe an image, or an image reader with the given number of components."""
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
        """Read the header of an image, and refuse sizes that the file cannot hold."""
        reader = self._sitk.ImageFileReader()
        reader.SetFileName(str(source))
        reader.ReadImageInformation()
        pixel = self._sitk.Image([1, 1], reader.GetPixelID(), reader.GetNumberOfComponents())
        pixel_size = pixel.GetSizeOfPixelComponent() * pixel.GetNumberOfComponentsPerPixel()
        files = source.parent.iterdir() if source.suffix.lower() in PARTED else [source]
        largest = max((file.stat().st_size for file in files if file.is_file()), default=0)
        expansion = 1 if source.suffix.lower() == ".nii" else MOST_PACKED
        if math.prod(reader.GetSize()) * pixel_size > largest * expansion:
            raise Refused("it claims more pixels than it holds")
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
        # ANTs stores a warp and its affine map in one file. The last transform is applied first,
        # so the last field has the grid of the image.
        chain = sitk.CompositeTransform(transform)
        parts = [chain.GetNthTransform(number) for number in range(chain.GetNumberOfTransforms())]
        last = [part for part in parts if part.GetName() == "DisplacementFieldTransform"][-1:]
        if not last:
            raise Refused("no field is among its transforms")
        field = sitk.DisplacementFieldTransform(last[0]).GetDisplacementField()
        if len(parts) == 1:
            return field
        grid = (field.GetSize(), field.GetOrigin(), field.GetSpacing(), field.GetDirection())
        return sitk.TransformToDisplacementField(chain, sitk.sitkVectorFloat64, *grid)


def _identity(source: Path) -> tuple[str, int, int]:
    status = source.stat()
    return str(source), status.st_mtime_ns, status.st_size


def _limit_processor_time(seconds: float) -> None:
    """Limit the processor time of this process, in case its client has ended."""
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
    """Answer requests until standard input is closed, or no request arrives for a minute."""
    with suppress(ValueError, OSError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent process
    out = os.fdopen(os.dup(1), "wb")
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # libraries print to these streams when a file is damaged
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
                os._exit(0)  # HDF5 keeps the file open when writing it fails
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

"""Client of the decoder process: starts the process, sends requests, and kills a hung process.

A damaged file can make the libraries that decode it crash or hang, and HDF5 does not recover from a
full disk. The libraries therefore run in a separate process (`itk_decoder`), which handles one
request at a time and is restarted after a crash.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import psutil

from napari_hmrf.errors import HmrfError
from napari_hmrf.extras import how_to_install
from napari_hmrf.io import itk_decoder

#: CPU time allowed for any file, in seconds.
_LEAST_SECONDS = 0.4
#: Additional CPU time allowed per MB, in seconds; long enough for large files on slow machines.
_SECONDS_PER_MB = 2.0
#: Elapsed time allowed for any file, and additional time per MB, in seconds; long enough for slow
#: disks and networks.
_LEAST_WAIT, _WAIT_PER_MB = 60.0, 5.0
#: Memory allowed in addition to the decompressed file, in bytes.
_LEAST_MEMORY = 512 * 2**20
#: Largest number of copies of the decompressed file in memory during decoding.
_COPIES = 4
#: Time between two checks of a busy decoder, in seconds.
_POLL = 0.05
#: Substrings in the names of programs that can run a Python script; in napari's bundle for macOS,
#: the interpreter is named "napari".
_INTERPRETERS = ("python", "pypy", "napari")
#: Number of rejected files to remember, so that they are not decoded again.
_REMEMBERED = 32


class Undecodable(Exception):
    """Error for a file that could not be decoded.

    Parameters
    ----------
    reason : str
        Reason, as a clause without a period; "" if unknown.
    fatal : bool
        True if the decoder crashed or was killed.
    """

    def __init__(self, reason: str, *, fatal: bool = False) -> None:
        super().__init__(reason)
        self.fatal = fatal


class Decoded(NamedTuple):
    """Response of the decoder: the header, and the pixels if they were requested."""

    header: dict[str, Any]
    pixels: npt.NDArray[Any] | None = None


class _Watch:
    """Watchdog thread that kills a decoder if a request exceeds its time or memory limit."""

    def __init__(self, process: subprocess.Popen[bytes], seconds: float, size: int) -> None:
        self.reason = ""
        self._process = process
        self._seconds = seconds
        self._most_wait = _LEAST_WAIT + _WAIT_PER_MB * size / 1e6
        self._memory = _LEAST_MEMORY + _COPIES * itk_decoder.MOST_PACKED * size
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        started, before = time.monotonic(), -1.0
        with suppress(psutil.Error):
            decoder = psutil.Process(self._process.pid)
            while not self._done.wait(_POLL):
                times = decoder.cpu_times()
                used = times.user + times.system
                before = used if before < 0 else before
                if used - before > self._seconds:
                    self.reason = "decoding it did not finish, so it is probably damaged"
                elif decoder.memory_info().rss > self._memory:
                    self.reason = "decoding it takes too much memory for a file of its size"
                elif time.monotonic() - started > self._most_wait:
                    self.reason = "its disk does not respond"
                if self.reason:
                    self._process.kill()
                    return


class DecoderProcess:
    """Thread-safe client of a decoder process, which is started on first use."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._reset()

    def _reset(self) -> None:
        self._lock = threading.Lock()
        self._process = None
        self._refusals: OrderedDict[tuple[Any, ...], Undecodable] = OrderedDict()

    def decode(self, source: Path, kind: str, *, vectors: bool = False) -> Decoded:
        """Decode a file, or only its header.

        Parameters
        ----------
        source : Path
            File, or folder of DICOM files.
        kind : {"head", "pixels", "series"}
            Content to decode: only the header; header and pixels; or, for a folder of DICOM files,
            its only series.
        vectors : bool
            If True, return the displacement field of a transform.

        Raises
        ------
        Undecodable
            If the file is rejected, or decoding crashes or hangs.
        HmrfError
            If SimpleITK is not installed, or the process cannot be started.
        OSError
            If the file does not exist.
        """
        status, size = source.stat(), _bytes_in(source)
        identity = (str(source), status.st_ino, status.st_mtime_ns, status.st_size, vectors)
        with self._lock:
            if identity in self._refusals:
                raise self._refusals[identity].with_traceback(None)
            seconds = _LEAST_SECONDS + _SECONDS_PER_MB * size / 1e6
            path = os.path.abspath(source)
            request = {"path": path, "kind": kind, "vectors": vectors, "seconds": seconds}
            try:
                return self._send_request(request, size)
            except Undecodable as error:
                self._refusals[identity] = error
                if len(self._refusals) > _REMEMBERED:
                    self._refusals.popitem(last=False)
                raise

    def write(
        self, file: Path, header: dict[str, Any], pixels: npt.NDArray[Any], *, vectors: bool
    ) -> None:
        """Write an image, or a displacement field as a transform.

        Parameters
        ----------
        file : Path
        header : dict
            Components, spacing, origin, direction and metadata, as in `Decoded.header`.
        pixels : ndarray
        vectors : bool
            True to write a transform.

        Raises
        ------
        Undecodable
            If writing fails, for example because SimpleITK does not support such pixels or the disk
            is full. The reason is unknown.
        HmrfError
            As for `decode`.
        """
        values = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("="))
        request = {
            **header,
            "kind": "write",
            "path": os.path.abspath(file),
            "vectors": vectors,
            "dtype": values.dtype.str,
            "shape": values.shape,
            "seconds": _LEAST_SECONDS + _SECONDS_PER_MB * values.nbytes / 1e6,
        }
        with self._lock:
            self._send_request(request, values.nbytes, values)

    def kill(self) -> None:
        """Kill the decoder immediately, even while another thread is waiting for a response."""
        process = self._process
        if process is not None:
            process.kill()
            process.wait()
        if self._lock.acquire(blocking=False):  # otherwise the requesting thread cleans up
            try:
                self._end()
            finally:
                self._lock.release()

    def forget_after_fork(self) -> None:
        """Detach a forked child process from the decoder, which belongs to the parent process."""
        process = self._process
        if process is not None:
            process.returncode = 0  # prevents waiting: the decoder is not a child of this process
            for stream in (process.stdin, process.stdout):
                with suppress(OSError):
                    if stream is not None:
                        os.close(stream.fileno())
        self._reset()

    def _send_request(
        self, request: dict[str, Any], size: int, pixels: npt.NDArray[Any] | None = None
    ) -> Decoded:
        for is_fresh in (self._process is None, True):
            process = self._running()
            watch = _Watch(process, request["seconds"], size)
            try:
                answer = _exchange(process, request, size, pixels)
            except BaseException:  # the rest of the response must not be read by the next request
                process.kill()
                self._end()
                raise
            finally:
                watch.stop()
            if answer is not None:
                if (refused := answer.header.get("refused")) is not None:
                    raise Undecodable(refused)
                return answer
            code = process.wait()
            self._end()
            if watch.reason:
                raise Undecodable(watch.reason, fatal=True)
            if code or is_fresh:
                raise Undecodable("decoding it crashes, so it is probably damaged", fatal=True)
            # The decoder exited because it was idle, before it received the request.
        raise AssertionError("a new decoder either answers or raises an error")

    def _running(self) -> subprocess.Popen[bytes]:
        process = self._process
        if process is None or process.poll() is not None:
            self._end()
            process = self._process = _start_decoder()
        return process

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            for stream in (process.stdin, process.stdout):
                with suppress(OSError):
                    if stream is not None:
                        stream.close()
            process.wait()


def _bytes_in(source: Path) -> int:
    """Return the size of a file, in bytes.

    For a folder, this is the total size of its files. For a header file with pixels in a separate
    file, this is the size of the largest file in the folder.
    """
    is_parted = source.suffix.lower() in itk_decoder.PARTED
    if not (source.is_dir() or is_parted):
        return source.stat().st_size
    folder = source.parent if is_parted else source
    sizes = [file.stat().st_size for file in folder.iterdir() if file.is_file()]
    return max(sizes, default=0) if is_parted else sum(sizes)


def _find_python() -> str:
    """Return the path of a Python interpreter.

    `sys.executable` is not always an interpreter: in a bundled program, it is the program itself.
    """
    names = ("python.exe", "python3.exe") if os.name == "nt" else ("python3", "python")
    folders = [Path(sys.prefix), Path(sys.exec_prefix)]
    candidates = [] if getattr(sys, "frozen", False) else [Path(sys.executable or "")]
    candidates += [
        folder / part / name for folder in folders for part in (".", "bin") for name in names
    ]
    for candidate in candidates:
        if candidate.is_file() and any(word in candidate.name.lower() for word in _INTERPRETERS):
            return str(candidate)
    raise HmrfError(
        "this file is read in a separate process, but no Python interpreter was found for it. Read "
        "the file in an environment with a Python interpreter."
    )


def _start_decoder() -> subprocess.Popen[bytes]:
    """Start a decoder process, and wait until it is ready."""
    command = [_find_python(), "-I", itk_decoder.__file__]
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        raise HmrfError(
            f"this file is read in a separate process, which cannot be started: {error.strerror}."
        ) from error
    try:
        answer = _exchange(process, [os.path.abspath(each) for each in sys.path], 0)
    except BaseException:
        process.kill()
        process.wait()
        raise
    if answer is None or "ready" not in answer.header:
        process.kill()
        process.wait()
        if answer is not None:
            raise missing_simpleitk()
        raise HmrfError("this file is read in a separate process, which ended while starting.")
    return process


def missing_simpleitk() -> HmrfError:
    """Return the error for a missing SimpleITK, with the command that installs the package."""
    return HmrfError(
        "medical files are read and written by SimpleITK, which is not installed: "
        f"{how_to_install('medical')}."
    )


def _exchange(
    process: subprocess.Popen[bytes],
    request: Any,
    size: int,
    sent: npt.NDArray[Any] | None = None,
) -> Decoded | None:
    """Send a request and return the response, or None if the decoder has exited."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(json.dumps(request).encode() + b"\n")
        if sent is not None and sent.size:
            process.stdin.write(memoryview(sent.data).cast("B"))
        process.stdin.flush()
    except OSError:
        return None
    line = process.stdout.readline()
    if not line.endswith(b"\n"):
        return None
    header: dict[str, Any] = json.loads(line)
    if "dtype" not in header:
        return Decoded(header)
    kind, shape = np.dtype(header["dtype"]), tuple(header["shape"])
    if math.prod(shape) * kind.itemsize > itk_decoder.MOST_PACKED * max(size, 1):
        raise Undecodable("it contains fewer pixels than its header states")
    pixels = np.empty(shape, kind)
    rest = memoryview(pixels.data).cast("B") if pixels.size else memoryview(b"")
    while rest:
        count = process.stdout.readinto(rest)  # type: ignore[attr-defined]
        if not count:
            return None
        rest = rest[count:]
    return Decoded(header, pixels)


decoder = DecoderProcess()
atexit.register(decoder.kill)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=decoder.forget_after_fork)

"""Seals of exchange files: digests that reveal damage.

A sealed file contains two identical lines, one near the beginning and one near the end. Each line
consists of a mark and the SHA-256 digest of the whole file, computed with zeros in place of both
digests. Other tools ignore the lines, and drop them when they save the file again. A file without a
seal is not checked.

=================  ==================================================================
.mha               comments on the second and the second-to-last line of the header
.nrrd              comments on the second and the last line of the header
.nii, .nii.gz      blocks between the header and the vectors, and after the vectors
.h5                blocks after the end of the HDF5 file
=================  ==================================================================
"""

from __future__ import annotations

import gzip
import hashlib
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

#: Text at the beginning of a seal.
_MARK = b"napari-hmrf field; SHA-256 with this digest as zeros: "
_DIGITS = 64
_SEAL = re.compile(re.escape(_MARK) + rb"([0-9a-f]{%d})" % _DIGITS)
_BLANK = _MARK + b"0" * _DIGITS
#: Number of seals in a file.
_COUNT = 2
#: Length of a seal in binary formats, in bytes; a multiple of 16, as NIfTI requires.
_BLOCK = 128
#: Numbers of bytes searched for seals at the beginning and at the end of a file.
_HEAD, _TAIL = 2**14, 2**10
#: Number of bytes read at a time.
_PIECE = 2**20
#: Share of matching bytes above which text is considered to be a damaged mark; for unrelated text,
#: the share is below a third.
_DAMAGED_SHARE = 0.6
_GZIP, _HDF5 = b"\x1f\x8b", b"\x89HDF\r\n\x1a\n"
#: Compression level of .nii.gz; low, because vectors hardly compress and higher levels are slower.
_LEVEL = 2
#: Length of the NIfTI header, and offset of the field with the position of the vectors, in bytes.
_NIFTI_HEADER, _NIFTI_START = 352, 108


class BrokenSeal(Exception):
    """Error for a sealed file that was damaged or edited after it was written."""


def seal(content: bytes, suffix: str) -> bytes:
    """Add seals to the content of a file.

    Parameters
    ----------
    content : bytes
        Content as written by SimpleITK; for .nii.gz, the uncompressed content.
    suffix : {".mha", ".nrrd", ".nii", ".nii.gz", ".h5"}

    Returns
    -------
    bytes
        Content with seals; for .nii.gz, the compressed content.
    """
    block = (_BLANK + b"\n").ljust(_BLOCK, b"\n")
    if suffix in (".mha", ".nrrd"):
        end = b"ElementDataFile" if suffix == ".mha" else b"\n\n"
        line = (b"Comment = " if suffix == ".mha" else b"# ") + _BLANK + b"\n"
        second, last = content.index(b"\n") + 1, content.index(end) + (suffix == ".nrrd")
        blank = content[:second] + line + content[second:last] + line + content[last:]
    elif suffix == ".h5":
        blank = content + 2 * block
    else:
        header, rest = bytearray(content[:_NIFTI_HEADER]), content[_NIFTI_HEADER:]
        struct.pack_into("<f", header, _NIFTI_START, _NIFTI_HEADER + _BLOCK)
        blank = bytes(header) + block + rest + block
    digest = hashlib.sha256(blank).hexdigest().encode()
    sealed = blank.replace(_BLANK, _MARK + digest)
    return gzip.compress(sealed, _LEVEL, mtime=0) if suffix == ".nii.gz" else sealed


def check_seal(path: Path) -> bool:
    """Return whether a file has a valid seal.

    The result is False for a file without a seal, such as a file from another program.

    Raises
    ------
    BrokenSeal
        If the seal does not match the content of the file, or the seal itself is damaged.
    OSError
        If the file cannot be opened.
    """
    try:
        with open(path, "rb") as file:
            start = file.read(48)
            file.seek(0)
            if start.startswith(_GZIP):
                with gzip.open(file) as stream:
                    is_sealed = _read_seals(stream)
            else:
                is_sealed = _read_seals(file)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        return False  # the decoder then reports the damage
    if not is_sealed and _hdf5_ends_early(start, path.stat().st_size):
        raise BrokenSeal
    return is_sealed


def _read_seals(stream: BinaryIO | gzip.GzipFile) -> bool:
    digest, likeness = hashlib.sha256(), 0.0
    digests: list[str] = []
    for part, is_end in _parts(stream):
        if is_end:
            digests += [match[1].decode() for match in _SEAL.finditer(part)]
            likeness = max(likeness, _likeness(part))
            part = _SEAL.sub(_BLANK, part)
        digest.update(part)
    if likeness < _DAMAGED_SHARE:
        return False
    if digests != [digest.hexdigest()] * _COUNT:
        raise BrokenSeal
    return True


def _parts(stream: BinaryIO | gzip.GzipFile) -> Iterator[tuple[bytes, bool]]:
    """Yield the content in pieces, each with a flag that is True for the first and last piece."""
    head = stream.read(_HEAD)
    pending = stream.read(_PIECE)
    if len(pending) < 2 * _TAIL:  # a seal must not be split between pieces
        yield head + pending, True
        pending = b""
    else:
        yield head, True
    while pending:
        piece = stream.read(_PIECE)
        if not piece:
            yield pending[:-_TAIL], False
            yield pending[-_TAIL:], True
            return
        pending += piece
        yield pending[: -2 * _TAIL], False
        pending = pending[-2 * _TAIL :]


def _likeness(part: bytes) -> float:
    """Return the largest share of bytes that match the mark, over all positions in a piece."""
    if len(part) < len(_MARK):
        return 0.0
    windows: Any = np.lib.stride_tricks.sliding_window_view(
        np.frombuffer(part, np.uint8), len(_MARK)
    )
    return float((windows == np.frombuffer(_MARK, np.uint8)).mean(axis=1).max())


def _hdf5_ends_early(start: bytes, size: int) -> bool:
    """Return whether a file has bytes after the end of its HDF5 content, where a seal would be."""
    if not start.startswith(_HDF5) or len(start) < 36 or start[8] not in (2, 3):
        return False
    end: int = struct.unpack_from("<Q", start, 28)[0]
    return end < size

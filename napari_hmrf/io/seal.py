"""Seals of exchange files: digests that reveal damage.

A sealed file contains the same line twice, near its beginning and its end: a mark and the SHA-256
of the whole file, computed with zeros in place of both digests. Other tools ignore the lines, and
drop them when they save the field again; a file without a seal is read without a check.

=================  ==============================================================
.mha               comments, in the second line of the header and before its last
.nrrd              comments, in the second line of the header and in its last
.nii, .nii.gz      between header and vectors, and after the vectors
.h5                after the end of the HDF5 file
=================  ==============================================================
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

#: Beginning of a seal.
_MARK = b"napari-hmrf field; SHA-256 with this digest as zeros: "
_DIGITS = 64
_SEAL = re.compile(re.escape(_MARK) + rb"([0-9a-f]{%d})" % _DIGITS)
_BLANK = _MARK + b"0" * _DIGITS
#: Number of seals in a file.
_COUNT = 2
#: Length of a seal in formats without lines, in bytes; NIfTI needs a multiple of 16.
_BLOCK = 128
#: Numbers of bytes at the beginning and at the end that are searched for seals.
_HEAD, _TAIL = 2**14, 2**10
#: Number of bytes read at once.
_PIECE = 2**20
#: Share of matching bytes from which text counts as a damaged mark; other text has below a third.
_DAMAGED_SHARE = 0.6
_GZIP, _HDF5 = b"\x1f\x8b", b"\x89HDF\r\n\x1a\n"
#: Compression level of .nii.gz: vectors hardly compress, and higher levels take longer.
_LEVEL = 2
#: Length of NIfTI's header, and offset of the number that states where the vectors begin.
_NIFTI_HEADER, _NIFTI_START = 352, 108


class BrokenSeal(Exception):
    """A sealed file was changed after it was written, by damage or by an edit."""


def seal(content: bytes, suffix: str) -> bytes:
    """Return the content of a file with seals.

    Parameters
    ----------
    content : bytes
        Content as written by SimpleITK; for .nii.gz before compression.
    suffix : {".mha", ".nrrd", ".nii", ".nii.gz", ".h5"}
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
    """Return whether a file has a valid seal; files of other programs have no seal.

    Raises
    ------
    BrokenSeal
        If the seal does not match the file, or is itself damaged.
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
    """Yield pieces of the content, each with True if it is the beginning or the end."""
    head = stream.read(_HEAD)
    pending = stream.read(_PIECE)
    if len(pending) < 2 * _TAIL:  # a seal must not be split between two pieces
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
    """Return the largest share of the mark's bytes that match, over all positions."""
    if len(part) < len(_MARK):
        return 0.0
    windows: Any = np.lib.stride_tricks.sliding_window_view(
        np.frombuffer(part, np.uint8), len(_MARK)
    )
    return float((windows == np.frombuffer(_MARK, np.uint8)).mean(axis=1).max())


def _hdf5_ends_early(start: bytes, size: int) -> bool:
    """Return whether bytes follow the end of an HDF5 file, where a seal would be."""
    if not start.startswith(_HDF5) or len(start) < 36 or start[8] not in (2, 3):
        return False
    end: int = struct.unpack_from("<Q", start, 28)[0]
    return end < size

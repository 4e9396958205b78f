"""Reading with SimpleITK what may be damaged: sizes are checked before memory is taken for them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from napari_hmrf.io.nifti import is_cut_short

#: No packed file holds more than so many times its own bytes: the limit of deflate.
_MOST_PACKED = 1032
#: Files whose numbers are in another file beside them.
_PARTED = (".mhd", ".nhdr", ".hdr")
_FIELD = "DisplacementFieldTransform_"


def read_image(sitk: Any, source: Path) -> Any:
    """Read an image as `SimpleITK.ReadImage` does.

    Raises
    ------
    RuntimeError
        If it is none, claims more pixels than it can hold, or is cut short.
    """
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(source))
    try:
        reader.ReadImageInformation()
    except ValueError:  # its own message cites bytes that are no text
        raise RuntimeError("its header is damaged") from None
    pixel = sitk.Image([1, 1], reader.GetPixelID(), reader.GetNumberOfComponents())
    each = pixel.GetSizeOfPixelComponent() * pixel.GetNumberOfComponentsPerPixel()
    beside = source.parent.iterdir() if source.suffix.lower() in _PARTED else [source]
    there = max((file.stat().st_size for file in beside if file.is_file()), default=0)
    packed = 1 if source.suffix.lower() == ".nii" else _MOST_PACKED
    if math.prod(reader.GetSize()) * each > there * packed:
        raise RuntimeError("it claims more pixels than it holds")
    if source.name.lower().endswith((".nii", ".nii.gz")) and is_cut_short(source):
        raise RuntimeError("it is cut short")
    return sitk.ReadImage(str(source))


def read_transform(sitk: Any, source: Path) -> Any:
    """Read a transform as `SimpleITK.ReadTransform` does.

    Raises
    ------
    RuntimeError
        If it is none, or a text that is cut short or says more than it holds.
    """
    try:
        if source.suffix.lower() in (".tfm", ".txt"):
            _check_text(source)
        return sitk.ReadTransform(str(source))
    except ValueError:
        raise RuntimeError("it is damaged") from None


def _check_text(source: Path) -> None:
    """Refuse fields of which ITK would make up the rest."""
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
                raise RuntimeError("its numbers are not as many as it says")
            n = 0
    if n or not text.endswith("\n"):
        raise RuntimeError("it is cut short")

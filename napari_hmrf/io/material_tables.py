"""Tables of materials in small, human-readable files.

A file is JSON::

    {
      "format": "napari-hmrf materials",
      "version": 1,
      "name": "Liver",
      "unit": "kPa",
      "source": "whose values these are",
      "materials": [
        {"label": 1, "name": "liver", "stiffness": 5.4, "poisson": 0.49}
      ]
    }

The stiffness of bone or an implant, which moves as a rigid body, is the word ``"rigid"``. Tissue
that grows has a ``"growth"``: 0.1 is a tenth longer; a list has a value for each axis of the image.
A file with such a material is of version 3, one with rigid tissue of version 2; all others are of
version 1, which earlier versions of this package read.

This module does not need napari.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import pydantic

from napari_hmrf.arguments import did_you_mean
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.io.csv_files import SYNONYMS
from napari_hmrf.regular_file import read_at_most
from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON, Material
from napari_hmrf.tissue.material_presets import Preset

_Format = Literal["napari-hmrf materials"]
FORMAT: _Format = "napari-hmrf materials"
VERSION = 3
#: Versions of files with neither rigid tissue nor growth, and of files with rigid tissue.
_FIRST, _RIGID = 1, 2
ENDING = ".json"
#: Largest size of a file, in bytes; a larger file is not read.
_LARGEST = 2**20


def write_preset(path: str | Path, preset: Preset) -> Path:
    """Write materials to a file, atomically, to use them with other images and to share them.

    Parameters
    ----------
    path : str or Path
        ``.json`` is added if it has no ending; a file of that name is replaced.
    preset : Preset

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    FileFormatError
        If the materials could not be read back; nothing is written.
    OSError
        If the file cannot be written.
    """
    target = Path(path)
    target = target if target.suffix else target.with_suffix(ENDING)
    values = {
        "format": FORMAT,
        "version": _version(preset),
        **asdict(preset),
        "materials": [material.as_row() for material in preset.materials],
    }
    try:
        text = _File.model_validate(values).model_dump_json(indent=2)
    except pydantic.ValidationError as error:
        raise _bad(target, error) from error
    write_whole(target, f"{text}\n".encode())
    return target


def read_preset(path: str | Path) -> Preset:
    """Read a file that was written by `write_preset` or by hand.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Preset
        Named after the file if the file gives no name.

    Raises
    ------
    FileFormatError
        Naming the material, its error, and valid values.
    OSError
        If the file cannot be read.
    """
    source = Path(path)
    content = read_at_most(source, _LARGEST)
    if content is None:
        raise FileFormatError(f"{source.name} is too large to be a file of materials.")
    try:
        file = _File.model_validate_json(content)
    except pydantic.ValidationError as error:
        raise _bad(source, error) from error
    materials = tuple(Material.of_row(**row.model_dump()) for row in file.materials)
    return Preset(file.name or source.stem, file.unit, file.source, materials)


def _version(preset: Preset) -> int:
    """Return the earliest version of the format that holds these materials."""
    if any(row.grows for row in preset.materials):
        return VERSION
    return _RIGID if any(row.is_rigid for row in preset.materials) else _FIRST


_Strain = Annotated[float, pydantic.Field(gt=-1, le=10, allow_inf_nan=False)]


class _Row(pydantic.BaseModel, strict=True, extra="forbid"):
    """A material in a file."""

    label: int = pydantic.Field(ge=0)
    name: str = ""
    # Only the word means rigid: JSON has no infinity, and a number such as 1e999 is a slip.
    stiffness: Annotated[
        Annotated[float, pydantic.Field(ge=0, allow_inf_nan=False)] | Literal["rigid"],
        pydantic.BeforeValidator(lambda v: v.strip().casefold() if isinstance(v, str) else v),
    ]
    poisson: float = pydantic.Field(USUAL_POISSON, ge=POISSON_RANGE[0], le=POISSON_RANGE[1])
    growth: _Strain | tuple[_Strain, ...] = 0.0


class _File(pydantic.BaseModel, strict=True, extra="forbid"):
    """Content of a file."""

    format: _Format
    version: int = pydantic.Field(ge=1)
    name: str = ""
    unit: str = ""
    source: str = ""
    materials: list[_Row] = pydantic.Field(min_length=1)

    @pydantic.field_validator("version")
    @classmethod
    def _is_known(cls, version: int) -> int:
        # Checked before the rows, as a newer version may use other words in them.
        if version > VERSION:
            newer = f"was written by a newer napari-hmrf (version {version})"
            raise ValueError(f"{newer}. Install the newest one")
        return version

    @pydantic.model_validator(mode="after")
    def _go_together(self) -> _File:
        labels = [row.label for row in self.materials]
        for label in labels:
            if labels.count(label) > 1:
                raise ValueError(f"has two materials for label {label}. Remove one")
        if not any(row.stiffness for row in self.materials):
            raise ValueError("has no material with a stiffness above 0. Write one that is tissue")
        return self


def _bad(path: Path, error: pydantic.ValidationError) -> FileFormatError:
    """Return an error with the first fault of a file, its place, and valid values."""
    found = error.errors(include_url=False)
    # A misspelt word is also reported as missing; the misspelt word is the better message.
    unknown = [each for each in found if each["type"] == "extra_forbidden"]
    first = (
        unknown[0] if unknown and found[0]["type"] in ("missing", unknown[0]["type"]) else found[0]
    )
    kind, message = first["type"], first["msg"]
    place = " ".join(
        str(part + 1) if isinstance(part, int) else part.replace("materials", "material")
        for part in first["loc"][:3]
    )
    if kind == "value_error":
        said = message.removeprefix("Value error, ")
    elif kind == "json_invalid":
        said = message.replace("Invalid JSON", "is no JSON")
    elif place in ("", "format"):
        said = f'is no file of materials: it does not say "format": "{FORMAT}"'
    elif kind == "extra_forbidden":
        word, in_row = str(first["loc"][-1])[:40], len(first["loc"]) > 1
        known = [*(_Row if in_row else _File).model_fields]
        where = f" in material {int(first['loc'][1]) + 1}" if in_row else ""
        hint = did_you_mean(word, known, SYNONYMS)
        said = f"has an unknown word {word!r}{where}.{hint} The words are {', '.join(known)}"
    elif kind == "missing":
        said = f"lacks {place}"
    else:
        right = message.removeprefix("Input should be ").removeprefix("a valid ")
        if "stiffness" in place:
            right = 'a number, 0 or more, or "rigid"'
        said = f"says {place} is {str(first['input'])[:40]!r}. It should be: {right}"
    return FileFormatError(f"{path.name} {said}.")

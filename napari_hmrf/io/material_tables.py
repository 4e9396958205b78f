"""Material files: human-readable tables of materials in JSON.

Example of a file::

    {
      "format": "napari-hmrf materials",
      "version": 4,
      "name": "Liver",
      "unit": "kPa",
      "source": "origin of the values",
      "materials": [
        {"label": 1, "name": "liver", "stiffness": 5.4, "poisson": 0.49}
      ]
    }

The stiffness of rigid tissue, such as bone or an implant, is the word ``"rigid"``. The optional
value ``"growth"`` is a strain: 0.1 increases lengths by a tenth. It can be a list with one value
for each axis of the image. The optional value ``"slides"`` is true for tissue that slides along all
other tissue.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import pydantic
from pydantic import TypeAdapter

from napari_hmrf.arguments import did_you_mean
from napari_hmrf.atomic_write import write_whole
from napari_hmrf.checks import POISSON_RANGE
from napari_hmrf.errors import FileFormatError
from napari_hmrf.io.csv_files import SYNONYMS
from napari_hmrf.regular_file import read_at_most
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON, Material
from napari_hmrf.tissue.material_presets import Preset

_Format = Literal["napari-hmrf materials"]
#: Identifier of the format, stored in each file.
FORMAT: _Format = "napari-hmrf materials"
#: Version of the format.
VERSION = 4
#: Suffix of the files.
ENDING = ".json"
#: Largest size of a file, in bytes; a larger file is not read.
_LARGEST = 2**20


def write_preset(path: str | Path, preset: Preset) -> Path:
    """Write materials to a file, atomically.

    Parameters
    ----------
    path : str or Path
        Path of the file; ``.json`` is appended if the name has no suffix. An existing file is
        replaced.
    preset : Preset

    Returns
    -------
    Path
        The written file.

    Raises
    ------
    FileFormatError
        If the materials are invalid, so that the file could not be read again; nothing is written.
    OSError
        If the file cannot be written.
    """
    target = Path(path)
    target = target if target.suffix else target.with_suffix(ENDING)
    values = {
        "format": FORMAT,
        "version": VERSION,
        **TypeAdapter(Preset).dump_python(preset, mode="json"),
    }
    try:
        text = _File.model_validate_json(json.dumps(values)).model_dump_json(
            indent=2, exclude_unset=True
        )
    except pydantic.ValidationError as error:
        raise _format_error(target, error) from error
    write_whole(target, f"{text}\n".encode())
    return target


def read_preset(path: str | Path) -> Preset:
    """Read a material file, written by `write_preset` or by hand.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Preset
        Materials. If the file does not contain a name, the preset has the name of the file.

    Raises
    ------
    FileFormatError
        If the file is invalid; the message states the material, the error and valid values.
    OSError
        If the file cannot be read.
    """
    source = Path(path)
    content = read_at_most(source, _LARGEST)
    if content is None:
        raise FileFormatError(f"{source.name} is too large to be a material file.")
    try:
        file = _File.model_validate_json(content)
    except pydantic.ValidationError as error:
        raise _format_error(source, error) from error
    materials = tuple(Material(**row.model_dump()) for row in file.materials)
    return Preset(file.name or source.stem, file.unit, file.source, materials)


_Strain = Annotated[float, pydantic.Field(gt=-1, le=10, allow_inf_nan=False)]


class _Row(pydantic.BaseModel, strict=True, extra="forbid"):
    """Schema of a material in a file."""

    label: int = pydantic.Field(ge=0)
    name: str = ""
    # JSON has no infinity, so rigid tissue is marked with a word; 1e999 is not accepted instead.
    stiffness: Annotated[
        Annotated[float, pydantic.Field(ge=0, allow_inf_nan=False)] | Literal["rigid"],
        pydantic.BeforeValidator(lambda v: v.strip().casefold() if isinstance(v, str) else v),
    ]
    poisson: float = pydantic.Field(USUAL_POISSON, ge=POISSON_RANGE[0], le=POISSON_RANGE[1])
    growth: _Strain | tuple[_Strain, ...] = 0.0
    slides: bool = False


class _File(pydantic.BaseModel, strict=True, extra="forbid"):
    """Schema of a material file."""

    format: _Format
    version: int = pydantic.Field(ge=1)
    name: str = ""
    unit: str = ""
    source: str = ""
    materials: list[_Row] = pydantic.Field(min_length=1)

    @pydantic.field_validator("version")
    @classmethod
    def _check_version(cls, version: int) -> int:
        # Check the version before the rows, because rows of a later version may have other keys.
        if version > VERSION:
            newer = f"was written by a later version of napari-hmrf (format {version})"
            raise ValueError(f"{newer}. Install the latest version")
        return version

    @pydantic.model_validator(mode="after")
    def _check_rows(self) -> _File:
        labels = [row.label for row in self.materials]
        for label in labels:
            if labels.count(label) > 1:
                raise ValueError(f"has two materials for label {label}. Remove one of them")
        if not any(row.stiffness for row in self.materials):
            raise ValueError("has no material with a stiffness above 0. Add such a material")
        return self


def _format_error(path: Path, error: pydantic.ValidationError) -> FileFormatError:
    """Return an error that describes the first fault in a file, its location and valid values."""
    errors = error.errors(include_url=False)
    # For a misspelt key, pydantic first reports the correct key as missing; the error about the
    # misspelt key is clearer.
    unknown = [each for each in errors if each["type"] == "extra_forbidden"]
    first = (
        unknown[0]
        if unknown and errors[0]["type"] in ("missing", unknown[0]["type"])
        else errors[0]
    )
    kind, reported = first["type"], first["msg"]
    place = " ".join(
        str(part + 1) if isinstance(part, int) else part.replace("materials", "material")
        for part in first["loc"][:3]
    )
    if kind == "value_error":
        message = reported.removeprefix("Value error, ")
    elif kind == "json_invalid":
        message = reported.replace("Invalid JSON", "is not valid JSON")
    elif place in ("", "format"):
        message = f'is not a material file: it lacks "format": "{FORMAT}"'
    elif kind == "extra_forbidden":
        word, in_row = str(first["loc"][-1])[:40], len(first["loc"]) > 1
        known = [*(_Row if in_row else _File).model_fields]
        where = f" in material {int(first['loc'][1]) + 1}" if in_row else ""
        hint = did_you_mean(word, known, SYNONYMS)
        message = f"has an unknown key {word!r}{where}.{hint} The keys are {', '.join(known)}"
    elif kind == "missing":
        message = f"lacks {place}"
    else:
        valid = reported.removeprefix("Input should be ").removeprefix("a valid ")
        if "stiffness" in place:
            valid = 'a non-negative number, or "rigid"'
        message = f"is invalid: {place} is {str(first['input'])[:40]!r}. It must be: {valid}"
    return FileFormatError(f"{path.name} {message}.")

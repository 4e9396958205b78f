"""Tables of materials in small files that people can read.

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

The stiffness of bone or an implant, which moves as one, is the word ``"rigid"``. A file with such a
material is of version 2; all others are of version 1, which earlier versions of this package read.

Nothing here needs napari.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.tissue.boundary_rules import USUAL_POISSON, Material
from napari_hmrf.tissue.material_presets import Preset

FORMAT = "napari-hmrf materials"
VERSION = 2
#: Of files that have no rigid material.
_FIRST = 1
ENDING = ".json"
#: Larger files are none of ours, and are not read.
_LARGEST = 2**20


def save_materials(path: str | Path, preset: Preset) -> Path:
    """Write materials to a file, whole or not at all, for other images and other people.

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
        If they could not be read again; nothing is written.
    OSError
        If the file cannot be written.
    """
    target = Path(path)
    target = target if target.suffix else target.with_suffix(ENDING)
    values = {
        "format": FORMAT,
        "version": VERSION if any(row.is_rigid for row in preset.materials) else _FIRST,
        **asdict(preset),
        "materials": [material.as_row() for material in preset.materials],
    }
    _preset(values, target)
    text = json.dumps(values, indent=2, ensure_ascii=False) + "\n"
    write_whole(target, text.encode())
    return target


def load_materials(path: str | Path) -> Preset:
    """Read what `save_materials` wrote, or somebody by hand.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Preset
        Named after the file, if it has no name of its own.

    Raises
    ------
    FileFormatError
        Saying what is wrong with which material, and what to write.
    OSError
        If the file cannot be read.
    """
    source = Path(path)
    if source.stat().st_size > _LARGEST:
        raise _bad(source, "is too large to be a file of materials")
    try:
        values = json.loads(source.read_text(encoding="utf-8"))
    except ValueError as error:  # of JSON or of UTF-8
        raise _bad(source, f"is no JSON: {error}") from error
    except RecursionError as error:
        raise _bad(source, "is nested too deeply to be a file of materials") from error
    return _preset(values, source)


class _Row(BaseModel):
    """A material as a file says it."""

    model_config = ConfigDict(strict=True)

    label: int = Field(ge=0)
    name: str = ""
    # Only the word says rigid: JSON has no infinite number, and one like 1e999 is a slip.
    stiffness: Annotated[
        Annotated[float, Field(ge=0, allow_inf_nan=False)] | Literal["rigid"],
        BeforeValidator(lambda v: v.strip().casefold() if isinstance(v, str) else v),
    ]
    poisson: float = Field(USUAL_POISSON, ge=POISSON_RANGE[0], le=POISSON_RANGE[1])


class _File(BaseModel):
    """All that a file says."""

    model_config = ConfigDict(strict=True)

    version: int = Field(ge=1)
    name: str = ""
    unit: str = ""
    source: str = ""
    materials: list[_Row] = Field(min_length=1)


def _preset(values: Any, path: Path) -> Preset:
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise _bad(path, f'is no file of materials: it does not say "format": "{FORMAT}"')
    try:
        file = _File.model_validate(values)
    except ValidationError as error:
        raise _bad(path, _in_words(error)) from error
    if file.version > VERSION:
        raise _bad(
            path,
            f"was written by a newer napari-hmrf (version {file.version}). Install the newest one",
        )
    materials = tuple(Material.of_row(**row.model_dump()) for row in file.materials)
    labels = [material.label for material in materials]
    for label in labels:
        if labels.count(label) > 1:
            raise _bad(path, f"has two materials for label {label}. Remove one")
    if not any(material.stiffness > 0 for material in materials):
        raise _bad(path, "has no material with a stiffness above 0. Write one that is tissue")
    return Preset(file.name or path.stem, file.unit, file.source, materials)


def _in_words(error: ValidationError) -> str:
    """What is wrong first, where, and what would be right."""
    first = error.errors(include_url=False)[0]
    place = " ".join(
        str(part + 1) if isinstance(part, int) else part.replace("materials", "material")
        for part in first["loc"][:3]
    )
    if first["type"] == "missing":
        return f"lacks {place}"
    right = first["msg"].removeprefix("Input should be ").removeprefix("a valid ")
    if "stiffness" in place:
        right = 'a number, 0 or more, or "rigid"'
    return f"says {place} is {str(first['input'])[:40]!r}. It should be: {right}"


def _bad(path: Path, message: str) -> FileFormatError:
    return FileFormatError(f"{path.name} {message}.")

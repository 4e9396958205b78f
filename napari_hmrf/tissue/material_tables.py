"""Tables of materials in small files that people can read, and a folder of one's own.

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
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from psygnal import Signal

from napari_hmrf.atomic_write import write_whole
from napari_hmrf.errors import FileFormatError
from napari_hmrf.solver.priors.elastic import POISSON_RANGE
from napari_hmrf.tissue.boundary_rules import RIGID, USUAL_POISSON, Material, read_stiffness
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
        "name": preset.name,
        "unit": preset.unit,
        "source": preset.source,
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


class MaterialLibrary:
    """Presets of one's own: a folder with one file each, which can be passed on as they are.

    Parameters
    ----------
    folder : str or Path
        Made when something is put into it.

    Attributes
    ----------
    changed : Signal()
        Emitted when something was put into it or taken out.
    """

    changed = Signal()

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    @property
    def presets(self) -> tuple[Preset, ...]:
        """All that can be read, by name."""
        return tuple(sorted(self._read()[0].values(), key=lambda preset: preset.name.lower()))

    @property
    def refused(self) -> tuple[str, ...]:
        """What is wrong with files that cannot be read, in a sentence each."""
        return self._read()[1]

    def remember(self, preset: Preset) -> Path:
        """Put a preset into the folder, in place of one of the same name.

        Returns
        -------
        Path
            Its file.

        Raises
        ------
        FileFormatError
            If it has no name, or could not be read again.
        OSError
            If it cannot be written.
        """
        name = preset.name.strip()
        if not name:
            raise FileFormatError("Materials are remembered by a name. Give them one.")
        self.folder.mkdir(parents=True, exist_ok=True)
        path = save_materials(self._file_of(name) or self._free(name), replace(preset, name=name))
        self.changed.emit()
        return path

    def forget(self, name: str) -> bool:
        """Take a preset out of the folder; whether it was there."""
        path = self._file_of(name)
        if path is None:
            return False
        path.unlink()
        self.changed.emit()
        return True

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob(f"*{ENDING}")) if self.folder.is_dir() else []

    def _read(self) -> tuple[dict[Path, Preset], tuple[str, ...]]:
        presets, refused = {}, []
        for path in self._files():
            try:
                presets[path] = load_materials(path)
            except (FileFormatError, OSError) as error:
                refused.append(str(error))
        return presets, tuple(refused)

    def _file_of(self, name: str) -> Path | None:
        return next((path for path, each in self._read()[0].items() if each.name == name), None)

    def _free(self, name: str) -> Path:
        """A file for a name, which may hold what no file's name can."""
        kept = "".join(letter if letter.isalnum() or letter in " -_" else "_" for letter in name)
        kept = kept.strip()[:80] or "materials"
        taken = {path.name.lower() for path in self._files()}
        number = 1
        while (file := f"{kept}{'' if number == 1 else f' {number}'}{ENDING}").lower() in taken:
            number += 1
        return self.folder / file


def _preset(values: Any, path: Path) -> Preset:
    if not isinstance(values, Mapping) or values.get("format") != FORMAT:
        raise _bad(path, f'is no file of materials: it does not say "format": "{FORMAT}"')
    version = values.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise _bad(path, f'has no version. Write "version": {VERSION}')
    if version > VERSION:
        raise _bad(
            path, f"was written by a newer napari-hmrf (version {version}). Install the newest one"
        )
    words = {key: values.get(key, "") for key in ("name", "unit", "source")}
    for key, word in words.items():
        if not isinstance(word, str):
            raise _bad(path, f'has a {key} that is no word: {word!r}. Write it in "quotes"')
    rows = values.get("materials")
    if not isinstance(rows, list) or not rows:
        raise _bad(path, 'lists no "materials". Write one or more')
    materials = tuple(_material(row, number, path) for number, row in enumerate(rows, start=1))
    seen: set[int] = set()
    for material in materials:
        if material.label in seen:
            raise _bad(path, f"has two materials for label {material.label}. Remove one")
        seen.add(material.label)
    if not any(material.stiffness > 0 for material in materials):
        raise _bad(path, "has no material with a stiffness above 0. Write one that is tissue")
    return Preset(words["name"] or path.stem, words["unit"], words["source"], materials)


def _material(row: Any, number: int, path: Path) -> Material:
    if not isinstance(row, Mapping) or not {"label", "stiffness"} <= set(row):
        raise _bad(path, f'has a material, number {number}, without a "label" or a "stiffness"')
    label, name = row["label"], row.get("name", "")
    which = f"material {number}" + (f" ({name})" if isinstance(name, str) and name else "")
    if not isinstance(label, int) or isinstance(label, bool) or label < 0:
        raise _bad(path, f"gives {which} the label {label!r}. Write a whole number, 0 or more")
    if not isinstance(name, str):
        raise _bad(path, f'gives {which} the name {name!r}. Write it in "quotes"')
    given = row["stiffness"]
    # Only the word says rigid: JSON has no infinite number, and one like 1e999 is a slip.
    rigid = isinstance(given, str) and read_stiffness(given) == RIGID
    stiffness = RIGID if rigid else _number(given)
    if not (rigid or (math.isfinite(stiffness) and stiffness >= 0)):
        raise _bad(
            path,
            f'gives {which} the stiffness {given!r}. Write a number, 0 or more, or "rigid"',
        )
    poisson, (low, high) = _number(row.get("poisson", USUAL_POISSON)), POISSON_RANGE
    if not low <= poisson <= high:
        raise _bad(
            path,
            f"gives {which} the Poisson's ratio {row['poisson']!r}. Write a number from {low:g} to "
            f"{high:g}",
        )
    return Material(label, name, stiffness, poisson)


def _number(value: Any) -> float:
    """A number; NaN for anything else, true and false among it."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _bad(path: Path, message: str) -> FileFormatError:
    return FileFormatError(f"{path.name} {message}.")

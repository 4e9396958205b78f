"""Pairs of images with a known deformation, for validating image registration."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import checked_path, require_kind
from napari_hmrf.augmentation.random_deformation import RandomDeformation, RandomSample
from napari_hmrf.checks import Count, Seed, convert
from napari_hmrf.errors import HmrfError
from napari_hmrf.field.deformation import spread
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.case import read_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.fields import geometry_of, write_mapping
from napari_hmrf.io.image_grid import grid_of_image
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.io.landmark_files import write_points
from napari_hmrf.io.overwriting import refuse_overwriting
from napari_hmrf.io.study_file import write_study
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.study import Grid, Pictures, Study

# Approximate number of landmarks per pair.
_LANDMARKS = 200
#: Names of the files of all pairs, and of each pair.
_SHARED = "image.mha", "labels.mha"
_OF_PAIRS = "deformed.mha", "deformed_labels.mha", "field.mha", "landmarks.csv", "truth.study"
#: Name of the folder of a pair.
_PAIR = re.compile("[0-9]{3,}")


@dataclass(frozen=True)
class Truth:
    """Summary of one written pair.

    Attributes
    ----------
    folder : Path
        Folder of the pair.
    farthest : float
        Largest displacement of the tissue, in the unit of the study.
    scale : float
        Factor, at most 1, by which the drawn deformation was multiplied to limit the
        compression of tissue.
    unit : str
        Unit of `farthest`.
    """

    folder: Path
    farthest: float
    scale: float
    unit: str


def write_truth(
    case: Case,
    folder: str | os.PathLike[str],
    *,
    count: int = 1,
    seed: int = 0,
    overwrite: bool = True,
    progress: Callable[[int, int], None] | None = None,
    on_written: Callable[[Truth], None] = lambda _: None,
    **options: Any,
) -> list[Truth]:
    """Deform an image randomly, and write the deformed images with their ground truth.

    The function writes ``image.mha`` and ``labels.mha`` to the folder. For each pair, it writes
    these files, all or none, to a subfolder ``001``, ``002``, ...:

    - ``deformed.mha`` and ``deformed_labels.mha``;
    - ``field.mha``, the displacement field that warps the image to the deformed image, in the
      convention of registration software (backward, from each deformed pixel to its origin, in mm,
      LPS). At pixels that no tissue covers, it continues the field of the nearest tissue;
    - ``landmarks.csv``, corresponding points in the image and in the deformed image, with the
      columns of BigWarp: in mm, from the first pixel, along the axes of ``image.mha``;
    - ``truth.study``, a study that can be solved and opened in napari.

    Parameters
    ----------
    case : Case
        Image with labels and materials, or a study that contains them.
    folder : str or path-like
        Output folder, which is created if it does not exist. The image and all pairs of an earlier
        run are removed when the first pair is complete; other files in the folder are kept.
    count : int
        Number of pairs.
    seed : int
        Seed of the random numbers. The seed of each pair is (seed, index of the pair).
    overwrite : bool
        True if the image and the pairs of an earlier run may be removed.
    progress : callable, optional
        As for `RandomDeformation`.
    on_written : callable, optional
        Function called with the `Truth` of each pair after the pair is written.
    **options
        Options of `RandomDeformation`, such as `amplitude`.

    Returns
    -------
    list of Truth
        Summary of each pair.

    Raises
    ------
    HmrfError, OSError
        As for `read_case` and `RandomDeformation`; if the case has no image or no labels; or if
        the folder contains an earlier run, and `overwrite` is False or the case reads its files.
    """
    count, seed = convert(Count, count, "count"), convert(Seed, seed, "seed")
    folder = Path(checked_path(folder, "folder", "folder"))
    require_kind(Case, "case", case, "Case('scan.nii.gz')")
    _refuse_earlier(folder, case, overwrite)
    study = read_case(case)
    image, labels = study.pictures.image, study.tissue.labels
    if image is None or labels is None:
        missing = "image" if image is None else "labels. Give --labels, or --maps"
        raise HmrfError(f"{case.image.name} has no {missing}")
    folder.mkdir(parents=True, exist_ok=True)  # before the solves, to fail early
    colours = image.ndim > len(study.grid.shape)
    random = RandomDeformation(
        labels,
        study.tissue.materials,
        spacing=study.grid.spacing,
        unit=study.grid.unit,
        progress=progress,
        **options,
    )
    written, digits = [], max(3, len(str(count)))
    for number in range(count):
        sample = random.sample((seed, number))
        if not number:
            geometry = geometry_of(_placed(sample.solution, study.grid))
        with _unfinished(folder) as new:
            if not number:
                write_image(new / "image.mha", ImageFile(image, geometry, colours))
                write_image(new / "labels.mha", ImageFile(labels, geometry))
                study = replace(study, grid=_grid_in(new / "image.mha", study.grid))
            solution = _placed(sample.solution, study.grid)
            pair = new / f"{number + 1:0{digits}}"
            pair.mkdir()
            moved = {
                "deformed.mha": ImageFile(sample.image(image), geometry, colours),
                "deformed_labels.mha": ImageFile(sample.labels(labels), geometry),
            }
            for name, each in moved.items():
                write_image(pair / name, each)
            _write_motion(pair, sample, solution, geometry)
            write_study(pair / "truth.study", _whole(study, sample), solution)
            if not number:
                _remove_earlier(folder)
            _publish(new, folder)
        farthest = float(np.linalg.norm(sample.displacement, axis=-1).max())
        written.append(Truth(folder / pair.name, farthest, sample.scale, study.grid.unit))
        on_written(written[-1])
    return written


def _earlier(folder: Path) -> list[Path]:
    """Return the files of an earlier run in a folder, of any number of pairs."""
    pairs = sorted(each for each in folder.glob("*") if _PAIR.fullmatch(each.name))
    files = [folder / name for name in _SHARED]
    files += [pair / name for pair in pairs for name in _OF_PAIRS]
    return [file for file in files if file.is_file()]


def _refuse_earlier(folder: Path, case: Case, overwrite: bool) -> None:
    """Raise an error if an earlier run may not be removed, or is the input of this one."""
    earlier = _earlier(folder)
    refuse_overwriting(earlier, overwrite=overwrite)
    read = {path.resolve() for path in case.inputs}
    for file in earlier:
        if file.resolve() in read:
            raise HmrfError(f"{file} is an input, but would be removed. Choose another folder.")


def _remove_earlier(folder: Path) -> None:
    """Remove the files of an earlier run, whose pairs do not belong to the new image."""
    earlier = _earlier(folder)
    for file in earlier:
        file.unlink()
    for pair in {file.parent for file in earlier} - {folder}:
        with suppress(OSError):  # it may contain other files
            pair.rmdir()


@contextmanager
def _unfinished(folder: Path) -> Iterator[Path]:
    """Make a folder for files that are not yet complete, and remove it with what is left in it."""
    made = folder / f".unfinished-{secrets.token_hex(4)}"
    made.mkdir()
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _publish(new: Path, folder: Path) -> None:
    """Move complete files and pairs into place."""
    for each in sorted(new.iterdir(), key=Path.is_dir):  # pairs after their image
        target = folder / each.name
        if target.is_dir():  # with files that are not of a pair
            for file in each.iterdir():
                file.replace(target / file.name)
        else:
            each.replace(target)


def _placed(solution: Solution, grid: Grid) -> Solution:
    """Return a solution with the place of a grid."""
    return replace(solution, frame=None if grid.place is None else grid.place.as_dict())


def _grid_in(image: Path, grid: Grid) -> Grid:
    """Return a grid with the place that it has in a written image.

    The axes of the original file may have another order, and a slice has another index there. The
    landmarks are along the axes of the written image, and the study must read them so.
    """
    if grid.place is None:
        return grid
    flat = len(grid.shape) < grid.place.ndim
    return replace(grid, place=grid_of_image(image, slice=0 if flat else None).place)


def _write_motion(
    within: Path, sample: RandomSample, solution: Solution, geometry: Geometry
) -> None:
    """Write the field that moves the image, and the landmarks."""
    n = sample.tissue.ndim
    # The images are warped by the same inverse, not by that of trilinear motion.
    back = inverse_displacement(
        sample.displacement, spacing=sample.spacing, tissue=sample.tissue, trilinear=False
    ).displacement
    mm = back * (np.array(geometry.spacing[-n:]) / solution.spacing)
    write_mapping(within / "field.mha", mm, **geometry.as_itk)
    points = landmarks(sample.tissue)
    # The grid of a slice has an additional first axis, along which the index is 0.
    more = geometry.ndim - n
    ends = (np.pad(each, ((0, 0), (more, 0))) for each in (points, sample.points(points)))
    write_points(within / "landmarks.csv", *(each * geometry.spacing for each in ends))


def landmarks(tissue: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
    """Return the indices, shape (N, n), of about 200 pixels that are evenly spread over tissue."""
    apart = max(1.0, (float(tissue.sum()) / _LANDMARKS) ** (1 / tissue.ndim))
    return spread(tissue, apart)


def _whole(study: Study, sample: RandomSample) -> Study:
    """Return the study of a sample with the image, grid and names of the original study."""
    picture = Pictures(study.pictures.image, study.tissue.labels, study.pictures.name)
    return replace(sample.study, grid=study.grid, pictures=picture, names=study.names)

"""Registration of public pairs of real images beside other programs.

`real.pairs` reads copies of public repositories of GitHub, each in a folder with its name, from the
folder ``--files FOLDER``; docs/validation/registration.md names them. The pairs were named in a
commit before the first run, and no setting was chosen on them. All programs receive the same
images: the moving image on the grid of the fixed image, after the affine alignment of this package.
The error is the mean distance of landmarks, or the mean distance between the surfaces of the labels
of both images.

The settings of the other programs are those that their documentation recommends: elastix with its
default B-splines, with correlation and with mutual information, with knots a 24th and a 12th of
the image apart, SyN of ANTs with mutual information and with cross-correlation, and demons of
SimpleITK after histogram matching. The best of them counts.
"""

from __future__ import annotations

import ast
import csv
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import nibabel
import numpy as np
from scipy import ndimage

from napari_hmrf.field.brightness import luminance
from napari_hmrf.registration.alignment import align
from napari_hmrf.registration.register import on_grid
from validation.studies.registration import (
    OURS,
    Array,
    Program,
    available,
    demons,
    elastix,
    ours,
    syn,
)
from validation.study import Options, Results, Target, study

_PAGE = "registration.md"
#: Smallest number of pixels of a label that counts.
_LEAST = 50
#: Largest errors of `register` relative to the best other program: of the median, and of any pair.
_MEDIAN, _WORST = 1.0, 1.4
_OASIS = "MalfLabelingExample/{}/OASIS-TRT-20-{}slice118.nii.gz"
_SLAB = "ANTsTutorial/data/JLF/{}list{}.nii.gz"
_HEART = (
    "P2-Cardiac-Motion/NN_segmentation/Datasets/patient{0:03}/patient{0:03}_frame{1:02}{2}.nii.gz"
)
_SKULL = "Cephalometric-Landmark-Detection-Using-Contemporary-DL/dataset/benchmark/{}"
#: Number of pixels along the longest side above which pictures are halved.
_LARGE = 1500


class RealPair(NamedTuple):
    """Pair of real images.

    Attributes
    ----------
    kind, name : str
    images : tuple of str
        Files of the fixed and of the moving image.
    truth : tuple of str
        Files with landmarks (.csv) or labels of both images.
    """

    kind: str
    name: str
    images: tuple[str, str]
    truth: tuple[str, str]


def _stained(name: str, folder: str, *files: str) -> RealPair:
    """Return a pair of stained sections of BIRL (Borda), with landmarks."""
    paths = [f"BIRL/data-images/{folder}/scale-5pc/{file}" for file in files]
    images, truth = ((f"{paths[0]}{end}", f"{paths[1]}{end}") for end in (".jpg", ".csv"))
    return RealPair("stained sections", name, images, truth)


def _two(form: str, *parts: tuple[Any, ...]) -> tuple[str, str]:
    first, second = (form.format(*part) for part in parts)
    return first, second


def _persons(one: int, other: int) -> RealPair:
    """Return sections of the brains of two persons, with labels (Mindboggle 101, OASIS)."""
    end = "DKT31_CMA_labels_"
    return RealPair(
        "sections of two brains",
        f"persons {one} and {other}",
        _two(_OASIS, ("Atlases", f"{one}_"), ("Atlases", f"{other}_")),
        _two(_OASIS, ("Labels", f"{one}_{end}"), ("Labels", f"{other}_{end}")),
    )


def _slabs(one: int, other: int) -> RealPair:
    """Return slabs of 18 planes of T1-weighted MRI of two persons, with labels of tissue."""
    return RealPair(
        "slabs of two heads",
        f"persons {one} and {other}",
        _two(_SLAB, ("i", one), ("i", other)),
        _two(_SLAB, ("s", one), ("s", other)),
    )


def _heart(number: int, end: int) -> RealPair:
    """Return a heart at the end of diastole and of systole, with labels (ACDC)."""
    images = _two(_HEART, (number, 1, ""), (number, end, ""))
    truth = _two(_HEART, (number, 1, "_gt"), (number, end, "_gt"))
    return RealPair("heart in diastole and systole", f"patient {number}", images, truth)


def _skulls(one: int, other: int) -> RealPair:
    """Return lateral X-rays of the skulls of two persons, with landmarks (ISBI 2015)."""
    images = _two(_SKULL, (f"images/{one:03}.jpg",), (f"images/{other:03}.jpg",))
    truth = _two(_SKULL, ("points.csv",), ("points.csv",))
    return RealPair("X-rays of two skulls", f"persons {one} and {other}", images, truth)


#: All pairs.
PAIRS = (
    _stained("rat kidney", "rat-kidney_", "Rat-Kidney_HE", "Rat-Kidney_PanCytokeratin"),
    _stained("lung lesion", "lesions_", "Izd2-29-041-w35_HE", "Izd2-29-041-w35_proSPC"),
    _persons(1, 2),
    _persons(3, 4),
    _slabs(1, 2),
    _slabs(3, 4),
    _heart(5, 13),
    _skulls(1, 10),
    _skulls(3, 20),
)


class Prepared(NamedTuple):
    """Pair on one grid, with its truth.

    Attributes
    ----------
    fixed, moving : ndarray
    spacing : tuple of float
    points : tuple of ndarray, or None
        Landmarks in pixels of the grid: in the fixed image, and in the aligned moving image.
    labels : tuple of ndarray, or None
    """

    fixed: Array
    moving: Array
    spacing: tuple[float, ...]
    points: tuple[Array, Array] | None
    labels: tuple[Array, Array] | None

    def error(self, displacement: Array) -> float:
        """Return the mean error of a displacement on the grid, in the unit of the spacing."""
        sides = np.array(self.spacing)
        if self.points is not None:
            here, there = self.points
            moved = here + _at(displacement, here) / sides
            return float(np.linalg.norm((moved - there) * sides, axis=1).mean())
        assert self.labels is not None
        one, other = self.labels
        sites = np.moveaxis(np.indices(one.shape), 0, -1) + displacement / sides
        warped = ndimage.map_coordinates(other, np.moveaxis(sites, -1, 0), order=0, mode="nearest")
        return float(
            np.mean(
                [_distance(one == label, warped == label, self.spacing) for label in self.shared]
            )
        )

    @property
    def shared(self) -> list[int]:
        """Labels that are large enough in both images."""
        assert self.labels is not None
        large = [
            {int(label) for label in np.unique(each[each > 0]) if (each == label).sum() >= _LEAST}
            for each in self.labels
        ]
        return sorted(large[0] & large[1])


def _at(displacement: Array, points: Array) -> Array:
    """Interpolate a displacement at points, shape (N, n), in pixels."""
    return np.stack(
        [
            ndimage.map_coordinates(along, points.T, order=1, mode="nearest")
            for along in np.moveaxis(displacement, -1, 0)
        ],
        axis=-1,
    )


def _distance(one: Array, other: Array, spacing: tuple[float, ...]) -> float:
    """Return the mean distance between the surfaces of two masks, in both directions."""
    if not other.any():  # the label is lost: as far as its own size
        return float(np.linalg.norm(np.ptp(np.argwhere(one), axis=0) * spacing))
    edges = [mask & ~ndimage.binary_erosion(mask) for mask in (one, other)]
    far = [ndimage.distance_transform_edt(~edge, sampling=spacing) for edge in edges]
    return float((far[1][edges[0]].mean() + far[0][edges[1]].mean()) / 2)


def prepared(folder: Path, pair: RealPair) -> Prepared:
    """Read a pair, and bring its moving image and truth to the grid of the fixed image."""
    (fixed, sides), (moving, own_sides) = (_grey(folder / name) for name in pair.images)
    sizes = {"spacing": sides, "moving_spacing": own_sides}
    masks = np.ones(fixed.shape, bool), np.ones(moving.shape, bool)
    matrix = align("affine", fixed, moving, masks=masks, **sizes).matrix
    counted = np.ones(fixed.shape, bool), np.ones(moving.shape, bool)
    images = on_grid(fixed, moving, counted, sides, own_sides, matrix)
    axes = fixed.ndim
    turn = matrix[:axes, :axes] * np.array(sides) / np.array(own_sides)[:, None]
    shift = matrix[:axes, axes] / np.array(own_sides)
    points = labels = None
    truth = [folder / name for name in pair.truth]
    if truth[0].suffix == ".csv":
        here, there = (
            _landmarks(path, folder / image) for path, image in zip(truth, pair.images, strict=True)
        )
        both = sorted(set(here) & set(there))
        here, there = (np.array([each[number] for number in both]) for each in (here, there))
        points = here, np.linalg.solve(turn, (there - shift).T).T
    else:
        one, other = (np.asarray(nibabel.load(path).dataobj) for path in truth)
        mapped = ndimage.affine_transform(other, turn, shift, fixed.shape, order=0)
        labels = one.astype(int), mapped.astype(int)
    return Prepared(images.fixed, images.moving, sides, points, labels)


def _grey(path: Path) -> tuple[Array, tuple[float, ...]]:
    """Return the brightness of a picture or volume, and the size of its pixels."""
    if path.suffix == ".jpg":
        picture = np.asarray(iio.imread(path), np.float32)
        grey = luminance(picture) if picture.ndim == 3 else picture
        if _is_large(grey.shape):
            rows, cols = (n // 2 * 2 for n in grey.shape)
            grey = grey[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2).mean(axis=(1, 3))
        return grey.astype(np.float32), (1.0, 1.0)
    file = nibabel.load(path)
    pixels = np.asarray(file.dataobj, np.float32)
    return pixels, tuple(float(side) for side in file.header.get_zooms()[: pixels.ndim])


def _is_large(shape: tuple[int, ...]) -> bool:
    return max(shape[:2]) > _LARGE


def _landmarks(path: Path, picture: Path) -> dict[int, tuple[float, float]]:
    """Return the landmarks of a picture, (row, col) by number.

    The table has rows of number, x and y, or a row for each picture.
    """
    with path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    if head == ["document", "points"]:
        known = ast.literal_eval(dict(rows)[picture.name])
        points = {int(number): (at["y"], at["x"]) for number, at in known.items()}
    else:
        points = {int(number): (float(y), float(x)) for number, x, y in rows}
    if _is_large(iio.improps(picture).shape):
        return {
            number: ((y + 0.5) / 2 - 0.5, (x + 0.5) / 2 - 0.5) for number, (y, x) in points.items()
        }
    return points


def _programs(prepared: Prepared) -> dict[str, Program]:
    """Return the programs with settings for an image."""
    longest = max(n * side for n, side in zip(prepared.fixed.shape, prepared.spacing, strict=True))
    every = {OURS: Program(ours)}
    for sigma in (1.5, 2.0):
        every[f"demons, width {sigma:g}"] = Program(
            partial(demons, sigma=sigma), "SimpleITK", "SimpleITK"
        )
    for part in (24, 12):
        for name, metric in (
            ("correlation", "AdvancedNormalizedCorrelation"),
            ("mutual information", "AdvancedMattesMutualInformation"),
        ):
            every[f"elastix, {name}, 1/{part}"] = Program(
                partial(
                    elastix, gap=longest / part, Metric=f"{metric} TransformBendingEnergyPenalty"
                ),
                "itk",
                "itk-elastix",
            )
    for name, metric in (("mutual information", "mattes"), ("cross-correlation", "CC")):
        every[f"SyN, {name}"] = Program(partial(syn, metric=metric), "ants", "antspyx")
    return available(every)


def _cases(options: Options) -> Iterator[tuple[str, tuple[Path, RealPair]]]:
    if not options.files:
        raise SystemExit("give the folder with the copies of the repositories: --files FOLDER")
    for pair in PAIRS:
        yield f"{pair.kind}, {pair.name}", (options.files[0], pair)


def _rows(results: Results) -> Iterator[list[Any]]:
    for row in results.values():
        best = min(row["others"], key=row["others"].get)
        yield [
            row["kind"],
            row["name"],
            f"{row['unmoved']:.2f}",
            f"{row['ours']:.2f}",
            *(f"{min(own):.2f}" for own in _by_program(row["others"])),
            best,
            f"{row['ours'] / row['others'][best]:.2f}",
        ]


def _by_program(others: dict[str, float]) -> list[list[float]]:
    """Return the errors of the variants of each program."""
    return [
        [error for name, error in others.items() if name.startswith(program)] or [np.nan]
        for program in ("demons", "elastix", "SyN")
    ]


def _targets(results: Results) -> Iterator[Target]:
    ratios = [row["ours"] / min(row["others"].values()) for row in results.values()]
    yield Target("median error relative to the best other program", np.median(ratios), _MEDIAN)
    yield Target("largest error relative to the best other program", max(ratios), _WORST)


@study(
    "real.pairs",
    _cases,
    (
        "kind", "pair", "aligned only", "`register`", "demons", "elastix", "SyN", "best other",
        "ratio",
    ),
    rows=_rows,
    targets=_targets,
    page=_PAGE,
)  # fmt: skip
def real(given: tuple[Path, RealPair]) -> dict[str, Any]:
    """Compare the errors of `register` and of other programs on public pairs of real images."""
    folder, pair = given
    made = prepared(folder, pair)
    errors = {}
    for name, program in _programs(made).items():
        errors[name] = made.error(program.register(made.fixed, made.moving, made.spacing))
    unmoved = made.error(np.zeros((*made.fixed.shape, made.fixed.ndim)))
    own = errors.pop(OURS)
    print({name: round(error, 3) for name, error in errors.items()}, flush=True)
    return {
        "kind": pair.kind, "name": pair.name, "unmoved": unmoved, "ours": own, "others": errors,
    }  # fmt: skip

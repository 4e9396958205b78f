"""Registration of public pairs of real images beside other programs.

`real.pairs` reads copies of public repositories of GitHub, each in a folder with its name, from the
folder ``--files FOLDER``: Borda/BIRL, ntustison/MalfLabelingExample, stnava/ANTsTutorial and
DeepRegNet/DeepReg. The pairs were named in a commit before the first run, and no setting was chosen
on them. All programs receive the same images: the moving image on the grid of the fixed image,
after the affine alignment of this package. Volumes of a prostate have no common position, and are
scaled to the same box. The error is the mean distance of landmarks, or the mean distance between
the surfaces of the labels of both images.

The settings of the other programs are those that their documentation recommends: elastix with its
default B-splines, with correlation and with mutual information, with knots a 24th and a 12th of
the image apart, SyN of ANTs with mutual information and with cross-correlation, and demons of
SimpleITK after histogram matching. The best of them counts.
"""

from __future__ import annotations

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
_PROSTATE = "DeepReg/data/test/nifti/paired/train/{}_{}/case{:06d}.nii.gz"


class RealPair(NamedTuple):
    """Pair of real images.

    Attributes
    ----------
    kind, name : str
    images : tuple of str
        Files of the fixed and of the moving image.
    truth : tuple of str
        Files with landmarks (.csv) or labels of both images.
    aligned : bool
        True if the images are aligned; False if they are scaled to the same box.
    """

    kind: str
    name: str
    images: tuple[str, str]
    truth: tuple[str, str]
    aligned: bool = True


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


def _prostate(number: int) -> RealPair:
    """Return ultrasound and MRI of a prostate, with masks of structures (DeepReg)."""
    files = (
        _two(_PROSTATE, ("fixed", kind, number), ("moving", kind, number))
        for kind in ("images", "labels")
    )
    return RealPair("ultrasound and MRI of a prostate", f"case {number}", *files, aligned=False)


#: All pairs.
PAIRS = (
    _stained("rat kidney", "rat-kidney_", "Rat-Kidney_HE", "Rat-Kidney_PanCytokeratin"),
    _stained("lung lesion", "lesions_", "Izd2-29-041-w35_HE", "Izd2-29-041-w35_proSPC"),
    _persons(1, 2),
    _persons(3, 4),
    _slabs(1, 2),
    _slabs(3, 4),
    _prostate(1),
    _prostate(3),
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
    if pair.aligned:
        sizes = {"spacing": sides, "moving_spacing": own_sides}
        masks = np.ones(fixed.shape, bool), np.ones(moving.shape, bool)
        matrix = align("affine", fixed, moving, masks=masks, **sizes).matrix
    else:
        ratio = [
            n * size / (m * side)
            for n, size, m, side in zip(moving.shape, own_sides, fixed.shape, sides, strict=True)
        ]
        matrix = np.diag([*ratio, 1.0])
    counted = np.ones(fixed.shape, bool), np.ones(moving.shape, bool)
    images = on_grid(fixed, moving, counted, sides, own_sides, matrix)
    axes = fixed.ndim
    turn = matrix[:axes, :axes] * np.array(sides) / np.array(own_sides)[:, None]
    shift = matrix[:axes, axes] / np.array(own_sides)
    points = labels = None
    truth = [folder / name for name in pair.truth]
    if truth[0].suffix == ".csv":
        here, there = (_landmarks(path) for path in truth)
        both = sorted(set(here) & set(there))
        here, there = (np.array([each[number] for number in both]) for each in (here, there))
        points = here, np.linalg.solve(turn, (there - shift).T).T
    else:
        one, other = (_masks(path) for path in truth)
        if pair.aligned:
            mapped = ndimage.affine_transform(other[0], turn, shift, fixed.shape, order=0)
            labels = one[0].astype(int), mapped.astype(int)
        else:
            here, there = (
                np.array([np.argwhere(mask > 0).mean(axis=0) for mask in masks])
                for masks in (one, other)
            )
            points = here, np.linalg.solve(turn, (there - shift).T).T
    return Prepared(images.fixed, images.moving, sides, points, labels)


def _grey(path: Path) -> tuple[Array, tuple[float, ...]]:
    """Return the brightness of a picture or volume, and the size of its pixels."""
    if path.suffix == ".jpg":
        return luminance(iio.imread(path)).astype(np.float32), (1.0, 1.0)
    file = nibabel.load(path)
    pixels = np.asarray(file.dataobj, np.float32)
    return pixels, tuple(float(side) for side in file.header.get_zooms()[: pixels.ndim])


def _landmarks(path: Path) -> dict[int, tuple[float, float]]:
    """Return landmarks, (row, col) by number, from a table of number, x and y."""
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    return {int(number): (y, x) for number, x, y in rows}


def _masks(path: Path) -> list[Array]:
    """Return the label image of a file, or the masks of a file with several, whose axis is last."""
    pixels = np.asarray(nibabel.load(path).dataobj)
    return list(np.moveaxis(pixels, -1, 0)) if pixels.ndim == 4 else [pixels]


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

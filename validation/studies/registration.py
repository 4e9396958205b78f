"""Registration beside other programs: known deformations, landmarks, and constraints.

`known` deforms a head by known displacements: random B-splines with knots 24 mm apart and an
expansion (``splines``), regions of the brain that are pulled, in large motion (``large``), lesions
that grow (``growth``), and random B-splines with knots 12 mm apart (``fine``). The image is a
volume such as a T1-weighted MRI with optional probability maps of grey and white matter (``--files
T1 GREY WHITE``), or else the synthetic head of the package; ``--sizes 1`` is the size of a voxel in
mm. No MRI is part of this project. The image after the displacement has another gamma, a smooth
bias and noise. Seeds 0 and 1 were used to choose the settings of all programs.

`contrasts` registers the truths ``splines`` with images of other contrasts: inverted, similar to a
T2-weighted MRI, and another nonlinear function of brightness.

`missing` removes tissue of a head, or lets a tumour take its place and push the tissue around it,
and measures errors within 12 mm of the missing tissue.

`intervals` compares the errors of the truths of `known` with their error bars.

`sizes` measures the time and the memory of a registration of a whole head, and of one with missing
tissue, which is registered twice.

`pairs` registers two pictures of neighbouring sections after the same affine map, and compares
landmarks (``--files FIXED MOVING [FIXED.csv MOVING.csv]``): rows of number, x and y, or else
features that are matched in both pictures as in `sections`.

`alignment` turns and shifts images, and aligns them again with ``initial="rigid"``: each file of
``--files`` is a picture or a volume, of which the middle slice is a picture, too; by default the
synthetic samples of the package.

The other programs are demons of SimpleITK, elastix and ANTs (``pip install itk-elastix antspyx``).
Elastix and SyN receive images without bias (N4 of SimpleITK, not timed), because only `register`
normalizes brightness. ``--methods demons elastix`` selects programs by the beginnings of their
names; SyN with cross-correlation takes minutes for each case, and runs only if it is named.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from benchmarks.clock import timed, with_memory
from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve, warp
from napari_hmrf.data import head_phantom, phantom
from napari_hmrf.field.deformation import smallest_determinant
from napari_hmrf.fields import count_folds, green_lagrange_strain, rmsd
from napari_hmrf.io.images import read_image
from napari_hmrf.loads import Loads
from napari_hmrf.posterior import image_uncertainty
from napari_hmrf.registration import register
from napari_hmrf.registration.alignment import align
from validation.oracles.elasticity import direct_solution
from validation.study import (
    Options,
    Results,
    Table,
    Target,
    draw_differences,
    draw_grid,
    new_figure,
    save,
    study,
)

Array = npt.NDArray[Any]
Register = Callable[[Array, Array, tuple[float, ...]], Array]
_PAGE = "registration.md"
OURS = "`register`"

# Programs.

#: Pixel sizes of the levels of demons, and numbers of iterations.
_DEMONS_LEVELS = ((4, 100), (2, 60), (1, 30))
#: Iterations and compared points of elastix on each of its four levels.
_ELASTIX_STEPS, _ELASTIX_POINTS = 500, 4000
#: Weight of the bending energy in elastix; without it, knots 12 mm apart follow the noise.
_BENDING = 1.0

#: Pixel size of the grid on which the bias is estimated, and brightness that is added because the
#: method takes logarithms.
_N4_SHRINK, _POSITIVE = 3, 0.1


class Program(NamedTuple):
    """Registration program with its settings.

    Attributes
    ----------
    register : callable
        Function of the fixed image, the moving image and the spacing.
    module, package : str
        Module that must be importable, and its name for pip.
    unbiased : bool
        True if it receives images without bias. Demons are worse with them: 2.0 instead of 1.5 mm
        on the first held-out case.
    slow : bool
        True if it runs only if it is named.
    """

    register: Register
    module: str = "napari_hmrf"
    package: str = "napari-hmrf"
    unbiased: bool = False
    slow: bool = False


def as_itk(*pixels: Array, spacing: tuple[float, ...] | None = None) -> list[Any]:
    """Return arrays as images of SimpleITK, in single precision."""
    import SimpleITK as sitk

    images = [sitk.GetImageFromArray(np.asarray(each, np.float32)) for each in pixels]
    for image in images if spacing is not None else ():
        image.SetSpacing([float(size) for size in reversed(spacing)])
    return images


def displacement_of(field: Any) -> Array:
    """Return a field of SimpleITK, whose components are in the order (x, y, z), as an array."""
    import SimpleITK as sitk

    return np.ascontiguousarray(sitk.GetArrayFromImage(field)[..., ::-1])


def demons(fixed: Array, moving: Array, spacing: tuple[float, ...], sigma: float) -> Array:
    """Return the displacement by symmetric demons of SimpleITK, on three levels.

    Parameters
    ----------
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    sigma : float
        Standard deviation of the smoothing of the displacement, in pixels of the level.
    """
    import SimpleITK as sitk

    images = as_itk(fixed, moving, spacing=spacing)
    images[1] = sitk.HistogramMatching(images[1], images[0], 1024, 7, True)
    field = None
    for size, count in _DEMONS_LEVELS:
        level = images
        if size > 1:
            widths = [float(size * side / 2) for side in reversed(spacing)]
            level = [
                sitk.Shrink(sitk.SmoothingRecursiveGaussian(image, widths), [size] * fixed.ndim)
                for image in images
            ]
        method = sitk.FastSymmetricForcesDemonsRegistrationFilter()
        method.SetNumberOfIterations(count)
        method.SetSmoothDisplacementField(True)
        method.SetStandardDeviations(sigma)
        if field is None:
            field = method.Execute(*level)
        else:
            kind, still = sitk.sitkVectorFloat64, sitk.Transform(fixed.ndim, sitk.sitkIdentity)
            start = sitk.Resample(field, level[0], still, sitk.sitkLinear, 0.0, kind)
            field = method.Execute(*level, start)
    return displacement_of(field)


def elastix(
    fixed: Array, moving: Array, spacing: tuple[float, ...], gap: float, **settings: str
) -> Array:
    """Return the displacement by B-splines of elastix.

    Parameters
    ----------
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    gap : float
        Distance of the knots on the finest level, in the unit of the spacing.
    **settings : str
        Further parameters of elastix, with values separated by spaces.
    """
    import itk

    images = []
    for each in (fixed, moving):
        image = itk.image_view_from_array(np.ascontiguousarray(each, np.float32))
        image.SetSpacing([float(size) for size in reversed(spacing)])
        images.append(image)
    parameters = itk.ParameterObject.New()
    values = parameters.GetDefaultParameterMap("bspline", 4, float(gap))
    wanted = {
        "Registration": "MultiMetricMultiResolutionRegistration",
        "Metric": "AdvancedNormalizedCorrelation TransformBendingEnergyPenalty",
        "Metric0Weight": "1",
        "Metric1Weight": str(_BENDING),
        "MaximumNumberOfIterations": str(_ELASTIX_STEPS),
        "NumberOfSpatialSamples": str(_ELASTIX_POINTS),
        "WriteResultImage": "false",
        **settings,
    }
    for name, value in wanted.items():
        values[name] = value.split()
    parameters.AddParameterMap(values)
    _, found = itk.elastix_registration_method(
        *images, parameter_object=parameters, log_to_console=False
    )
    with tempfile.TemporaryDirectory() as folder:
        field = itk.transformix_deformation_field(images[1], found, output_directory=folder)
        return np.array(itk.array_from_image(field))[..., ::-1]


def syn(
    fixed: Array, moving: Array, spacing: tuple[float, ...], metric: str, step: float = 0.2
) -> Array:
    """Return the displacement by SyN of ANTs.

    Parameters
    ----------
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    spacing : tuple of float
    metric : {"mattes", "CC"}
    step : float
        Length of a step of the gradient descent, in pixels.
    """
    import ants

    images = [
        ants.from_numpy(each.astype(np.float32), spacing=[float(size) for size in spacing])
        for each in (fixed, moving)
    ]
    with tempfile.TemporaryDirectory() as folder:
        found = ants.registration(
            *images,
            type_of_transform="SyNOnly",
            initial_transform="Identity",
            outprefix=str(Path(folder) / "syn"),
            syn_metric=metric,
            grad_step=step,
            syn_sampling=4 if metric == "CC" else 32,
            reg_iterations=(40, 20, 10) if metric == "CC" else (100, 70, 30),
        )
        field = next(name for name in found["fwdtransforms"] if name.endswith(".nii.gz"))
        return np.array(ants.image_read(field).numpy())


def without_bias(image: Array) -> Array:
    """Return an image without its smooth bias, by N4 of SimpleITK on a coarser grid."""
    import SimpleITK as sitk

    (whole,) = as_itk(image + _POSITIVE)
    mask = sitk.OtsuThreshold(whole, 0, 1)
    coarse = [sitk.Shrink(each, [_N4_SHRINK] * image.ndim) for each in (whole, mask)]
    correction = sitk.N4BiasFieldCorrectionImageFilter()
    correction.SetMaximumNumberOfIterations([50] * 4)
    correction.Execute(*coarse)
    bias = sitk.Exp(correction.GetLogBiasFieldAsImage(whole))
    return sitk.GetArrayFromImage(whole / bias) - _POSITIVE


def ours(fixed: Array, moving: Array, spacing: tuple[float, ...], m: Array | None = None) -> Array:
    """Return the displacement by `register`."""
    return register(fixed, moving, spacing=spacing, stiffness=m).displacement


def programs(
    options: Options, gaps: tuple[str, ...], sigmas: tuple[float, ...], m: Array | None = None
) -> dict[str, Program]:
    """Return the chosen programs by name, and print those that are not installed.

    Parameters
    ----------
    options : Options
    gaps : tuple of str
        Distances of the knots of elastix, with their unit.
    sigmas : tuple of float
        Standard deviations of demons, in pixels.
    m : ndarray, optional
        Stiffness of tissue, with which `register` runs once more if it is named.
    """
    every = {OURS: Program(ours)}
    if m is not None:
        every["stiffness in `register`"] = Program(partial(ours, m=m), slow=True)
    for sigma in sigmas:
        run: Register = partial(demons, sigma=sigma)
        every[f"demons, width {sigma:g}"] = Program(run, "SimpleITK", "SimpleITK")
    for gap in gaps:
        run = partial(elastix, gap=float(gap.split()[0]))
        every[f"elastix, knots {gap} apart"] = Program(run, "itk", "itk-elastix", unbiased=True)
    for name, settings, slow in (
        ("mutual information", {"metric": "mattes"}, False),
        ("cross-correlation", {"metric": "CC"}, True),
        ("shorter steps", {"metric": "mattes", "step": 0.1}, True),
    ):
        run = partial(syn, **settings)
        every[f"SyN, {name}"] = Program(run, "ants", "antspyx", unbiased=True, slow=slow)
    named = {
        name: any(name.strip("`").startswith(word) for word in options.methods) for name in every
    }
    return available(
        {
            name: program
            for name, program in every.items()
            if (named[name] if options.methods else not program.slow)
        }
    )


def available(programs: dict[str, Program]) -> dict[str, Program]:
    """Return the programs that are installed, and print the others."""
    chosen = {}
    for name, program in programs.items():
        if importlib.util.find_spec(program.module) is None:
            print(f"{name} is skipped: it requires `pip install {program.package}`")
        else:
            chosen[name] = program
    return chosen


def intervals(away: Array, statistic: Callable[..., Any]) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of a statistic of the last axis of some values."""
    count = away.shape[-1]
    drawn = np.random.default_rng(0).integers(count, size=(2000, count))
    low, high = np.percentile(statistic(away[drawn], axis=1), (2.5, 97.5))
    return float(low), float(high)


# Known deformations of a head.

#: Relative stiffness of grey matter, white matter, and everything else.
_GREY, _WHITE, _FLUID = 1.0, 1.5, 0.05
#: Relative stiffness of a lesion, its radius in mm, its growth as a strain, and its brightness.
_LESION, _RADIUS, _GROWTH, _DARKER = 4.0, 16.0, 0.4, 0.6
#: Radius and motion of a moved region in mm, and number of regions.
_REGION, _PULL, _REGIONS = 12.0, 9.0, 3
#: Distance from the brain, in mm, at which tissue is fixed.
_FIXED_BEYOND = 8.0
#: Pixels of elastic truths are larger by this factor.
_COARSER = 2
#: Smallest determinant of a truth.
_LEAST = 0.2


class Head(NamedTuple):
    """Image of a head with its tissue.

    Attributes
    ----------
    name : str
    image : ndarray, shape (D, H, W), float32
        Brightness from 0 to 1.
    brain : ndarray of bool
        Tissue in which errors are measured.
    stiffness : ndarray, float32
        Relative stiffness.
    spacing : tuple of float
        Size of a voxel in mm.
    """

    name: str
    image: Array
    brain: Array
    stiffness: Array
    spacing: tuple[float, ...]


class Case(NamedTuple):
    """Two images, and the displacement between them in mm."""

    fixed: Array
    moving: Array
    displacement: Array


def phantom_head(size: int) -> Head:
    """Return the synthetic head of the package."""
    head = head_phantom(size)
    m = head.problem.stiffness
    image = (head.image / head.image.max()).astype(np.float32)
    return Head(f"phantom-{size}", image, m > 0, np.maximum(m, _FLUID), head.spacing)


def head_from_files(image: Path, tissue: list[Path], voxel: float) -> Head:
    """Read a head from files.

    Parameters
    ----------
    image : path
        Volume, such as a T1-weighted MRI.
    tissue : list of path
        Probability maps of grey and white matter on the grid of `image`. Without maps, all pixels
        brighter than a threshold count as tissue.
    voxel : float
        Size of a voxel in mm; the volume is sampled at every n-th voxel.
    """
    read = read_image(image)
    if read.geometry is None or read.pixels.ndim != 3:
        raise SystemExit(f"{image} is not a volume with a place in mm. Pass a NIfTI file")
    steps = [max(1, round(voxel / size)) for size in read.geometry.spacing]

    def sampled(pixels: Array) -> Array:
        smooth = [step / 2.5 if step > 1 else 0 for step in steps]
        return ndimage.gaussian_filter(pixels.astype(np.float32), smooth)[
            tuple(slice(None, None, step) for step in steps)
        ]

    pixels = sampled(read.pixels)
    maps = [sampled(read_image(path).pixels) for path in tissue]
    m = np.full(pixels.shape, _FLUID, np.float32)
    if maps:
        half = max(each.max() for each in maps) / 2
        brain = sum(maps) > 0.8 * half
        m[brain] = _GREY
        if len(maps) > 1:
            m[brain & (maps[1] > maps[0])] = _WHITE
    else:
        brain = ndimage.binary_opening(pixels > 0.25 * np.quantile(pixels, 0.99), iterations=2)
        m[brain] = _GREY
    spacing = tuple(step * size for step, size in zip(steps, read.geometry.spacing, strict=True))
    name = f"{image.name.split('.')[0]}-{spacing[0]:g}mm"
    return Head(name, pixels / pixels.max(), brain, m, spacing)


def case(head: Head, truth: str, seed: int, contrast: str = "equal") -> Case:
    """Return a case; its random numbers depend on the seed and the name of the truth only."""
    number = list(TRUTHS).index(truth)
    rng = np.random.default_rng([seed, number] if number else seed)
    fixed, displacement = TRUTHS[truth](head, rng)
    moving = warp(fixed, displacement, spacing=head.spacing)
    moving = CONTRASTS[contrast](np.clip(moving, 0, 1))
    return Case(fixed, degraded(rng, moving, head.spacing), displacement)


#: Brightness of a T2-weighted image at some brightnesses of a T1-weighted image: background, bone,
#: fluid, grey and white matter, fat.
_T1 = (0.0, 0.08, 0.2, 0.35, 0.55, 0.75, 1.0)
_T2 = (0.0, 0.25, 1.0, 0.85, 0.6, 0.4, 0.3)
#: Contrasts of the moving image, as functions of the brightness of the fixed image.
CONTRASTS: dict[str, Callable[[Array], Array]] = {
    "equal": lambda bright: bright,
    "inverted": lambda bright: 1 - bright,
    "like T2": lambda bright: np.interp(bright, _T1, _T2),
    "nonlinear": lambda bright: np.sin(1.4 * np.pi * bright) ** 2,
}


def random_splines(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    spacing: tuple[float, ...],
    gap: float,
    size: float,
) -> Array:
    """Return a displacement of random cubic B-splines.

    Parameters
    ----------
    rng : Generator
    shape, spacing : tuple
        Grid.
    gap : float
        Distance of the knots, in the unit of the spacing.
    size : float
        Root mean square of the displacement.
    """
    extent = [count * side for count, side in zip(shape, spacing, strict=True)]
    knots = [math.ceil(length / gap) + 3 for length in extent]
    at = np.meshgrid(
        *(np.arange(count) * side / gap + 1 for count, side in zip(shape, spacing, strict=True)),
        indexing="ij",
    )
    parts = [
        ndimage.map_coordinates(
            rng.normal(size=knots), at, order=3, prefilter=False, mode="nearest"
        )
        for _ in shape
    ]
    field = np.stack(parts, axis=-1)
    return field * (size / np.sqrt((field**2).sum(axis=-1).mean()))


def degraded(rng: np.random.Generator, image: Array, spacing: tuple[float, ...]) -> Array:
    """Return an image with another gamma, a smooth bias of 20 %, and noise of 2 %."""
    bright = np.clip(image / image.max(), 0, 1) ** rng.uniform(0.7, 1.4)
    bias = random_splines(rng, image.shape, spacing, 80.0, 1.0)[..., 0]
    bright = bright * (1 + 0.2 * bias / np.abs(bias).max())
    return (bright + rng.normal(scale=0.02, size=image.shape)).astype(np.float32)


def _splines(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Move tissue by B-splines with knots 24 mm apart, and expand it around a point."""
    field = random_splines(rng, head.image.shape, head.spacing, 24.0, 3.6)
    inner = np.argwhere(_deeper(head, 16.0))
    centre = inner[rng.integers(len(inner))]
    away = _offsets(head, centre)
    far = np.linalg.norm(away, axis=-1, keepdims=True) / 20
    outward = away / 20 * np.exp(0.5 - 0.5 * far**2)
    return head.image, _unfolded(field + 4.0 * outward, head.spacing)


def _fine_splines(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Move tissue by B-splines with knots 12 mm apart."""
    field = random_splines(rng, head.image.shape, head.spacing, 12.0, 2.4)
    return head.image, _unfolded(field, head.spacing)


def _large(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pull three regions of the brain in random directions, in large motion."""
    moved = np.zeros((*head.image.shape, 3), np.float32)
    held = np.zeros(head.image.shape, bool)
    for centre in _places(head, rng, _REGIONS, 14.0, 40.0):
        ball = np.linalg.norm(_offsets(head, centre), axis=-1) <= _REGION
        direction = rng.normal(size=3)
        moved[ball] = _PULL * direction / np.linalg.norm(direction)
        held |= ball
    return head.image, _solved(head, moved, held, head.stiffness, None)


def _grown(head: Head, rng: np.random.Generator) -> tuple[Array, Array]:
    """Let two darker lesions grow, in large motion."""
    lesion, m = np.zeros(head.image.shape), head.stiffness.copy()
    for centre in _places(head, rng, 2, 14.0, 45.0):
        radius = _RADIUS * rng.uniform(0.8, 1.2)
        far = np.linalg.norm(_offsets(head, centre) * rng.uniform(0.8, 1.25, 3), axis=-1)
        lesion = np.maximum(lesion, (far <= radius).astype(float))
    m[lesion > 0] = _LESION
    fixed = head.image * (1 - (1 - _DARKER) * ndimage.gaussian_filter(lesion, 0.7))
    nothing = np.zeros((*lesion.shape, 3), np.float32)
    displacement = _solved(head, nothing, np.zeros(lesion.shape, bool), m, _GROWTH * lesion)
    return fixed.astype(np.float32), displacement


TRUTHS: dict[str, Callable[[Head, np.random.Generator], tuple[Array, Array]]] = {
    "splines": _splines,
    "large": _large,
    "growth": _grown,
    "fine": _fine_splines,
}


def _solved(head: Head, y: Array, held: Array, m: Array, growth: Array | None) -> Array:
    """Return a large motion on every second voxel, interpolated by cubic splines."""
    every = (slice(None, None, _COARSER),) * 3
    outside = ndimage.distance_transform_edt(~head.brain, sampling=head.spacing) > _FIXED_BEYOND
    c = np.repeat((held | outside)[every][..., None], 3, axis=-1)
    problem = Problem(
        observed=y[every],
        confidence=c.astype(np.float32),
        stiffness=m[every],
        spacing=[_COARSER * size for size in head.spacing],
        loads=None if growth is None else Loads(growth=growth[every]),
    )
    coarse = solve(problem, NeoHookeanPrior(0.4), backend="cpu").displacement
    at = np.meshgrid(*(np.arange(count) / _COARSER for count in y.shape[:3]), indexing="ij")
    parts = [
        ndimage.map_coordinates(coarse[..., axis], at, order=3, mode="nearest") for axis in range(3)
    ]
    return _unfolded(np.stack(parts, axis=-1), head.spacing)


def _unfolded(displacement: Array, spacing: tuple[float, ...]) -> Array:
    """Return a displacement that is reduced until its smallest determinant is 0.2."""
    while np.nanmin(smallest_determinant(displacement, spacing)) < _LEAST:
        displacement = 0.9 * displacement
    return displacement


def _places(
    head: Head, rng: np.random.Generator, count: int, depth: float, apart: float
) -> list[Array]:
    """Return random voxels at a depth in the brain, at a distance from each other in mm."""
    inner = np.argwhere(_deeper(head, depth))
    places: list[Array] = []
    while len(places) < count:
        place = inner[rng.integers(len(inner))]
        gaps = [np.linalg.norm((place - other) * head.spacing) for other in places]
        if min(gaps, default=math.inf) > apart:
            places.append(place)
    return places


def _deeper(head: Head, depth: float) -> Array:
    """Return the voxels of the filled brain that are deeper than a depth in mm."""
    filled = ndimage.binary_fill_holes(ndimage.binary_closing(head.brain, iterations=3))
    return np.asarray(ndimage.distance_transform_edt(filled, sampling=head.spacing) > depth)


def _offsets(head: Head, centre: Array) -> Array:
    """Return the offset of each voxel from a voxel, in mm."""
    return (np.moveaxis(np.indices(head.image.shape), 0, -1) - centre) * np.array(head.spacing)


class Known(NamedTuple):
    """Registration of a known deformation by a program; None moves nothing."""

    truth: str
    seed: int
    method: str
    program: Program | None
    head: Head
    images: Callable[[str, int], Case]
    unbiased: Callable[[str, int], tuple[Array, Array]]


def head_of(options: Options) -> Head:
    """Return the head of the command."""
    voxel = options.sizes[0] if options.sizes else options.choose(2.0, 6.0)
    if options.files:
        head = head_from_files(options.files[0], options.files[1:], voxel)
    else:
        head = phantom_head(round(190 / voxel))
    print(f"{head.name}: {' x '.join(map(str, head.image.shape))} voxels")
    warm = np.random.default_rng(0).random((16, 16, 16))
    register(warm, warm, spacing=1)  # compiles loops outside of the measured times
    return head


def known_cases(options: Options) -> Iterator[tuple[str, Known]]:
    """Yield the truths, seeds and programs for the head of the command."""
    head = head_of(options)
    images = functools.lru_cache(1)(partial(case, head))

    @functools.lru_cache(1)
    def unbiased(truth: str, seed: int) -> tuple[Array, Array]:
        return tuple(map(without_bias, images(truth, seed)[:2]))

    chosen = programs(options, ("12 mm", "20 mm"), (1.5, 2.0), head.stiffness)
    for truth in TRUTHS:
        for seed in options.seeds or options.choose((2, 3, 4, 5, 6), (2,)):
            for name, program in ({"unmoved": None} | chosen).items():
                own = Known(truth, seed, name, program, head, images, unbiased)
                yield f"{truth}, seed {seed}, {name}", own


def _mean_rows(results: Results) -> Iterator[list[Any]]:
    rows = list(results.values())
    for truth in dict.fromkeys(row["truth"] for row in rows):
        for method in dict.fromkeys(row["method"] for row in rows):
            own = [row for row in rows if (row["truth"], row["method"]) == (truth, method)]
            if not own:
                continue
            seeds = ", ".join(str(row["seed"]) for row in own)
            errors = ", ".join(f"{row['mean']:.2f}" for row in own)
            names = ("mean", "p95", "processor", "folds")
            mean, p95, work, folds = (np.mean([row[name] for row in own]) for name in names)
            cells = f"{mean:.2f}", f"{p95:.2f}", f"{work:.0f}", f"{folds:.0f}"
            yield [truth, method, seeds, errors, *cells]


def _ratio_rows(results: Results) -> Iterator[list[Any]]:
    """Yield the program with the smallest mean error besides `register`, for each truth."""
    rows = list(results.values())
    for truth in dict.fromkeys(row["truth"] for row in rows):
        errors: dict[str, dict[int, float]] = {}
        for row in rows:
            if row["truth"] == truth and row["method"] != "unmoved":
                errors.setdefault(row["method"], {})[row["seed"]] = row["mean"]
        ours = errors.pop(OURS, {})
        others = {name: found for name, found in errors.items() if found.keys() == ours.keys()}
        if others:
            best = min(others, key=lambda name: sum(others[name].values()))
            ratios = [ours[seed] / error for seed, error in others[best].items()]
            seeds = ", ".join(map(str, ours))
            ratio = sum(ours.values()) / sum(others[best].values())
            by_seed = f"{min(ratios):.2f} to {max(ratios):.2f}"
            yield [truth, best, seeds, f"{ratio:.2f}", by_seed]


_MEAN_TITLES = ("truth", "program", "seeds", "mean error by seed (mm)", "mean (mm)")
_MEAN_TITLES += ("95th percentile", "processor time (s)", "folds")
_RATIO_TITLES = ("truth", "program", "seeds", "error of `register` relative to it", "by seed")


@study(
    "registration.known",
    known_cases,
    lambda results: [Table(_MEAN_TITLES, _mean_rows), Table(_RATIO_TITLES, _ratio_rows)],
    page=_PAGE,
)
def known(given: Known) -> dict[str, Any]:
    """Compare the displacements of a head with the true ones, in mm."""
    made = given.images(given.truth, given.seed)
    program, spacing = given.program, given.head.spacing
    if program is None:
        found, work = np.zeros_like(made.displacement), 0.0
    else:
        images = made[:2]
        if program.unbiased:
            images = given.unbiased(given.truth, given.seed)
        found, times = timed(lambda: program.register(*images, spacing))
        work = times.processor
    away = np.linalg.norm(found - made.displacement, axis=-1)[given.head.brain]
    return {
        "truth": given.truth,
        "seed": given.seed,
        "method": given.method,
        "mean": float(away.mean()),
        "p95": float(np.percentile(away, 95)),
        "processor": work,
        "folds": int(count_folds(found, spacing=spacing)),
    }


# Different contrasts.


class Variant(NamedTuple):
    """Kind of a registration of a known deformation of a head, with the seed of the deformation."""

    kind: str
    seed: int
    head: Head


def variants(kinds: Iterable[str], options: Options) -> Iterator[tuple[str, Variant]]:
    """Yield all kinds with all seeds, for the head of the command."""
    head = head_of(options)
    for kind in kinds:
        for seed in options.seeds or options.choose((2, 3, 4, 5, 6), (2,)):
            yield f"{kind}, seed {seed}", Variant(kind, seed, head)


def _contrast_rows(results: Results) -> Iterator[list[Any]]:
    rows = list(results.values())
    equal = {row["seed"]: row["mean"] for row in rows if row["contrast"] == "equal"}
    for contrast in CONTRASTS:
        own = [row for row in rows if row["contrast"] == contrast]
        ratios = [row["mean"] / equal[row["seed"]] for row in own]
        errors = ", ".join(f"{row['mean']:.2f}" for row in own)
        relations = ", ".join(dict.fromkeys(row["relation"] for row in own))
        mean = f"{np.mean(ratios):.2f}", f"{max(ratios):.2f}"
        yield [contrast, relations, ", ".join(str(row["seed"]) for row in own), errors, *mean]


@study(
    "registration.contrasts",
    partial(variants, CONTRASTS),
    ("contrast", "relation", "seeds", "mean error by seed (mm)", "ratio to equal", "largest"),
    rows=_contrast_rows,
    page=_PAGE,
)
def contrasts(given: Variant) -> dict[str, Any]:
    """Compare the displacements of a head with the true ones, for images of other contrasts."""
    made = case(given.head, "splines", given.seed, given.kind)
    found = register(made.fixed, made.moving, spacing=given.head.spacing)
    away = np.linalg.norm(found.displacement - made.displacement, axis=-1)[given.head.brain]
    return {
        "contrast": given.kind,
        "seed": given.seed,
        "relation": found.relation,
        "mean": float(away.mean()),
    }


# Missing tissue.

#: Brightness of a cavity and of a tumour; radius of both in mm; radius of the tissue that becomes a
#: tumour, relative to it; distance in mm over which the tissue around a tumour is pushed away.
_CAVITY, _TUMOUR, _RADII, _GROWN, _REACH = 0.22, 0.95, (12.0, 18.0), 0.8, 12.0


def without_tissue(given: Variant) -> tuple[Case, Array, Array]:
    """Return a case, and the masks of the tissue without counterpart in each image."""
    head, rng = given.head, np.random.default_rng([given.seed, given.kind == "tumour", 7])
    fixed, displacement = TRUTHS["splines"](head, rng)
    inner = np.argwhere(_deeper(head, _RADII[0]))
    offsets = _offsets(head, inner[rng.integers(len(inner))])
    radius = rng.uniform(*_RADII)
    far = np.linalg.norm(offsets * rng.uniform(0.8, 1.25, 3), axis=-1)
    content = np.full(fixed.shape, _CAVITY)
    if given.kind == "tumour":
        inside = _GROWN * radius
        grown = (radius - inside) * np.exp(-np.maximum(far - inside, 0) / _REACH)
        outward = offsets / np.maximum(np.linalg.norm(offsets, axis=-1, keepdims=True), 1e-6)
        push = (grown * np.minimum(far / inside, 1))[..., None] * outward
        displacement = _unfolded(displacement + push, head.spacing)
        radius = inside
        texture = ndimage.gaussian_filter(rng.normal(size=fixed.shape), 2.0)
        content = _TUMOUR + 0.03 * texture / texture.std()
    gone = far <= radius
    hole = ndimage.gaussian_filter(gone.astype(np.float32), 0.7)
    hole = warp(hole, displacement, spacing=head.spacing)
    moving = (1 - hole) * warp(fixed, displacement, spacing=head.spacing) + hole * content
    moving = degraded(rng, moving.astype(np.float32), head.spacing)
    return Case(fixed, moving, displacement), gone, hole > 0.5


def _lacking_rows(results: Results) -> Iterator[list[Any]]:
    rows = list(results.values())
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        yield [
            kind,
            ", ".join(str(row["seed"]) for row in own),
            *(
                ", ".join(f"{row[name]:.2f}" for row in own)
                for name in ("dice", "found", "masks", "all")
            ),
            f"{np.mean([row['found'] / row['masks'] for row in own]):.2f}",
        ]


@study(
    "registration.missing",
    partial(variants, ("resection", "tumour")),
    (
        "tissue", "seeds", "Dice", "error (mm)", "with true masks", "all compared",
        "ratio to true masks",
    ),
    rows=_lacking_rows,
    page=_PAGE,
)  # fmt: skip
def lacking(given: Variant) -> dict[str, Any]:
    """Compare displacements near missing tissue with the true ones, with and without masks."""
    (fixed, moving, truth), gone, hole = without_tissue(given)
    head = given.head
    near = ndimage.distance_transform_edt(~gone, sampling=head.spacing) < _REACH

    def error(displacement: Array) -> float:
        away = np.linalg.norm(displacement - truth, axis=-1)
        return float(away[head.brain & near & ~gone].mean())

    found = register(fixed, moving, spacing=head.spacing)
    masked = register(fixed, moving, spacing=head.spacing, masks=(~gone, ~hole), compare_all=True)
    compared = register(fixed, moving, spacing=head.spacing, compare_all=True)
    missing = np.zeros_like(gone) if found.missing is None else found.missing
    return {
        "kind": given.kind,
        "seed": given.seed,
        "dice": 2 * (missing & gone).sum() / (missing.sum() + gone.sum()),
        "found": error(found.displacement),
        "masks": error(masked.displacement),
        "all": error(compared.displacement),
    }


# Error bars.

#: Number of samples of the error bars.
_SAMPLES = 16


def _interval_cases(options: Options) -> Iterator[tuple[str, Variant]]:
    yield from variants(TRUTHS, options)


def _interval_rows(results: Results) -> Iterator[list[Any]]:
    rows = list(results.values())
    for truth in (*dict.fromkeys(row["truth"] for row in rows), "all"):
        own = [row for row in rows if truth in ("all", row["truth"])]
        shares = (np.mean([row[name] for row in own], axis=0) for name in ("patches", "sites"))
        yield [
            truth,
            ", ".join(dict.fromkeys(str(row["seed"]) for row in own)),
            *(f"{100 * share:.1f}" for both in shares for share in both),
            f"{np.mean([row['sd'] for row in own]):.2f}",
            f"{np.mean([row['error'] for row in own]):.2f}",
            f"{np.mean([row['seconds'] for row in own]):.0f}",
        ]


def _interval_targets(results: Results) -> Iterator[Target]:
    shares = np.mean([row["patches"] for row in results.values()], axis=0)
    for share, wanted in zip(100 * shares, (68, 95), strict=True):
        yield Target(f"points between {wanted} % and the patches found", abs(share - wanted), 5)


@study(
    "registration.intervals",
    _interval_cases,
    (
        "truth", "seeds", "68 % of patches", "95 %", "68 % of sites", "95 %", "mean sd (mm)",
        "root mean square error (mm)", "time (s)",
    ),
    rows=_interval_rows,
    targets=_interval_targets,
    page=_PAGE,
)  # fmt: skip
def intervals_of_errors(given: Variant) -> dict[str, Any]:
    """Compare the errors of patches and of sites with their error bars."""
    head = given.head
    made = case(head, given.kind, given.seed)
    found = register(made.fixed, made.moving, spacing=head.spacing)
    begun = time.perf_counter()
    bars = image_uncertainty(found.problem, found.prior, _SAMPLES)
    seconds = time.perf_counter() - begun
    away = found.displacement - made.displacement
    # A patch has an odd number of voxels along each axis.
    sides = [1 + 2 * int(bars.patch / side / 2) for side in head.spacing]
    mean = np.stack(
        [ndimage.uniform_filter(along, sides) for along in np.moveaxis(away, -1, 0)], -1
    )

    def shares(error: Array) -> list[float]:
        units = np.abs(error / bars.sd)[head.brain]
        return [float((units < limit).mean()) for limit in (1.0, 1.96)]

    return {
        "truth": given.kind,
        "seed": given.seed,
        "patches": shares(mean),
        "sites": shares(away),
        "sd": float(bars.sd[head.brain].mean()),
        "error": float(np.sqrt((mean[head.brain] ** 2).mean())),
        "seconds": seconds,
    }


# Time and memory.


def _size_cases(options: Options) -> Iterator[tuple[str, Variant]]:
    """Yield cases with missing tissue on voxels of each size in mm."""
    for voxel in options.sizes or options.choose((2.0, 1.0), (8.0,)):
        head = head_of(replace(options, sizes=(voxel,)))
        for kind in ("whole", "resection"):
            yield f"{kind}, voxels of {voxel:g} mm", Variant(kind, 2, head)


@study(
    "registration.sizes",
    _size_cases,
    ("tissue", "voxels", "passes", "time (s)", "peak memory (GiB)", "mean error (mm)"),
    page=_PAGE,
)
def sizes(given: Variant) -> list[str]:
    """Measure the time and the memory of registrations with and without missing tissue."""
    head = given.head
    if given.kind == "whole":
        (fixed, moving, truth), counted = case(head, "splines", given.seed), head.brain
    else:
        (fixed, moving, truth), gone, _ = without_tissue(given)
        counted = head.brain & ~gone
    begun = time.perf_counter()
    found, used = with_memory(lambda: register(fixed, moving, spacing=head.spacing))
    seconds = time.perf_counter() - begun
    away = np.linalg.norm(found.displacement - truth, axis=-1)[counted]
    return [
        given.kind,
        " x ".join(map(str, fixed.shape)),
        "1" if found.missing is None else "2",
        f"{seconds:.1f}",
        f"{1e6 * used / 2**30:.2f}",
        f"{away.mean():.2f}",
    ]


# Landmarks of two pictures.


class Pair(NamedTuple):
    """Affine map of `register`, landmarks of two pictures, and a program that runs after it."""

    matrix: Array
    at: Array
    to: Array
    run: Callable[[], Array]


def pair_cases(options: Options) -> Iterator[tuple[str, Pair]]:
    """Yield the affine map and the programs for two pictures."""
    from validation.studies.landmarks import grey, landmarks

    if len(options.files) not in (2, 4):
        print("Two pictures are required: --files FIXED MOVING [FIXED.csv MOVING.csv]")
        return
    fixed, moving = map(grey, options.files[:2])
    if len(options.files) == 2:
        at, to = landmarks(fixed, moving)
    else:
        both = [
            np.loadtxt(each, delimiter=",", skiprows=1)[:, [2, 1]] for each in options.files[2:]
        ]
        at, to = (each[: min(map(len, both))] for each in both)
    ours = register(fixed, moving, spacing=1, initial="affine")
    turn, shift = ours.matrix[:2, :2], ours.matrix[:2, 2]
    aligned = ndimage.affine_transform(moving, turn, shift, fixed.shape, order=3, mode="nearest")
    print(f"{options.files[0].name}, {options.files[1].name}: {len(at)} landmarks")
    runs: dict[str, Callable[[], Array]] = {
        "affine map": lambda: np.zeros_like(ours.displacement),
        OURS: lambda: register(fixed, moving, spacing=1, initial="affine").displacement,
    }
    for name, program in programs(options, ("40 px", "80 px"), (1.5, 3.0)).items():
        if name != OURS:
            runs[name] = partial(program.register, fixed, aligned, (1.0, 1.0))
    for name, run in runs.items():
        yield name, Pair(ours.matrix, at, to, run)


def _rms(values: Array, axis: int | None = None) -> Array:
    return np.sqrt((values**2).mean(axis=axis))


def _with_interval(value: float, low: float, high: float, form: str) -> str:
    return f"{value:{form}} ({low:{form}} to {high:{form}})"


def _pair_tables(results: Results) -> Iterator[Table]:
    rows = []
    for name, (away, seconds, folds) in results.items():
        cells = (
            _with_interval(statistic(away), *intervals(away, statistic), ".2f")
            for statistic in (np.median, _rms)
        )
        rows.append([name, *cells, f"{seconds:.1f}", folds])
    yield Table(("method", "median (px)", "rms (px)", "time (s)", "folds"), lambda _: rows)
    if OURS not in results:
        return
    ours, differences = results[OURS][0], []
    for name, (away, *_) in results.items():
        if name != OURS:
            both, cells = np.stack([ours, away], axis=-1), []
            drawn = np.random.default_rng(0).integers(len(ours), size=(2000, len(ours)))
            for statistic in (np.median, _rms):
                value = np.diff(statistic(both[:, ::-1], axis=0))[0]
                found = np.diff(statistic(both[drawn][..., ::-1], axis=1), axis=-1)
                cells.append(_with_interval(value, *np.percentile(found, (2.5, 97.5)), "+.2f"))
            differences.append([name, *cells])
    yield Table(("`register` minus", "median (px)", "rms (px)"), lambda _: differences)


@study("registration.pairs", pair_cases, _pair_tables, page=_PAGE)
def pairs(case: Pair) -> tuple[Array, float, int]:
    """Compare predicted landmarks of two pictures with the true ones, in pixels."""
    field, times = timed(case.run)
    moved = case.at + np.stack(
        [ndimage.map_coordinates(field[..., axis], case.at.T, order=1) for axis in range(2)], axis=1
    )
    moved = moved @ case.matrix[:2, :2].T + case.matrix[:2, 2]
    away = np.linalg.norm(moved - case.to, axis=1)
    return away, times.wall, int(count_folds(field, spacing=1))


# Rigid bone and missing tissue.

#: Sites along an axis; radius of the bone, and radius at which the motion ends.
_SIZE, _BONE, _END = 64, 14, 28
#: Rotation of the bone in degrees, and its shift in voxels.
_ANGLE, _SHIFT = 8, 1.5
#: Centre, relative to that of the bone, and radius of the artefact.
_CENTRE, _NEAR = (0, 0, 20), 7


class Turned(NamedTuple):
    """Volume in which a ball of bone is turned, with its displacement and distances from it."""

    before: Array
    after: Array
    truth: Array
    place: Array
    away: Array


def turned_bone() -> Turned:
    """Return two images of a ball of bone that is turned within soft tissue."""
    place = np.moveaxis(np.indices((_SIZE,) * 3), 0, -1) - (_SIZE - 1) / 2
    away = np.linalg.norm(place, axis=-1)
    part = np.clip((_END - away) / (_END - _BONE), 0, 1)
    angle = np.radians(_ANGLE) * part
    cosine, sine = np.cos(angle), np.sin(angle)
    z, y, x = np.moveaxis(place, -1, 0)
    turned = np.stack([z + _SHIFT * part, cosine * y - sine * x, sine * y + cosine * x], axis=-1)
    truth, bone = turned - place, away < _BONE
    rng = np.random.default_rng(0)
    before = ndimage.gaussian_filter(rng.normal(size=bone.shape), 1.8)
    before = (before - before.min()) / np.ptp(before)
    after = 0.7 * warp(before, truth, spacing=1) + 0.1 + rng.normal(scale=0.01, size=bone.shape)
    return Turned(before, after, truth, place, away)


def _error(found: Array, given: Turned, where: Array) -> str:
    return f"{np.linalg.norm(found - given.truth, axis=-1)[where].mean():.3f}"


@study(
    "registration.bone",
    {"unknown": ("unknown", 1.0), "rigid": ("rigid", np.inf)},
    ("bone", "largest strain in it", "mean error in it (voxels)", "in soft tissue around it"),
    page=_PAGE,
)
def bone(case: tuple[str, float]) -> list[str]:
    """Compare the motion of bone, unknown or rigid, with the true one."""
    (name, inside), given = case, turned_bone()
    m = None if name == "unknown" else np.where(given.away < _BONE, inside, 1.0)
    found = register(given.before, given.after, spacing=1, stiffness=m).displacement
    strain = np.abs(green_lagrange_strain(found, spacing=1))[given.away < _BONE - 1].max()
    soft = (given.away > _BONE + 1) & (given.away < _END - 2)
    errors = (_error(found, given, where) for where in (given.away < _BONE, soft))
    return [name, f"{strain:.1e}", *errors]


@study(
    "registration.artefact",
    {name: name for name in ("none", "compared", "masked")},
    ("artefact in the first image", "mean error within 5 voxels around it"),
    page=_PAGE,
)
def artefact(name: str) -> list[str]:
    """Compare the motion around a bright artefact with the true one."""
    given = turned_bone()
    inside = np.linalg.norm(given.place - _CENTRE, axis=-1) < _NEAR
    damaged = np.where(inside, given.before.max(), given.before)
    image = given.before if name == "none" else damaged
    masks = ~inside if name == "masked" else None
    found = register(image, given.after, spacing=1, masks=masks).displacement
    around = ndimage.binary_dilation(inside, iterations=5) & ~inside
    return [name, _error(found, given, around)]


# Rigid alignment.

#: Largest angle in degrees, and largest shift relative to the longest axis.
_FARTHEST_TURN, _FARTHEST_SHIFT = 180.0, 0.3
#: Mean error, relative to the diagonal, below which an alignment is found.
_FOUND = 0.02
#: Required part of alignments that are found, by number of axes.
_REQUIRED = {2: 0.95, 3: 0.9}
#: Size of a voxel in mm, and number of points along each axis at which errors are measured.
_VOXEL, _POINTS = 4.0, 9


class Aligned(NamedTuple):
    """Pairs of images of one kind.

    Attributes
    ----------
    name : str
    image : ndarray, shape (H, W) or (D, H, W)
    others : list of ndarray
        Images with other content, if the pairs have nothing in common.
    inverted : bool
        True if the second image has inverted contrast.
    numbers : range
        Numbers of the pairs, which are the seeds.
    """

    name: str
    image: Array
    others: list[Array]
    inverted: bool
    numbers: range


def aligned_cases(options: Options) -> Iterator[tuple[str, Aligned]]:
    """Yield the images with the same and with inverted contrast, and pairs without common tissue.

    There are a fifth as many pairs of the latter two.
    """
    from validation.studies.landmarks import grey

    images: dict[str, Array] = {}
    voxel = options.sizes[0] if options.sizes else options.choose(_VOXEL, 7.9)
    for file in options.files:
        if file.name.endswith((".nii.gz", ".nii", ".nrrd", ".mha")):
            pixels = read_image(file).pixels.astype(np.float32)
            images[f"{file.name}, slice"] = pixels[len(pixels) // 2] / pixels.max()
            images[f"{file.name}, {voxel:g} mm"] = head_from_files(file, [], voxel).image
        else:
            images[file.name] = grey(file).astype(np.float32)
    if not images:
        images["phantom"] = phantom("mass-effect", options.choose(256, 64)).image.astype(np.float32)
        images[f"head, {voxel:g} mm"] = phantom_head(round(190 / voxel)).image.astype(np.float32)
    count = options.count or options.choose(50, 2)
    few = range(options.first, options.first + max(1, count // 5))
    for name, image in images.items():
        others = [
            other for key, other in images.items() if key != name and other.ndim == image.ndim
        ]
        yield name, Aligned(name, image, [], False, range(options.first, options.first + count))
        yield f"{name}, inverted", Aligned(f"{name}, inverted", image, [], True, few)
        if others:
            yield f"{name}, other image", Aligned(f"{name}, other image", image, others, False, few)


def turned_image(
    rng: np.random.Generator, image: Array, *, inverted: bool = False
) -> tuple[Array, Array]:
    """Return an image that is turned about its centre and shifted, and the matrix of its motion.

    The second image has another gamma, a smooth bias and noise; content from outside of the image
    is black.

    Parameters
    ----------
    rng : Generator
    image : ndarray, shape (H, W) or (D, H, W)
    inverted : bool
        True to invert the contrast.

    Returns
    -------
    tuple of ndarray
        Image, and homogeneous matrix, shape (n + 1, n + 1), in pixels.
    """
    axes, shape = image.ndim, np.array(image.shape)
    matrix = np.eye(axes + 1)
    angle = math.radians(rng.uniform(0, _FARTHEST_TURN))
    if axes == 2:
        angle *= rng.choice((-1, 1))
        cosine, sine = math.cos(angle), math.sin(angle)
        turn = np.array([[cosine, -sine], [sine, cosine]])
    else:
        direction = rng.normal(size=3)
        turn = Rotation.from_rotvec(angle * direction / np.linalg.norm(direction)).as_matrix()
    direction = rng.normal(size=axes)
    length = rng.uniform(0, _FARTHEST_SHIFT) * shape.max()
    centre = (shape - 1) / 2
    matrix[:axes, :axes] = turn
    matrix[:axes, axes] = centre - turn @ centre + length * direction / np.linalg.norm(direction)
    back = np.linalg.inv(matrix)
    moved = ndimage.affine_transform(image, back[:axes, :axes], back[:axes, axes], order=1)
    spacing = (200.0 / max(image.shape),) * axes  # a bias as smooth as in a head of 200 mm
    changed = degraded(rng, moved, spacing)
    return (1 - changed if inverted else changed), matrix


def _away(found: Array, truth: Array, shape: tuple[int, ...]) -> float:
    """Return the mean error of points that stay inside the image, relative to the diagonal."""
    ends = [np.linspace(0, n - 1, _POINTS) for n in shape]
    points = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, len(shape))
    there, here = (points @ each[:-1, :-1].T + each[:-1, -1] for each in (truth, found))
    inside = ((there >= 0) & (there <= np.array(shape) - 1)).all(axis=1)
    away = np.linalg.norm(there - here, axis=1)[inside]
    return float(away.mean() / np.linalg.norm(shape))


def _alignment_targets(results: Results) -> Iterator[Target]:
    rows = [row for row in results.values() if row["found"] is not None]
    for axes, required in _REQUIRED.items():
        own = [row for row in rows if row["axes"] == axes]
        if own:
            part = sum(row["found"] for row in own) / sum(row["pairs"] for row in own)
            yield Target(f"part of the turns found in {axes}-D", part, required, at_least=True)
    worse = sum(row["worse"] for row in results.values())
    yield Target("alignments accepted although worse", worse, 0)


def _alignment_rows(results: Results) -> Iterator[list[Any]]:
    for row in results.values():
        found, median = row["found"], row["median"]
        cells = ("-", "-") if found is None else (found, f"{100 * median:.2f}")
        yield [row["name"], row["pairs"], *cells, row["refused"], row["worse"], f"{row['s']:.1f}"]


_ALIGNMENT_TITLES = ("image", "pairs", "found", "median error (% of the diagonal)", "refused")
_ALIGNMENT_TITLES += ("accepted although worse", "processor time (s)")


@study(
    "registration.alignment",
    aligned_cases,
    _ALIGNMENT_TITLES,
    rows=_alignment_rows,
    targets=_alignment_targets,
    page=_PAGE,
)
def alignment(given: Aligned) -> dict[str, Any]:
    """Align images that are turned and shifted, with the same, inverted or another content."""
    image, axes = given.image, given.image.ndim
    still, errors, refused, worse, work = np.eye(axes + 1), [], 0, 0, 0.0
    for number in given.numbers:
        rng = np.random.default_rng([number, axes])
        source = given.others[number % len(given.others)] if given.others else image
        after, truth = turned_image(rng, source, inverted=given.inverted)
        masks = np.ones(image.shape, bool), np.ones(after.shape, bool)
        sizes = (1.0,) * axes
        options: dict[str, Any] = {"spacing": sizes, "moving_spacing": sizes, "masks": masks}
        found, times = timed(partial(align, "rigid", image, after, **options))
        work += times.processor
        refused += bool(found.notes)
        if given.others:
            worse += not np.array_equal(found.matrix, still)
            continue
        errors.append(_away(found.matrix, truth, image.shape))
        worse += errors[-1] > _away(still, truth, image.shape)
    return {
        "name": given.name,
        "axes": axes,
        "pairs": len(given.numbers),
        "found": None if given.others else sum(error < _FOUND for error in errors),
        "median": float(np.median(errors)) if errors else None,
        "refused": refused,
        "worse": worse,
        "s": work / len(given.numbers),
    }


# Figure 4c of the paper.


def splines(
    image: npt.NDArray[Any], moved: npt.NDArray[Any], spline: int
) -> npt.NDArray[np.float64]:
    """Find the position of each pixel of `image` in `moved`, by B-splines `spline` pixels apart.

    The original image is fixed and the deformed image is moving, so the transform maps X to
    X + d(X), the material displacement of the other fields. The registration uses mean squares,
    three resolutions and L-BFGS.

    Returns
    -------
    ndarray, shape (H, W, 2)
        Displacement in (row, col) order, in pixels.
    """
    import SimpleITK as sitk

    fixed, moving = as_itk(image, moved)
    mesh = [max(1, round(size / spline / 4)) for size in fixed.GetSize()]
    transform = sitk.BSplineTransformInitializer(fixed, mesh, 3)
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMeanSquares()
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsLBFGS2(numberOfIterations=50)
    method.SetShrinkFactorsPerLevel([4, 2, 1])
    method.SetSmoothingSigmasPerLevel([2, 1, 0])
    # The density of control points increases with the image resolution.
    method.SetInitialTransformAsBSpline(transform, inPlace=True, scaleFactors=[1, 2, 4])
    method.Execute(fixed, moving)
    found = sitk.TransformToDisplacementField(transform, sitk.sitkVectorFloat64, fixed.GetSize())
    return displacement_of(found)


class Explained(NamedTuple):
    """Phantom with the field of finite elements, that of the registration, and their times."""

    problem: Problem
    truth: Array
    registered: Array
    elastic: Array
    seconds: tuple[float, float]


def _figure_rows(results: Results) -> Iterator[list[str]]:
    for name, found in results.items():
        tissue = found.problem.tissue
        free = tissue & (found.problem.confidence == 0).all(axis=-1)
        registration, elastic = found.seconds
        for title, field, seconds in (
            ("registration, control points 20 px apart", found.registered, f"{registration:.1f} s"),
            ("elastic prior", found.elastic, f"{elastic:.3f} s"),
        ):
            cells = (f"{rmsd(field, found.truth, where):.3f} px" for where in (tissue, free))
            yield [name, title, *cells, seconds]


def _draw_figure(results: Results, folder: Path) -> None:
    for name, found in results.items():
        tissue, figure = found.problem.tissue, new_figure(17, 4.4)
        first, second, *rest = figure.subplots(1, 5)
        for axes, title, field in (
            (first, "finite elements", found.truth),
            (second, "registration, 20 px apart", found.registered),
        ):
            draw_grid(axes, field, tissue)
            axes.set_title(title)
        shown = draw_differences(rest, found.registered, found.truth, tissue)
        figure.colorbar(shown, ax=rest, label="registration - finite elements, px")
        for axes, what in zip(rest, ("magnitude", "x (col)", "y (row)"), strict=True):
            axes.set_title(what)
        save(figure, folder, f"{name}-registration")


_FIGURE_TITLES = ("phantom", "field", "RMSD in the body", "away from the boundary", "time")


@study(
    "registration.figure-4c",
    lambda options: {
        name: (name, options.sizes_or((300,), (48,))[0]) for name in ("expansion", "mass-effect")
    },
    _FIGURE_TITLES,
    rows=_figure_rows,
    draw=_draw_figure,
    on_request=True,
)
def figure_4c(case: tuple[str, int]) -> Explained:
    """Compare a registration of grey values with the motion that deformed the image."""
    example = phantom(*case)
    problem, prior = example.problem, ElasticPrior(0.3)
    truth = direct_solution(problem, prior)
    moved = warp(example.image, truth, spacing=1, tissue=problem.tissue)
    registered, times = timed(lambda: splines(example.image, moved, 20))
    run, took = timed(lambda: solve(problem, prior, optimizer=Multigrid(0.01), backend="cpu"))
    elastic = run.displacement.astype(np.float64)
    return Explained(problem, truth, registered, elastic, (times.wall, took.wall))

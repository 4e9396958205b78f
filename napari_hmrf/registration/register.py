"""Registration of two images: checks of the input, alignment and matching."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import is_one_of, refuse_unless, require_kind
from napari_hmrf.checks import Positive, convert
from napari_hmrf.errors import NoteWarning, ProblemError
from napari_hmrf.field.brightness import luminance
from napari_hmrf.field.warp import Spacing
from napari_hmrf.real_arrays import as_mask, as_numbers, checked_spacing
from napari_hmrf.registration.alignment import align, matrix_in_pixels
from napari_hmrf.registration.image_data import BoolArray, FloatArray, Images, Relation
from napari_hmrf.registration.matching import (
    SIMILARITIES,
    Match,
    Show,
    Step,
    interpolated,
    match,
    placeholder,
    schedule,
    without_placeholder,
)
from napari_hmrf.registration.missing_tissue import around_missing, missing_tissue
from napari_hmrf.registration.result import Registration
from napari_hmrf.solver.optimizers import Monitor
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, as_stiffness
from napari_hmrf.solver.solve import CancelFlag, Progress, stop_if_cancelled
from napari_hmrf.solver.uncertain_landmarks import Landmarks, typical_stiffness
from napari_hmrf.solver.volume_memory import REGISTRATION, require_memory

Float64Array = npt.NDArray[np.float64]

#: Number of sites from which the standard deviation is computed.
_SITES = 50_000
#: Stiffness with which the tissue around a site holds it, relative to its Young's modulus.
_COUPLING = 6.0
#: Factor of the variance, by number of axes, chosen on the same deformations as other settings.
_NOISE = {2: 0.1, 3: 0.19}
#: Part of the work on all levels but the finest.
_ROUGH = 0.2


def register(
    fixed: npt.ArrayLike,
    moving: npt.ArrayLike,
    *,
    spacing: Spacing,
    moving_spacing: Spacing | None = None,
    stiffness: npt.ArrayLike | None = None,
    masks: npt.ArrayLike | tuple[npt.ArrayLike | None, npt.ArrayLike | None] | None = None,
    landmarks: Landmarks | None = None,
    initial: str | npt.ArrayLike | Registration | None = None,
    smoothness: float = 1.0,
    similarity: str = "auto",
    compare_all: bool = False,
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Registration:
    """Find the displacement of elastic tissue between two images.

    The tissue of the fixed image moves until the moved image looks like the moving image. The
    brightness of both images is normalized locally, so that a different brightness, contrast, or
    bias does not matter. The images may have different contrasts (`similarity`). Tissue that exists
    in one image only is found, and the images are registered again without it. Nothing folds.

    Parameters
    ----------
    fixed, moving : array_like, shape (H, W) or (D, H, W)
        Images of the same tissue; colour images have 3 or 4 channels in addition. Pixels that are
        NaN do not count. The displacement is defined on the grid of `fixed`.
    spacing : float or sequence of float
        Size of a pixel of `fixed` along each axis.
    moving_spacing : float or sequence of float, optional
        Size of a pixel of `moving`; by default `spacing`. The first pixels of both images are at
        the same position.
    stiffness : array_like, shape (H, W) or (D, H, W), optional
        Young's modulus of the tissue of `fixed`, as in a `Problem`: 0 is void, which does not move,
        and ``inf`` is rigid tissue, which turns and shifts as a whole. Only ratios matter. By
        default, all pixels are tissue of the same stiffness.
    masks : array_like of bool, or tuple of two arrays, optional
        Pixels of `fixed` that count, or of `fixed` and `moving`; None for all pixels.
    landmarks : Landmarks, optional
        Points of `fixed` with their positions in `moving` after the alignment, as in a `Problem`.
    initial : {"rigid", "affine"}, array_like or Registration, optional
        Alignment of the images before the tissue deforms: computed, for turns by any angle, or a
        homogeneous matrix, shape (n + 1, n + 1), from positions in `fixed` to positions in
        `moving`, in the unit of the spacing. A computed alignment that does not make the images
        clearly more similar is left out, with a `NoteWarning` and a note of the solution. A
        registration of the same images continues from its alignment and its displacement. By
        default, the images are not aligned.
    smoothness : float
        Weight of the elastic energy, relative to the usual weight. A larger weight leads to smaller
        strains.
    similarity : {"auto", "same", "inverse", "other"}
        Relation of the brightness of both images: bright tissue is bright in both, or dark in one
        of them; or the brightness of one image is another function of that of the other, as in two
        sequences of an MRI. By default, the relation with the largest correlation on pixels of low
        resolution; `Registration.relation` contains it.
    compare_all : bool
        True to compare all pixels that count, also of tissue that exists in one image only, such as
        a tumour before an operation. By default, such tissue is found (`Registration.missing`), and
        has no effect.
    progress, cancel
        As in `solve`.

    Returns
    -------
    Registration

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    ArgumentError
        If an argument has the wrong type.
    HmrfError
        If an alignment requires SimpleITK, which is not installed.
    Cancelled
        If `cancel` was set before the work was done.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy import ndimage
    >>> from napari_hmrf import warp
    >>> from napari_hmrf.registration import register
    >>> before = ndimage.gaussian_filter(np.random.default_rng(0).random((64, 64)), 2)
    >>> shift = np.zeros((64, 64, 2))
    >>> shift[..., 1] = 3
    >>> after = warp(before, shift, spacing=1)
    >>> found = register(before, after, spacing=1)
    >>> np.round(found.displacement[32, 32]).tolist()
    [0.0, 3.0]
    """
    if np.shape(fixed)[-1:] not in ((3,), (4,)):  # no colours
        require_memory(np.shape(fixed), REGISTRATION, "fixed")
    first, second = _as_grey("fixed", fixed), _as_grey("moving", moving)
    axes = first.ndim
    if second.ndim != axes:
        raise ProblemError(
            "moving",
            f"has {second.ndim} axes, but fixed has {axes}. Pass two images or two volumes.",
        )
    sizes = checked_spacing(spacing, axes)
    own_sizes = sizes if moving_spacing is None else checked_spacing(moving_spacing, axes)
    smoothness = convert(Positive, smoothness, "smoothness")
    words = ", ".join(f'"{each}"' for each in SIMILARITIES)
    refuse_unless(is_one_of(similarity, SIMILARITIES), "similarity", similarity, words)
    if landmarks is not None:
        require_kind(Landmarks, "landmarks", landmarks, "Landmarks(points, targets, sd=1)")
    m = np.ones(first.shape, np.float32) if stiffness is None else as_stiffness(stiffness)
    if m.shape != first.shape:
        raise ProblemError(
            "stiffness",
            f"has shape {m.shape}, but fixed has shape {first.shape}. Pass the stiffness of each "
            "pixel of fixed.",
        )
    counted = _counted(masks, first, second)
    first, second = (np.where(np.isfinite(each), each, 0) for each in (first, second))
    matrix, start, notes = _initial(initial, first, second, sizes, own_sizes, counted)
    for note in notes:
        warnings.warn(note, NoteWarning, stacklevel=2)
    images = on_grid(first, second, counted, sizes, own_sizes, matrix)
    check_contrast(images)
    unit = typical_stiffness(m)
    problem = Problem(
        observed=np.zeros((*m.shape, axes), np.float32),
        confidence=np.zeros((*m.shape, axes), np.float32),
        stiffness=m,
        spacing=sizes,
        precision=placeholder(m > 0, unit),
        landmarks=landmarks,
    )
    problem = without_placeholder(problem, unit)
    return registered(
        problem,
        ElasticPrior(0.0),
        images,
        unit=unit,
        matrix=matrix,
        moving_spacing=own_sizes,
        smoothness=smoothness,
        similarity=similarity,
        compare_all=compare_all,
        start=start,
        notes=notes,
        progress=progress,
        cancel=cancel,
    )


def registered(
    problem: Problem,
    prior: ElasticPrior,
    images: Images,
    *,
    unit: float,
    matrix: Float64Array,
    moving_spacing: tuple[float, ...],
    smoothness: float = 1.0,
    similarity: str = "auto",
    compare_all: bool = False,
    missing: BoolArray | None = None,
    start: npt.NDArray[np.floating] | None = None,
    notes: tuple[str, ...] = (),
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
    show: Show | None = None,
) -> Registration:
    """Match the images on the grid of a problem, and return the registration.

    Tissue that exists in one image only is found, and the images are matched again without it,
    unless `compare_all` is True. If a mask of such tissue is given, it is not searched.

    Parameters
    ----------
    problem, prior, images, unit, smoothness, start, progress, cancel, show
        As in `match`.
    similarity, compare_all
        As in `register`.
    matrix, moving_spacing
        As in a `Registration`.
    missing : ndarray of bool, shape (H, W) or (D, H, W), optional
        Mask of the tissue of the fixed image without counterpart.
    notes : tuple of str
        Notes on the alignment, which the solution receives.
    """
    fixed, moving = images.counted
    first = images if missing is None else images._replace(counted=(fixed & ~missing, moving))
    checkpoint = partial(stop_if_cancelled, cancel)
    searches = missing is None and not compare_all
    once = compare_all and missing is None

    def matched(
        compared: Images,
        relations: Sequence[Relation],
        part: tuple[float, float],
        note: str = "",
        begin: npt.NDArray[np.floating] | None = start,
        finest: bool = True,
    ) -> Match:
        return match(
            problem,
            prior,
            compared,
            unit=unit,
            smoothness=smoothness,
            relations=relations,
            start=begin,
            finest=finest,
            progress=_part(progress, part, note),
            cancel=cancel,
            show=show,
        )

    def missing_in(motion: npt.NDArray[np.floating], relation: Relation) -> BoolArray:
        return missing_tissue(images, motion, problem.spacing, relation, checkpoint)

    region, begin, relations = missing, start, SIMILARITIES[similarity]
    found: Match | None = None
    steps: tuple[Step, ...] = ()
    done = 0.0
    try:
        # Most of the time is spent on the finest level, so missing tissue is searched before it.
        if searches and start is None and len(schedule(problem.shape)) > 1:
            found, done = matched(first, relations, (0.0, _ROUGH), finest=False), _ROUGH
            relations, steps, coarse = (found.relation,), found.history, found.solution
            begin = interpolated(coarse.displacement, coarse.tissue, problem.shape, checkpoint)
            motion, region = begin, missing_in(begin, found.relation)
        if missing is not None or region is None or not region.any():
            part, done = (done, 1.0 if once else 0.6), 0.6
            found = matched(first, relations, part, begin=begin)
            found = found._replace(history=(*steps, *found.history))
            motion, relations = found.solution.displacement, (found.relation,)
            if searches:
                region = missing_in(motion, found.relation)
        if region is not None and region.any():
            around = around_missing(region, motion, problem.spacing)
            again = images._replace(counted=(fixed & ~around.fixed, moving & ~around.moving))
            del around
            found = None  # frees memory
            found = matched(again, relations, (done, 1.0), "without missing tissue: ")
            # Where tissue no longer follows a wrong structure, its edge is found more exactly.
            nearer = missing_in(found.solution.displacement, found.relation) if searches else region
            region = nearer if nearer.any() else region
    except ProblemError as error:
        if error.field == "confidence":  # no pixel counts on a level
            raise _nothing_in_common("fixed") from None
        if error.field != "precision":
            raise
        raise ProblemError(
            "smoothness",
            f"is {smoothness:g}, so small that tissue has no stiffness beside the images. Pass a "
            "larger number; 1 is usual.",
        ) from None
    assert found is not None
    return Registration(
        solution=replace(found.solution, notes=(*found.solution.notes, *notes)),
        matrix=matrix,
        moving_spacing=moving_spacing,
        observed=found.images.observed,
        landmarks=problem.landmarks,
        precision=found.images.precision,
        residual=found.residual,
        similarity_before=found.similarity_before,
        similarity=found.similarity,
        sd=_standard_deviation(found),
        history=found.history,
        prior=prior,
        relation=found.relation,
        missing=region if region is not None and region.any() else None,
    )


def _part(progress: Progress | None, bounds: tuple[float, float], note: str) -> Progress | None:
    """Return a function that reports the progress of a part of the work, with a note before it."""
    if progress is None:
        return None
    first, last = bounds

    def report(monitor: Monitor) -> None:
        fraction = first + (last - first) * monitor.fraction
        progress(Monitor(note + monitor.message, fraction))

    return report


def on_grid(
    fixed: FloatArray,
    moving: FloatArray,
    counted: tuple[BoolArray, BoolArray],
    spacing: tuple[float, ...],
    moving_spacing: tuple[float, ...],
    matrix: Float64Array,
) -> Images:
    """Return both images on the grid of the fixed image, after an alignment.

    Parameters
    ----------
    fixed, moving : ndarray, shape (H, W) or (D, H, W)
    counted : tuple of ndarray of bool
        Masks of the pixels of `fixed` and `moving` that count.
    spacing, moving_spacing : tuple of float
    matrix : ndarray, shape (n + 1, n + 1)
        As in a `Registration`.
    """
    axes = fixed.ndim
    pixels = matrix_in_pixels(matrix, spacing, moving_spacing)
    turn, shift = pixels[:axes, :axes], pixels[:axes, axes]
    same = np.array_equal(turn, np.eye(axes)) and not shift.any()
    if same and moving.shape == fixed.shape:
        return Images(fixed, moving, counted)

    def aligned(image: npt.NDArray[Any], order: int, mode: str) -> npt.NDArray[np.float32]:
        out = np.empty(fixed.shape, np.float32)
        scipy.ndimage.affine_transform(
            image.astype(np.float32), turn, shift, output=out, order=order, mode=mode
        )
        return out

    # Cubic interpolation blurs the image less, but must not reach beyond pixels that count. With
    # these modes, pixels that rounding moves beyond the edge are those at the edge.
    known = aligned(counted[1], 1, "grid-constant") > 0.999
    return Images(fixed, aligned(moving, 3, "mirror"), (counted[0], known))


def _standard_deviation(found: Match) -> float:
    """Return the standard deviation of the displacement, from the residual and the precision.

    The covariance at a site is about the inverse of the precision of the images and of the tissue
    around the site, times the variance of the normalized brightness. The precision of the images
    was multiplied by the size of a pixel and divided by their weight, which the variance undoes.
    """
    precision = found.images.precision
    axes, spacing = precision.shape[-1], found.solution.spacing
    step = max(1, int((math.prod(precision.shape[:-2]) / _SITES) ** (1 / axes)))
    some = precision[(slice(None, None, step),) * axes]
    seen = some[some.any(axis=(-2, -1))].astype(np.float64)
    if not len(seen):
        return math.inf
    coupling = _COUPLING * math.prod(spacing) ** (1 - 2 / axes)
    covariance = np.linalg.inv(seen + coupling * np.eye(axes))
    variance = _NOISE[axes] * found.residual**2 * math.prod(spacing) / found.images.weight
    return math.sqrt(variance * float(np.trace(covariance, axis1=1, axis2=2).mean()) / axes)


def _initial(
    initial: str | npt.ArrayLike | Registration | None,
    fixed: FloatArray,
    moving: FloatArray,
    spacing: tuple[float, ...],
    moving_spacing: tuple[float, ...],
    counted: tuple[BoolArray, BoolArray],
) -> tuple[Float64Array, npt.NDArray[np.floating] | None, tuple[str, ...]]:
    """Return the alignment, the initial displacement or None, and notes on the alignment."""
    axes = fixed.ndim
    if initial is None:
        return np.eye(axes + 1), None, ()
    if isinstance(initial, Registration):
        if initial.displacement.shape[:-1] != fixed.shape:
            raise ProblemError(
                "initial",
                f"is a registration of images of shape {initial.displacement.shape[:-1]}, but "
                f"fixed has shape {fixed.shape}. Pass a registration of the same images.",
            )
        return initial.matrix, initial.displacement, ()
    if isinstance(initial, str):
        known = is_one_of(initial, ("rigid", "affine"))
        refuse_unless(known, "initial", initial, '"rigid", "affine" or a matrix')
        kind: Any = initial
        found = align(
            kind,
            fixed,
            moving,
            spacing=spacing,
            moving_spacing=moving_spacing,
            masks=counted,
        )
        return found.matrix, None, found.notes
    matrix = np.array(as_numbers("initial", initial), dtype=np.float64)
    valid = matrix.shape == (axes + 1, axes + 1) and np.isfinite(matrix).all()
    if not valid or abs(np.linalg.det(matrix)) < 1e-9:
        raise ProblemError(
            "initial",
            f"has shape {matrix.shape} or is not invertible. Pass a homogeneous matrix of shape "
            f"{(axes + 1, axes + 1)} from positions in fixed to positions in moving.",
        )
    return matrix, None, ()


def _as_grey(name: str, image: npt.ArrayLike) -> FloatArray:
    pixels = as_numbers(name, image)
    if pixels.ndim in (3, 4) and pixels.shape[-1] in (3, 4) and min(pixels.shape[:-1]) > 4:
        pixels = luminance(pixels)
    if pixels.ndim not in (2, 3) or min(pixels.shape) < 2:
        raise ProblemError(
            name,
            f"has shape {pixels.shape}. Pass an image (H, W) or a volume (D, H, W) with at least "
            "two pixels along each axis.",
        )
    return pixels.astype(np.float32)


def _counted(masks: Any, fixed: FloatArray, moving: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return the masks of the pixels that count, with the shapes of the images."""
    both = masks if isinstance(masks, tuple) and len(masks) == 2 else (masks, None)
    counted = []
    for name, mask, image in zip(("fixed", "moving"), both, (fixed, moving), strict=True):
        known = np.isfinite(image)
        if mask is not None:
            given = as_mask("masks", mask)
            if given.shape != image.shape:
                raise ProblemError(
                    "masks",
                    f"has shape {given.shape} for {name}, which has shape {image.shape}. Pass a "
                    "mask with one value for each pixel.",
                )
            known &= given
        if not known.any():
            raise ProblemError(
                "masks", f"exclude all pixels of {name}. Pass masks that are True somewhere."
            )
        counted.append(known)
    return counted[0], counted[1]


def _nothing_in_common(name: str) -> ProblemError:
    return ProblemError(
        name,
        "and the other image have no pixels in common, or too few, after the alignment. Check the "
        "positions of both images, the alignment and the masks.",
    )


def check_contrast(images: Images) -> None:
    """Raise an error for an image without structure, which cannot be registered."""
    pairs = zip(("fixed", "moving"), (images.fixed, images.moving), images.counted, strict=True)
    for name, image, mask in pairs:
        if not mask.any():
            raise _nothing_in_common(name)
        if np.ptp(image[mask]) == 0:
            raise ProblemError(
                name, "has the same brightness everywhere. Choose an image that shows structure."
            )

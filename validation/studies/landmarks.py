"""Prediction of motion from landmarks: known random motion, and sections of real tissue.

`landmarks`: smooth random displacements of an ellipse and an ellipsoid are observed at random
points with noise of 0.5 pixels; each method estimates the displacement of all tissue. `sections`:
features of two pictures (``--files FIXED MOVING``) are matched. Each is predicted from the others,
with forces or strains that are chosen without it, and from the pictures. No pictures are part of
this project; any two sections are suitable. ``--every 3`` predicts each third landmark, and
``--out`` draws the sections.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from skimage.color import rgb2gray
from skimage.feature import SIFT, match_descriptors
from skimage.io import imread
from skimage.measure import ransac
from skimage.transform import AffineTransform
from skimage.transform import warp as sampled

from benchmarks.clock import timed
from napari_hmrf import ElasticPrior, Multigrid, Problem, Solution, solve, warp
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.landmarks import Landmarks, StrainScale, fit_spline, spline
from napari_hmrf.tissue import edge_confidence
from validation.studies.registration import as_itk, displacement_of
from validation.study import Options, Results, Table, study

Points = npt.NDArray[np.float64]
Array = npt.NDArray[Any]
Fit = Callable[[Points, Points], Callable[[Points], Points]]

# Known random motion.

_SIDE, _SD = 96, 0.5
_HALF_AXES = {2: (44.0, 34.0), 3: (44.0, 38.0, 34.0)}
#: Sites at which errors are measured.
_SITES = 8000
#: Typical strains of elastic tissue; cross-validation selects one.
_TYPICAL_STRAINS = (0.2, 1.0, 5.0)


def _inside(x: Array) -> npt.NDArray[np.bool_]:
    return np.asarray((((x - 47.5) / _HALF_AXES[x.shape[-1]]) ** 2).sum(axis=-1) <= 1)


def _motion(axes: int, wave: float, rng: np.random.Generator) -> Callable[[Array], Array]:
    """Return a Gaussian random field with a standard deviation of 5 pixels.

    `wave` is its correlation length as a fraction of the side.
    """
    frequency = rng.standard_normal((400, axes)) / (wave * _SIDE)
    phase = rng.uniform(0, 2 * np.pi, (axes, 400))
    size = rng.standard_normal((axes, 400)) * np.sqrt(2 / 400) * 5

    def motion(x: Array) -> Array:
        angle = x @ frequency.T
        columns = [np.cos(angle + phase[axis]) @ size[axis] for axis in range(axes)]
        return np.stack(columns, axis=1)

    return motion


def _radial(kernel: str) -> Callable[..., Array]:
    def field(points: Array, shifts: Array, places: Array, tissue: Array) -> Array:
        def at(known: slice | Array, x: Array, smoothing: float) -> Array:
            scaled = (points[known] - 47.5) / 48
            spline = RBFInterpolator(scaled, shifts[known], smoothing=smoothing, kernel=kernel)
            return np.asarray(spline((x - 47.5) / 48))

        fold = np.arange(len(points)) % 10

        def score(smoothing: float) -> float:
            parts = (
                ((at(fold != k, points[fold == k], smoothing) - shifts[fold == k]) ** 2).sum()
                for k in range(10)
            )
            return float(sum(parts))

        return at(slice(None), places, min(np.logspace(-4, 2, 10), key=score))

    return field


def _affine_field(points: Array, shifts: Array, places: Array) -> Array:
    known, wanted = (np.column_stack([np.ones(len(x)), x]) for x in (points, places))
    return np.asarray(wanted @ np.linalg.lstsq(known, shifts, rcond=None)[0])


def _elastic_field(points: Array, shifts: Array, places: Array, tissue: Array) -> Array:
    """Return an affine motion plus an elastic displacement that fits the rest of the shifts.

    The typical strain is selected with every fifth landmark left out.
    """
    rest = shifts - _affine_field(points, shifts, points)

    def at(known: Array, x: Array, strain: float) -> Array:
        scale = StrainScale(strain)
        marks = Landmarks(points[known], (points + rest)[known], sd=_SD, scale=scale)
        problem = _landmarked(tissue, marks)
        return np.asarray(solve(problem, ElasticPrior(0.0), backend="cpu").at(x, extend=True))

    left_out = np.arange(len(points)) % 5 == 0

    def score(strain: float) -> float:
        return float(((at(~left_out, points[left_out], strain) - rest[left_out]) ** 2).sum())

    field = at(np.ones(len(points), bool), places, min(_TYPICAL_STRAINS, key=score))
    return np.asarray(_affine_field(points, shifts, places) + field)


def _landmarked(tissue: Array, marks: Landmarks, side: float = 1.0) -> Problem:
    """Return tissue that only landmarks move; `side` is the size of its pixels."""
    none = np.zeros((*tissue.shape, tissue.ndim), np.float32)
    return Problem(
        observed=none,
        confidence=none,
        stiffness=tissue,
        spacing=(side,) * tissue.ndim,
        landmarks=marks,
    )


def _spline_field(points: Array, shifts: Array, places: Array, tissue: Array) -> Array:
    field = spline(Landmarks(points, points + shifts, sd=_SD), tissue, spacing=1)
    return np.asarray(field[tuple(places.astype(int).T)])


METHODS: dict[str, Callable[..., Array]] = {
    "linear RBF": _radial("linear"),
    "thin-plate RBF": _radial("thin_plate_spline"),
    "affine + elastic": _elastic_field,
    "spline": _spline_field,
}


class Field(NamedTuple):
    """Random displacement with landmarks, and its kind.

    `shifts` are the noisy displacements of `points`, and `truth` is the displacement of `places`.
    """

    kind: tuple[str, int, str]
    points: Points
    shifts: Points
    places: Points
    truth: Points
    tissue: Array


def random_fields(options: Options) -> Iterator[tuple[str, Field]]:
    """Yield random displacements, with and without an affine motion."""
    seeds = options.count or options.choose(2, 1)
    waves = options.choose((0.2, 0.3), (0.3,))
    for axes in options.choose((2, 3), (2,)):
        sites = np.moveaxis(np.indices((_SIDE,) * axes), 0, -1).astype(float)
        tissue = _inside(sites)
        places = np.random.default_rng(0).permutation(sites[tissue])[:_SITES]
        for count, affine, seed, wave in itertools.product(
            (50, 200), (False, True), range(seeds), waves
        ):
            rng = np.random.default_rng([seed, axes, count, affine, int(100 * wave)])
            # The corners of the element of a point are tissue, as elastic landmarks require.
            points = rng.uniform(0, 95, (20 * count, axes))
            low, half = np.floor(points), np.array(_HALF_AXES[axes])
            far = np.maximum(abs(low - 47.5), abs(low + 1 - 47.5)) / half
            points = points[(far**2).sum(axis=1) <= 1][:count]
            smooth, rates = _motion(axes, wave, rng), 0.1 * rng.standard_normal((axes, axes))

            def motion(x: Points, smooth=smooth, rates=affine * rates) -> Points:
                return np.asarray(smooth(x) + (x - 47.5) @ rates)

            shifts = motion(points) + _SD * rng.standard_normal(points.shape)
            kind = (f"{axes}-D", count, "yes" if affine else "no")
            field = Field(kind, points, shifts, places, motion(places), tissue)
            yield f"{axes}-D, {count} landmarks, affine {kind[2]}, {seed}, {wave}", field


def _interpolated_rows(results: Results) -> Iterator[list[Any]]:
    for kind in dict.fromkeys(own for own, _ in results.values()):
        found = [by_method for own, by_method in results.values() if own == kind]
        errors = {name: np.array([each[name][0] for each in found]) for name in METHODS}
        better = np.minimum(errors["linear RBF"], errors["thin-plate RBF"])
        for name in METHODS:
            ratio = errors[name] / better
            seconds = np.median([each[name][1] for each in found])
            shares = f"{ratio.mean():.2f}", f"{(ratio < 1.1).mean():.0%}"
            yield [*kind, name, f"{errors[name].mean():.2f}", *shares, f"{seconds:.2f} s"]


_INTERPOLATED_TITLES = ("", "landmarks", "affine", "method", "error (px)", "ratio", "within 10 %")
_INTERPOLATED_TITLES += ("time",)


@study(
    "landmarks.interpolation",
    random_fields,
    _INTERPOLATED_TITLES,
    rows=_interpolated_rows,
    page="landmarks.md",
)
def interpolation(field: Field) -> tuple[Any, dict[str, tuple[float, float]]]:
    """Compare radial basis functions, elastic tissue and the spline with known motion.

    *Ratio* is the mean ratio to the better one of the two radial basis functions in each case, and
    *within 10 %* is the share of cases below 1.1.
    """
    found = {}
    for name, method in METHODS.items():
        run = partial(method, field.points, field.shifts, field.places, field.tissue)
        moved, times = timed(run)
        found[name] = (float(np.linalg.norm(moved - field.truth, axis=1).mean()), times.wall)
    return field.kind, found


# Intervals of the spline.

#: Number of further landmarks for each field, which the spline does not know.
_HELD_OUT = 400
#: Standard deviations of the intervals, and their nominal coverages.
_INTERVALS = {1.0: "68 %", 1.96: "95 %"}


def _interval_rows(results: Results) -> Iterator[list[Any]]:
    for kind in dict.fromkeys(own for own, _, _ in results.values()):
        rows = [row for row in results.values() if row[0] == kind]
        yield [*kind, *_interval_cells(rows)]
    yield ["all", "", "", *_interval_cells(list(results.values()))]


def _interval_cells(rows: list[Any]) -> Iterator[Any]:
    yield sum(len(ratios) for _, ratios, _ in rows)
    whole = np.concatenate([np.ravel(ratios) for _, ratios, _ in rows])
    for size in _INTERVALS:
        yield f"{np.mean(whole <= size):.1%}"
    yield f"{np.mean([width for *_, width in rows]):.2f}"


@study(
    "landmarks.intervals",
    random_fields,
    ("", "landmarks", "affine", "held out", *_INTERVALS.values(), "half width of 95 % (px)"),
    rows=_interval_rows,
    page="landmarks.md",
)
def covered(field: Field) -> tuple[Any, Array, float]:
    """Compare the errors of a spline at landmarks that it does not know with its intervals.

    The error of a component is relative to its standard deviation, which contains the estimated
    noise of the held-out landmark.
    """
    fit = fit_spline(
        Landmarks(field.points, field.points + field.shifts, sd=_SD), field.tissue, spacing=1
    )
    rng = np.random.default_rng(len(field.points))
    some = rng.permutation(len(field.places))[:_HELD_OUT]
    at = tuple(field.places[some].astype(int).T)
    shifts = field.truth[some] + _SD * rng.standard_normal((len(some), field.truth.shape[1]))
    sd = np.hypot(fit.sd[at], fit.noise[0])
    return field.kind, np.abs(fit.displacement[at] - shifts) / sd, float(1.96 * sd.mean())


# Sections of real tissue.

#: Largest distance of a match from an affine map, in pixels; other matches are discarded.
_MISTAKEN = 40
#: Size of a pixel of the field in pixels of the pictures, and tolerance of its solve in pixels.
_STEP, _NEAR = 4, 1e-2
#: Distance in pixels below which landmarks belong to the same feature.
_APART = 2
#: Candidate forces K of eq. 19, and numbers of folds of the outer and inner cross-validation.
_FORCES, _PARTS, _INNER = (0.01, 0.03, 0.1, 0.3, math.inf), 6, 4
#: Standard deviation of a landmark in pixels, and candidate strains of tissue.
_NOISE, _STRAINS = 1.0, (0.002, 0.005, 0.01, 0.02, 0.05)
#: Landmarks are near the edge if their distance from it is below this fraction of the picture.
_EDGE = 0.1


def landmarks(fixed: npt.NDArray[Any], moving: npt.NDArray[Any]) -> tuple[Points, Points]:
    """Return the positions (row, col) of the same features in the two pictures."""
    found = []
    for picture in (fixed, moving):
        features = SIFT(upsampling=1)
        features.detect_and_extract(picture)
        found.append((features.keypoints, features.descriptors))
    pairs = match_descriptors(found[0][1], found[1][1], max_ratio=0.8, cross_check=True)
    at, to = found[0][0][pairs[:, 0]].astype(float), found[1][0][pairs[:, 1]].astype(float)
    _, right = ransac((at, to), AffineTransform, min_samples=4, residual_threshold=_MISTAKEN, rng=0)
    _, alone = np.unique(np.rint(at / _APART), axis=0, return_index=True)
    kept = np.intersect1d(np.flatnonzero(right), alone)
    return at[kept], to[kept]


def _affine(at: Points, to: Points) -> Callable[[Points], Points]:
    return AffineTransform.from_estimate(at, to)


def _splines(smoothing: float) -> Fit:
    return lambda at, to: RBFInterpolator(at, to, kernel="thin_plate_spline", smoothing=smoothing)


class _Elastic:
    """Tissue of uniform stiffness with landmarks as observations, after an affine map."""

    def __init__(self, shape: tuple[int, int], penalty: float) -> None:
        self._shape = tuple(size // _STEP for size in shape)
        self._penalty = penalty
        self._before: Solution | None = None

    def __call__(self, at: Points, to: Points) -> Callable[[Points], Points]:
        straight = _affine(at, to)
        y, c = np.zeros((2, *self._shape, 2))
        sites = tuple(np.clip(np.rint(_in_field(at)).astype(int), 0, np.array(self._shape) - 1).T)
        np.add.at(y, sites, to - straight(at))  # landmarks in the same pixel are averaged
        np.add.at(c, sites, 1)
        y, c = y / np.maximum(c, 1), np.minimum(c, 1)
        spacing = (_STEP, _STEP)
        problem = Problem(observed=y, confidence=c, stiffness=np.ones(self._shape), spacing=spacing)
        prior, optimizer = ElasticPrior(0.3, penalty=self._penalty), Multigrid(_NEAR)
        solution = solve(problem, prior, optimizer=optimizer, initial=self._before)
        self._before = solution

        def goes(points: Points) -> Points:
            places = _in_field(points)
            moved = moved_points(places, solution.displacement, spacing=spacing)
            return straight(points) + (moved - places) * _STEP

        return goes


class _Uncertain:
    """Tissue with landmarks that have a standard deviation, after an affine map."""

    def __init__(self, shape: tuple[int, int], strain: float) -> None:
        self._shape = tuple(size // _STEP for size in shape)
        self._scale = StrainScale(strain)
        self._before: Solution | None = None

    def __call__(self, at: Points, to: Points) -> Callable[[Points], Points]:
        straight = _affine(at, to)
        points = _inside_field(at, self._shape)
        rest = (to - straight(at)) / _STEP
        marks = Landmarks(points, points + rest, sd=_NOISE, scale=self._scale)
        problem, optimizer = _landmarked(np.ones(self._shape), marks, _STEP), Multigrid(_NEAR)
        solution = solve(problem, ElasticPrior(0.3), optimizer=optimizer, initial=self._before)
        self._before = solution
        return lambda x: straight(x) + solution.at(_inside_field(x, self._shape))


def _smooth(shape: tuple[int, int]) -> Fit:
    """Return the fit of a smoothing spline inside the picture."""
    tissue = np.ones(tuple(size // _STEP for size in shape))
    spacing = (_STEP, _STEP)

    def fit(at: Points, to: Points) -> Callable[[Points], Points]:
        points = _inside_field(at, tissue.shape)
        marks = Landmarks(points, points + (to - at) / _STEP, sd=_NOISE)
        field = spline(marks, tissue, spacing=spacing)

        def goes(places: Points) -> Points:
            before = _inside_field(places, tissue.shape)
            return places + (moved_points(before, field, spacing=spacing) - before) * _STEP

        return goes

    return fit


class _Chosen:
    """Fit that is chosen by cross-validation.

    The landmarks are divided into folds. For the landmarks of a fold, the fit is chosen from the
    other folds only, by an inner cross-validation.

    Parameters
    ----------
    make : callable
        Function that returns the fit for a candidate value.
    values : sequence of float
        Candidates.
    at, to : ndarray, shape (N, 2)
        Landmarks.
    """

    def __init__(
        self, make: Callable[[float], Fit], values: Sequence[float], at: Points, to: Points
    ) -> None:
        self._part = np.random.default_rng(0).permutation(len(at)) % _PARTS
        self.values = []
        self._fits = []
        for part in range(_PARTS):
            others = self._part != part
            errors = [_told_apart(make(value), at[others], to[others]) for value in values]
            self.values.append(values[int(np.argmin(errors))])
            self._fits.append(make(self.values[-1]))

    def of(self, number: int) -> Fit:
        """Return the fit that was chosen without a landmark."""
        return self._fits[self._part[number]]


def _told_apart(fit: Fit, at: Points, to: Points) -> float:
    """Return the mean error of a fit in a cross-validation."""
    part = np.random.default_rng(1).permutation(len(at)) % _INNER
    errors = []
    for out in (part == number for number in range(_INNER)):
        goes = fit(at[~out], to[~out])(at[out])
        errors.append(np.linalg.norm(goes - to[out], axis=1))
    return float(np.concatenate(errors).mean())


def _in_field(points: Points) -> Points:
    """Convert points from pixels of the pictures to pixels of the field."""
    return (points + 0.5) / _STEP - 0.5


def _inside_field(points: Points, shape: tuple[int, ...]) -> Points:
    """Convert points to pixels of the field, and move points outside it to its edge."""
    return np.clip(_in_field(points), 0, np.array(shape) - 1)


def left_out(fit_of: Callable[[int], Fit], at: Points, to: Points, every: int) -> Array:
    """Return the errors of landmarks, each predicted from the others."""
    errors = []
    for number in range(0, len(at), every):
        others = np.arange(len(at)) != number
        goes = fit_of(number)(at[others], to[others])(at[number : number + 1])
        errors.append(np.linalg.norm(goes - to[number]))
    return np.array(errors)


def _registered(fixed: npt.NDArray[Any], moving: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the displacement of each pixel of the fixed picture by SimpleITK's demons."""
    import SimpleITK as sitk

    demons = sitk.SymmetricForcesDemonsRegistrationFilter()
    demons.SetNumberOfIterations(200)
    demons.SetStandardDeviations(3.0)
    return displacement_of(demons.Execute(*as_itk(fixed, moving)))


def _followed(fixed: npt.NDArray[Any], field: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the elastic displacement with a field as observations at edges of the picture."""
    c = np.repeat(edge_confidence(fixed)[..., None], 2, axis=-1)
    problem = Problem(observed=field, confidence=c, stiffness=np.ones(fixed.shape))
    prior = ElasticPrior(0.3, penalty=0.3)
    return solve(problem, prior, optimizer=Multigrid(_NEAR)).displacement


def zones(at: Points, shape: tuple[int, ...]) -> dict[str, Array]:
    """Return masks of the landmarks by their location."""
    depth = np.minimum(at, np.array(shape) - 1 - at).min(axis=1)
    next_one = cKDTree(at).query(at, 2)[0][:, 1]
    edge = depth < _EDGE * min(shape)
    return {
        "near the edge": edge,
        "in the middle": ~edge,
        "nearest feature < 10 px": next_one < 10,
        "10-20 px": (next_one >= 10) & (next_one < 20),
        "> 20 px": next_one >= 20,
    }


def _likeness(at: Points, to: Points) -> Iterator[list[Any]]:
    """Yield rms differences between the displacements of two landmarks, by their distance.

    The displacements are taken after the affine map. At distance zero, the difference is the noise
    of the landmarks. Beyond the distance at which it stops increasing, landmarks are independent.
    """
    beside = to - _affine(at, to)(at)
    apart, differ = pdist(at), pdist(beside) / math.sqrt(2)
    for low, high in itertools.pairwise((0, 10, 20, 40, 80, 160, 320)):
        pairs = differ[(apart >= low) & (apart < high)]
        if len(pairs):
            yield [f"{low} to {high} px", len(pairs), f"{math.sqrt((pairs**2).mean()):.2f}"]


class Sections(NamedTuple):
    """Pictures of two sections with their landmarks, and every how many are predicted."""

    fixed: Array
    moving: Array
    at: Points
    to: Points
    every: int

    @property
    def turned(self) -> Array:
        """The moving picture after the affine map of the landmarks."""
        straight = _as_xy(_affine(self.at, self.to))
        return sampled(self.moving, straight, order=1, cval=float(np.median(self.moving)))


def _predicted(fit: Fit) -> Callable[[Sections], tuple[Array, str]]:
    return lambda pair: (left_out(lambda _: fit, pair.at, pair.to, pair.every), "")


def _chosen(
    make: Callable[[tuple[int, ...], float], Fit], values: Sequence[float]
) -> Callable[[Sections], tuple[Array, str]]:
    def run(pair: Sections) -> tuple[Array, str]:
        fits = _Chosen(partial(make, pair.fixed.shape), values, pair.at, pair.to)
        errors = left_out(fits.of, pair.at, pair.to, pair.every)
        return errors, ", ".join(map(str, fits.values))

    return run


def _of_pictures(
    field_of: Callable[[Array, Array], Array],
) -> Callable[[Sections], tuple[Array, str]]:
    """Return the errors of all landmarks after the affine map, which are not used otherwise."""

    def run(pair: Sections) -> tuple[Array, str]:
        field = field_of(pair.fixed, pair.turned)
        moved = moved_points(pair.at, field, spacing=(1.0, 1.0))
        return np.linalg.norm(_affine(pair.at, pair.to)(moved) - pair.to, axis=1), ""

    return run


PREDICTIONS: dict[str, Callable[[Sections], tuple[Array, str]]] = {
    "a translation": _predicted(lambda a, b: lambda p: p + np.median(b - a, axis=0)),
    "an affine map": _predicted(_affine),
    "thin-plate splines": _predicted(_splines(0)),
    "thin-plate splines, smoothed": _predicted(_splines(1000)),
    "`landmarks.spline`": lambda pair: _predicted(_smooth(pair.fixed.shape))(pair),
    "elastic tissue after the affine map, exact": lambda pair: _predicted(
        _Elastic(pair.fixed.shape, math.inf)
    )(pair),
    "elastic tissue, with the chosen force": _chosen(_Elastic, _FORCES),
    "elastic tissue, with the chosen strain": _chosen(_Uncertain, _STRAINS),
    "*the images:* the affine map": _of_pictures(lambda fixed, _: np.zeros((*fixed.shape, 2))),
    "*the images:* SimpleITK's demons": _of_pictures(_registered),
    "*the images:* demons at edges, elastic tissue": _of_pictures(
        lambda fixed, turned: _followed(fixed, _registered(fixed, turned))
    ),
}


def predictions(options: Options) -> Iterator[tuple[str, tuple[str, Sections]]]:
    """Yield the kinds of predictions of the landmarks of two pictures."""
    if len(options.files) != 2:
        print("The pictures of two sections are required: --files FIXED MOVING")
        return
    fixed, moving = map(grey, options.files)
    pair = Sections(fixed, moving, *landmarks(fixed, moving), options.every)
    for name in PREDICTIONS:
        yield name, (name, pair)


def _prediction_tables(results: Results) -> Iterator[Table]:
    pair = next(iter(results.values()))[0]
    yield Table(
        (f"distance of two of {len(pair.at)} landmarks", "pairs", "rms difference (px)"),
        lambda _: _likeness(pair.at, pair.to),
    )
    locations = zones(pair.at, pair.fixed.shape)
    rows = []
    for name, (_, errors, chosen) in results.items():
        taken = slice(None, None, 1 if len(errors) == len(pair.at) else pair.every)
        parts = [errors[zone[taken]] for zone in locations.values()]
        cells = [np.median(errors), math.sqrt((errors**2).mean())]
        cells += [np.median(part) if len(part) else math.nan for part in parts]
        rows.append([name, *(f"{cell:.2f}" for cell in cells), chosen])
    titles = ("predicted by", "all features", "rms of all", *locations)
    yield Table(titles, lambda _: [row[:-1] for row in rows])
    chosen = [(row[0], row[-1]) for row in rows if row[-1]]
    yield Table(("chosen without the predicted landmarks", "values"), lambda _: chosen)


def _draw(results: Results, folder: Path) -> None:
    """Draw both sections, and their overlays after the affine map and after elastic tissue."""
    from matplotlib.figure import Figure

    pair = next(iter(results.values()))[0]
    fixed, turned = pair.fixed, pair.turned
    # The field leads from the fixed picture to the other; its inverse warps the other onto it.
    field = _followed(fixed, _registered(fixed, turned))
    back = inverse_displacement(field, spacing=(1, 1)).displacement
    figure = Figure((13, 13.6), layout="constrained")
    for number, (title, picture) in enumerate(
        {
            "fixed section": np.repeat(fixed[..., None], 3, axis=-1),
            "moving section": np.repeat(pair.moving[..., None], 3, axis=-1),
            "overlay, after the affine map": _over(fixed, turned),
            "overlay, after elastic tissue": _over(fixed, warp(turned, back, spacing=1)),
        }.items()
    ):
        axes = figure.add_subplot(2, 2, number + 1)
        axes.imshow(np.clip(picture, 0, 1))
        axes.set_title(title)
        axes.axis("off")
    figure.savefig(folder / "sections.png")


@study("sections.prediction", predictions, _prediction_tables, draw=_draw, page="sections.md")
def predict(case: tuple[str, Sections]) -> tuple[Sections, Array, str]:
    """Compare predicted landmarks of two sections with matched features, in pixels."""
    name, pair = case
    return (pair, *PREDICTIONS[name](pair))


def grey(path: Path) -> npt.NDArray[Any]:
    """Read a picture as brightness from 0 to 1."""
    picture = imread(path)
    return rgb2gray(picture[..., :3]) if picture.ndim > 2 else picture / 255


def _as_xy(straight: Any) -> Any:
    """Return the map for scikit-image's `warp`, which uses points (col, row)."""
    return lambda points: straight(points[:, ::-1])[:, ::-1]


def _over(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a picture of both sections: grey where they agree, otherwise green or magenta."""
    return np.stack([other, one, other], axis=-1)

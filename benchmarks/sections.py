"""Prediction of landmarks in neighbouring sections of real tissue by several kinds of motion.

    python benchmarks/sections.py FIXED MOVING [--every 1] [--picture OUT.png]

Features of the two pictures are matched to obtain landmarks. Each landmark is left out once and
predicted from the other landmarks by an affine map, by thin-plate splines, and by elastic tissue
with the other landmarks as observations after the affine map. The observations are prescribed
exactly, with a limited force, or with a standard deviation. The force, or the typical strain of the
tissue, is chosen by cross-validation without the predicted landmark.
Then the landmarks are predicted by two registrations of the whole pictures: SimpleITK's demons, and
elastic tissue with the demons field as observations at the edges of the picture only. Prints the
errors in pixels for all landmarks and by location, and the similarity of neighbouring landmarks
after the affine map, which limits the accuracy of all methods. No pictures are included in this
project; any two sections are suitable.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

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

from napari_hmrf import ElasticPrior, Multigrid, Problem, Solution, solve, warp
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.landmarks import Landmarks, StrainScale, spline
from napari_hmrf.tissue import edge_confidence

Points = npt.NDArray[np.float64]
Fit = Callable[[Points, Points], Callable[[Points], Points]]

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
        none, spacing = np.zeros((*self._shape, 2)), (_STEP, _STEP)
        problem = Problem(
            observed=none,
            confidence=none,
            stiffness=np.ones(self._shape),
            spacing=spacing,
            landmarks=marks,
        )
        optimizer = Multigrid(_NEAR)
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


def left_out(
    fit_of: Callable[[int], Fit], at: Points, to: Points, every: int
) -> tuple[npt.NDArray[Any], float]:
    """Return the errors of landmarks, each predicted from the others, and the time in seconds."""
    started, errors = time.perf_counter(), []
    for number in range(0, len(at), every):
        others = np.arange(len(at)) != number
        goes = fit_of(number)(at[others], to[others])(at[number : number + 1])
        errors.append(np.linalg.norm(goes - to[number]))
    return np.array(errors), time.perf_counter() - started


def _registered(fixed: npt.NDArray[Any], moving: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the displacement of each pixel of the fixed picture by SimpleITK's demons."""
    import SimpleITK as sitk

    demons = sitk.SymmetricForcesDemonsRegistrationFilter()
    demons.SetNumberOfIterations(200)
    demons.SetStandardDeviations(3.0)
    one, other = (sitk.GetImageFromArray(picture.astype(np.float32)) for picture in (fixed, moving))
    field: npt.NDArray[Any] = sitk.GetArrayFromImage(demons.Execute(one, other))[..., ::-1]
    return field


def _followed(fixed: npt.NDArray[Any], field: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the elastic displacement with a field as observations at edges of the picture."""
    c = np.repeat(edge_confidence(fixed)[..., None], 2, axis=-1)
    problem = Problem(observed=field, confidence=c, stiffness=np.ones(fixed.shape))
    prior = ElasticPrior(0.3, penalty=0.3)
    return solve(problem, prior, optimizer=Multigrid(_NEAR)).displacement


class _Table:
    """Table of errors for all landmarks and by their location."""

    def __init__(self, at: Points, shape: tuple[int, int]) -> None:
        depth = np.minimum(at, np.array(shape) - 1 - at).min(axis=1)
        next_one = cKDTree(at).query(at, 2)[0][:, 1]
        edge = depth < _EDGE * min(shape)
        self.zones = {
            "edge": edge,
            "middle": ~edge,
            "next <10": next_one < 10,
            "10-20": (next_one >= 10) & (next_one < 20),
            "20-": next_one >= 20,
        }

    def head(self, taken: slice) -> str:
        """Return the line of column titles."""
        counts = [f"{name} ({zone[taken].sum()})" for name, zone in self.zones.items()]
        words = "".join(f"{each:>15}" for each in counts)
        return f"{'':<44}{'median':>8}{'90 %':>8}{'rms':>8}{words}{'seconds':>9}"

    def line(self, name: str, errors: npt.NDArray[Any], seconds: float, taken: slice) -> str:
        """Return a line with the errors of a method in pixels; by location, with medians."""
        middle, most = np.percentile(errors, [50, 90])
        rms = math.sqrt((errors**2).mean())
        zones = [errors[zone[taken]] for zone in self.zones.values()]
        parts = "".join(f"{np.median(zone) if len(zone) else math.nan:>15.2f}" for zone in zones)
        return f"{name:<44}{middle:>8.2f}{most:>8.2f}{rms:>8.2f}{parts}{seconds:>9.1f}"


def _likeness(at: Points, to: Points) -> str:
    """Return differences between the displacements of two landmarks, by their distance.

    The displacements are taken after the affine map. At distance zero, the difference is the noise
    of the landmarks. Beyond the distance at which it stops increasing, landmarks are independent.
    """
    beside = to - _affine(at, to)(at)
    apart, differ = pdist(at), pdist(beside) / math.sqrt(2)
    words = []
    for low, high in itertools.pairwise((0, 10, 20, 40, 80, 160, 320)):
        pairs = differ[(apart >= low) & (apart < high)]
        if len(pairs):
            words.append(f"{low}-{high}: {math.sqrt((pairs**2).mean()):.2f} ({len(pairs)})")
    return ", ".join(words)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("fixed", type=Path)
    parser.add_argument("moving", type=Path)
    parser.add_argument("--every", type=int, default=1, help="leave out every n-th landmark")
    parser.add_argument("--picture", type=Path, help="path of a picture of the sections to write")
    options = parser.parse_args(arguments)
    fixed, moving = (grey(path) for path in (options.fixed, options.moving))
    at, to = landmarks(fixed, moving)
    table, taken = _Table(at, fixed.shape), slice(None, None, options.every)
    print(f"{len(at)} landmarks; errors in pixels of {fixed.shape[0]} x {fixed.shape[1]}")
    print("rms difference of neighbours in pixels, by their distance (pairs):", _likeness(at, to))
    print(f"\neach predicted from the others by\n{table.head(taken)}")
    fits: dict[str, Fit] = {
        "a translation": lambda a, b: lambda p: p + np.median(b - a, axis=0),
        "an affine map": _affine,
        "thin-plate splines": _splines(0),
        "thin-plate splines, smoothed (1000)": _splines(1000),
        "spline inside the picture": _smooth(fixed.shape),
        "elastic tissue, exactly": _Elastic(fixed.shape, math.inf),
    }
    for name, fit in fits.items():
        found = left_out(lambda _, fit=fit: fit, at, to, options.every)
        print(table.line(name, *found, taken), flush=True)
    makers: dict[str, tuple[Callable[[float], Fit], Sequence[float]]] = {
        "elastic tissue, with the chosen force": (partial(_Elastic, fixed.shape), _FORCES),
        "elastic tissue, with the chosen strain": (partial(_Uncertain, fixed.shape), _STRAINS),
    }
    for name, (make, values) in makers.items():
        started = time.perf_counter()
        chosen = _Chosen(make, values, at, to)
        sought = time.perf_counter() - started
        errors, seconds = left_out(chosen.of, at, to, options.every)
        print(table.line(name, errors, seconds + sought, taken), flush=True)
        print(f"  (chosen without the predicted landmarks: {', '.join(map(str, chosen.values))})")
    straight = _affine(at, to)
    # Both registrations start from the affine map and use no landmarks otherwise.
    turned = sampled(moving, _as_xy(straight), order=1, cval=float(np.median(moving)))
    started = time.perf_counter()
    field = _registered(fixed, turned)
    print("\npredicted from the pictures, after the affine map, by")
    for name, by in (
        ("the affine map alone", lambda: np.zeros_like(field)),
        ("SimpleITK's demons", lambda: field),
        ("elastic tissue with the demons field at edges", lambda: _followed(fixed, field)),
    ):
        found_field = by()
        goes = straight(moved_points(at, found_field, spacing=(1.0, 1.0)))
        errors = np.linalg.norm(goes - to, axis=1)
        seconds = time.perf_counter() - started
        print(table.line(name, errors, seconds, slice(None)), flush=True)
    if options.picture is not None:
        _draw(options.picture, fixed, moving, turned, found_field)
    return 0


def grey(path: Path) -> npt.NDArray[Any]:
    """Read a picture as brightness from 0 to 1."""
    picture = imread(path)
    return rgb2gray(picture[..., :3]) if picture.ndim > 2 else picture / 255


def _as_xy(straight: Any) -> Any:
    """Return the map for scikit-image's `warp`, which uses points (col, row)."""
    return lambda points: straight(points[:, ::-1])[:, ::-1]


def _draw(
    path: Path,
    fixed: npt.NDArray[Any],
    moving: npt.NDArray[Any],
    turned: npt.NDArray[Any],
    field: npt.NDArray[Any],
) -> None:
    from matplotlib.figure import Figure

    # The field leads from the fixed picture to the other; its inverse warps the other onto it.
    back = inverse_displacement(field, spacing=(1, 1)).displacement
    figure = Figure((13, 13.6), layout="constrained")
    for number, (title, picture) in enumerate(
        {
            "fixed section": np.repeat(fixed[..., None], 3, axis=-1),
            "moving section": np.repeat(moving[..., None], 3, axis=-1),
            "overlay, after the affine map": _over(fixed, turned),
            "overlay, after elastic tissue": _over(fixed, warp(turned, back, spacing=1)),
        }.items()
    ):
        axes = figure.add_subplot(2, 2, number + 1)
        axes.imshow(np.clip(picture, 0, 1))
        axes.set_title(title)
        axes.axis("off")
    figure.savefig(path)


def _over(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a picture of both sections: grey where they agree, otherwise green or magenta."""
    return np.stack([other, one, other], axis=-1)


if __name__ == "__main__":
    sys.exit(main())

"""Neighbouring sections of real tissue: which motion says best where a landmark goes.

    python benchmarks/sections.py FIXED MOVING [--every 1] [--picture OUT.png]

Features of both pictures are matched, and each landmark is taken out once: where it goes is told
from the others by an affine map, by thin-plate splines, and by elastic tissue that is led by them
after the affine map: exactly, or with a force that is chosen by taking others out, never by the one
that is asked for. Then the same by two registrations of the whole pictures: SimpleITK's own field
(demons), and elastic tissue that takes that field as observed at the picture's edges alone. Prints
the errors in pixels, over all and by where a landmark is; and how much alike neighbours go beside
the affine map, which no method can do better than. No pictures are part of this project; any two
sections will do.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
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
from napari_hmrf.tissue import edge_confidence

Points = npt.NDArray[np.float64]
Fit = Callable[[Points, Points], Callable[[Points], Points]]

#: Matches further than this from an affine map, in pixels, are mistakes.
_MISTAKEN = 40
#: Pixels of the pictures in one of the field, and how near that is solved, in pixels.
_STEP, _NEAR = 4, 1e-2
#: Landmarks nearer to each other are of one feature.
_APART = 2
#: The forces that are tried, K of eq. 19, and in how many parts landmarks are taken out for that.
_FORCES, _PARTS, _INNER = (0.01, 0.03, 0.1, 0.3, math.inf), 6, 4
#: Nearer to a side of the picture than this share of it is near the edge.
_EDGE = 0.1


def landmarks(fixed: npt.NDArray[Any], moving: npt.NDArray[Any]) -> tuple[Points, Points]:
    """Where the same features are in both pictures, (row, col)."""
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
    """Tissue of one stiffness that landmarks lead, after an affine map."""

    def __init__(self, shape: tuple[int, int], penalty: float) -> None:
        self._shape = tuple(size // _STEP for size in shape)
        self._penalty = penalty
        self._before: Solution | None = None

    def __call__(self, at: Points, to: Points) -> Callable[[Points], Points]:
        straight = _affine(at, to)
        y, c = np.zeros((2, *self._shape, 2))
        sites = tuple(np.clip(np.rint(_in_field(at)).astype(int), 0, np.array(self._shape) - 1).T)
        np.add.at(y, sites, to - straight(at))  # in one pixel their mean
        np.add.at(c, sites, 1)
        y, c = y / np.maximum(c, 1), np.minimum(c, 1)
        spacing = (_STEP, _STEP)
        problem = Problem(y, c, np.ones(self._shape), spacing=spacing)
        prior, optimizer = ElasticPrior(0.3, penalty=self._penalty), Multigrid(_NEAR)
        solution = solve(problem, prior, optimizer=optimizer, initial=self._before)
        self._before = solution

        def goes(points: Points) -> Points:
            places = _in_field(points)
            moved = moved_points(places, solution.displacement, spacing=spacing)
            return straight(points) + (moved - places) * _STEP

        return goes


class _Chosen:
    """Elastic tissue, with the force by which others of the landmarks are told best.

    They are dealt into parts. For the landmarks of a part the force is chosen by the other parts
    alone, of which each part in turn is told from the rest.
    """

    def __init__(self, shape: tuple[int, int], at: Points, to: Points) -> None:
        self._part = np.random.default_rng(0).permutation(len(at)) % _PARTS
        self.forces = []
        self._fits = []
        for part in range(_PARTS):
            others = self._part != part
            errors = [_told_apart(_Elastic(shape, k), at[others], to[others]) for k in _FORCES]
            self.forces.append(_FORCES[int(np.argmin(errors))])
            self._fits.append(_Elastic(shape, self.forces[-1]))

    def of(self, number: int) -> Fit:
        """The fit that was chosen without a landmark."""
        return self._fits[self._part[number]]


def _told_apart(fit: Fit, at: Points, to: Points) -> float:
    """The mean error of landmarks that are told from others, part by part."""
    part = np.random.default_rng(1).permutation(len(at)) % _INNER
    errors = []
    for out in (part == number for number in range(_INNER)):
        goes = fit(at[~out], to[~out])(at[out])
        errors.append(np.linalg.norm(goes - to[out], axis=1))
    return float(np.concatenate(errors).mean())


def _in_field(points: Points) -> Points:
    """Points of the pictures in pixels of the field."""
    return (points + 0.5) / _STEP - 0.5


def left_out(
    fit_of: Callable[[int], Fit], at: Points, to: Points, every: int
) -> tuple[npt.NDArray[Any], float]:
    """The errors of landmarks, each told from the others, and the seconds that took."""
    started, errors = time.perf_counter(), []
    for number in range(0, len(at), every):
        others = np.arange(len(at)) != number
        goes = fit_of(number)(at[others], to[others])(at[number : number + 1])
        errors.append(np.linalg.norm(goes - to[number]))
    return np.array(errors), time.perf_counter() - started


def _registered(fixed: npt.NDArray[Any], moving: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """SimpleITK's demons: for each pixel of the fixed picture, by how much it lies off."""
    import SimpleITK as sitk

    demons = sitk.SymmetricForcesDemonsRegistrationFilter()
    demons.SetNumberOfIterations(200)
    demons.SetStandardDeviations(3.0)
    one, other = (sitk.GetImageFromArray(picture.astype(np.float32)) for picture in (fixed, moving))
    field: npt.NDArray[Any] = sitk.GetArrayFromImage(demons.Execute(one, other))[..., ::-1]
    return field


def _followed(fixed: npt.NDArray[Any], field: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Elastic tissue that takes a field as observed where the picture has edges."""
    c = np.repeat(edge_confidence(fixed)[..., None], 2, axis=-1)
    problem = Problem(field, c, np.ones(fixed.shape))
    prior = ElasticPrior(0.3, penalty=0.3)
    return solve(problem, prior, optimizer=Multigrid(_NEAR)).displacement


class _Table:
    """Errors in lines: over all landmarks, and by where they are."""

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
        """What the columns are."""
        counts = [f"{name} ({zone[taken].sum()})" for name, zone in self.zones.items()]
        words = "".join(f"{each:>15}" for each in counts)
        return f"{'':<44}{'median':>8}{'90 %':>8}{'rms':>8}{words}{'seconds':>9}"

    def line(self, name: str, errors: npt.NDArray[Any], seconds: float, taken: slice) -> str:
        """The errors by one method, in pixels; by where they are, their medians."""
        middle, most = np.percentile(errors, [50, 90])
        rms = math.sqrt((errors**2).mean())
        zones = [errors[zone[taken]] for zone in self.zones.values()]
        parts = "".join(f"{np.median(zone) if len(zone) else math.nan:>15.2f}" for zone in zones)
        return f"{name:<44}{middle:>8.2f}{most:>8.2f}{rms:>8.2f}{parts}{seconds:>9.1f}"


def _likeness(at: Points, to: Points) -> str:
    """By how much what two landmarks do beside the affine map differs, by how far they are apart.

    What is left at no distance is noise of the landmarks; beyond where it grows no more, a landmark
    says nothing of another.
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
    parser.add_argument("--every", type=int, default=1, help="take out every n-th landmark")
    parser.add_argument("--picture", type=Path, help="both sections, and the one moved over")
    options = parser.parse_args(arguments)
    fixed, moving = (_grey(path) for path in (options.fixed, options.moving))
    at, to = landmarks(fixed, moving)
    table, taken = _Table(at, fixed.shape), slice(None, None, options.every)
    print(f"{len(at)} landmarks; errors in pixels of {fixed.shape[0]} x {fixed.shape[1]}")
    print("unlike neighbours, rms in pixels by their distance (pairs):", _likeness(at, to))
    print(f"\neach told from the others by\n{table.head(taken)}")
    fits: dict[str, Fit] = {
        "one shift": lambda a, b: lambda p: p + np.median(b - a, axis=0),
        "an affine map": _affine,
        "thin-plate splines": _splines(0),
        "thin-plate splines, smoothed (1000)": _splines(1000),
        "elastic tissue that holds them exactly": _Elastic(fixed.shape, math.inf),
    }
    for name, fit in fits.items():
        found = left_out(lambda _, fit=fit: fit, at, to, options.every)
        print(table.line(name, *found, taken), flush=True)
    started = time.perf_counter()
    chosen = _Chosen(fixed.shape, at, to)
    sought = time.perf_counter() - started
    errors, seconds = left_out(chosen.of, at, to, options.every)
    name = "elastic tissue, held as strongly as fits"
    print(table.line(name, errors, seconds + sought, taken))
    print(
        f"  (K = {', '.join(map(str, chosen.forces))}, each chosen without the landmarks asked for)"
    )
    straight = _affine(at, to)
    # Both registrations begin with the affine map, and know no landmark beside it.
    turned = sampled(moving, _as_xy(straight), order=1, cval=float(np.median(moving)))
    started = time.perf_counter()
    field = _registered(fixed, turned)
    print("\ntold from the pictures, after the affine map, by")
    for name, by in (
        ("the affine map alone", lambda: np.zeros_like(field)),
        ("SimpleITK's demons", lambda: field),
        ("that as observed, where the picture has edges", lambda: _followed(fixed, field)),
    ):
        found_field = by()
        goes = straight(moved_points(at, found_field, spacing=(1.0, 1.0)))
        errors = np.linalg.norm(goes - to, axis=1)
        seconds = time.perf_counter() - started
        print(table.line(name, errors, seconds, slice(None)), flush=True)
    if options.picture is not None:
        _draw(options.picture, fixed, moving, turned, found_field)
    return 0


def _grey(path: Path) -> npt.NDArray[Any]:
    picture = imread(path)
    return rgb2gray(picture[..., :3]) if picture.ndim > 2 else picture / 255


def _as_xy(straight: Any) -> Any:
    """The map for scikit-image's `warp`, whose points are (col, row)."""
    return lambda points: straight(points[:, ::-1])[:, ::-1]


def _draw(
    path: Path,
    fixed: npt.NDArray[Any],
    moving: npt.NDArray[Any],
    turned: npt.NDArray[Any],
    field: npt.NDArray[Any],
) -> None:
    from matplotlib.figure import Figure

    # The field leads from the fixed picture to the other: back, that moves onto this one.
    back = inverse_displacement(field, spacing=(1, 1)).displacement
    figure = Figure((13, 13.6), layout="constrained")
    for number, (title, picture) in enumerate(
        {
            "the one section": np.repeat(fixed[..., None], 3, axis=-1),
            "the other": np.repeat(moving[..., None], 3, axis=-1),
            "the other over the one, by the affine map": _over(fixed, turned),
            "and by elastic tissue": _over(fixed, warp(turned, back, spacing=1)),
        }.items()
    ):
        axes = figure.add_subplot(2, 2, number + 1)
        axes.imshow(np.clip(picture, 0, 1))
        axes.set_title(title)
        axes.axis("off")
    figure.savefig(path)


def _over(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Both in one picture: grey where they agree, green and magenta where not."""
    return np.stack([other, one, other], axis=-1)


if __name__ == "__main__":
    sys.exit(main())

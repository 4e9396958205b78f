"""Landmark interpolation: errors of radial basis functions, elastic tissue and the spline.

    python -m benchmarks.landmark_interpolation [--quick] [--seeds N]

Smooth random displacements of an ellipse and an ellipsoid, on grids of 96 pixels along each axis,
are observed at 50 or 200 random points with noise of 0.5 pixels. Each method then estimates the
displacement of all tissue. The errors are means over tissue, fields and seeds. `affine` adds a
random affine motion with rates of about 0.1. `ratio` is the mean ratio to the better one of the two
radial basis functions in each case, and `within 10 %` the share of cases below 1.1.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import defaultdict
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.interpolate import RBFInterpolator

from napari_hmrf import ElasticPrior, Problem, solve
from napari_hmrf.landmarks import Landmarks, StrainScale, spline

Array = npt.NDArray[np.float64]
_SIDE, _NOISE = 96, 0.5
_HALF_AXES = {2: (44.0, 34.0), 3: (44.0, 38.0, 34.0)}
#: Sites at which errors are measured.
_SITES = 8000
#: Typical strains of elastic tissue; cross-validation selects one.
_STRAINS = (0.2, 1.0, 5.0)


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


def _affine(points: Array, shifts: Array, places: Array) -> Array:
    known, wanted = (np.column_stack([np.ones(len(x)), x]) for x in (points, places))
    return np.asarray(wanted @ np.linalg.lstsq(known, shifts, rcond=None)[0])


def _elastic(points: Array, shifts: Array, places: Array, tissue: Array) -> Array:
    """Return an affine motion plus an elastic displacement that fits the rest of the shifts.

    The typical strain is selected with every fifth landmark left out.
    """
    rest = shifts - _affine(points, shifts, points)
    none = np.zeros((*tissue.shape, tissue.ndim), np.float32)

    def at(known: Array, x: Array, strain: float) -> Array:
        scale = StrainScale(strain)
        marks = Landmarks(points[known], (points + rest)[known], sd=_NOISE, scale=scale)
        problem = Problem(observed=none, confidence=none, stiffness=tissue, landmarks=marks)
        return np.asarray(solve(problem, ElasticPrior(0.0), backend="cpu").at(x, extend=True))

    left_out = np.arange(len(points)) % 5 == 0

    def score(strain: float) -> float:
        return float(((at(~left_out, points[left_out], strain) - rest[left_out]) ** 2).sum())

    field = at(np.ones(len(points), bool), places, min(_STRAINS, key=score))
    return np.asarray(_affine(points, shifts, places) + field)


def _spline(points: Array, shifts: Array, places: Array, tissue: Array) -> Array:
    field = spline(Landmarks(points, points + shifts, sd=_NOISE), tissue, spacing=1)
    return np.asarray(field[tuple(places.astype(int).T)])


METHODS: dict[str, Callable[..., Array]] = {
    "linear RBF": _radial("linear"),
    "thin-plate RBF": _radial("thin_plate_spline"),
    "affine + elastic": _elastic,
    "spline": _spline,
}


def table(axes: int, counts: tuple[int, ...], seeds: int, waves: tuple[float, ...]) -> None:
    """Print the rows of a dimension."""
    sites = np.moveaxis(np.indices((_SIDE,) * axes), 0, -1).astype(float)
    tissue = _inside(sites)
    places = np.random.default_rng(0).permutation(sites[tissue])[:_SITES]
    for count, affine in itertools.product(counts, (False, True)):
        errors, seconds = defaultdict(list), defaultdict(list)
        for seed, wave in itertools.product(range(seeds), waves):
            rng = np.random.default_rng([seed, axes, count, affine, int(100 * wave)])
            # The corners of the element of a point are tissue, as elastic landmarks require.
            points = rng.uniform(0, 95, (20 * count, axes))
            low, half = np.floor(points), np.array(_HALF_AXES[axes])
            far = np.maximum(abs(low - 47.5), abs(low + 1 - 47.5)) / half
            points = points[(far**2).sum(axis=1) <= 1][:count]
            smooth, rates = _motion(axes, wave, rng), 0.1 * rng.standard_normal((axes, axes))

            def motion(x: Array, smooth=smooth, rates=affine * rates) -> Array:
                return np.asarray(smooth(x) + (x - 47.5) @ rates)

            shifts, truth = (
                motion(points) + _NOISE * rng.standard_normal(points.shape),
                motion(places),
            )
            for name, method in METHODS.items():
                begun = time.perf_counter()
                found = method(points, shifts, places, tissue)
                seconds[name].append(time.perf_counter() - begun)
                errors[name].append(np.linalg.norm(found - truth, axis=1).mean())
        better = np.minimum(errors["linear RBF"], errors["thin-plate RBF"])
        for name in METHODS:
            ratio = np.array(errors[name]) / better
            print(
                f"| {axes}-D | {count} | {'yes' if affine else 'no'} | {name} "
                f"| {np.mean(errors[name]):.2f} | {ratio.mean():.2f} | {(ratio < 1.1).mean():.0%} "
                f"| {np.median(seconds[name]):.2f} s |",
                flush=True,
            )


def main() -> None:
    """Print the table of all methods."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="images only, with one field")
    parser.add_argument("--seeds", type=int, default=2, help="random fields of each kind")
    options = parser.parse_args()
    print("| | landmarks | affine | method | error (px) | ratio | within 10 % | time |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for axes in (2,) if options.quick else (2, 3):
        seeds, waves = (1, (0.3,)) if options.quick else (options.seeds, (0.2, 0.3))
        table(axes, (50, 200), seeds, waves)


if __name__ == "__main__":
    main()

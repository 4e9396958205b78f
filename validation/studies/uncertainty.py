"""Uncertainty beside dense posteriors, coverage of intervals, and fits.

The true motion of random tissue is drawn from a matrix that scikit-fem assembled. `brain` times
`uncertainty` for an MRI of a brain without its skull (``--files t1.nii.gz``), or for an ellipsoid
of the same size. ``python -m benchmarks.speed sample`` measures the time of a sample.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from benchmarks.clock import fastest, now, timed
from napari_hmrf import ElasticPrior, Problem, solve
from napari_hmrf.io.images import read_image
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import growth
from napari_hmrf.posterior import fit, sample_posterior, uncertainty
from napari_hmrf.posterior.agreement import agreement_in
from napari_hmrf.posterior.data_space import DataSpace, data_space
from napari_hmrf.posterior.noise import PosteriorNoise
from napari_hmrf.posterior.sampling import Sampler, checked_prior, energy_of
from napari_hmrf.posterior.scale_fit import Likelihood
from napari_hmrf.solver.operator import Operator
from validation.bodies import between_plates, noisy
from validation.oracles.elasticity import direct_solution, stiffness_matrix
from validation.oracles.posterior import interpolation, posterior_covariance
from validation.problems import small_tissue_with_data
from validation.study import Options, Results, Table, numbered, study

Array = npt.NDArray[np.float64]
_PAGE = "uncertainty.md"
_SCALE = StrainScale(0.1)
# Tissue of the true motion.
_TRUTH = ElasticPrior(0.3)
# Quantiles of the normal distribution for 68 % and 95 %.
_BOUNDS = {68: 0.9945, 95: 1.96}

# Samples.

_COUNTS = (30, 300, 3000)


def _sample_rows(results: Results) -> Iterator[list[Any]]:
    for number, errors in zip(_COUNTS, zip(*results.values(), strict=True), strict=True):
        rms = float(np.sqrt(np.mean(np.square(errors))))
        yield [number, f"{rms:.2f}", f"{np.abs(errors).max():.2f}"]


_SAMPLE_TITLES = ("samples", "root mean square of the errors (1 in theory)", "largest")


@study(
    "uncertainty.samples",
    numbered(24),
    _SAMPLE_TITLES,
    rows=_sample_rows,
    page=_PAGE,
)
def sample_variances(seed: int) -> list[float]:
    """Compare the mean variance of samples with that of dense inverse matrices.

    Errors are in units of their theoretical standard deviation, which follows from the whole
    covariance: neighbouring sites move together, and their variances are not independent.
    """
    problem = small_tissue_with_data(seed, _SCALE)
    covariance, free = posterior_covariance(problem, ElasticPrior(), _SCALE)
    variance = np.diag(covariance)
    correlation = covariance / np.sqrt(np.outer(variance, variance))
    squares, errors = np.zeros(len(variance)), []
    drawn = sample_posterior(problem, n=_COUNTS[-1], scale=_SCALE, seed=seed, backend="cpu")
    for number, field in enumerate(drawn, start=1):
        squares += field.ravel()[free].astype(np.float64) ** 2
        if number in _COUNTS:
            theory = np.sqrt(2 * (correlation**2).mean() / number)
            errors.append(float((squares / number / variance).mean() - 1) / theory)
    return errors


def _root(problem: Problem) -> tuple[npt.NDArray[np.bool_], Array]:
    """Return the free components, and the Cholesky factor of their matrix by scikit-fem."""
    free = ~problem.known.ravel()
    return free, np.linalg.cholesky(stiffness_matrix(problem, _TRUTH).toarray()[np.ix_(free, free)])


# Coverage.

_KINDS = {
    "label": "mean of a label",
    "patch": "mean of a patch, from 30 samples",
    "along": "mean of a label along its motion",
    "length": "mean of a label, of its true length",
}


def _coverage_rows(kinds: tuple[str, ...], results: Results) -> Iterator[list[Any]]:
    for kind, percent in itertools.product(kinds, _BOUNDS):
        errors = [error for found in results.values() for error in found[kind]]
        share = float(np.mean(np.array(errors) < _BOUNDS[percent]))
        yield [_KINDS[kind], f"{percent} %", f"{share:.1%}".replace("%", " %"), len(errors)]


def _coverage(results: Results) -> Iterator[Table]:
    titles = ("what", "interval", "contains the truth", "number")
    yield Table(titles, partial(_coverage_rows, ("label", "patch")))
    titles = ("mean along the motion", *titles[1:])
    yield Table(titles, partial(_coverage_rows, ("along", "length")))


@study("uncertainty.coverage", numbered(2000), _coverage, page=_PAGE)
def coverage(seed: int) -> dict[str, list[float]]:
    """Compare patches and labels with their true motion, in standard deviations."""
    rng = np.random.default_rng(seed)
    grid = tuple(int(size) for size in rng.integers(8, 15, 2))
    spacing = (1.0, float(rng.choice([1.0, 2.0])))
    m = (10 ** rng.uniform(0, 2)) ** rng.random(grid)
    c = np.zeros((*grid, 2))
    c[0] = 1
    bare = Problem(observed=np.zeros_like(c), confidence=c, stiffness=m, spacing=spacing)
    energy = _SCALE.energy(bare.stiffness, spacing)
    # The truth is a sample of the prior, by another assembly of the elements.
    free, root = _root(bare)
    truth = np.zeros(c.size)
    truth[free] = np.sqrt(energy) * np.linalg.solve(root.T, rng.normal(size=free.sum()))
    points = rng.random((int(rng.integers(1, 7)), 2)) * (np.array(grid) - 1)
    sd = float(10 ** rng.uniform(-1, 0.5))
    seen = (interpolation(points, grid) @ truth).reshape(-1, 2)
    seen += sd * rng.normal(size=seen.shape)
    marks = Landmarks(points, points + seen / spacing, sd=sd, scale=_SCALE)
    problem = Problem(observed=0 * c, confidence=c, stiffness=m, spacing=spacing, landmarks=marks)
    labels = np.zeros(grid, int)
    labels[-4:, -4:], labels[3:5, 3:5] = 1, 2
    result = uncertainty(
        problem, ElasticPrior(0.3), labels=labels, patch=3.0, seed=seed, backend="cpu"
    )
    field = truth.reshape(*grid, 2)
    errors: dict[str, list[float]] = {kind: [] for kind in _KINDS}
    for number, found in result.labels.items():
        moved = field[labels == number]
        errors["label"] += (np.abs(moved.mean(axis=0) - found.mean) / found.sd).tolist()
        likely = result.solution.displacement[labels == number].astype(np.float64)
        ways = likely / np.linalg.norm(likely, axis=-1, keepdims=True)
        true_along = (moved * ways).sum(axis=-1).mean()
        true_length = np.linalg.norm(moved, axis=-1).mean()
        errors["along"].append(float(abs(true_along - found.length) / found.along))
        errors["length"].append(float(abs(true_length - found.length) / found.along))
    row, col = grid[0] - 3, int(rng.integers(2, grid[1] - 2))
    width = 1 if spacing[1] == 1 else 0
    around = (slice(row - 1, row + 2), slice(col - width, col + width + 1))
    mean, known = (each[around].mean(axis=(0, 1)) for each in (field, result.solution.displacement))
    errors["patch"] += (np.abs(mean - known) / result.sd[row, col]).tolist()
    return errors


# One more landmark.

_SIDE, _SIZE = 3, 16
_NEXT_TITLES = ("place of one more landmark", "mean", "10th percentile")


def _next_rows(results: Results) -> Iterator[list[str]]:
    names = ("least sure patch, from 30 samples", "any place")
    for name, values in zip(names, np.transpose(list(results.values())), strict=True):
        cells = (
            f"{value:.0%}".replace("%", " %") for value in (values.mean(), np.quantile(values, 0.1))
        )
        yield [name, *cells]


@study(
    "uncertainty.landmark",
    numbered(30),
    _NEXT_TITLES,
    rows=_next_rows,
    page=_PAGE,
)
def next_landmark(seed: int) -> tuple[float, float]:
    """Compare the variance that one more landmark removes with that at the best place."""
    rng, sd = np.random.default_rng(seed), 0.3
    m = scipy.ndimage.gaussian_filter(np.exp(rng.normal(size=(_SIZE, _SIZE))), 2)
    c = np.zeros((_SIZE, _SIZE, 2))
    for axis in rng.permutation(2)[: rng.integers(1, 3)]:
        c.swapaxes(0, axis)[0] = 1
    points = rng.uniform(1, _SIZE - 2, (int(rng.integers(1, 5)), 2))
    targets = points + rng.normal(size=points.shape)
    marks = Landmarks(points, targets, sd=sd, scale=_SCALE)
    problem = Problem(observed=0 * c, confidence=c, stiffness=m, landmarks=marks)
    dense, free = posterior_covariance(problem, ElasticPrior(), _SCALE)
    covariance = np.zeros((c.size, c.size))
    covariance[np.ix_(free, free)] = dense
    # Mean over the patch around each site.
    one = (np.abs(np.subtract.outer(np.arange(_SIZE), np.arange(_SIZE))) <= _SIDE // 2) * 1.0
    means = np.kron(np.kron(one, one), np.eye(2))
    means /= means.sum(axis=1, keepdims=True)
    patches = (means @ covariance @ means.T).reshape(_SIZE**2, 2, _SIZE**2, 2)
    removed = np.zeros(_SIZE**2)
    for place in range(_SIZE**2):
        known = patches[place, :, place, :] + sd**2 * np.eye(2)
        shared = patches[:, :, place, :].reshape(-1, 2)
        removed[place] = np.trace(shared @ np.linalg.solve(known, shared.T))
    found = uncertainty(problem, patch=_SIDE, seed=seed, backend="cpu").least_sure()
    best = removed.max()
    return removed[np.ravel_multi_index(found, m.shape)] / best, removed.mean() / best


# Scale of the strain, and agreement with the model.


class LandmarkedTissue:
    """Uniform tissue with random landmarks, and their motion in random fields.

    The first row of 24 x 24 pixels is held, and the last one moved by 4 pixels.

    Parameters
    ----------
    landmarks, seed : int
    """

    grid, sd = (24, 24), 0.1

    def __init__(self, landmarks: int, seed: int) -> None:
        self.rng = np.random.default_rng((seed, landmarks))
        points = self.rng.random((landmarks, 2)) * (np.array(self.grid) - 1)
        marks = Landmarks(points, points, sd=self.sd, scale=_SCALE)
        self._rows = interpolation(points, self.grid)
        bare = self._tissue(1.0)
        self._assumed = direct_solution(bare, _TRUTH).ravel()
        problem = Problem(
            observed=bare.observed,
            confidence=bare.confidence,
            stiffness=bare.stiffness,
            landmarks=marks,
        )
        prior = checked_prior(problem, ElasticPrior(0.3))
        self.energy = energy_of(problem, None)
        self.space = data_space(problem, prior, self.energy, "cpu", None, None)

    def _tissue(self, stiffness: float) -> Problem:
        m = np.ones(self.grid)
        m[7:17, 7:17] = stiffness
        return between_plates(m, (4.0, 1.0))

    def truth(self, stiffness: float = 1.0) -> tuple[Array, Array]:
        """Return the mean and a root of the covariance of the motion, by scikit-fem.

        Parameters
        ----------
        stiffness : float
            Stiffness of a square of 10 x 10 pixels, relative to the tissue around it. The mean is
            relative to that of uniform tissue.
        """
        true = self._tissue(stiffness)
        free, root = _root(true)
        seen = self._rows[:, np.flatnonzero(free)].toarray()
        mean = self._rows @ (direct_solution(true, _TRUTH).ravel() - self._assumed)
        return mean, scipy.linalg.solve_triangular(root, np.sqrt(self.energy) * seen.T, lower=True)

    def draw(
        self,
        truth: tuple[Array, Array],
        strain: float = 1.0,
        noise: float = 1.0,
        outlier: float = 0.0,
    ) -> DataSpace:
        """Return the data space with observations of a random field.

        Parameters
        ----------
        truth : (ndarray, ndarray)
            Result of `truth`.
        strain, noise : float
            Factors on the typical strain and on the standard deviations.
        outlier : float
            Displacement of the first landmark, in standard deviations.
        """
        mean, root = truth
        seen = mean + strain * self.rng.normal(size=len(root)) @ root
        seen += noise * self.sd * self.rng.normal(size=len(seen))
        angle = self.rng.uniform(0, 2 * np.pi)
        seen[:2] += outlier * self.sd * np.array((np.cos(angle), np.sin(angle)))
        return replace(self.space, residual=self.space.basis.T @ seen)


def tissues(draws: int) -> Callable[[Options], Iterator[tuple[str, tuple[int, int, int]]]]:
    """Return cases of 20 sets of 5, 10 and 50 landmarks, each with some draws."""

    def cases(options: Options) -> Iterator[tuple[str, tuple[int, int, int]]]:
        for landmarks in options.choose((5, 10, 50), (5, 10)):
            for seed in range(options.count or options.choose(20, 1)):
                yield f"{landmarks} landmarks, set {seed}", (landmarks, seed, draws)

    return cases


def _scale_rows(results: Results) -> Iterator[list[Any]]:
    for landmarks in dict.fromkeys(n for n, _ in results.values()):
        found = [row for n, own in results.values() if n == landmarks for row in own]
        missing, errors, inside = np.transpose(found)
        yield [
            landmarks,
            f"{missing.mean():.1%}",
            f"{np.median(errors):.0%}",
            f"{inside.mean():.1%} of {len(found)}",
        ]


_SCALE_TITLES = ("landmarks", "interval begins at 0", "median error")
_SCALE_TITLES += ("95 % intervals that contain it",)


@study(
    "uncertainty.scales",
    tissues(50),
    _SCALE_TITLES,
    rows=_scale_rows,
    page=_PAGE,
)
def scales(case: tuple[int, int, int]) -> tuple[int, list[tuple[bool, float, bool]]]:
    """Compare fitted strains with the true one."""
    landmarks, seed, draws = case
    tissue, found = LandmarkedTissue(landmarks, seed), []
    truth, right = tissue.truth(), 2.0
    for _ in range(draws):
        given = Likelihood.of(tissue.draw(truth, right), tissue.energy)
        best = given.most_likely()
        low, high = given.interval(best)
        error = float(abs(np.exp(best) / right - 1))
        found.append((bool(low == 0), error, bool(low <= right <= high)))
    return landmarks, found


# Errors of the model: words, stiffness of the square, and arguments of `LandmarkedTissue.draw`.
_CHANGES: tuple[tuple[str, float, dict[str, float]], ...] = (
    ("nothing", 1.0, {}),
    *((f"one landmark displaced by {k} sd", 1.0, {"outlier": float(k)}) for k in (3, 5, 10)),
    *((f"errors {k:g} times as large", 1.0, {"noise": k}) for k in (1.5, 2.0, 3.0)),
    *((f"strain {k:g} times as large", 1.0, {"strain": k}) for k in (1.5, 2.0)),
    *((f"square {k:.2g} times as stiff", k, {}) for k in (0.1, 1 / 3, 3.0, 10.0)),
)


def _power_tables(results: Results) -> list[Table]:
    counts = dict.fromkeys(landmarks for landmarks, _ in results.values())
    shares = [
        np.mean([own for n, own in results.values() if n == count], axis=0) for count in counts
    ]
    rows = [
        [words, *(f"{share[row, test]:.0%}" for share in shares for test in (0, 1))]
        for row, (words, *_) in enumerate(_CHANGES)
    ]
    titles = (f"{count}: {test}" for count in counts for test in ("all", "one"))
    return [Table(["wrong in the model", *titles], lambda _: rows)]


@study("uncertainty.power", tissues(25), _power_tables, page=_PAGE)
def power(case: tuple[int, int, int]) -> tuple[int, Array]:
    """Count how often tests of landmarks find that the model is wrong, at a level of 5 %."""
    landmarks, seed, draws = case
    tissue, shares = LandmarkedTissue(landmarks, seed), np.zeros((len(_CHANGES), 2))
    truths = {stiffness: tissue.truth(stiffness) for _, stiffness, _ in _CHANGES}
    for row, (_, stiffness, change) in enumerate(_CHANGES):
        for _ in range(draws):
            space = tissue.draw(truths[stiffness], **change)
            agreement = agreement_in(space, tissue.energy, landmarks, 2)
            shares[row, 0] += agreement.p_value < 0.05
            shares[row, 1] += agreement.landmark_p_values.min() < 0.05 / landmarks
    return landmarks, shares / draws


# Fitted properties.

_FITS = {
    "stiffness": "ratios of 0.2 to 10",
    "uniform": "ratios of 1 (homogeneous)",
    "growth": "growth of 0.1 to 0.3",
}
_FIT_TITLES = ("fitted", "median error", "95th percentile", "largest")
_FIT_TITLES += ("95 % intervals that contain it",)


def _fit_rows(results: Results) -> Iterator[list[str]]:
    for kind, words in _FITS.items():
        found = [pair for own in results.values() for pair in own[kind]]
        errors, inside = np.transpose(found)
        cells = (f"{each:.1%}" for each in (*np.percentile(errors, (50, 95)), errors.max()))
        yield [words, *cells, f"{inside.mean():.1%} of {len(found)}"]


@study("uncertainty.fits", numbered(100), _FIT_TITLES, rows=_fit_rows, page=_PAGE)
def fits(seed: int) -> dict[str, list[tuple[float, bool]]]:
    """Compare fitted ratios of stiffness and growth with the true ones."""
    grid, prior = (48, 48), ElasticPrior(0.3)
    ends = (3.0, 1.0)
    errors: dict[str, list[tuple[float, bool]]] = {kind: [] for kind in _FITS}
    rng = np.random.default_rng(seed)
    labels = np.ones(grid, int)
    for label, (row, col) in zip((2, 3, 4), ((5, 5), (5, 28), (28, 15)), strict=True):
        size = rng.integers(10, 15, 2)
        labels[row : row + size[0], col : col + size[1]] = label
    # The homogeneous sample has the same labels.
    for kind in _FITS:
        true = np.ones(5)
        if kind != "uniform":
            true[2:] = 10 ** rng.uniform(-0.7, 1, 3)
        if kind == "growth":
            strain = float(rng.uniform(0.1, 0.3))
            grown = between_plates(true[labels], ends, loads=growth(strain * (labels == 2)))
            field = solve(grown, prior, backend="cpu").displacement
        else:
            field = direct_solution(between_plates(true[labels], ends), _TRUTH)
        seen, sd = noisy(field, 0.05, rng)
        grows = kind == "growth"
        guess = between_plates(true[labels] if grows else np.ones(grid), ends)
        found = fit(
            guess,
            labels,
            measured=seen,
            sd=sd,
            growth=(2,) if grows else (),
            stiffness=() if grows else (2, 3, 4),
            prior=prior,
            backend="cpu",
        )
        for label, value in (found.growth if grows else found.stiffness).items():
            truth = strain if grows else float(true[label])
            within = value.interval[0] < truth < value.interval[1]
            errors[kind].append((abs(value.value / truth - 1), within))
    return errors


# Accuracy of a sample.


def sampled_tissue(options: Options) -> Iterator[tuple[str, tuple[str, str, Array, float]]]:
    """Yield images and volumes in plane strain: size, words, stiffness, Poisson's ratio."""
    for grid in options.choose(((128, 128), (32, 32, 32)), ((32, 32),)):
        rng, size = np.random.default_rng(0), " x ".join(map(str, grid))
        away = np.linalg.norm(np.indices(grid).T - (np.array(grid[::-1]) - 1) / 2, axis=-1).T
        hole, stiff = away < grid[0] / 4, away < grid[0] / 5
        cases = {
            "an inclusion, 5 times as stiff": (np.where(stiff, 5.0, 1.0), 0.45),
            "random pixels, contrast of 1000": (1e3 ** rng.random(grid), 0.45),
            "a hole": (np.where(hole, 0.0, 1.0), 0.45),
            "nearly incompressible": (np.ones(grid), 0.49),
        }
        for words, (m, poisson) in cases.items():
            yield f"{size}, {words}", (size, words, m, poisson)


_ACCURACY_TITLES = ("grid", "tissue", "root mean square error", "largest error", "sd of patches")
_ACCURACY_TITLES += ("with twice the tolerance",)


@study("uncertainty.accuracy", sampled_tissue, _ACCURACY_TITLES, page=_PAGE)
def accuracy(case: tuple[str, str, Array, float]) -> list[str]:
    """Compare samples with those of a solver that is a thousand times more accurate.

    A patch is a quarter of the image wide. The last columns are the regression coefficient of its
    means on those of the exact sample, minus 1: the relative error of their standard deviation, in
    samples with the usual tolerance and with twice this tolerance.
    """
    size, words, m, poisson = case
    held = np.zeros((*m.shape, m.ndim))
    held[0] = 1
    problem = Problem(observed=0 * held, confidence=held, stiffness=m)
    prior = checked_prior(problem, ElasticPrior(poisson, plane="strain"))
    operator = Operator(problem, prior, "cpu")
    noise = PosteriorNoise(problem, prior, energy_of(problem, _SCALE))
    force = noise.force(0, 1)
    exact = operator.solve(force, 3e-5)
    sampler = Sampler(operator, noise, 0)
    sample, other = sampler.deviation(1), operator.solve(force, atol=2 * sampler.tolerance)
    errors = np.linalg.norm(sample - exact, axis=-1)
    width = (*(side // 4 for side in m.shape), 1)
    *found, right = (
        scipy.ndimage.uniform_filter(each, width)[m > 0] for each in (sample, other, exact)
    )
    slope, rougher = (float((means * right).sum() / (right**2).sum()) for means in found)
    sizes = np.linalg.norm(exact, axis=-1)[m > 0]
    relative = np.sqrt((errors[m > 0] ** 2).mean() / (sizes**2).mean())
    largest = errors.max() / np.median(sizes)
    slopes = (f"{slope - 1:+.2%}", f"{rougher - 1:+.2%}")
    return [size, words, f"{relative:.2%}", f"{largest:.1%}", *slopes]


# Time of a brain.


def brain_cases(options: Options) -> dict[str, tuple[Path | None, int]]:
    """Return the volume of the command, or none, with the number of samples."""
    path = options.files[0] if options.files else None
    return {"brain": (path, options.count or 30)}


def _brain(path: Path | None) -> Problem:
    """Return uniform tissue with a held surface: the voxels above 0 of an image, or an ellipsoid.

    The ellipsoid has the number of voxels of an average brain at 1 mm.
    """
    if path is None:
        grid, sides = (189, 233, 197), (149, 174, 139)
        middle = (np.array(grid) - 1) / 2
        from_middle = (np.indices(grid).T - middle) / (np.array(sides) / 2)
        tissue = (from_middle**2).sum(axis=-1).T < 1
    else:
        tissue = read_image(path).pixels > 0
    held = np.zeros((*tissue.shape, 3))
    held[tissue & ~scipy.ndimage.binary_erosion(tissue)] = 1
    return Problem(observed=0 * held, confidence=held, stiffness=1.0 * tissue)


@study("uncertainty.brain", brain_cases, ("figure", "value"), page=_PAGE, on_request=True)
def brain(case: tuple[Path | None, int]) -> list[list[str]]:
    """Time the samples of a brain, beside a solve and a copy of memory."""
    path, count = case
    problem = _brain(path)
    pulled = problem.observed.copy()
    pulled[problem.known] = 1
    solve(problem, backend="cpu")  # loads the compiled loops
    moved = Problem(observed=pulled, confidence=problem.confidence, stiffness=problem.stiffness)
    solved = timed(lambda: solve(moved, backend="cpu"))[1].wall
    values = np.ones(1 << 27, np.float32)
    copies = [_copied(values)]
    marks = [now()]
    uncertainty(
        problem,
        n=count,
        backend="cpu",
        progress=lambda _: marks.append(now()),
    )
    copies.append(_copied(values))
    (setup, *samples), (work, *works) = np.diff(np.transpose(marks))
    one, work_of_one = np.median(samples), np.median(works)
    return [
        ["grid", " x ".join(map(str, problem.shape))],
        ["voxels of tissue", f"{int(problem.tissue.sum()):,}"],
        ["setup", f"{setup:.1f} s"],
        ["one sample", f"{one:.2f} s ({min(samples):.2f} to {max(samples):.2f})"],
        [f"all, for {count} samples", f"{setup + sum(samples):.1f} s"],
        ["processor time of the setup, of all cores", f"{work:.1f} s"],
        ["processor time of one sample", f"{work_of_one:.2f} s"],
        [f"processor time of all, for {count} samples", f"{work + sum(works):.1f} s"],
        ["a solve after a change of the motion", f"{solved:.2f} s"],
        ["speed of a copy, before and after", f"{copies[0]:.1f}, {copies[1]:.1f} GB/s"],
    ]


def _copied(values: npt.NDArray[np.float32]) -> float:
    """Return the speed of a copy on one thread, read and written, in GB/s."""
    return 2e-9 * values.nbytes / fastest(values.copy, 3)[1].wall

"""Uncertainty: standard deviations beside dense posteriors, and coverage of intervals.

    python -m benchmarks.uncertainty [samples] [coverage] [landmark] [scales] [power] [fits]
                                     [maps] [accuracy] [--problems 2000]
    python -m benchmarks.uncertainty brain [--image FILE] [--samples 30]

`samples` compares standard deviations of 30, 300 and 3000 samples with those of dense inverse
matrices: contrast to 1000, tensors, landmarks, void, long pixels, images and volumes. `coverage`
draws the true motion of random tissue from a matrix that scikit-fem assembled, observes it with
noise, and counts how often the intervals of 68 % and 95 % contain it. `landmark` compares one more
landmark at the least sure patch with one at the best and at any place. `scales` fits the typical
strain to such landmarks, and `power` counts how often a test of their agreement with the model
finds that the model is wrong. `fits` finds the stiffness and the growth of labels from the motion
that scikit-fem computed, with noise of 5 %, and `maps` two inclusions whose places are unknown.
`accuracy` compares samples with those of a solver that is a thousand times more accurate. `brain`
prints the time of `uncertainty` for an MRI of a brain without its skull, or for an ellipsoid of the
same size, beside the time of a solve and the speed of memory; it takes minutes, and runs only if
named. ``python benchmarks/speed.py sample`` measures the time of a sample.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy

from benchmarks.clock import timed
from napari_hmrf import ElasticPrior, Problem, solve
from napari_hmrf.io.images import read_image
from napari_hmrf.landmarks import Landmarks, StrainScale
from napari_hmrf.loads import growth
from napari_hmrf.posterior import fit, sample_posterior, stiffness_map, uncertainty
from napari_hmrf.posterior.agreement import agreement_in
from napari_hmrf.posterior.data_space import DataSpace, data_space
from napari_hmrf.posterior.noise import PosteriorNoise
from napari_hmrf.posterior.response import Response
from napari_hmrf.posterior.sampling import Sampler, checked_prior, energy_of
from napari_hmrf.posterior.scale_fit import Likelihood
from validation.oracles.elasticity import direct_solution, stiffness_matrix
from validation.oracles.posterior import interpolation, posterior_covariance

Array = npt.NDArray[np.float64]
_SCALE = StrainScale(0.1)
# Tissue of the true motion.
_TRUTH = ElasticPrior(0.3)
_COUNTS = (30, 300, 3000)
_TABLES = ("samples", "coverage", "landmark", "scales", "power", "fits", "maps")
_TABLES += ("accuracy",)
# Quantiles of the normal distribution for 68 % and 95 %.
_BOUNDS = {68: 0.9945, 95: 1.96}


def _random(seed: int) -> tuple[str, Problem]:
    """Return a random problem with a data term, and its description."""
    rng = np.random.default_rng(seed)
    grid, spacing = (
        ((14, 14), (1.0, 1.0)),
        ((14, 14), (1.0, 3.0)),
        ((6, 6, 6), (1.0, 1.0, 1.0)),
        ((6, 6, 6), (2.0, 1.0, 1.0)),
    )[seed % 4]
    axes, contrast = len(grid), (1.0, 1e3)[seed // 4 % 2]
    m = contrast ** rng.random(grid)
    c = np.zeros((*grid, axes))
    kind = ("held", "tensors", "landmarks")[seed // 8 % 3]
    precision, marks = None, None
    if kind != "landmarks":
        m[(slice(2, 4),) * axes] = 0
        c[0] = 1
    energy = _SCALE.energy(m, spacing)
    if kind == "tensors":
        factors = rng.normal(size=(*grid, axes, axes))
        precision = factors @ factors.swapaxes(-1, -2) * (rng.random(grid) < 0.1)[..., None, None]
        precision *= energy / 0.3**2
    if kind == "landmarks":
        points = rng.random((8, axes)) * (np.array(grid) - 1)
        marks = Landmarks(points, points, sd=10 ** rng.uniform(-1, 0.5), scale=_SCALE)
    observed = np.zeros_like(c)
    problem = Problem(
        observed=observed,
        confidence=c,
        stiffness=m,
        spacing=spacing,
        precision=precision,
        landmarks=marks,
    )
    return f"{grid}, spacing {spacing}, contrast {contrast:g}, {kind}", problem


def samples(count: int = 24) -> None:
    """Print the variance of samples relative to that of dense inverse matrices.

    The theoretical error of the mean variance follows from the whole covariance: neighbouring sites
    move together, and their variances are not independent.
    """
    print("| problem | samples | error of the mean variance | its theoretical sd | ratio |")
    print("| --- | --- | --- | --- | --- |")
    scores = []
    for seed in range(count):
        words, problem = _random(seed)
        covariance, free = posterior_covariance(problem, ElasticPrior(), _SCALE)
        variance = np.diag(covariance)
        correlation = covariance / np.sqrt(np.outer(variance, variance))
        squares = np.zeros(len(variance))
        drawn = sample_posterior(problem, n=_COUNTS[-1], scale=_SCALE, seed=seed, backend="cpu")
        for number, field in enumerate(drawn, start=1):
            squares += field.ravel()[free].astype(np.float64) ** 2
            if number in _COUNTS:
                error = float((squares / number / variance).mean() - 1)
                theory = np.sqrt(2 * (correlation**2).mean() / number)
                scores.append(error / theory)
                print(f"| {words} | {number} | {error:+.4f} | {theory:.4f} | {scores[-1]:+.2f} |")
    rms = float(np.sqrt(np.mean(np.square(scores))))
    largest = float(np.abs(scores).max())
    print(f"ratios: root mean square {rms:.2f} (1 in theory), largest {largest:.2f}")


def coverage(count: int = 2000) -> None:
    """Print how often intervals contain the true motion of patches and labels."""
    kinds = ("label", "label along its motion", "label, of its true length", "patch")
    inside = {(what, percent): 0 for what in kinds for percent in _BOUNDS}
    total = dict.fromkeys(kinds, 0)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        grid = tuple(int(size) for size in rng.integers(8, 15, 2))
        spacing = (1.0, float(rng.choice([1.0, 2.0])))
        m = 10 ** rng.uniform(0, 2) ** rng.random(grid)
        c = np.zeros((*grid, 2))
        c[0] = 1
        bare = Problem(observed=np.zeros_like(c), confidence=c, stiffness=m, spacing=spacing)
        energy = _SCALE.energy(bare.stiffness, spacing)
        # The truth is a sample of the prior, by another assembly of the elements.
        free = (c == 0).ravel()
        root = np.linalg.cholesky(stiffness_matrix(bare, _TRUTH).toarray()[np.ix_(free, free)])
        truth = np.zeros(c.size)
        truth[free] = np.sqrt(energy) * np.linalg.solve(root.T, rng.normal(size=free.sum()))
        points = rng.random((int(rng.integers(1, 7)), 2)) * (np.array(grid) - 1)
        sd = float(10 ** rng.uniform(-1, 0.5))
        seen = (interpolation(points, grid) @ truth).reshape(-1, 2)
        seen += sd * rng.normal(size=seen.shape)
        marks = Landmarks(points, points + seen / spacing, sd=sd, scale=_SCALE)
        problem = Problem(
            observed=0 * c, confidence=c, stiffness=m, spacing=spacing, landmarks=marks
        )
        labels = np.zeros(grid, int)
        labels[-4:, -4:], labels[3:5, 3:5] = 1, 2
        result = uncertainty(
            problem, ElasticPrior(0.3), labels=labels, patch=3.0, seed=seed, backend="cpu"
        )
        field = truth.reshape(*grid, 2)
        for number, found in result.labels.items():
            errors = np.abs(field[labels == number].mean(axis=0) - found.mean) / found.sd
            total["label"] += errors.size
            for percent, bound in _BOUNDS.items():
                inside["label", percent] += int((errors < bound).sum())
            moved = field[labels == number]
            likely = result.solution.displacement[labels == number].astype(np.float64)
            ways = likely / np.linalg.norm(likely, axis=-1, keepdims=True)
            for what, true in (
                ("label along its motion", (moved * ways).sum(axis=-1).mean()),
                ("label, of its true length", np.linalg.norm(moved, axis=-1).mean()),
            ):
                total[what] += 1
                for percent, bound in _BOUNDS.items():
                    inside[what, percent] += int(abs(true - found.length) < bound * found.along)
        row, col = grid[0] - 3, int(rng.integers(2, grid[1] - 2))
        width = 1 if spacing[1] == 1 else 0
        around = (slice(row - 1, row + 2), slice(col - width, col + width + 1))
        mean, known = (
            each[around].mean(axis=(0, 1)) for each in (field, result.solution.displacement)
        )
        errors = np.abs(mean - known) / result.sd[row, col]
        total["patch"] += errors.size
        for percent, bound in _BOUNDS.items():
            inside["patch", percent] += int((errors < bound).sum())
    print("| what | interval | contains the truth | of |")
    print("| --- | --- | --- | --- |")
    for (what, percent), number in inside.items():
        share = 100 * number / total[what]
        print(f"| mean of a {what} | {percent} % | {share:.1f} % | {total[what]} |")


class _Landmarked:
    """Uniform tissue with random landmarks, and their motion in random fields.

    The first row of 24 x 24 pixels is held, and the last one moved by 4 pixels.

    Parameters
    ----------
    landmarks, seed : int
    """

    grid, sd = (24, 24), 0.1

    def __init__(self, landmarks: int, seed: int) -> None:
        self.rng = np.random.default_rng((seed, landmarks))
        self._observed, self._confidence = np.zeros((2, *self.grid, 2))
        self._confidence[[0, -1]], self._observed[-1] = 1, (4, 1)
        points = self.rng.random((landmarks, 2)) * (np.array(self.grid) - 1)
        marks = Landmarks(points, points, sd=self.sd, scale=_SCALE)
        self._rows = interpolation(points, self.grid)
        self._assumed = direct_solution(self._tissue(1.0), _TRUTH).ravel()
        problem = Problem(
            observed=self._observed,
            confidence=self._confidence,
            stiffness=np.ones(self.grid),
            landmarks=marks,
        )
        prior = checked_prior(problem, ElasticPrior(0.3))
        self.energy = energy_of(problem, None)
        self.space = data_space(problem, prior, self.energy, "cpu", None, None)

    def _tissue(self, stiffness: float) -> Problem:
        m = np.ones(self.grid)
        m[7:17, 7:17] = stiffness
        return Problem(observed=self._observed, confidence=self._confidence, stiffness=m)

    def truth(self, stiffness: float = 1.0) -> tuple[Array, Array]:
        """Return the mean and a root of the covariance of the motion, by scikit-fem.

        Parameters
        ----------
        stiffness : float
            Stiffness of a square of 10 x 10 pixels, relative to the tissue around it. The mean is
            relative to that of uniform tissue.
        """
        true, free = self._tissue(stiffness), (self._confidence == 0).ravel()
        root = np.linalg.cholesky(stiffness_matrix(true, _TRUTH).toarray()[np.ix_(free, free)])
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


_COUNTS_OF_LANDMARKS = (5, 10, 50)


def scales(tissues: int = 20, draws: int = 50) -> None:
    """Print the errors of fitted strains and factors on errors, and the coverage of intervals."""
    print(
        "| landmarks | fitted | interval begins at 0 | median error "
        "| 95 % intervals that contain it |"
    )
    print("| --- | --- | --- | --- | --- |")
    for landmarks in _COUNTS_OF_LANDMARKS:
        for noise in (False, True):
            errors: dict[str, list[float]] = {"strain": [], "errors": []}
            inside = dict.fromkeys(errors, 0)
            missing, total = dict.fromkeys(errors, 0), 0
            for seed in range(tissues):
                tissue = _Landmarked(landmarks, seed)
                truth = tissue.truth()
                for _ in range(draws // 5 if noise else draws):
                    true = tissue.rng.uniform(0.5, 2, 2) if noise else (2.0, 1.0)
                    given = Likelihood.of(tissue.draw(truth, *true), tissue.energy, noise)
                    best = given.most_likely()
                    found: dict[str, tuple[float, Callable[[float], float]]] = {
                        "strain": (best, given.profile_strain)
                    }
                    if noise:
                        found["errors"] = given.noise_at(best), given.profile_noise
                    total += 1
                    for (what, (value, profile)), right in zip(found.items(), true, strict=False):
                        low, high = given.interval(profile, value)
                        inside[what] += low <= right <= high
                        missing[what] += low == 0
                        errors[what].append(abs(np.exp(value) / right - 1))
            for what in ("strain", "errors")[: 1 + noise]:
                both = ", with the errors" if noise and what == "strain" else ""
                print(
                    f"| {landmarks} | {what}{both} | {missing[what] / total:.1%} "
                    f"| {np.median(errors[what]):.0%} | {inside[what] / total:.1%} of {total} |"
                )


# Errors of the model: words, stiffness of the square, and arguments of `_Landmarked.draw`.
_CHANGES: tuple[tuple[str, float, dict[str, float]], ...] = (
    ("nothing", 1.0, {}),
    *((f"one landmark displaced by {k} sd", 1.0, {"outlier": float(k)}) for k in (3, 5, 10)),
    *((f"errors {k:g} times as large", 1.0, {"noise": k}) for k in (1.5, 2.0, 3.0)),
    *((f"strain {k:g} times as large", 1.0, {"strain": k}) for k in (1.5, 2.0)),
    *((f"square {k:.2g} times as stiff", k, {}) for k in (0.1, 1 / 3, 3.0, 10.0)),
)


def power(tissues: int = 20, draws: int = 25) -> None:
    """Print how often tests of landmarks find that the model is wrong, at a level of 5 %."""
    counts = len(_COUNTS_OF_LANDMARKS)
    found = np.zeros((len(_CHANGES), 2 * counts))
    for column, landmarks in enumerate(_COUNTS_OF_LANDMARKS):
        for seed in range(tissues):
            tissue = _Landmarked(landmarks, seed)
            truths = {stiffness: tissue.truth(stiffness) for _, stiffness, _ in _CHANGES}
            for row, (_, stiffness, change) in enumerate(_CHANGES):
                for _ in range(draws):
                    space = tissue.draw(truths[stiffness], **change)
                    agreement = agreement_in(space, tissue.energy, landmarks, 2)
                    least = agreement.landmark_p_values.min()
                    found[row, 2 * column] += agreement.p_value < 0.05
                    found[row, 2 * column + 1] += least < 0.05 / landmarks
    heads = (f"{n} landmarks: {test}" for n in _COUNTS_OF_LANDMARKS for test in ("all", "one"))
    print(f"| wrong in the model | {' | '.join(heads)} |")
    print("| --- |" + " --- |" * 2 * counts)
    for (words, _, _), shares in zip(_CHANGES, found / (tissues * draws), strict=True):
        print(f"| {words} | {' | '.join(f'{share:.0%}' for share in shares)} |")


def next_landmark(count: int = 30) -> None:
    """Print how much of the variance of all patches one more landmark removes, by its place."""
    side, sd, size = 3, 0.3, 16
    shares: list[tuple[float, float]] = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        m = scipy.ndimage.gaussian_filter(np.exp(rng.normal(size=(size, size))), 2)
        c = np.zeros((size, size, 2))
        for axis in rng.permutation(2)[: rng.integers(1, 3)]:
            c.swapaxes(0, axis)[0] = 1
        points = rng.uniform(1, size - 2, (int(rng.integers(1, 5)), 2))
        targets = points + rng.normal(size=points.shape)
        marks = Landmarks(points, targets, sd=sd, scale=_SCALE)
        problem = Problem(observed=0 * c, confidence=c, stiffness=m, landmarks=marks)
        dense, free = posterior_covariance(problem, ElasticPrior(), _SCALE)
        covariance = np.zeros((c.size, c.size))
        covariance[np.ix_(free, free)] = dense
        # Mean over the patch around each site.
        one = (np.abs(np.subtract.outer(np.arange(size), np.arange(size))) <= side // 2) * 1.0
        means = np.kron(np.kron(one, one), np.eye(2))
        means /= means.sum(axis=1, keepdims=True)
        patches = (means @ covariance @ means.T).reshape(size**2, 2, size**2, 2)
        removed = np.zeros(size**2)
        for place in range(size**2):
            known = patches[place, :, place, :] + sd**2 * np.eye(2)
            shared = patches[:, :, place, :].reshape(-1, 2)
            removed[place] = np.trace(shared @ np.linalg.solve(known, shared.T))
        found = uncertainty(problem, patch=side, seed=seed, backend="cpu").least_sure()
        best = removed.max()
        shares.append((removed[np.ravel_multi_index(found, m.shape)] / best, removed.mean() / best))
    print("| place of one more landmark | mean | 10th percentile |")
    print("| --- | --- | --- |")
    for name, values in zip(("least sure patch", "any"), np.transpose(shares), strict=True):
        print(f"| {name} | {values.mean():.0%} | {np.quantile(values, 0.1):.0%} |")


def fits(count: int = 100) -> None:
    """Print the errors of fitted ratios of stiffness and growth, and the coverage of intervals."""
    grid, prior = (48, 48), ElasticPrior(0.3)
    errors: dict[str, list[float]] = {"stiffness": [], "uniform": [], "growth": []}
    inside = dict.fromkeys(errors, 0)
    held, moved = np.zeros((2, *grid, 2))
    held[[0, -1]], moved[-1] = 1, (3, 1)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        labels = np.ones(grid, int)
        for label, (row, col) in zip((2, 3, 4), ((5, 5), (5, 28), (28, 15)), strict=True):
            size = rng.integers(10, 15, 2)
            labels[row : row + size[0], col : col + size[1]] = label
        # The homogeneous sample has the same labels.
        for kind in ("stiffness", "uniform", "growth"):
            true = np.ones(5)
            if kind != "uniform":
                true[2:] = 10 ** rng.uniform(-0.7, 1, 3)
            problem = Problem(observed=moved, confidence=held, stiffness=true[labels])
            if kind == "growth":
                strain = float(rng.uniform(0.1, 0.3))
                problem = Problem(
                    observed=moved,
                    confidence=held,
                    stiffness=true[labels],
                    loads=growth(strain * (labels == 2)),
                )
                field = solve(problem, prior, backend="cpu").displacement
            else:
                field = direct_solution(problem, _TRUTH)
            sd = 0.05 * float(np.sqrt((field**2).mean()))
            seen = field + rng.normal(0, sd, field.shape)
            guess = Problem(
                observed=moved,
                confidence=held,
                stiffness=np.ones(grid) if kind != "growth" else true[labels],
            )
            grows = kind == "growth"
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
                errors[kind].append(abs(value.value / truth - 1))
                inside[kind] += value.interval[0] < truth < value.interval[1]
    print("| fitted | median error | 95th percentile | largest | 95 % intervals that contain it |")
    print("| --- | --- | --- | --- | --- |")
    names = ("ratios of 0.2 to 10", "ratios of 1 (homogeneous)", "growth of 0.1 to 0.3")
    for name, (kind, found_errors) in zip(names, errors.items(), strict=True):
        middle, most = np.percentile(found_errors, (50, 95))
        share = inside[kind] / len(found_errors)
        print(
            f"| {name} | {middle:.1%} | {most:.1%} | {max(found_errors):.1%} | {share:.1%} of "
            f"{len(found_errors)} |"
        )


def maps(count: int = 10) -> None:
    """Print the contrast and the outline of two inclusions in maps of the stiffness."""
    size, prior = 64, ElasticPrior(0.3)
    rows, cols = np.indices((size, size))
    held, moved = np.zeros((2, size, size, 2))
    held[[0, -1]], moved[-1, :, 0] = 1, -2
    print("| seed | contrast (3 in truth) | outline: mean, largest distance (px) | pieces |")
    print("| --- | --- | --- | --- |")
    for seed in range(count):
        rng = np.random.default_rng(seed)
        inside = np.zeros((size, size), bool)
        for row, col in ((22, 20), (42, 44)):
            middle = rng.uniform(-3, 3, 2) + np.array((row, col))
            inside |= np.hypot(rows - middle[0], cols - middle[1]) < rng.uniform(7, 10)
        field = direct_solution(
            Problem(observed=moved, confidence=held, stiffness=np.where(inside, 3.0, 1.0)), _TRUTH
        )
        sd = 0.05 * float(np.sqrt((field**2).mean()))
        seen = field + rng.normal(0, sd, field.shape)
        guess = Problem(observed=moved, confidence=held, stiffness=np.ones((size, size)))
        found = stiffness_map(guess, seen, sd=sd, prior=prior, backend="cpu")
        ratios = found.stiffness / np.median(found.stiffness[~inside])
        stiff = ratios > np.sqrt(3)
        distances = []
        for one, other in ((stiff, inside), (inside, stiff)):
            away = scipy.ndimage.distance_transform_edt(~_outline(other))
            distances.append(away[_outline(one)])
        apart = np.concatenate(distances)
        pieces = scipy.ndimage.label(stiff)[1]
        print(
            f"| {seed} | {np.median(ratios[inside]):.2f} | {apart.mean():.2f}, {apart.max():.1f} "
            f"| {pieces} |"
        )


def _outline(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return the outermost pixels of a mask."""
    return np.asarray(mask & ~scipy.ndimage.binary_erosion(mask))


def accuracy() -> None:
    """Print the error that the solver leaves in a sample, and in means over large patches.

    A patch is a quarter of the image wide. The last columns are the regression coefficient of its
    means on those of the exact sample, minus 1: the relative error of their standard deviation, in
    samples with the usual tolerance and with twice this tolerance.
    """
    print(
        "| grid | tissue | root mean square error | largest error | sd of patches "
        "| with twice the tolerance |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for grid in ((128, 128), (32, 32, 32)):
        rng, held = np.random.default_rng(0), np.zeros((*grid, len(grid)))
        held[0] = 1
        away = np.linalg.norm(np.indices(grid).T - (np.array(grid[::-1]) - 1) / 2, axis=-1).T
        hole, stiff = away < grid[0] / 4, away < grid[0] / 5
        cases = {
            "an inclusion, 5 times as stiff": (np.where(stiff, 5.0, 1.0), 0.45),
            "random pixels, contrast of 1000": (1e3 ** rng.random(grid), 0.45),
            "a hole": (np.where(hole, 0.0, 1.0), 0.45),
            "nearly incompressible": (np.ones(grid), 0.49),
        }
        size = " x ".join(map(str, grid))
        for words, (m, poisson) in cases.items():
            problem, prior = (
                Problem(observed=0 * held, confidence=held, stiffness=m),
                ElasticPrior(poisson, plane="strain"),
            )
            prior = checked_prior(problem, prior)
            response = Response(problem, prior, "cpu")
            noise = PosteriorNoise(problem, prior, energy_of(problem, _SCALE))
            force = noise.force(0, 1)
            exact = response.to(force, 1e-3 * response.tolerance_for(force))
            sampler = Sampler(response, noise, 0)
            sample, other = sampler.deviation(1), response.to(force, 2 * sampler.tolerance)
            errors = np.linalg.norm(sample - exact, axis=-1)
            width = (*(side // 4 for side in grid), 1)
            *found, right = (
                scipy.ndimage.uniform_filter(each, width)[m > 0] for each in (sample, other, exact)
            )
            slope, rougher = (float((means * right).sum() / (right**2).sum()) for means in found)
            sizes = np.linalg.norm(exact, axis=-1)[m > 0]
            relative = np.sqrt((errors[m > 0] ** 2).mean() / (sizes**2).mean())
            largest = errors.max() / np.median(sizes)
            print(
                f"| {size} | {words} | {relative:.2%} | {largest:.1%} | {slope - 1:+.2%} "
                f"| {rougher - 1:+.2%} |"
            )


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


def brain(path: Path | None, count: int) -> None:
    """Print the time of the samples of a brain, beside that of a solve and of a copy."""
    problem = _brain(path)
    pulled = problem.observed.copy()
    pulled[problem.known] = 1
    solve(problem, backend="cpu")  # loads the compiled loops
    moved = Problem(observed=pulled, confidence=problem.confidence, stiffness=problem.stiffness)
    solved = timed(lambda: solve(moved, backend="cpu"))[1].wall
    values = np.ones(1 << 27, np.float32)
    copies = [_copied(values)]
    marks = [(time.perf_counter(), time.process_time())]
    uncertainty(
        problem,
        n=count,
        backend="cpu",
        progress=lambda _: marks.append((time.perf_counter(), time.process_time())),
    )
    copies.append(_copied(values))
    (setup, *samples), (work, *works) = np.diff(np.transpose(marks))
    print("| figure | value |")
    print("| --- | --- |")
    print(f"| grid | {' x '.join(map(str, problem.shape))} |")
    print(f"| voxels of tissue | {int(problem.tissue.sum()):,} |")
    print(f"| setup | {setup:.1f} s |")
    print(f"| one sample | {np.median(samples):.2f} s ({min(samples):.2f} to {max(samples):.2f}) |")
    print(f"| all, for {count} samples | {setup + sum(samples):.1f} s |")
    print(f"| processor time of the setup, of all cores | {work:.1f} s |")
    print(f"| processor time of one sample | {np.median(works):.2f} s |")
    print(f"| processor time of all, for {count} samples | {work + sum(works):.1f} s |")
    print(f"| a solve after a change of the motion | {solved:.2f} s |")
    print(f"| speed of a copy, before and after | {copies[0]:.1f}, {copies[1]:.1f} GB/s |")


def _copied(values: npt.NDArray[np.float32]) -> float:
    """Return the speed of a copy on one thread, read and written, in GB/s."""
    return 2e-9 * values.nbytes / min(timed(values.copy)[1].wall for _ in range(3))


def main() -> None:
    """Print the chosen tables, or all except `brain`."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("tables", nargs="*", choices=[*_TABLES, "brain", []])
    parser.add_argument("--problems", type=int, default=2000, help="random problems of `coverage`")
    parser.add_argument("--image", type=Path, help="volume for `brain`; tissue is above 0")
    parser.add_argument("--samples", type=int, default=30, help="number of samples of `brain`")
    given = parser.parse_args()
    tables: dict[str, Callable[[], None]] = {
        "samples": samples,
        "coverage": partial(coverage, given.problems),
        "landmark": next_landmark,
        "scales": scales,
        "power": power,
        "fits": fits,
        "maps": maps,
        "accuracy": accuracy,
        "brain": partial(brain, given.image, given.samples),
    }
    for name in given.tables or _TABLES:
        tables[name]()


if __name__ == "__main__":
    main()

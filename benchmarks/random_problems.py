"""Random problems for `trust.py`: typical problems of users, and unusual problems.

Problem k of a seed depends only on NumPy's generator, so each problem can be generated separately.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.ndimage as ndi

from napari_hmrf import ElasticPrior, Problem, SeilerPrior

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Shape = tuple[int, int]

LARGEST = 64
#: Number of decades of the largest contrast of stiffness.
DECADES = 7
# Range of decades of the unit of stiffness; units and pixel sizes are arbitrary.
_UNITS = (-3.0, 6.0)


@dataclass(frozen=True, eq=False)
class RandomProblem:
    """Problem and its kind.

    Attributes
    ----------
    number : int
        Number of the problem.
    observed, confidence, stiffness, spacing
        Arguments of `Problem`.
    prior : ElasticPrior or SeilerPrior
        Prior of the tissue.
    tolerance : float
        Tolerance of `Multigrid`.
    reading : str
        Name of the energy, and whether observations are prescribed or may slip.
    tissue, void, seen, moved : str
        Kinds of stiffness, void, observed sites and displacement.
    contrast : float
        Ratio of the largest to the smallest stiffness.
    """

    number: int
    observed: Array
    confidence: Array
    stiffness: Array
    spacing: tuple[float, float]
    prior: ElasticPrior | SeilerPrior
    tolerance: float
    reading: str
    tissue: str
    void: str
    seen: str
    moved: str
    contrast: float

    @functools.cached_property
    def problem(self) -> Problem:
        """Problem as accepted by the package."""
        return Problem(
            observed=self.observed,
            confidence=self.confidence,
            stiffness=self.stiffness,
            spacing=self.spacing,
        )

    @property
    def words(self) -> str:
        """Description of the problem in one line."""
        size = " x ".join(map(str, self.stiffness.shape))
        pixel = "" if len(set(self.spacing)) == 1 else f", pixel {_ratio(self.spacing)}"
        nu = ""
        if isinstance(self.prior, ElasticPrior):
            mapped = isinstance(self.prior.poisson, np.ndarray)
            nu = ", nu mapped" if mapped else f", nu {self.prior.poisson:.3g}"
        penalty = self.prior.penalty
        held = "" if penalty in (None, math.inf) else f", K {penalty:.2g}"
        return (
            f"{size}{pixel}, {self.tissue} 1:{self.contrast:.2g}, void {self.void}, "
            f"{self.seen} {self.moved}{nu}{held}, tolerance {self.tolerance:g}"
        )


def random_problem(seed: int, number: int) -> RandomProblem:
    """Return problem `number` of a seed."""
    dice = np.random.default_rng([seed, number])
    shape = _shape(dice)
    ratio = 1.0 if dice.random() < 0.5 else 10 ** dice.uniform(-1, 1)
    size = 1.0 if dice.random() < 0.5 else 10 ** dice.uniform(-2, 2)
    spacing = (size * math.sqrt(ratio), size / math.sqrt(ratio)) if ratio != 1 else (size, size)
    tissue, relative = _stiffness(dice, shape)
    void, empty = _void(dice, shape)
    m = np.where(empty, 0.0, relative * 10 ** dice.uniform(*_UNITS)).astype(np.float32)
    seen, observed = _observed(dice, m > 0)
    moved, y = _displacement(dice, shape, observed.any(axis=-1))
    # Limit displacements to less than half the image, because `Problem` refuses much larger ones.
    across = math.hypot(shape[0] * spacing[0], shape[1] * spacing[1])
    largest = min(10 ** dice.uniform(-1, 0.9) * math.sqrt(math.prod(spacing)), 0.4 * across)
    y *= largest / max(float(np.abs(y).max()), 1e-9)
    c = np.where(observed, _confidence(dice, observed.shape), 0.0)
    prior, reading = _prior(dice, shape)
    body = m[m > 0]
    return RandomProblem(
        number=number,
        observed=y,
        confidence=c,
        stiffness=m,
        spacing=spacing,
        prior=prior,
        tolerance=float(dice.choice([1e-3, 1e-2, 1e-4], p=[0.8, 0.1, 0.1])),
        reading=reading,
        tissue=tissue,
        void=void,
        seen=seen,
        moved=moved,
        contrast=float(body.max() / body.min()),
    )


def _ratio(spacing: tuple[float, float]) -> str:
    return f"{spacing[0] / spacing[1]:.2g}:1"


def _shape(dice: np.random.Generator) -> Shape:
    kind = dice.choice(["any", "strip", "large", "tiny"], p=[0.6, 0.2, 0.08, 0.12])
    if kind == "strip":
        sides = [int(dice.integers(1, 5)), int(dice.integers(8, LARGEST + 1))]
        dice.shuffle(sides)
    elif kind == "large":
        sides = list(dice.integers(40, LARGEST + 1, 2))
    elif kind == "tiny":
        sides = list(dice.integers(1, 6, 2))
    else:
        sides = [int(2 ** dice.uniform(1, math.log2(LARGEST))) for _ in range(2)]
    rows, cols = int(sides[0]), int(sides[1])
    return (rows, cols) if rows * cols > 1 else (2, 2)


def noise(dice: np.random.Generator, shape: Shape, width: float) -> Array:
    """Return smooth noise, evenly distributed from 0 to 1."""
    values = ndi.gaussian_filter(dice.normal(size=shape), width, mode="reflect")
    made = np.empty(values.size)
    made[np.argsort(values, axis=None)] = np.linspace(0, 1, values.size)
    return made.reshape(shape)


def _stiffness(dice: np.random.Generator, shape: Shape) -> tuple[str, Array]:
    """Return the kind of stiffness, and stiffness from 1 to a random contrast."""
    contrast = 10 ** dice.uniform(0, DECADES)
    rows, cols = np.indices(shape)
    kind = str(
        dice.choice(
            ["uniform", "blobs", "white", "smooth", "layers", "fibres", "board", "mixed"],
            p=[0.12, 0.22, 0.1, 0.08, 0.12, 0.16, 0.1, 0.1],
        )
    )
    if kind == "uniform":
        share = np.zeros(shape)
    elif kind == "blobs":
        share = 1.0 * (noise(dice, shape, dice.uniform(0.6, 6)) > dice.uniform(0.15, 0.85))
    elif kind == "white":
        share = dice.random(shape)
    elif kind == "smooth":
        share = noise(dice, shape, dice.uniform(2, 8))
    elif kind == "layers":
        along = [rows, cols, rows + cols][dice.integers(3)]
        levels = dice.integers(2, 5)
        share = (along // dice.integers(1, 9)) % levels / (levels - 1)
    elif kind == "fibres":
        share = _fibres(dice, shape)
    elif kind == "board":
        size = dice.integers(1, 5)
        share = 1.0 * ((rows // size + cols // size) % 2)
    else:
        share = np.round(noise(dice, shape, dice.uniform(0.6, 4)) * 3) / 3
    if dice.random() < 0.3:
        share = 1 - share
    return kind, np.asarray(contrast**share)


def _fibres(dice: np.random.Generator, shape: Shape) -> Array:
    """Return a mask of a few straight lines, one to three pixels wide."""
    rows, cols = np.indices(shape)
    share = np.zeros(shape)
    for _ in range(dice.integers(1, 7)):
        turn, place = dice.uniform(0, math.pi), dice.random(2) * shape
        off = (rows - place[0]) * math.cos(turn) + (cols - place[1]) * math.sin(turn)
        share[np.abs(off) < dice.choice([0.5, 1.0, 1.5])] = 1
    return share


def _void(dice: np.random.Generator, shape: Shape) -> tuple[str, Flags]:
    rows, cols = np.indices(shape)
    kind = str(
        dice.choice(["none", "holes", "around", "specks", "gaps"], p=[0.55, 0.13, 0.14, 0.08, 0.1])
    )
    empty = np.zeros(shape, dtype=bool)
    if kind == "holes":
        empty = noise(dice, shape, dice.uniform(0.6, 4)) < dice.uniform(0.05, 0.4)
    elif kind == "around":
        height, width = shape
        across = ((rows + 0.5) / height - 0.5) ** 2 + ((cols + 0.5) / width - 0.5) ** 2
        empty = across > dice.uniform(0.18, 0.35)
    elif kind == "specks":
        empty = dice.random(shape) < dice.uniform(0.01, 0.2)
    elif kind == "gaps":
        empty = _fibres(dice, shape) > 0
    if empty.all():
        empty[...] = False
    return kind if empty.any() else "none", empty


def _observed(dice: np.random.Generator, tissue: Flags) -> tuple[str, Flags]:
    """Return the kind and the mask of observed components, at least one of them in tissue."""
    shape = tissue.shape
    kind = str(
        dice.choice(
            ["edges", "patches", "pixels", "random", "outline", "everywhere"],
            p=[0.3, 0.2, 0.15, 0.2, 0.12, 0.03],
        )
    )
    sites = np.zeros(shape, dtype=bool)
    rows, cols = np.indices(shape)
    if kind == "edges":
        for edge in dice.permutation(4)[: dice.integers(1, 5)]:
            sites[[np.s_[:1], np.s_[-1:], np.s_[:, :1], np.s_[:, -1:]][edge]] = True
    elif kind == "patches":
        for _ in range(dice.integers(1, 7)):
            i, j = dice.random(2) * shape
            sites |= np.hypot(rows - i, cols - j) < dice.uniform(0.8, 1 + 0.2 * max(shape))
    elif kind == "pixels":
        at = np.argwhere(tissue)
        sites[tuple(at[dice.integers(len(at), size=dice.integers(1, 11))].T)] = True
    elif kind == "random":
        sites = dice.random(shape) < 10 ** dice.uniform(-2, -0.2)
    elif kind == "outline":
        sites = tissue & ~ndi.binary_erosion(tissue)
    else:
        sites[...] = True
    observed = np.repeat(sites[..., None], 2, axis=-1)
    how = dice.choice(["both", "one", "either"], p=[0.6, 0.15, 0.25])
    if how == "one":
        observed[..., dice.integers(2)] = False
    elif how == "either":
        observed &= dice.random(observed.shape) < dice.uniform(0.3, 0.9)
    # In most problems, every piece of tissue has observations.
    if dice.random() < 0.85:
        _hold_pieces(dice, tissue, observed)
    if not (observed & tissue[..., None]).any():
        i, j = dice.choice(np.argwhere(tissue))
        observed[i, j] = True
    return kind, observed


def _hold_pieces(dice: np.random.Generator, tissue: Flags, observed: Flags) -> None:
    """Observe two or three sites of each piece of tissue with fewer observed sites, in place."""
    pieces, count = ndi.label(tissue)
    full = observed.all(axis=-1)
    for number in range(1, count + 1):
        at = np.argwhere(pieces == number)
        if (full & (pieces == number)).sum() < 2:
            for i, j in at[dice.permutation(len(at))[: dice.integers(2, 4)]]:
                observed[i, j] = True


def _displacement(dice: np.random.Generator, shape: Shape, sites: Flags) -> tuple[str, Array]:
    """Return the kind of displacement, and a displacement of arbitrary size."""
    grid = np.indices(shape) / max(shape)
    kind = str(dice.choice(["smooth", "random", "pushed", "bent"], p=[0.3, 0.25, 0.3, 0.15]))
    if kind == "smooth":
        matrix, shift = dice.normal(size=(2, 2)), dice.normal(size=2)
        y = np.moveaxis(np.tensordot(matrix, grid - 0.5, 1), 0, -1) + 0.3 * shift
    elif kind == "random":
        y = dice.normal(size=(*shape, 2))
    elif kind == "bent":
        waves = [noise(dice, shape, max(shape) / 4) - 0.5 for _ in range(2)]
        y = np.stack(waves, axis=-1)
    else:
        pieces, count = ndi.label(sites)
        pushes = dice.normal(size=(count + 1, 2)) * (dice.random((count + 1, 1)) < 0.6)
        if count == 1:
            pushes = (
                dice.normal(size=(max(shape) + 1, 2)) * (np.arange(max(shape) + 1) > 1)[:, None]
            )
            pieces = np.indices(shape)[int(shape[1] > shape[0])] // max(1, max(shape) // 3)
        y = pushes[pieces]
    return kind, np.array(y, dtype=np.float64)


def _confidence(dice: np.random.Generator, shape: tuple[int, ...]) -> Array:
    kind = dice.choice(["full", "any", "steps", "wide"], p=[0.5, 0.25, 0.15, 0.1])
    if kind == "full":
        return np.ones(shape)
    if kind == "steps":
        return dice.choice([0.25, 0.5, 1.0], shape)
    if kind == "wide":
        return np.asarray(10 ** dice.uniform(-3, 0, shape))
    return 1 - dice.random(shape)


def _prior(dice: np.random.Generator, shape: Shape) -> tuple[ElasticPrior | SeilerPrior, str]:
    kind = str(dice.choice(["stress", "strain", "centred", "blanket"], p=[0.3, 0.3, 0.2, 0.2]))
    penalty = None if dice.random() < 0.45 else float(10 ** dice.uniform(-3, 4))
    how = "held" if penalty is None else "slips"
    if kind in ("centred", "blanket"):
        return SeilerPrior(penalty=penalty, conditional=kind), f"{kind}, {how}"
    nu = dice.choice([0.0, 0.3, 0.45, 0.49, 0.499, dice.uniform(0, 0.499)])
    poisson = float(nu)
    if dice.random() < 0.25:
        other = dice.uniform(0, 0.499)
        share = noise(dice, shape, dice.uniform(0.6, 5))
        share = share if dice.random() < 0.5 else 1.0 * (share > 0.5)
        # Round as `ElasticPrior` does, because it stores a map in single precision.
        poisson = np.clip(nu + share * (other - nu), 0, 0.499).astype(np.float32)
    return ElasticPrior(poisson, plane=kind, penalty=penalty or math.inf), f"elastic {kind}, {how}"

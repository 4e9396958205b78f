"""Hard elastic tissue: stiff parts of many shapes and sizes at any contrast, beside other programs.

The whole table takes an hour on two cores; with ``--results FILE``, a later run continues it. With
``--methods ours``, PyAMG and SuperLU do not run, and the exact field is computed without them.
``--seeds 3`` replaces the seed of all noise, and ``--cases "ribs 97" 1e4`` selects rows.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

# Set before NumPy is imported: threads of its dense kernels slow PyAMG down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import numpy.typing as npt

from benchmarks.clock import one_heap
from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.data import phantom
from validation.bodies import dice_of
from validation.oracles.elasticity import exact_field, refined
from validation.problems import smooth_noise
from validation.studies.peers import Run, has_pyamg, run_ours, run_pyamg, run_superlu
from validation.study import Options, Results, Table, study

Array = npt.NDArray[Any]
#: Required true error of a solver, in pixels.
WITHIN = 3e-3
PRIOR = ElasticPrior(0.3)
CONTRASTS = (1.0, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7)
#: Largest allowed ratio of our time to the time of the better peer.
MOST = 1.3

# Tissue.

#: Displacement of the last row, in pixels: 4 px, towards the first row and to the right.
PUSH = (-3.2, 2.4)
#: Contrast of the unchanged phantoms.
PHANTOM_CONTRAST = 4.0


class Layout(NamedTuple):
    """Case at one size, for any contrast.

    Attributes
    ----------
    pattern : ndarray, shape (H, W)
        Logarithm of the stiffness to the base of the contrast: 0 in soft tissue, 1 in stiff tissue.
    void : ndarray of bool, shape (H, W)
        Mask of void.
    observed, confidence : ndarray, shape (H, W, 2)
        Observed displacement, and its confidence.
    """

    pattern: Array
    void: Array
    observed: Array
    confidence: Array

    def problem(self, contrast: float) -> Problem:
        """Return the problem with stiffness from 1 to `contrast`."""
        m = np.where(self.void, 0, contrast**self.pattern).astype(np.float32)
        return Problem(observed=self.observed, confidence=self.confidence, stiffness=m)


def _pushed(stiff: Array, void: Array | None = None) -> Layout:
    """Return a layout with first and last row prescribed, and the last row pushed."""
    y, c = np.zeros((*stiff.shape, 2)), np.zeros((*stiff.shape, 2))
    c[0] = c[-1] = 1
    y[-1] = PUSH
    return Layout(
        stiff.astype(np.float64), np.zeros(stiff.shape, bool) if void is None else void, y, c
    )


def noise(n: int, sigma: float, seed: int = 2008) -> Layout:
    """Return two phases of equal volume, by a threshold on smoothed noise."""
    return _pushed(smooth_noise(dice_of(seed), (n, n), sigma) > 0.5)


def ribs(n: int) -> Layout:
    """Return vertebrae with soft discs, and slanted ribs on both sides with void gaps."""
    row, col = np.indices((n, n)) / (n - 1)
    side = np.abs(col - 0.5)
    count = min(12, max(2, n // 12))
    turn = (count * (row - 0.3 * side)) % 1
    within = (row > 0.06) & (row < 0.94)
    rib = (np.abs(turn - 0.5) < 0.12) & (side > 0.08) & (side < 0.42)
    vertebra = (side < 0.06) & ((count * row) % 1 > 0.25)
    gap = (np.abs(turn - 0.5) > 0.36) & (side > 0.14) & (side < 0.36)
    return _pushed((rib | vertebra) & within, gap & within)


def checkerboard(n: int) -> Layout:
    """Return squares of 5 x 5 sites; stiff squares are connected at their corners."""
    row, col = np.indices((n, n)) // 5
    return _pushed((row + col) % 2 == 0)


def fibres(n: int) -> Layout:
    """Return slanted fibres one pixel wide, in pieces of 23 rows with gaps of 4 rows."""
    row, col = np.indices((n, n))
    number, place = np.divmod(col - np.rint(0.35 * row).astype(int), 7)
    return _pushed((place == 0) & ((row + 11 * number) % 27 >= 4))


def holes(n: int, seed: int = 2008) -> Layout:
    """Return a grid of round holes, nine pixels wide and four apart, in two phases."""
    row, col = np.indices((n, n)) - (n % 13) // 2
    void = (row % 13 - 6) ** 2 + (col % 13 - 6) ** 2 <= 20
    void[:2] = void[-2:] = False
    return _pushed(smooth_noise(dice_of(seed), (n, n), 5.0) > 0.5, void)


def inclusion(n: int) -> Layout:
    """Return a stiff disc, slightly off the middle."""
    row, col = np.indices((n, n)) / (n - 1)
    return _pushed((row - 0.55) ** 2 + (col - 0.42) ** 2 < 0.2**2)


def brain(n: int, name: str) -> Layout:
    """Return a phantom with the logarithms of its stiffnesses scaled to the contrast."""
    problem = phantom(name, n).problem
    void = ~problem.tissue
    m = np.where(
        void, 1, problem.stiffness.astype(np.float64) / problem.stiffness[problem.tissue].min()
    )
    return Layout(
        np.log(m) / math.log(PHANTOM_CONTRAST), void, problem.observed, problem.confidence
    )


#: Functions from a size to a layout, by name. For the seeds of the smoothest noise, an iteration
#: that estimates its error from previous iterates misses the motion of a stiff part (n = 97, 257).
TISSUES: dict[str, Callable[..., Layout]] = {
    "noise-2": partial(noise, sigma=2),
    "noise-5": partial(noise, sigma=5),
    "noise-10": partial(noise, sigma=10, seed=1),
    "noise-20": partial(noise, sigma=20, seed=7),
    "ribs": ribs,
    "checkerboard": checkerboard,
    "fibres": fibres,
    "holes": holes,
    "inclusion": inclusion,
    "expansion": partial(brain, name="expansion"),
    "mass-effect": partial(brain, name="mass-effect"),
}
#: Names of the cases with a seed.
SEEDED = ("noise-2", "noise-5", "noise-10", "noise-20", "holes")


# Rows.


@dataclass(frozen=True)
class Row:
    """Result of one case at one size and contrast; peers are None if they did not run."""

    case: str
    size: int
    contrast: float
    ours: Run
    pyamg: Run | None = None
    superlu: Run | None = None

    @classmethod
    def read(cls, values: dict[str, Any]) -> Row:
        """Return the row of a result, which a file can contain."""
        runs = {who: values[who] and Run(**values[who]) for who in ("ours", "pyamg", "superlu")}
        return cls(**{**values, **runs})

    @property
    def rival(self) -> float:
        """Seconds of the better peer that succeeded; NaN if there is none."""
        peers = [run for run in (self.pyamg, self.superlu) if run is not None and not run.fault]
        return min((run.seconds for run in peers), default=math.nan)

    @property
    def ratio(self) -> float:
        """Our time divided by the better peer's time; NaN if our field is missing or wrong."""
        right = not self.ours.fault and self.ours.error <= WITHIN
        return self.ours.seconds / self.rival if right else math.nan

    @property
    def name(self) -> str:
        """Name of the row."""
        return _name(self.case, self.size, self.contrast)

    @property
    def cells(self) -> list[str]:
        """Cells of the table row."""
        ours = self.ours
        cells = [self.case, str(self.size), _contrast(self.contrast)]
        cells += [ours.fault or str(ours.iterations), ours.how, *_measured(ours)]
        cells.append(_error(ours.reported))
        pyamg = self.pyamg
        how = "" if pyamg is None else pyamg.fault or f"{pyamg.iterations} ({pyamg.how})"
        cells += [how, *_measured(pyamg), *_measured(self.superlu)]
        return [*cells, "" if math.isnan(self.ratio) else f"{self.ratio:.2f}"]


def _name(case: str, size: int, contrast: float) -> str:
    return f"{case} {size} {_contrast(contrast)}"


def _contrast(contrast: float) -> str:
    return f"{contrast:.0e}".replace("e+0", "e")


def _error(error: float) -> str:
    return "" if math.isnan(error) else f"{error:.1e}"


def _measured(run: Run | None) -> list[str]:
    """Return the cells with seconds, megabytes and true error."""
    if run is None or math.isnan(run.seconds):
        return ["", "", ""]
    return [f"{run.seconds:.3g}", f"{run.megabytes:.0f}", _error(run.error)]


def hard_cases(options: Options) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Yield problems; of identical ones, such as most with contrast 1, only the first."""
    one_heap()
    for contrast in (4.0, 1e6):  # imports and compiles
        measure(("noise-2", 33, contrast, noise(33, 2).problem(contrast), False))
    seen: set[str] = set()
    seeds = {"seed": options.seeds[0]} if options.seeds else {}
    for size in options.sizes_or((97, 257, 513), (33,)):
        for case, make in TISSUES.items():
            layout = make(size, **(seeds if case in SEEDED else {}))
            own = {PHANTOM_CONTRAST} if case in ("expansion", "mass-effect") else set()
            for contrast in sorted({*options.choose(CONTRASTS, (1.0, 1e4)), *own}):
                problem = layout.problem(contrast)
                parts = (problem.observed, problem.confidence, problem.stiffness)
                digest = hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()
                if digest not in seen:
                    name = _name(case, size, contrast)
                    yield name, (case, size, contrast, problem, "ours" in options.methods)
                seen.add(digest)


def findings(found: Sequence[Row]) -> Iterator[tuple[str, str]]:
    """Yield the main findings of the table."""
    solved = [row for row in found if not row.ours.fault]
    yield "rows solved", f"{len(solved)} of {len(found)}"
    for fault in sorted({row.ours.fault for row in found} - {""}):
        yield fault, _listed(row for row in found if row.ours.fault == fault)
    wrong = [row for row in solved if row.ours.error > WITHIN]
    yield f"true error above {WITHIN} px", _listed(wrong)
    small = [row for row in solved if row.ours.error > 2 * max(row.ours.reported, 1e-4)]
    yield "true error above twice the reported error", _listed(small)
    compared = [row for row in found if not math.isnan(row.rival)]
    if not compared:
        return
    timed = [row for row in compared if not math.isnan(row.ratio)]
    if timed:
        worst = max(timed, key=lambda row: row.ratio)
        yield "largest ratio of times", f"{worst.ratio:.2f} ({worst.name})"
    yield f"ratio of times above {MOST}", _listed(row for row in timed if row.ratio > MOST)
    large = [row for row in compared if row.size >= 257]
    if large:
        half = sum(row.ratio <= 0.5 for row in large)
        share = f"{half} of {len(large)} ({half / len(large):.0%})"
        yield "rows with n >= 257 and a ratio of times of at most 0.5", share
    for fault in ("fails", "later"):
        failed = [row for row in compared if row.pyamg is not None and row.pyamg.fault == fault]
        yield f"PyAMG {fault}", _listed(failed)


def _listed(rows: Iterable[Row]) -> str:
    """Return the number and the names of some rows."""
    names = [row.name for row in rows]
    return f"{len(names)} rows" + (f" ({', '.join(names)})" if names else "")


def peers(found: Sequence[Row]) -> list[list[str]]:
    """Return the times of the other programs over all cases, by size and contrast."""
    compared = [row for row in found if row.superlu is not None]
    lines = []
    for size, contrast in sorted({(row.size, row.contrast) for row in compared}):
        those = [row for row in compared if (row.size, row.contrast) == (size, contrast)]
        pyamg = [row.pyamg for row in those if row.pyamg is not None and not row.pyamg.fault]
        lines.append(
            [
                str(size),
                _contrast(contrast),
                _range([row.rival for row in those]),
                _range([run.seconds for run in pyamg]),
                _range([run.iterations for run in pyamg]),
                _range([row.superlu.seconds for row in those]),
            ]
        )
    return lines


def _range(values: Sequence[float]) -> str:
    """Return the least, the median and the largest value."""
    if not values:
        return ""
    return f"{min(values):.2g} / {np.median(values):.2g} / {max(values):.2g}"


_PEERS = ("n", "contrast", "faster of the two, s", "PyAMG, s", "PyAMG iterations", "SuperLU, s")
_TITLES = ("case", "n", "contrast", "cycles", "method", "time, s", "MB", "true error, px")
_TITLES += ("reported error, px", "PyAMG iterations", "PyAMG time, s", "PyAMG MB")
_TITLES += ("PyAMG error, px", "SuperLU time, s", "SuperLU MB", "SuperLU error, px")
_TITLES += ("ratio of times",)


def _tables(results: Results) -> Iterator[Table]:
    found = [Row.read(values) for values in results.values()]
    yield Table(("finding", "rows"), lambda _: findings(found))
    yield Table(_PEERS, lambda _: peers(found))
    yield Table(_TITLES, lambda _: [row.cells for row in found])


@study("hard.tissue", hard_cases, _tables, page="hard.md")
def measure(given: tuple[str, int, float, Problem, bool]) -> dict[str, Any]:
    """Time all solvers, and compare them with the exact field: the largest error of any site."""
    case, size, contrast, problem, alone = given
    ours = run_ours(problem, PRIOR)
    if alone:
        exact = None if ours.fault else exact_field(problem, PRIOR)
        return asdict(Row(case, size, contrast, ours.against(exact)))
    superlu, factors = run_superlu(problem, PRIOR)
    exact = refined(problem, PRIOR, *factors)
    pyamg = None
    if has_pyamg():
        patience = superlu.seconds
        pyamg = run_pyamg(problem, PRIOR, exact, WITHIN, by_decade=True, patience=patience)
        pyamg = pyamg.against(exact)
    return asdict(Row(case, size, contrast, ours.against(exact), pyamg, superlu.against(exact)))

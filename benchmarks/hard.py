"""Benchmark of hard elastic tissue: cases x sizes x contrasts, with the best peers in the same run.

    python benchmarks/hard.py [--sizes 97 257 513] [--contrasts 1 1e4 ...] [--cases ribs ...]
                              [--seed 3] [--ours] [--page FILE]
    python benchmarks/hard.py --strain     nearly incompressible tissue in plane strain
    python benchmarks/hard.py --rigid      rigid bone

The whole table takes an hour on two cores. Each row is printed when it is complete, and Ctrl-C
prints a summary of the rows so far. Rows are stored in benchmark-output/, and a page also contains
the rows of earlier runs. With --ours, the peers do not run, and exact fields are also stored, so
the next run is faster.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

# Set before NumPy is imported: threads of its dense kernels slow PyAMG down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import numpy.typing as npt
from clock import load, machine, one_heap
from peers import SETTING, Run, distance, has_pyamg, run_ours, run_pyamg, run_superlu
from report.page import Section
from report.tissues import BONES, PHANTOM_CONTRAST, PUSH, SEEDED, TISSUES, Images, bone_images

from napari_hmrf import ElasticPrior, Multigrid, Problem, solve
from validation.oracles.elasticity import direct_solution, exact_field, refined, rigid_sites

#: Required true error of a solver, in pixels.
WITHIN = 3e-3
PRIOR = ElasticPrior(0.3)
SIZES = (97, 257, 513)
CONTRASTS = (1.0, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7)
KEPT = Path(__file__).resolve().parent.parent / "benchmark-output" / "hard"
#: Largest allowed ratio of our time to the time of the better peer.
MOST = 1.3
STRAIN = ElasticPrior(0.499, plane="strain")
_STRAIN_CASES = ("expansion", "mass-effect", "inclusion")
_STRAIN_SIZES, _LARGEST_REFERENCE = (300, 1200), 513
_STRAIN_CONTRASTS = (1.0, 1e2, 1e4)
_RIGID_SIZES = (300,)
_TURNS = 31
_MEASURED = ("s", "MB", "error")
HEADER = ("case", "n", "contrast", "cycles", "how", *_MEASURED, "reported")
HEADER += ("PyAMG its", *_MEASURED, "SuperLU s", *_MEASURED[1:], "ratio")
_PEERS_WIDTHS = (4, 8, 20, 20, 14, 20)
_WIDTHS = (12, 4, 8, 13, 6, 7, 5, 7, 8, 9, 7, 5, 7, 9, 5, 7, 5)


@dataclass(frozen=True)
class Row:
    """Result of one case at one size and contrast; peers are None if they did not run."""

    case: str
    size: int
    contrast: float
    ours: Run
    pyamg: Run | None = None
    superlu: Run | None = None

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
        return f"{self.case} {self.size} {_contrast(self.contrast)}"

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


def _contrast(contrast: float) -> str:
    return f"{contrast:.0e}".replace("e+0", "e")


def _error(error: float) -> str:
    return "" if math.isnan(error) else f"{error:.1e}"


def _measured(run: Run | None) -> list[str]:
    """Return the cells with seconds, megabytes and true error."""
    if run is None or math.isnan(run.seconds):
        return ["", "", ""]
    return [f"{run.seconds:.3g}", f"{run.megabytes:.0f}", _error(run.error)]


def rows(
    cases: Sequence[str],
    sizes: Sequence[int],
    contrasts: Sequence[float] | None,
    alone: bool,
    seed: int | None = None,
) -> Iterator[Row]:
    """Yield measured rows; identical problems, such as most with contrast 1, are measured once."""
    seen: set[str] = set()
    for size in sizes:
        for case in cases:
            own_seed = seed is None or case not in SEEDED
            layout = TISSUES[case](size) if own_seed else TISSUES[case](size, seed=seed)
            own = {PHANTOM_CONTRAST} if case in ("expansion", "mass-effect") else set()
            for contrast in contrasts or sorted({*CONTRASTS, *own}):
                images = layout.images(contrast)
                known = digest(images) in seen
                seen.add(digest(images))
                if not known:
                    yield measure(case, size, contrast, images, alone)


def measure(case: str, size: int, contrast: float, images: Images, alone: bool) -> Row:
    """Run all solvers, or only ours."""
    _say(f"{case}, {size} x {size}, contrast {_contrast(contrast)}: ours")
    ours = run_ours(images, PRIOR)
    if alone:
        _say("exact field")
        exact = None if ours.fault else stored_reference(images, PRIOR)
        return Row(case, size, contrast, ours.against(exact))
    _say("SuperLU and the exact field")
    superlu, factors = run_superlu(images, PRIOR)
    exact = refined(images, PRIOR, *factors)
    store_reference(images, PRIOR, exact)
    ours, superlu = ours.against(exact), superlu.against(exact)
    if not has_pyamg():
        return Row(case, size, contrast, ours, None, superlu)
    _say("PyAMG")
    pyamg = run_pyamg(
        images, PRIOR, exact, WITHIN, by_decade=True, patience=superlu.seconds
    ).against(exact)
    return Row(case, size, contrast, ours, pyamg, superlu)


def warm_up() -> None:
    """Import and compile all solvers; must be called first in a process."""
    one_heap()
    for contrast in (4.0, 1e6):
        images = TISSUES["noise-2"](33).images(contrast)
        for prior in (PRIOR, STRAIN):
            run_ours(images, prior)
        _, factors = run_superlu(images, PRIOR)
        if has_pyamg():
            run_pyamg(images, PRIOR, refined(images, PRIOR, *factors), WITHIN, by_decade=True)


def stored_reference(images: Images, prior: ElasticPrior) -> npt.NDArray[np.floating]:
    """Return the exact field, loaded from an earlier run if possible."""
    file = _reference_file(images, prior)
    if not file.exists():
        store_reference(images, prior, exact_field(images, prior))
    return np.load(file)


def store_reference(images: Images, prior: ElasticPrior, exact: npt.NDArray[np.floating]) -> None:
    """Store a reference for later runs, with an accuracy of a millionth of a pixel."""
    KEPT.mkdir(parents=True, exist_ok=True)
    np.save(_reference_file(images, prior), exact.astype(np.float32))


def _reference_file(images: Images, prior: ElasticPrior) -> Path:
    return KEPT / f"{digest(images)[:16]}-{prior.poisson}-{prior.plane}.npy"


def digest(images: Images) -> str:
    """Return a digest that is equal for equal images."""
    parts = (images.observed, images.confidence, images.stiffness)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def _say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def summary(found: Sequence[Row]) -> list[str]:
    """Return the main findings of the table, one line each."""
    solved = [row for row in found if not row.ours.fault]
    lines = [f"{len(found)} rows, of which {len(solved)} were solved"]
    for fault in sorted({row.ours.fault for row in found} - {""}):
        lines.append(_listed(fault, [row for row in found if row.ours.fault == fault]))
    wrong = [row for row in solved if row.ours.error > WITHIN]
    lines.append(_listed(f"true error above {WITHIN} px", wrong))
    small = [row for row in solved if row.ours.error > 2 * max(row.ours.reported, 1e-4)]
    lines.append(_listed("true error above twice the reported", small))
    compared = [row for row in found if not math.isnan(row.rival)]
    if not compared:
        return lines
    timed = [row for row in compared if not math.isnan(row.ratio)]
    if timed:
        worst = max(timed, key=lambda row: row.ratio)
        lines.append(f"worst ratio to the better peer: {worst.ratio:.2f} ({worst.name})")
    lines.append(_listed(f"ratio above {MOST}", [row for row in timed if row.ratio > MOST]))
    large = [row for row in compared if row.size >= 257]
    if large:
        half = sum(row.ratio <= 0.5 for row in large)
        share = f"{half} of {len(large)} ({half / len(large):.0%})"
        lines.append(f"rows of n >= 257 in at most half of the better peer's time: {share}")
    for fault in ("fails", "later"):
        failed = [row for row in compared if row.pyamg is not None and row.pyamg.fault == fault]
        lines.append(_listed(f"PyAMG {fault}", failed))
    return lines


PEERS_HEADER = ("n", "contrast", "better peer, s", "PyAMG, s", "iterations", "SuperLU, s")


def peers(found: Sequence[Row]) -> list[list[str]]:
    """Return the times to beat, from least to most over all cases, by size and contrast."""
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


def _listed(what: str, those: Sequence[Row]) -> str:
    """Return a line with the number and the names of some rows."""
    names = ", ".join(row.name for row in those)
    return f"{what}: {len(those)} rows" + (f" ({names})" if names else "")


def keep(row: Row) -> None:
    """Store a row for the page of a later run."""
    KEPT.mkdir(parents=True, exist_ok=True)
    rows = {other.name: other for other in kept()} | {row.name: row}
    text = json.dumps([asdict(each) for each in rows.values()])
    (KEPT / "rows.json").write_text(text, encoding="utf-8")


def kept() -> list[Row]:
    """Return the stored rows of earlier runs."""
    if not (KEPT / "rows.json").exists():
        return []
    rows = []
    for each in json.loads((KEPT / "rows.json").read_text(encoding="utf-8")):
        for who in ("ours", "pyamg", "superlu"):
            each[who] = None if each[who] is None else Run(**each[who])
        rows.append(Row(**each))
    return sorted(rows, key=lambda row: (row.size, list(TISSUES).index(row.case), row.contrast))


def write_page(path: Path, found: Sequence[Row]) -> None:
    """Write a page with the table and its summary."""
    page = Section("Hard tissue")
    busy = load()
    page.say(
        f"""Made by `make hard`; the solvers of each row ran one after the other. {machine()}.
        {time.strftime("%Y-%m-%d")}{f", load at the end {busy:.1f}" if busy else ""}."""
    )
    page.say(
        f"""**Question.** How fast and how accurate is elastic tissue (plane stress, Poisson's
        ratio {PRIOR.poisson}) of every shape and contrast, compared with the two usual programs?
        *noise* is a threshold of noise smoothed by that many pixels; *ribs* are ribs and
        vertebrae with void gaps; *fibres* are one pixel wide; in *expansion* and *mass-effect*
        the logarithms of the phantom's stiffnesses are stretched to the contrast; 4 is the
        unchanged phantom. The first and the last row are held, and the last is pushed by {PUSH}
        px; the phantoms move as they do. If several problems are the same, such as most of
        contrast 1, only the first counts."""
    )
    page.say(
        f"""**Method.** *Ours* is `solve` at its default tolerance, from a `Problem` to a
        displacement, with new tissue and compiled kernels. The times of the others include the
        assembly of the matrix from slices of the image in blocks of 2 x 2, without sorting
        triplets. PyAMG: smoothed aggregation with the three rigid-body modes and
        conjugate gradients, with the best of 18 settings (`{SETTING}`). It stops at the loosest
        of the relative residuals 0.1, 0.01, ... (in brackets) at which its true error is within
        {WITHIN} px. It *fails* if it needs more than 300 iterations, and is *later* if SuperLU
        would have finished before. SuperLU: symmetric mode, minimum degree, no pivoting. Seconds
        are the median of three if they are below one; MB is the peak of memory minus the memory
        before. An error is the distance, in pixels, of the worst site from the exact field: that
        of SuperLU, refined with a residual from displacement differences in extended precision
        until it changes by less than a millionth of a pixel. *Ratio*: our seconds, if we
        succeed, divided by those of the better peer that succeeds."""
    )
    page.blocks.append("\n".join(f"- {line}" for line in summary(found)))
    page.say("""Times to beat, over all cases: the smallest, the median and the largest.""")
    page.table(PEERS_HEADER, peers(found))
    page.table(HEADER, [row.cells for row in found])
    text = str(page).replace("## ", "# ", 1)
    path.write_text(text + "\n", encoding="utf-8")


def _print_row(cells: Sequence[str], widths: Sequence[int]) -> None:
    each = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
    print(" ".join([cells[0].ljust(widths[0]), *each]), flush=True)


def print_strain(cases: Sequence[str], sizes: Sequence[int], contrasts: Sequence[float]) -> None:
    """Print the table of nearly incompressible tissue in plane strain."""
    widths = (12, 5, 9, 13, 8, 6, 8, 8)
    header = ("case", "n", "contrast", "cycles", "s", "MB", "error", "reported")
    _print_row(header, widths)
    for size in sizes:
        for case in cases:
            for contrast in contrasts:
                _say(f"{case}, {size} x {size}, contrast {_contrast(contrast)}")
                images = TISSUES[case](size).images(contrast)
                ours, exact = run_ours(images, STRAIN), None
                if not ours.fault and size <= _LARGEST_REFERENCE:
                    exact = stored_reference(images, STRAIN)
                ours = ours.against(exact)
                cells = [case, str(size), _contrast(contrast)]
                cells += [ours.fault or str(ours.iterations), *_measured(ours)]
                _print_row([*cells, _error(ours.reported)], widths)


def print_rigid(sizes: Sequence[int]) -> None:
    """Print the table of rigid bone in soft tissue."""
    widths = (12, 5, 13, 8, 8, 8, 16, 12)
    header = ("bone", "n", "cycles", "s", "error", "reported", "largest strain", "over ratio 1")
    _print_row(header, widths)
    for size in sizes:
        for name, draw in BONES.items():
            images = bone_images(draw(size))
            ours = run_ours(images, PRIOR)
            if ours.fault:
                _print_row([name, str(size), ours.fault, *[""] * 5], widths)
                if ours.fault == "refused":
                    print("m = inf is refused, so there is nothing to measure", flush=True)
                    return
                continue
            over = over_soft(images)
            exact = direct_solution(images, PRIOR)
            cells = [name, str(size), str(ours.iterations), f"{ours.seconds:.3g}"]
            cells += [_error(distance(ours.field, exact)), _error(ours.reported)]
            cells.append(_error(largest_strain(ours.field, rigid_sites(images.stiffness))))
            _print_row([*cells, f"{over:.2f}"], widths)


def over_soft(images: Images) -> float:
    """Return the ratio of the median times with and without bone, for alternating solves."""
    seconds = np.zeros((_TURNS, 2))
    for turn in range(_TURNS):
        for which, m in enumerate((images.stiffness, np.ones_like(images.stiffness))):
            # Another unit of stiffness invalidates all caches.
            problem = Problem(
                observed=images.observed,
                confidence=images.confidence,
                stiffness=m * np.float32(2 ** (turn % 8)),
                spacing=images.spacing,
            )
            started = time.perf_counter()
            solve(problem, PRIOR, optimizer=Multigrid(), backend="cpu")
            seconds[turn, which] = time.perf_counter() - started
    with_bone, without = np.median(seconds, axis=0)
    return float(with_bone / without)


def largest_strain(field: npt.NDArray[np.floating], body: npt.NDArray[np.bool_]) -> float:
    """Return the largest strain of any element with all four sites in a body."""
    d = field.astype(np.float64)
    inside = body[:-1, :-1] & body[:-1, 1:] & body[1:, :-1] & body[1:, 1:]
    along_rows, along_cols = np.diff(d, axis=0), np.diff(d, axis=1)
    slide = (
        along_rows[:, :-1, 1] + along_rows[:, 1:, 1] + along_cols[:-1, :, 0] + along_cols[1:, :, 0]
    )
    strains = (
        along_rows[:, :-1, 0],
        along_rows[:, 1:, 0],
        along_cols[:-1, :, 1],
        along_cols[1:, :, 1],
        slide / 4,
    )
    return max(float(np.abs(strain[inside]).max()) for strain in strains)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; always return 0, because a table is not a test."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+")
    parser.add_argument("--contrasts", type=float, nargs="+")
    parser.add_argument("--cases", nargs="+", choices=TISSUES)
    parser.add_argument("--seed", type=int, help="seed of all noise; by default, one per case")
    parser.add_argument("--ours", action="store_true", help="without PyAMG and SuperLU")
    parser.add_argument("--page", type=Path, help="path of a page to write")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--strain", action="store_true", help="Poisson's ratio 0.499, plane strain")
    other.add_argument("--rigid", action="store_true", help="rigid bone")
    options = parser.parse_args(arguments)
    _say("warming up")
    warm_up()
    found: list[Row] = []
    try:
        if options.strain:
            print_strain(
                options.cases or _STRAIN_CASES,
                options.sizes or _STRAIN_SIZES,
                options.contrasts or _STRAIN_CONTRASTS,
            )
            return 0
        if options.rigid:
            print_rigid(options.sizes or _RIGID_SIZES)
            return 0
        columns = slice(HEADER.index("PyAMG its") if options.ours else len(HEADER))
        _print_row(HEADER[columns], _WIDTHS[columns])
        sizes, cases = options.sizes or SIZES, options.cases or list(TISSUES)
        for row in rows(cases, sizes, options.contrasts, options.ours, options.seed):
            found.append(row)
            if not options.ours:
                keep(row)
            _print_row(row.cells[columns], _WIDTHS[columns])
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    else:
        if options.page is not None:
            write_page(options.page, kept())
            print(f"written: {options.page}")
    print("\n".join(["", *summary(found), ""]))
    if not options.ours:
        for cells in (PEERS_HEADER, *peers(found)):
            _print_row(cells, _PEERS_WIDTHS)
    return 0


if __name__ == "__main__":
    sys.exit(main())

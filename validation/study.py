"""Harness of the studies: it runs cases, prints tables with targets, and updates the pages.

A study is its cases, a comparison of a case with a reference, and its table::

    @study("sliding.normals", cases=interfaces, table=("interface", "mean", "largest"))
    def normals(case):
        \"\"\"Return the errors of fitted normals, in degrees.\"\"\"

`run` executes the studies of a command; `validation.__main__` chooses them.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks.clock import conditions
from benchmarks.table import head, line, markdown, replace
from napari_hmrf import BackendError
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.fields import deformation_grid

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / "docs" / "validation"
#: Results of a study by the names of its cases.
Results = Mapping[str, Any]
Rows = Iterable[Sequence[Any]]
# Beginning of the line of a page that states when its figures ran.
_RAN = "Commit of the figures: "
COLOURS = ("#0b7285", "#e8590c", "#5f3dc4", "#2b8a3e", "#868e96", "#c2255c", "#1864ab")


@dataclass(frozen=True)
class Target:
    """Required value of a result, and the measured value."""

    claim: str
    found: float
    bound: float
    at_least: bool = False

    @property
    def met(self) -> bool:
        """True if the target was met."""
        return self.found >= self.bound if self.at_least else self.found <= self.bound

    def __str__(self) -> str:
        """Return a line for the list of targets."""
        sign = ">=" if self.at_least else "<="
        verdict = "met   " if self.met else "MISSED"
        return f"{verdict}  {self.claim}: {self.found:.3g} ({sign} {self.bound:g})"


@dataclass(frozen=True)
class Options:
    """Options of the command; a study uses those that it needs.

    Attributes
    ----------
    quick : bool
        True for small sizes, to test that a study runs; its results are not meaningful.
    sizes, seeds, files, methods
        Values that replace those of the study; empty for its own.
    count : int or None
        Number of random problems, samples or repetitions.
    first, every : int
        Number of the first random problem, and step between problems.
    """

    quick: bool = False
    sizes: Sequence[float] = ()
    seeds: Sequence[int] = ()
    count: int | None = None
    first: int = 0
    every: int = 1
    files: Sequence[Path] = ()
    methods: Sequence[str] = ()

    def choose(self, full: Any, quick: Any) -> Any:
        """Return the first argument, or the second for a quick study."""
        return quick if self.quick else full

    def sizes_or(self, full: Sequence[int], quick: Sequence[int] | None = None) -> list[int]:
        """Return the sizes of the command, or those of the study, as integers."""
        return [int(size) for size in self.sizes or self.choose(full, quick or full)]


class Table(NamedTuple):
    """Titles of a table, and a function from the results to its rows."""

    titles: Sequence[str]
    rows: Callable[[Results], Rows]


@dataclass(frozen=True)
class Study:
    """Cases, a comparison with a reference, and tables.

    Attributes
    ----------
    name : str
        Group and name, such as "sliding.normals".
    cases : callable
        Function from the options to the cases by name.
    compare : callable
        Function from a case to its row, its rows, or its result.
    tables : sequence of str, or callable
        Titles, if `compare` returns rows; or a function from all results to the tables.
    targets : callable
        Function from all results to the targets.
    draw : callable or None
        Function that draws pictures of all results in a folder.
    page : str
        Page with the tables.
    on_request : bool
        True for a study that runs only if its full name is given.
    """

    name: str
    cases: Callable[[Options], Iterable[tuple[str, Any]]]
    compare: Callable[[Any], Any]
    tables: Sequence[str] | Callable[[Results], Iterable[Table | str]]
    targets: Callable[[Results], Iterable[Target]]
    draw: Callable[[Results, Path], object] | None
    page: str
    on_request: bool


#: All studies of the imported modules by name.
STUDIES: dict[str, Study] = {}


def study(
    name: str,
    cases: Mapping[str, Any] | Callable[[Options], Any],
    table: Sequence[str] | Callable[[Results], Iterable[Table | str]],
    *,
    rows: Callable[[Results], Rows] | None = None,
    targets: Callable[[Results], Iterable[Target]] = lambda results: (),
    draw: Callable[[Results, Path], object] | None = None,
    page: str = "README.md",
    on_request: bool = False,
) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Register the function below as the comparison of a study; see `Study`.

    Parameters
    ----------
    cases : dict, or callable
        Cases by name, or a function from the options to them, or to pairs of a name and a case.
    rows : callable, optional
        Function from all results to the rows of the table; by default, `compare` returns rows.
    """
    tables = table if rows is None else lambda _: [Table(table, rows)]

    def of(options: Options) -> Iterable[tuple[str, Any]]:
        found = cases(options) if callable(cases) else cases
        return found.items() if isinstance(found, Mapping) else found

    def register(compare: Callable[[Any], Any]) -> Callable[[Any], Any]:
        STUDIES[name] = Study(name, of, compare, tables, targets, draw, page, on_request)
        return compare

    return register


def numbered(count: int, quick: int = 2) -> Callable[[Options], Iterator[tuple[str, int]]]:
    """Return the cases of statistics of random problems: `count` consecutive numbers."""

    def cases(options: Options) -> Iterator[tuple[str, int]]:
        total = options.count or options.choose(count, quick)
        for number in range(options.first, options.first + total, options.every):
            yield str(number), number

    return cases


@cache
def backends() -> tuple[str, ...]:
    """Return the backends of this machine, and print the reason if there are no shaders."""
    from napari_hmrf.solver.backends.opengl import describe

    try:
        compute_thread.submit(describe).result()
    except BackendError as error:
        print(f"shaders are skipped: {error}", file=sys.stderr)
        return ("cpu",)
    return "opengl", "cpu"


def order(errors: Sequence[float], sizes: Sequence[float]) -> float:
    """Return the exponent of the pixel size in the error, from the first to the last size."""
    first, last = errors[0], errors[-1]
    if len(errors) < 2:
        return float("nan")
    return math.log(first / last) / math.log(sizes[-1] / sizes[0])


@dataclass
class Run:
    """Run of several studies: their tables and targets.

    Attributes
    ----------
    options : Options
    only : sequence of str
        Texts of which a name of a case must contain one; empty for all cases.
    results : Path or None
        File of results, in which a later run of the same commit finds those of an earlier one.
    out : Path or None
        Folder of pictures.
    """

    options: Options
    only: Sequence[str] = ()
    results: Path | None = None
    out: Path | None = None
    tables: list[tuple[Study, str]] = field(default_factory=list)
    targets: list[tuple[Study, Target]] = field(default_factory=list)

    def execute(self, one: Study) -> None:
        """Run a study, and print its tables and targets."""
        print(f"\n{one.name}: {(one.compare.__doc__ or '').partition(chr(10))[0]}\n", flush=True)
        results = dict(self._compared(one))
        if not results:
            return
        for each in self._tables(one, results):
            self.tables.append((one, each))
        for target in one.targets(results):
            print(target)
            self.targets.append((one, target))
        if self.out is not None and one.draw is not None:
            one.draw(results, self.out)

    def _tables(self, one: Study, results: Results) -> Iterator[str]:
        if not callable(one.tables):  # its rows are printed already
            yield markdown(one.tables, (row for each in results.values() for row in rows_of(each)))
            return
        for table in one.tables(results):
            if isinstance(table, Table):
                table = markdown(table.titles, table.rows(results))
            print(f"{table}\n", flush=True)
            yield table

    def _compared(self, one: Study) -> Iterator[tuple[str, Any]]:
        """Yield the name and the result of each case, and print its rows."""
        earlier = self._earlier(one)
        if not callable(one.tables):
            print(head(one.tables))
        for name, case in one.cases(self.options):
            if self.only and not any(text in name for text in self.only):
                continue
            if name in earlier:
                result = earlier[name]
            else:
                print(f"{time.strftime('%H:%M:%S')} {one.name}: {name}", file=sys.stderr)
                result = one.compare(case)
                if isinstance(result, Iterator):
                    result = list(result)
                self._keep(one, name, result)
            if not callable(one.tables):
                for row in rows_of(result):
                    print(line(row), flush=True)
            yield name, result
        if not callable(one.tables):
            print()

    def _earlier(self, one: Study) -> dict[str, Any]:
        if self.results is None or not self.results.exists():
            return {}
        lines = map(json.loads, self.results.read_text(encoding="utf-8").splitlines())
        own = [one.name, commit()]  # a page states one commit for all rows
        return {case: result for *key, case, result in lines if key == own}

    def _keep(self, one: Study, name: str, result: Any) -> None:
        if self.results is not None:  # an error, if the study keeps more than rows and numbers
            self.results.parent.mkdir(parents=True, exist_ok=True)
            with self.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps([one.name, commit(), name, result]) + "\n")

    def write(self) -> None:
        """Replace the tables, the targets and the commit of the pages of the studies."""
        for page in dict.fromkeys(each.page for each, _ in self.tables):
            path = PAGES / page
            for each, table in self.tables:
                if each.page == page:
                    try:
                        replace(path, table)
                    except ValueError as error:
                        print(error)
            text = path.read_text(encoding="utf-8")
            for each, target in self.targets:
                if each.page == page:
                    pattern = rf"^(met   |MISSED)  {re.escape(target.claim)}: .*$"
                    text = re.sub(pattern, lambda _, new=target: str(new), text, flags=re.M)
            ran = {each for each, _ in self.tables}
            if all(each in ran or each.on_request for each in of_page(page)):
                text = re.sub(rf"^{_RAN}.*$", lambda _: _RAN + commit(), text, flags=re.M)
            else:
                print(f"{page}: state which of its figures are older, beside '{_RAN.strip()}'")
            met, missed = (len(re.findall(rf"^{word}  ", text, re.M)) for word in ("met", "MISSED"))
            verdict = f"{met} of {met + missed} targets were met."
            text = re.sub(r"^\d+ of \d+ targets were met\.", verdict, text, flags=re.M)
            path.write_text(text, encoding="utf-8")
            print(f"written: docs/validation/{page}")


def of_page(page: str) -> list[Study]:
    """Return the studies of a page."""
    return [each for each in STUDIES.values() if each.page == page]


def rows_of(result: Any) -> list[Sequence[Any]]:
    """Return the rows of a result, which is a row or a list of rows."""
    is_row = not result or not isinstance(result[0], list | tuple)
    return [result] if is_row and result else list(result)


def commit() -> str:
    """Return the commit of this checkout, its day, and whether it was changed since."""
    asked = ["git", "-C", str(ROOT), "log", "-1", "--format=`%h` (%cs)"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    changes = ["git", "-C", str(ROOT), "status", "--porcelain", "--untracked-files=no"]
    changed = subprocess.run(changes, capture_output=True, text=True, check=False).stdout.strip()
    return (found or "unknown") + (", with changes" if changed else "")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options of all studies."""
    made = argparse.ArgumentParser(
        prog="python -m validation", description=__doc__.partition("\n")[0]
    )
    add = made.add_argument
    add("names", nargs="*", help="groups or studies, such as `sliding` or `sliding.normals`")
    add("--quick", action="store_true", help="small sizes, to test that a study runs")
    add("--cases", nargs="+", default=[], help="texts; only cases with one of them in their name")
    add(
        "--sizes", type=float, nargs="+", default=[], help="sites along an axis, or sizes of voxels"
    )
    add("--seeds", type=int, nargs="+", default=[], help="seeds of random cases")
    add("--count", type=int, help="number of random problems, samples or repetitions")
    add("--first", type=int, default=0, help="number of the first random problem")
    add("--every", type=int, default=1, help="only every n-th random problem or landmark")
    add("--files", type=Path, nargs="+", default=[], help="input files; see the study")
    add("--methods", nargs="+", default=[], help="names of programs, or beginnings of names")
    add(
        "--results",
        type=Path,
        help="file of results, from which a later run of this commit continues",
    )
    add("--out", type=Path, help="folder for pictures")
    add("--write", action="store_true", help="replace the tables and pictures of docs/validation/")
    return made


def run(studies: Iterable[Study], given: argparse.Namespace, command: str) -> int:
    """Run studies; return 1 if a target is missed, unless the pages show it."""
    names = ("quick", "sizes", "seeds", "count", "first", "every", "files", "methods")
    options = Options(**{name: getattr(given, name) for name in names})
    out = PAGES if given.write else given.out
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    print(f"{command}\n{_RAN}{commit()}\n{conditions()}")
    if options.quick:
        print("A quick run: sizes are small, and its numbers are not meaningful.")
    whole = Run(options, given.cases, given.results, out)
    for one in studies:
        whole.execute(one)
    if given.write:
        whole.write()
        return 0
    missed = sum(not target.met for _, target in whole.targets)
    if whole.targets:
        print(f"\n{len(whole.targets) - missed} of {len(whole.targets)} targets were met.")
    return int(missed > 0 and not options.quick)


# Pictures of the studies.


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure; sizes are in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Any, folder: Path, name: str) -> Path:
    """Write a figure to a folder."""
    from PIL import Image

    path = folder / f"{name}.png"
    drawn = BytesIO()
    figure.savefig(drawn, dpi=100, facecolor="white")
    # A palette reduces the file to a third, without a visible difference.
    Image.open(drawn).convert("RGB").quantize(128).save(path, optimize=True)
    return path


def draw_grid(axes: Any, d: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]) -> None:
    """Draw a square grid that moves with the tissue (figure 4); the displacement is in pixels."""
    from matplotlib.collections import LineCollection

    every = max(1, max(tissue.shape) // 50)
    segments = deformation_grid(d, spacing=(1.0, 1.0), every=every, tissue=tissue)
    ends = np.stack([segments[:, 0], segments.sum(axis=1)], axis=1)
    axes.add_collection(LineCollection(ends[..., ::-1], colors=COLOURS[0], linewidths=0.5))
    (top, left), (bottom, right) = (at(ends.reshape(-1, 2), axis=0) for at in (np.min, np.max))
    margin = 0.02 * (bottom - top)
    axes.set_xlim(left - margin, right + margin)
    axes.set_ylim(bottom + margin, top - margin)
    axes.set_aspect("equal")
    axes.set_axis_off()


def draw_differences(
    axes_row: Any, found: npt.NDArray[Any], truth: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]
) -> Any:
    """Draw figure 5, differences in magnitude, x (col) and y (row), and return the last panel."""
    error = np.where(tissue[..., None], found - truth, np.nan)
    length = np.linalg.norm(found, axis=-1) - np.linalg.norm(truth, axis=-1)
    panels = (np.where(tissue, length, np.nan), error[..., 1], error[..., 0])
    limit = max(float(np.nanmax(np.abs(panel))) for panel in panels) or 1.0
    shown = None
    for axes, panel in zip(axes_row, panels, strict=True):
        shown = axes.imshow(panel, cmap="RdBu_r", vmin=-limit, vmax=limit)
        axes.set_axis_off()
    return shown

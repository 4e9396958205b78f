"""Speed and robustness of solving many cases: `python benchmarks/many_cases.py`.

Solves 200 cases of 256 x 256 pixels, one of them broken, with two processes, kills the processes
with SIGKILL half way, and resumes. Then it measures the throughput of whole batches. The reference
is a loop in one process that does the same work (reading, solving, writing) on one thread, after
warm-up. If dask.distributed is installed, a local cluster of two workers is also measured. All
times are given as wall-clock time and as processor time, because the machine may be shared.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from napari_hmrf.cases import read_cases, solve_cases
from napari_hmrf.data import phantom
from napari_hmrf.io.batch import one_thread
from napari_hmrf.io.case import solve_case
from napari_hmrf.io.case_records import RECORD
from napari_hmrf.io.images import ImageFile, write_image

SIZE, WORKERS = 256, 2
#: Options of dask. By default, workers return memory immediately and are profiled a hundred times
#: per second, which takes a fifth and a tenth of the time, respectively.
LEAN = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    "distributed.worker.profile.enabled": False,
}


def write_cases(folder: Path, count: int, broken: bool = True) -> Path:
    """Write a table of cases of one phantom that differ in the motion of the tumour's rim."""
    case = phantom("mass-effect", size=SIZE)
    images = {
        "image": case.image,
        "labels": case.tissue_labels,
        "rim": case.boundary_labels,
    }
    for name, pixels in images.items():
        write_image(folder / f"{name}.tif", ImageFile(np.asarray(pixels).astype(np.uint8)))
    rows = [f"{row.label},{row.stiffness},{row.poisson}" for row in case.materials]
    (folder / "materials.csv").write_text("\n".join(["label,stiffness,poisson", *rows]))
    (folder / "rules.csv").write_text("label,action,amount\n1,fixed,\n2,expand,4\n")
    lines = ["name,image,labels,materials,boundary,rules,amount:2"]
    for number in range(count):
        image = "gone.tif" if broken and number == count // 3 else "image.tif"
        amount = 2 + 4 * number / count
        lines.append(f"case {number},{image},labels.tif,materials.csv,rim.tif,rules.csv,{amount:g}")
    table = folder / "cases.csv"
    table.write_text("\n".join(lines))
    return table


def in_shell(table: Path, out: Path, *more: str) -> list[str]:
    """Return the command that solves a table."""
    code = "import sys; from napari_hmrf.cli import main; sys.exit(main())"
    return [sys.executable, "-c", code, "batch", str(table), str(out), *more]


def finished(out: Path) -> list[Path]:
    return sorted(out.glob(f"*/{RECORD}"))


def killed_and_resumed(folder: Path, count: int) -> None:
    """Kill all processes of a batch half way, and resume the batch."""
    table, out = write_cases(folder, count), folder / "killed"
    process = subprocess.Popen(in_shell(table, out, "--jobs", f"{WORKERS}"))
    while len(finished(out)) < count // 2 and process.poll() is None:
        time.sleep(0.05)
    process.kill()
    process.wait()
    before = {path: path.stat().st_mtime_ns for path in finished(out)}
    done = subprocess.run(in_shell(table, out, "--jobs", f"{WORKERS}", "--resume"), check=False)
    with open(out / "summary.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    wrong = [row["case"] for row in rows if row["state"] != "done"]
    kept = sum(path.stat().st_mtime_ns == when for path, when in before.items())
    most = {
        row["case"]: abs(float(row["largest_displacement"]) - amount)
        for row, amount in zip(rows, (2 + 4 * n / count for n in range(count)), strict=True)
        if row["state"] == "done"
    }
    print(
        f"killed with {len(before)} of {count} cases finished, and resumed (exit {done.returncode})"
    )
    print(
        f"  unchanged: {kept} of {len(before)}; solved: {len(most)}; not solved: {', '.join(wrong)}"
    )
    print(f"  largest displacement: within {max(most.values()):.2g} px of the requested one")
    halves = [path.name for path in out.iterdir() if path.is_dir() and not (path / RECORD).exists()]
    print(f"  incomplete folders: {len(halves)}")


def loop(table: Path, out: Path, count: int) -> dict[str, float]:
    """Solve cases in this process on one thread, and return the time per case."""
    one_thread()
    cases = [each for each in read_cases(table) if each.case.image.exists()][: count + 3]
    for case in cases[:3]:
        solve_case(case.case, out / case.name, backend="cpu", changes=case.changes)
    clock, busy = time.perf_counter(), time.process_time()
    for case in cases[3:]:
        solve_case(case.case, out / case.name, backend="cpu", changes=case.changes)
    clock, busy = time.perf_counter() - clock, time.process_time() - busy
    return {"clock": clock / len(cases[3:]), "processor": busy / len(cases[3:])}


class Pace(NamedTuple):
    """Seconds per case of a batch.

    Attributes
    ----------
    first : float
        Time until the first case is complete, including the start of processes and loading loops.
    clock, processors : float
        Wall-clock time and processor time of all our processes, per later case.
    """

    first: float
    clock: float
    processors: float


def processors() -> float:
    """Return the processor time of this process and its child processes, in seconds."""
    here = psutil.Process()
    return sum(sum(each.cpu_times()[:2]) for each in (here, *here.children(recursive=True)))


def pace_of(count: int, run: Callable[[Callable[[object], None]], object]) -> Pace:
    """Measure the pace of a batch of `count` cases."""
    warm, come, busy = 4 * WORKERS, [time.perf_counter()], []

    def tell(_: object) -> None:
        come.append(time.perf_counter())
        if len(come) - 1 in (warm, count):  # measuring takes as long as a case
            busy.append(processors())

    run(tell)
    some = count - warm
    return Pace(come[1] - come[0], (come[-1] - come[warm]) / some, (busy[1] - busy[0]) / some)


def throughput(folder: Path, count: int) -> None:
    """Print cases per second and core of the loop, the pool and a cluster, in turn."""
    table, again = write_cases(folder, count, broken=False), [sys.executable, __file__, "--loop"]

    def looped() -> dict[str, float]:
        out = folder / "loop"
        shutil.rmtree(out, ignore_errors=True)
        done = subprocess.run(
            [*again, str(table), str(out)], capture_output=True, text=True, check=True
        )
        return json.loads(done.stdout.splitlines()[-1])

    before = looped()
    cases = read_cases(table)
    paces = {
        "2 processes": pace_of(
            count, lambda tell: solve_cases(cases, folder / "pool", jobs=WORKERS, progress=tell)
        )
    }
    if importlib.util.find_spec("distributed"):
        import dask
        from distributed import LocalCluster

        options = {"n_workers": WORKERS, "threads_per_worker": 1, "dashboard_address": None}
        with dask.config.set(LEAN), LocalCluster(**options) as cluster:
            address = cluster.scheduler_address
            paces["dask, 2 workers"] = pace_of(
                count,
                lambda tell: solve_cases(cases, folder / "dask", scheduler=address, progress=tell),
            )
    after = looped()
    clock, busy = ((before[each] + after[each]) / 2 for each in ("clock", "processor"))
    print(
        f"\na loop in one process, warm: {1000 * clock:.0f} ms per case (processor time "
        f"{1000 * busy:.0f} ms; {1000 * before['clock']:.0f} ms before the other runs, "
        f"{1000 * after['clock']:.0f} ms after them)"
    )
    for name, pace in paces.items():
        print(
            f"{name}: the first case after {pace.first:.1f} s, then {1000 * pace.clock:.0f} ms "
            f"per case (processor time {1000 * pace.processors:.0f} ms)"
        )
        print(
            f"  throughput per core relative to the loop: {clock / (pace.clock * WORKERS):.2f} by "
            f"wall-clock time, {busy / pace.processors:.2f} by processor time"
        )
    if len(paces) == 1:
        print("dask.distributed is not installed, so no cluster was measured")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--loop", nargs=2, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.loop:
        print(json.dumps(loop(*options.loop, options.cases)))
        return 0
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {SIZE} x {SIZE} pixels")
    with tempfile.TemporaryDirectory() as folder:
        killed_and_resumed(Path(folder), options.cases)
        throughput(Path(folder), options.cases)
    return 0


if __name__ == "__main__":
    sys.exit(main())

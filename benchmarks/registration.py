"""Accuracy and time of `register` and of other registration programs.

    python -m benchmarks.registration known [--image T1 [--tissue GREY WHITE]] [--seeds 2 3 4]
    python -m benchmarks.registration pairs FIXED MOVING
    python -m benchmarks.registration constraints

`known` deforms a head by known displacements: random B-splines with knots 24 mm apart and an
expansion (``splines``), regions of the brain that are pulled, in large motion (``large``), lesions
that grow (``growth``), and random B-splines with knots 12 mm apart (``fine``). The image is a
volume such as a T1-weighted MRI, with optional probability maps of grey and white matter, or else
the synthetic head of the package. No MRI is included in this project. Seeds 0 and 1 were used to
choose the settings of all programs. ``--results FILE`` keeps each result in a file, from which a
later run continues.

`pairs` registers two pictures of neighbouring sections after the same affine map, and compares
landmarks, which are features that are matched in both pictures as in `benchmarks.sections`.

The other programs are demons of SimpleITK (extra ``medical``), elastix and ANTs::

    pip install itk-elastix antspyx

Elastix and SyN receive images without bias (N4 of SimpleITK, not timed), because only `register`
normalizes brightness. Programs that are not installed are skipped. ``--methods`` selects programs,
such as ``ours demons elastix-12``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from benchmarks.registration_constraints import print_constraints
from benchmarks.registration_rivals import rivals, without_bias
from benchmarks.registration_truths import TRUTHS, Head, case, head_from_files, phantom_head
from napari_hmrf.fields import count_folds
from napari_hmrf.registration import register

Array = npt.NDArray[Any]
Row = dict[str, Any]

#: Name of this package, with and without the stiffness of tissue.
_OURS, _STIFF = "ours", "ours-stiffness"
#: Settings of the other programs: distances of the knots of elastix, and widths of demons.
_KNOWN = {"gaps": (12.0, 20.0), "sigmas": (1.5, 2.0)}
_PAIRS = {"gaps": (40.0, 80.0), "sigmas": (1.5, 3.0)}
#: Programs that receive images without bias. `register` normalizes brightness itself, and demons
#: are worse with them: 2.0 instead of 1.5 mm on the first held-out case.
_UNBIASED = ("elastix", "syn")
#: Programs that run by default; SyN with cross-correlation takes minutes for each case.
_DEFAULT = (_OURS, "demons", "elastix", "syn-mattes")
#: Random samples for an interval, and its level in percent.
_SAMPLES, _LEVEL = 2000, 95.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the selected benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    known = commands.add_parser("known", help="known deformations of a head")
    known.add_argument("--image", type=Path, help="volume of a head; by default a synthetic head")
    known.add_argument("--tissue", type=Path, nargs="+", default=[], help="grey and white matter")
    known.add_argument("--voxel", type=float, default=2.0, help="size of a voxel in mm")
    known.add_argument("--truths", nargs="+", default=list(TRUTHS), choices=list(TRUTHS))
    known.add_argument("--seeds", type=int, nargs="+", default=[2, 3, 4, 5, 6])
    known.add_argument("--results", type=Path, help="file of results, one in each line")
    pairs = commands.add_parser("pairs", help="two pictures of neighbouring sections")
    pairs.add_argument("fixed", type=Path)
    pairs.add_argument("moving", type=Path)
    pairs.add_argument(
        "--landmarks",
        type=Path,
        nargs=2,
        help="files with a row of number, x and y for each landmark; by default, matched features",
    )
    commands.add_parser("constraints", help="rigid bone and a masked artefact, in a volume")
    for each in (known, pairs):
        each.add_argument(
            "--methods", nargs="+", default=_DEFAULT, help="names, or the beginnings of names"
        )
    options = parser.parse_args(arguments)
    if options.command == "constraints":
        print_constraints()
        return 0
    if options.command == "pairs":
        compare_pair(options.fixed, options.moving, options.methods, options.landmarks)
        return 0
    if options.image is None:
        head = phantom_head(round(190 / options.voxel))
    else:
        head = head_from_files(options.image, options.tissue, options.voxel)
    rows = run(head, options.truths, options.seeds, options.methods, options.results)
    print_means(rows)
    return 0


def run(
    head: Head,
    truths: Iterable[str],
    seeds: Iterable[int],
    methods: Sequence[str],
    results: Path | None = None,
) -> list[Row]:
    """Register all cases, print a row for each case and method, and return the rows."""
    earlier: list[Row] = []
    if results is not None and results.exists():
        earlier = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()]
    done = {_key(row): row for row in earlier}
    programs = _selected(methods, _KNOWN, head)
    print(
        f"{head.name}: {' x '.join(map(str, head.image.shape))} voxels\n\n"
        "| truth | seed | method | mean error (mm) | p95 | time (s) | processor (s) | folds |\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- |"
    )
    warm = np.random.default_rng(0).random((16, 16, 16))
    register(warm, warm, spacing=1)  # compiles loops outside of the measured times
    rows = []
    for seed in seeds:
        for truth in truths:
            made, others = None, None
            for method in ("unmoved", *programs):
                row: Row = {"head": head.name, "truth": truth, "seed": seed, "method": method}
                if _key(row) in done:
                    row = done[_key(row)]
                else:
                    made = made or case(head, truth, seed)
                    images = made.fixed, made.moving
                    if method.startswith(_UNBIASED):
                        others = others or tuple(map(without_bias, images))
                        images = others
                    began, worked = time.perf_counter(), time.process_time()
                    if method == "unmoved":
                        found = np.zeros_like(made.displacement)
                    else:
                        found = programs[method](*images, head.spacing)
                    row |= {
                        "seconds": time.perf_counter() - began,
                        "processor": time.process_time() - worked,
                        "folds": count_folds(found, spacing=head.spacing),
                        **errors(found, made.displacement, head.brain),
                    }
                    if results is not None:
                        with results.open("a", encoding="utf-8") as file:
                            file.write(json.dumps(row) + "\n")
                rows.append(row)
                print(
                    f"| {truth} | {seed} | {method} | {row['mean']:.3f} | {row['p95']:.2f} "
                    f"| {row['seconds']:.0f} | {row['processor']:.0f} | {row['folds']} |",
                    flush=True,
                )
    return rows


def errors(found: Array, truth: Array, tissue: Array) -> dict[str, float]:
    """Return the mean and the 95th percentile of the distance of two displacements in tissue."""
    away = np.linalg.norm(found - truth, axis=-1)[tissue]
    return {"mean": float(away.mean()), "p95": float(np.percentile(away, 95))}


def print_means(rows: Sequence[Row]) -> None:
    """Print means over seeds, and ratios to the best other program and to elastix."""
    cases: dict[tuple[str, int], dict[str, Row]] = {}
    for row in rows:
        cases.setdefault((row["truth"], row["seed"]), {})[row["method"]] = row
    print(
        "\n| truth | method | seeds | mean error (mm) | interval | p95 | time (s) "
        "| processor time (s) | folds |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    )
    for truth in dict.fromkeys(row["truth"] for row in rows):
        for method in dict.fromkeys(row["method"] for row in rows):
            own = [row for row in rows if (row["truth"], row["method"]) == (truth, method)]
            if own:
                means = {
                    name: np.mean([row[name] for row in own])
                    for name in ("mean", "p95", "seconds", "processor", "folds")
                }
                low, high = interval([row["mean"] for row in own])
                print(
                    f"| {truth} | {method} | {len(own)} | {means['mean']:.3f} "
                    f"| {low:.3f} to {high:.3f} | {means['p95']:.2f} | {means['seconds']:.0f} "
                    f"| {means['processor']:.0f} | {means['folds']:.0f} |"
                )
    _print_ratios(cases)


def _print_ratios(cases: dict[tuple[str, int], dict[str, Row]]) -> None:
    print(
        "\n| truth | seeds | best other program | error, ratio to it | interval | best in "
        "| processor time, ratio to the faster elastix |\n"
        "| --- | --- | --- | --- | --- | --- | --- |"
    )
    everything = []
    for truth in [*dict.fromkeys(truth for truth, _ in cases), "all"]:
        ratios, times, names = [], [], []
        for (own_truth, _), methods in cases.items():
            others = [
                row
                for name, row in methods.items()
                if name != "unmoved" and not name.startswith(_OURS)
            ]
            if _OURS not in methods or not others or truth not in (own_truth, "all"):
                continue
            best = min(others, key=lambda row: row["mean"])
            names.append(best["method"])
            ratios.append(methods[_OURS]["mean"] / best["mean"])
            elastix = [row["processor"] for row in others if row["method"].startswith("elastix")]
            if elastix:
                times.append(methods[_OURS]["processor"] / min(elastix))
        if not ratios:
            continue
        everything += ratios
        low, high = interval(ratios)
        often = max(dict.fromkeys(names), key=names.count)
        faster = f"{np.mean(times):.2f}" if times else "-"
        print(
            f"| {truth} | {len(ratios)} | {often} | {np.mean(ratios):.2f} | {low:.2f} to "
            f"{high:.2f} | {sum(ratio <= 1 for ratio in ratios)} of {len(ratios)} | {faster} |"
        )


def interval(
    values: Iterable[float], statistic: Callable[..., Any] = np.mean
) -> tuple[float, float]:
    """Return the bootstrap interval of a statistic of some values."""
    given = np.array(list(values))
    drawn = np.random.default_rng(0).integers(len(given), size=(_SAMPLES, len(given)))
    outside = (100 - _LEVEL) / 2
    low, high = np.percentile(statistic(given[drawn], axis=1), (outside, 100 - outside))
    return float(low), float(high)


def compare_pair(
    fixed: Path, moving: Path, methods: Sequence[str], files: Sequence[Path] | None = None
) -> None:
    """Print the errors of landmarks of two pictures, in pixels.

    Parameters
    ----------
    fixed, moving : Path
    methods : sequence of str
    files : sequence of Path, optional
        Landmarks of each picture; by default, features that are matched in both pictures.
    """
    from benchmarks.sections import grey, landmarks

    pictures = grey(fixed), grey(moving)
    if files is None:
        at, to = landmarks(*pictures)
    else:
        both = [np.loadtxt(each, delimiter=",", skiprows=1)[:, [2, 1]] for each in files]
        count = min(map(len, both))
        at, to = (each[:count] for each in both)
    began = time.perf_counter()
    ours = register(*pictures, spacing=1, initial="affine")
    seconds = {_OURS: time.perf_counter() - began}
    turn, shift = ours.matrix[:2, :2], ours.matrix[:2, 2]
    aligned = ndimage.affine_transform(
        pictures[1], turn, shift, pictures[0].shape, order=3, mode="nearest"
    )
    fields = {"affine": np.zeros_like(ours.displacement), _OURS: ours.displacement}
    for name, program in _selected(methods, _PAIRS, None).items():
        if name != _OURS:
            began = time.perf_counter()
            fields[name] = program(pictures[0], aligned, (1.0, 1.0))
            seconds[name] = time.perf_counter() - began
    print(
        f"{fixed.name}, {moving.name}: {len(at)} landmarks\n\n"
        "| method | median (px) | interval | rms | interval | time (s) | folds |\n"
        "| --- | --- | --- | --- | --- | --- | --- |"
    )
    away = {}
    for name, field in fields.items():
        moved = at + np.stack(
            [ndimage.map_coordinates(field[..., axis], at.T, order=1) for axis in range(2)], axis=1
        )
        away[name] = np.linalg.norm(moved @ turn.T + shift - to, axis=1)
        median, rms = interval(away[name], np.median), interval(away[name], _rms)
        print(
            f"| {name} | {np.median(away[name]):.2f} | {median[0]:.2f} to {median[1]:.2f} "
            f"| {_rms(away[name]):.2f} | {rms[0]:.2f} to {rms[1]:.2f} "
            f"| {seconds.get(name, 0):.1f} | {count_folds(field, spacing=1)} |"
        )
    print(
        "\n| ours minus | median (px) | interval | rms | interval |\n"
        "| --- | --- | --- | --- | --- |"
    )
    drawn = np.random.default_rng(0).integers(len(at), size=(_SAMPLES, len(at)))
    for name, other in away.items():
        if name != _OURS:
            cells = []
            for statistic in (np.median, _rms):
                value = statistic(away[_OURS]) - statistic(other)
                both = [statistic(each[drawn], axis=1) for each in (away[_OURS], other)]
                low, high = np.percentile(both[0] - both[1], (2.5, 97.5))
                cells.append(f"{value:+.2f} | {low:+.2f} to {high:+.2f}")
            print(f"| {name} | {' | '.join(cells)} |")


def _rms(values: Array, axis: int | None = None) -> Array:
    return np.sqrt((values**2).mean(axis=axis))


def _ours(fixed: Array, moving: Array, spacing: tuple[float, ...], m: Array | None = None) -> Array:
    return register(fixed, moving, spacing=spacing, stiffness=m).displacement


def _selected(
    methods: Sequence[str], settings: dict[str, Any], head: Head | None
) -> dict[str, Callable[[Array, Array, tuple[float, ...]], Array]]:
    """Return the programs whose names begin with a word, and report those not installed."""
    programs: dict[str, Any] = {_OURS: _ours}
    if head is not None:
        programs[_STIFF] = lambda *images: _ours(*images, m=head.stiffness)
    selected = {name: program for name, program in programs.items() if name in methods}
    for name, rival in rivals(**settings).items():
        if not any(name.startswith(word) for word in methods):
            continue
        if rival.available:
            selected[name] = rival.register
        else:
            print(f"{name} is skipped: it requires `pip install {rival.package}`")
    if not selected:
        raise SystemExit(f"no program has a name that begins with {', '.join(methods)}")
    return selected


def _key(row: Row) -> tuple[Any, ...]:
    return row["head"], row["truth"], row["seed"], row["method"]


if __name__ == "__main__":
    sys.exit(main())

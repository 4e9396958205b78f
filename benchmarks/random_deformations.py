"""Random deformations: folds, reproducibility by seed, and cost of a sample.

    python benchmarks/random_deformations.py [--quick] [--fields 1000]

The cost is compared with MONAI's elastic transforms in the same run if MONAI is installed.
Otherwise, it is compared with the usual elastic transform in SciPy: a displacement of blurred
noise, applied to an image and its labels. CPU time is the time of all threads of this process for a
field, an image and its labels.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import scipy
from report.page import load, machine

from napari_hmrf import Material, solve_study
from napari_hmrf.fields import Picture, fold_mask
from napari_hmrf.random import RandomDeformation
from napari_hmrf.tissue import RIGID

MATERIALS = (
    Material(0, "air", 0.0),
    Material(1, "soft", 3.0),
    Material(2, "tumour", 10.0, 0.45, 0.1),
    Material(3, "bone", RIGID),
)
#: Largest accepted ratio to the CPU time of the other transform, in images and in volumes.
ASKED = {2: 1.5, 3: 0.5}


def case(size: int, axes: int) -> np.ndarray:
    """Return labels of a round body in air, with a tumour in its middle and a bone beside it."""
    at = np.moveaxis(np.indices((size,) * axes), 0, -1) / (size - 1) - 0.5
    labels = (np.linalg.norm(at, axis=-1) < 0.46).astype(np.uint8)
    labels[np.linalg.norm(at, axis=-1) < 0.12] = 2
    beside = (0.0,) * (axes - 2) + (-0.2, 0.15)
    labels[np.linalg.norm(at - beside, axis=-1) < 0.06] = 3
    return labels


def by_scipy(image: np.ndarray, labels: np.ndarray) -> Callable[[], object]:
    """Return the usual elastic transform, as implemented in many pipelines."""
    random, n = np.random.default_rng(0), image.ndim
    own = np.indices(image.shape, dtype=np.float32)

    def transform() -> object:
        noise = random.standard_normal((n, *image.shape), dtype=np.float32)
        at = own + 60 * np.stack([scipy.ndimage.gaussian_filter(each, 8) for each in noise])
        moved = scipy.ndimage.map_coordinates(image, at, order=1, mode="nearest")
        return moved, scipy.ndimage.map_coordinates(labels, at, order=0, mode="nearest")

    return transform


def by_monai(image: np.ndarray, labels: np.ndarray) -> Callable[[], object]:
    """Return MONAI's elastic transform of an image and its labels, set as in MONAI's tutorial."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from monai.transforms import Rand2DElasticd, Rand3DElasticd

        keys, mode = ("image", "label"), ("bilinear", "nearest")
        if image.ndim == 2:
            more = {"spacing": (30, 30), "magnitude_range": (5, 6)}
            made = Rand2DElasticd(keys, prob=1.0, mode=mode, **more)
        else:
            more = {"sigma_range": (5, 8), "magnitude_range": (100, 200)}
            made = Rand3DElasticd(keys, prob=1.0, mode=mode, **more)
    made.set_random_state(0)
    given = {"image": image[None], "label": labels[None]}
    return lambda: made(given)


def cost(transform: Callable[[], object], times: int) -> float:
    """Return the median CPU time of a transform over several runs, in seconds."""
    transform()
    found = []
    for _ in range(times):
        begun = time.process_time()
        transform()
        found.append(time.process_time() - begun)
    return float(np.median(found))


def measure(size: int, axes: int, fields: int, times: int) -> bool:
    """Print the results of one case, and return whether they satisfy the requirements."""
    labels = case(size, axes)
    image = np.random.default_rng(0).random(labels.shape, dtype=np.float32)
    begun = time.perf_counter()
    deformation = RandomDeformation(labels, MATERIALS, spacing=1)
    print(f"\n{' x '.join([str(size)] * axes)}: {deformation}")
    print(f"  unit solutions in {time.perf_counter() - begun:.1f} s")
    digests, folded, scales, farthest = [], 0, [], []
    for seed in range(fields):
        sample = deformation.sample(seed)
        folded += bool(fold_mask(sample.displacement, spacing=1, tissue=sample.tissue).any())
        digests.append(hashlib.sha256(sample.displacement).digest())
        scales.append(sample.scale)
        farthest.append(float(np.linalg.norm(sample.displacement, axis=-1).max()))
    again = [hashlib.sha256(deformation.sample(s).displacement).digest() for s in range(fields)]
    less = [scale for scale in scales if scale < 1]
    print(
        f"  {fields} random fields: {folded} fold; {len(less)} were scaled down to prevent "
        f"folds, by a median factor of {np.median(less or [1]):.2f}; largest displacement: median "
        f"{np.median(farthest):.1f} px, maximum {max(farthest):.1f} px"
    )
    print(f"  same seeds again: {sum(map(bytes.__ne__, digests, again))} fields differ")
    off = 0.0
    for seed in range(3):
        sample = deformation.sample(seed)
        solved = solve_study(sample.study).displacement
        off = max(off, float(np.abs(solved - sample.displacement).max()))
    print(f"  largest difference from three full solves of the same boundaries: {off:.2g} px")
    seeds = iter(range(10**9))
    pictures = Picture(image), Picture(labels, order=0)
    ours = cost(lambda: deformation.sample(next(seeds)).pictures(*pictures), times)
    field = cost(lambda: deformation.sample(next(seeds)), times)
    asked = f" (required: at most {ASKED[axes]})"
    try:
        name, others = f"MONAI's Rand{axes}DElasticd", cost(by_monai(image, labels), times)
    except ImportError:
        name, others = (
            "MONAI is not installed; SciPy's transform",
            cost(by_scipy(image, labels), times),
        )
        asked = ""
    ratio = ours / others
    print(
        f"  CPU time per sample: {1e3 * ours:.1f} ms, of which {1e3 * field:.1f} ms for the field; "
        f"{name} {1e3 * others:.1f} ms: {ratio:.2f} times{asked}"
    )
    fast = not asked or ratio <= ASKED[axes]
    return not folded and digests == again and off < 0.01 and fast


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both cases; always return 0, because a benchmark is not a test."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small sizes, for a quick check")
    parser.add_argument("--fields", type=int, default=1000, help="default: %(default)s")
    options = parser.parse_args(arguments)
    before = load()
    print(machine(), "" if before is None else f"; load {before:.1f}", sep="")
    flat, deep, times = (48, 16, 3) if options.quick else (256, 96, 30)
    fields = 10 if options.quick else options.fields
    met = [measure(flat, 2, fields, times), measure(deep, 3, max(1, fields // 50), times)]
    print("\nall requirements met" if all(met) else "\nnot all requirements met")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Generator of the files in sample_data: phantoms, finite-element displacements, and two images.

Run the script from a checkout, with the test dependencies installed, after changing a phantom::

    python scripts/make_sample_data.py
"""

from __future__ import annotations

import io
import sys
import zipfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from napari_hmrf import ElasticPrior, solve  # noqa: E402
from napari_hmrf.data import PHANTOM_NAMES, phantom  # noqa: E402
from napari_hmrf.loads import growth  # noqa: E402
from napari_hmrf.samples.phantoms import held_brain  # noqa: E402
from napari_hmrf.solver.problem import variant_of  # noqa: E402
from validation.oracles.elasticity import direct_solution  # noqa: E402

#: Fixed date in the archives, so that equal arrays give identical files.
DATE = (2000, 1, 1, 0, 0, 0)
#: Label of the tumour.
TUMOUR = 3
#: Standard deviation of the noise of the two images, in grey levels.
NOISE = 4.0


def sample_arrays(name: str) -> dict[str, np.ndarray]:
    """Return the arrays of a phantom's file."""
    drawn = phantom(name)
    reference = direct_solution(drawn.problem, ElasticPrior(0.3))
    return {
        "image": drawn.image,
        "tissue_labels": drawn.tissue_labels,
        "boundary_labels": drawn.boundary_labels,
        "reference": np.rint(1000 * reference).astype(np.int16),
    }


def pair_arrays() -> dict[str, np.ndarray]:
    """Return images of a brain before and after its tumour grew by 40 % in length.

    Both have noise, and the second image has another contrast and a smooth bias.
    """
    brain = held_brain()
    grown = growth(0.4 * (brain.tissue_labels == TUMOUR))
    truth = solve(variant_of(brain.problem, loads=grown), backend="cpu")
    before, after = brain.image.astype(float), truth.warp(brain.image).astype(float)
    bias = 1 + 0.1 * np.sin(np.arange(before.shape[1]) / 60)
    after = 255 * (after / 255) ** 1.2 * bias
    rng = np.random.default_rng(0)
    return {
        name: np.clip(np.rint(image + rng.normal(0, NOISE, image.shape)), 0, 255).astype(np.uint8)
        for name, image in (("before", before), ("after", after))
    }


def write_archive(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a compressed .npz file, which depends only on the arrays."""
    with zipfile.ZipFile(path, "w") as archive:
        for member, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, version=(1, 0), allow_pickle=False)
            info = zipfile.ZipInfo(f"{member}.npy", DATE)
            archive.writestr(info, content.getvalue(), zipfile.ZIP_DEFLATED, 9)


def main() -> None:
    """Write all samples, and print the size of each file."""
    folder = ROOT / "sample_data"
    folder.mkdir(exist_ok=True)
    made = {name: sample_arrays(name) for name in PHANTOM_NAMES}
    for name, arrays in {**made, "two-images": pair_arrays()}.items():
        path = folder / f"{name}.npz"
        write_archive(path, arrays)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()

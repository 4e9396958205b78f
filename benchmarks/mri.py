"""Tumour growth in a real brain, from an MRI and its tissue maps to files, by shell commands.

    python benchmarks/mri.py FOLDER --slice 80 -o OUT [--size 12] [--growth 3]

FOLDER contains t1.nii.gz, and the probability maps gm.nii.gz and wm.nii.gz of grey and white
matter; any MRI with such maps is suitable. A tumour is painted in the middle of the largest region
of white matter, its rim grows, and the edge of the brain is prescribed. `napari-hmrf solve` and
`export` do the rest. Then SimpleITK warps the whole volume by the exported field, and its slice is
compared with our slice. Prints the results, and writes all files, the commands and a picture. Exits
with 1 if the two slices disagree.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    binary_erosion,
    binary_fill_holes,
    distance_transform_edt,
)

from napari_hmrf import Solution, read_study, warp
from napari_hmrf.cli import main as shell
from napari_hmrf.io.images import ImageFile, read_image, write_image

#: Largest difference between the two slices, as a fraction of the image's range.
_SAME = 1e-3
#: Typical values for brains, with stiffness in kPa; fluid is soft.
_MATERIALS = """label,name,stiffness,poisson
0,fluid and beyond,0.1,0.3
1,grey matter,1.9,0.45
2,white matter,2.8,0.45
"""
_RULES = """label,action,amount
1,fixed,
2,expand,{growth}
"""


def painted(brain: npt.NDArray[Any], white: npt.NDArray[Any], radius: float) -> npt.NDArray[Any]:
    """Return labels of the edge of the brain (1) and the rim of a tumour in white matter (2)."""
    depth = distance_transform_edt(white)
    # Avoid the middle of the picture, so that the tumour pushes to one side.
    depth[:, depth.shape[1] // 2 :] = 0
    middle = np.unravel_index(depth.argmax(), depth.shape)
    rows, cols = np.indices(brain.shape)
    tumour = np.hypot(rows - middle[0], cols - middle[1]) <= radius
    labels = np.zeros(brain.shape, np.uint8)
    labels[binary_dilation(brain, iterations=2) & ~binary_dilation(brain)] = 1
    labels[tumour & ~binary_erosion(tumour)] = 2
    return labels


def run(*command: Any) -> str:
    """Run a ``napari-hmrf`` command and return its command line."""
    words = [str(word) for word in command]
    if shell(words):
        raise SystemExit(f"failed: napari-hmrf {shlex.join(words)}")
    return f"napari-hmrf {shlex.join(words)}"


def resampled(volume: Path, field: Path, number: int) -> npt.NDArray[Any]:
    """Return SimpleITK's slice of the volume after warping the whole volume by a field."""
    import SimpleITK as sitk

    image = sitk.ReadImage(str(volume), sitk.sitkFloat64)
    vectors = sitk.ReadImage(str(field), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(vectors)
    moved = sitk.GetArrayFromImage(sitk.Resample(image, image, transform, sitk.sitkLinear))
    other = np.abs(moved - sitk.GetArrayFromImage(image)).max(axis=(1, 2))
    other[number] = 0
    print(f"other slices change by at most {other.max():.3g}")
    return np.asarray(moved[number])


def main(arguments: Sequence[str] | None = None) -> int:
    """Solve, export, compare and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--slice", type=int, default=80)
    parser.add_argument("--size", type=float, default=9.0, help="radius of the tumour, in pixels")
    parser.add_argument("--growth", type=float, default=3.0, help="expansion of its rim, in mm")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    out, number = options.out, options.slice
    out.mkdir(parents=True, exist_ok=True)
    t1, grey, white = (options.folder / f"{name}.nii.gz" for name in ("t1", "gm", "wm"))
    maps = [read_image(path).pixels[number].astype(float) for path in (grey, white)]
    likely = np.maximum(*maps) > max(map(np.max, maps)) / 2
    brain = binary_fill_holes(binary_closing(likely, iterations=4))
    rim = painted(brain, (maps[1] > maps[0]) & likely, options.size)
    write_image(out / "rim.png", ImageFile(rim))
    (out / "materials.csv").write_text(_MATERIALS)
    (out / "rules.csv").write_text(_RULES.format(growth=options.growth))
    tables = ("--materials", out / "materials.csv", "--rules", out / "rules.csv")
    inputs = ("--slice", number, "--maps", grey, white, "--boundary", out / "rim.png")
    typed = [run("solve", t1, *inputs, *tables, "-o", out, "--force")]
    saved, field = out / "t1.study", out / "field.mha"
    typed.append(run("export", saved, field, "--force"))
    typed.append(run("measure", saved, "-o", out / "measured.csv", "--force"))
    typed.append(run("replay", saved))
    study, solution = read_study(saved)
    assert solution is not None
    before = np.asarray(study.pictures.image, dtype=float)
    ours = warp(before, solution.displacement, spacing=solution.spacing, tissue=solution.tissue)
    theirs = resampled(t1, field, number)
    inside = binary_erosion(brain, iterations=2)
    away = np.abs(ours - theirs)[inside] / np.ptp(before)
    far = np.linalg.norm(solution.displacement, axis=-1)
    print(f"displacement: at most {far.max():.2f} mm, mean in the brain {far[brain].mean():.2f} mm")
    print(
        f"our slice differs from SimpleITK's by at most {away.max():.1g} of the image's range; the "
        f"deformation changes grey values by up to {np.abs(ours - before).max():.0f} of "
        f"{np.ptp(before):.0f}"
    )
    (out / "commands.sh").write_text("\n".join(typed) + "\n")
    _draw(out / "tumour.png", study.tissue.labels, rim, (before, ours, theirs), solution)
    return int(away.max() > _SAME)


def _draw(
    path: Path,
    tissue: npt.NDArray[Any] | None,
    rim: npt.NDArray[Any],
    pictures: Sequence[npt.NDArray[Any]],
    solution: Solution,
) -> None:
    from matplotlib.figure import Figure

    before, ours, theirs = pictures
    far = np.linalg.norm(solution.displacement, axis=-1)
    figure = Figure((15, 12), layout="constrained")
    drawn: list[tuple[str, npt.NDArray[Any], str]] = [
        ("before", before, "gray"),
        ("tissue from the maps, and painted labels", np.where(rim > 0, rim + 2, tissue), "viridis"),
        ("displacement, mm", far, "magma"),
        ("after, by this package", ours, "gray"),
        ("after, by SimpleITK", theirs, "gray"),
        ("difference of the two pictures", ours - theirs, "RdBu"),
    ]
    for place, (title, picture, colours) in enumerate(drawn):
        axes = figure.add_subplot(2, 3, place + 1)
        shown = axes.imshow(picture, cmap=colours, origin="lower")
        if colours in ("magma", "RdBu"):
            figure.colorbar(shown, shrink=0.6)
        axes.set_title(title)
        axes.axis("off")
    figure.savefig(path)


if __name__ == "__main__":
    sys.exit(main())

"""Synthetic images for the tutorial, in place of a user's own images."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

Floats = npt.NDArray[np.float64]


def ellipse(
    shape: tuple[int, int], centre: tuple[float, float], radii: tuple[float, float]
) -> Floats:
    """Return the approximate fraction of each pixel inside an ellipse, from 0 to 1."""
    rows, cols = np.indices(shape)
    away = np.hypot((rows - centre[0]) / radii[0], (cols - centre[1]) / radii[1])
    return np.clip((1 - away) * min(radii) + 0.5, 0, 1)


def abdomen(size: float = 1.0, seed: int = 5) -> Floats:
    """Draw a synthetic slice through an abdomen, 0 to 255; `size` scales its lesion."""
    shape = (260, 340)
    picture = np.full(shape, 4.0)
    for centre, radii, value in (
        ((132, 170), (116, 156), 150),  # fat
        ((132, 170), (103, 143), 100),  # muscle
        ((134, 170), (92, 130), 84),  # tissue between the organs
        ((118, 112), (68, 70), 165),  # liver
        ((100, 232), (34, 44), 48),  # stomach
        ((160, 262), (38, 24), 150),  # spleen
        ((186, 110), (20, 26), 140),  # kidneys
        ((192, 232), (20, 26), 140),
        ((204, 170), (24, 26), 230),  # spine
        ((166, 170), (9, 9), 190),  # aorta
        ((112, 98), (17 * size, 18 * size), 106),  # lesion
    ):
        part = ellipse(shape, centre, radii)
        picture = picture * (1 - part) + value * part
    noise = np.random.default_rng(seed).normal(size=shape)
    grain = 22 * gaussian_filter(noise, 1.6) * (picture > 10)
    return np.clip(gaussian_filter(picture, 0.7) + grain, 0, 255)


def gel() -> Floats:
    """Draw a synthetic photograph of a block of gel with inclusions, shape (H, W, 3)."""
    shape = (280, 360)
    rows, cols = np.indices(shape)
    block = ellipse(shape, (140, 180), (125, 165)) ** 0.2
    block *= ((np.abs(rows - 140) < 108) & (np.abs(cols - 180) < 148)).astype(float)
    block = gaussian_filter(block, 1.2)
    picture = np.empty((*shape, 3))
    picture[:] = (24, 30, 44)
    picture += gaussian_filter(np.random.default_rng(2).normal(size=shape), 3)[..., None] * 30
    light = 1.1 - 0.0012 * (rows + cols / 2)
    picture = picture * (1 - block[..., None])
    picture += (block * light)[..., None] * np.array((226, 150, 132))
    for centre, radii, colour in (
        ((120, 130), (34, 40), (172, 62, 70)),
        ((175, 245), (24, 22), (240, 214, 170)),
    ):
        part = ellipse(shape, centre, radii)[..., None]
        picture = picture * (1 - part) + part * np.array(colour) * light[..., None]
    lines = (np.minimum(rows % 27, cols % 27) < 1) & (block > 0.9)
    picture[lines] *= 0.8
    return np.clip(picture + np.random.default_rng(3).normal(size=shape)[..., None] * 3, 0, 255)


def write(folder: Path) -> dict[str, Path]:
    """Write a slice, a photograph and a stack to files, and return their paths."""
    paths = {
        "png": folder / "abdomen.png",
        "photograph": folder / "gel.png",
        "stack": folder / "abdomen-stack.tif",
    }
    stack = [abdomen(size, seed) for seed, size in enumerate((0.2, 0.5, 0.8, 1.0, 0.9, 0.6, 0.3))]
    iio.imwrite(paths["png"], abdomen().astype(np.uint8))
    iio.imwrite(paths["photograph"], gel().astype(np.uint8))
    iio.imwrite(paths["stack"], np.stack(stack).astype(np.uint8))
    return paths

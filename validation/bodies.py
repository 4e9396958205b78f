"""Problems in bodies of a known shape: bars, blocks, and balls in a fixed frame.

They use the public interface only, so that benchmarks can build them with another checkout.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf import Problem
from napari_hmrf.loads import Loads

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Shape = tuple[int, ...]
Dice = np.random.Generator

#: Sides of oblong voxels.
OBLONG = (1.0, 1.7, 0.6)


def bar(height: int, width: int, end: npt.ArrayLike, m: npt.ArrayLike = 1.0) -> Problem:
    """Return a bar with a fixed left end and a right end displaced by (2,) or (height, 2)."""
    c = np.zeros((height, width, 2))
    c[:, 0] = c[:, -1] = 1
    y = np.zeros_like(c)
    y[:, -1] = end
    return Problem(observed=y, confidence=c, stiffness=np.broadcast_to(m, (height, width)))


def turned(height: int, width: int, degrees: float) -> Array:
    """Return the displacement of the right end of a bar whose middle line is bent to an arc."""
    angle = np.deg2rad(degrees)
    radius = (width - 1) / angle
    off = np.arange(height) - (height - 1) / 2
    row = radius - (radius - off) * np.cos(angle) - off
    return np.stack([row, (radius - off) * np.sin(angle) - (width - 1)], axis=-1)


def between_plates(
    m: npt.NDArray[Any],
    by: npt.ArrayLike,
    spacing: tuple[float, ...] | None = None,
    loads: Loads | None = None,
) -> Problem:
    """Return tissue between a fixed plate and a plate that is moved by `by` pixels.

    Parameters
    ----------
    m : ndarray, shape (H, W) or (D, H, W)
        Stiffness; the plates are its first and last sites along the first axis.
    by : array_like, shape (axes,), or that with the shape of a plate before it
        Displacement along each axis, in pixels of that axis.
    spacing : tuple of float, optional
        Size of a pixel; by default 1.
    loads : Loads, optional
    """
    spacing = spacing or (1.0,) * m.ndim
    y, c = np.zeros((2, *m.shape, m.ndim))
    c[[0, -1]], y[-1] = 1, np.array(by) * spacing
    return Problem(observed=y, confidence=c, stiffness=m, spacing=spacing, loads=loads)


def random_block(size: int, contrast: float, by: tuple[float, ...], balls: int = 0) -> Problem:
    """Return oblong voxels of random stiffness, with void balls, between two plates."""
    dice, shape = dice_of(0), (size,) * 3
    m = contrast ** dice.random(shape)
    for _ in range(balls):
        m[
            np.linalg.norm(offsets(shape, dice.uniform(0.15, 0.85, 3) * size), axis=0) < 0.08 * size
        ] = 0
    return between_plates(m, by, OBLONG)


def frame_problem(
    shape: Shape,
    seed: int = 0,
    ratio: float = 4.0,
    amplitude: float = 2.0,
    spacing: tuple[float, ...] = (1.0, 1.0),
    has_hole: bool = False,
) -> Problem:
    """Return an image of random tissue with random prescribed displacements at its border."""
    dice = dice_of(seed)
    m = ratio ** dice.random(shape)
    if has_hole:
        m[shape[0] // 2, shape[1] // 2] = 0
    y = dice.normal(scale=amplitude, size=(*shape, 2))
    c = np.zeros((*shape, 2))
    c[[0, -1]] = c[:, [0, -1]] = 1
    return Problem(observed=y, confidence=c, stiffness=m, spacing=spacing)


def pulled_problem(
    vector: tuple[float, float] = (2.0, -1.0),
    at: tuple[float, float] = (10, 8),
    stiff: float = 30.0,
    size: int = 20,
    radius: float = 2.5,
) -> Problem:
    """Return a body with a fixed border, a stiff inclusion and a pulled patch."""
    m = np.full((size, size), 10.0)
    m[size // 4 : size // 2, size // 2 : -3] = stiff
    return framed(np.hypot(*offsets((size, size), at)) <= radius, vector, stiffness=m)


def uncertain_problem(seed: int = 0, spacing: tuple[float, ...] = (1.0, 1.0)) -> Problem:
    """Return soft and stiff tissue with observations of random confidence."""
    dice = dice_of(seed)
    shape = (9, 11)
    m = np.where(dice.random(shape) < 0.5, 1.0, 10.0)
    m[5:7, 2:5] = 0
    c = np.zeros((*shape, 2))
    c[0] = dice.uniform(0.05, 1, (11, 2))
    c[-1, ::2] = dice.uniform(0.05, 1, (6, 2))
    c[3:5, 6:10, 1] = 0.5
    return Problem(
        observed=dice.normal(size=(*shape, 2)), confidence=c, stiffness=m, spacing=spacing
    )


def framed(
    inside: Flags, y: npt.ArrayLike, loads: Loads | None = None, stiffness: npt.ArrayLike = 1.0
) -> Problem:
    """Return tissue with a fixed border, in which the sites `inside` are displaced by `y`.

    Parameters
    ----------
    inside : ndarray of bool, shape (H, W) or (D, H, W)
    y : array_like, shape (axes,) or (H, W, 2) or (D, H, W, 3)
        Displacement in pixels.
    loads : Loads, optional
    stiffness : array_like, shape () or that of `inside`
    """
    axes = inside.ndim
    c = np.ones((*inside.shape, axes))
    middle = (slice(1, -1),) * axes
    c[middle] = inside[middle][..., None]
    return Problem(
        observed=np.where(inside[..., None], y, 0.0),
        confidence=c,
        stiffness=np.broadcast_to(stiffness, inside.shape),
        loads=loads,
    )


def dragged_disc(size: int, radius: float, far: float, begun: float | None = None) -> Problem:
    """Return an image with a fixed border and a disc that is dragged along the last axis.

    It is dragged by `far` pixels, from `begun / 2` pixels before the middle, by default half the
    way.
    """
    row, col = np.indices((size, size)) - size // 2
    off = (far if begun is None else begun) / 2
    return framed(row**2 + (col + off) ** 2 <= radius**2, (0, far))


def dragged_ball(size: int, far: float, off: float | None = None) -> Problem:
    """Return a cube with a fixed border and a ball that is dragged along the last axis.

    It is dragged by `far` voxels, from `off` voxels before the middle, by default half the way.
    """
    around = np.indices((size,) * 3) - (size - 1) / 2
    around[2] += far / 2 if off is None else off
    return framed(np.linalg.norm(around, axis=0) <= size / 8, (0.0, 0.0, far))


def growing_ball(size: int, factor: float) -> Problem:
    """Return a cube with a fixed border and a central ball whose free radius grows by a factor."""
    around = np.indices((size, size, size)) - (size - 1) / 2
    ball = np.linalg.norm(around, axis=0) <= size / 8
    loads = Loads(growth=np.where(ball, factor - 1, 0.0))
    return framed(np.zeros_like(ball), (0.0, 0.0, 0.0), loads)


def dice_of(*seeds: int) -> Dice:
    """Return the generator of a problem of a campaign, from its seed and its number."""
    return np.random.default_rng(seeds)


def noisy(field: Array, share: float, dice: Dice) -> tuple[Array, float]:
    """Return a field with noise of a share of its root mean square, and the size of the noise."""
    sd = share * float(np.sqrt((field**2).mean()))
    return field + dice.normal(0, sd, field.shape), sd


def offsets(shape: Shape, place: Any) -> Array:
    """Return the position of each site relative to a place, shape (2, H, W) or (3, D, H, W)."""
    return np.asarray(np.indices(shape) - np.reshape(place, (-1,) + (1,) * len(shape)))

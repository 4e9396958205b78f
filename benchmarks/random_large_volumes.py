"""Random problems of large motion in volumes, and checks of their results.

``python -m validation large-volumes.random --count 1000`` solves these problems.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy

from benchmarks import random_large_motion
from benchmarks.random_large_motion import Case
from napari_hmrf import NeoHookeanPrior, Problem
from napari_hmrf.loads import Loads
from validation.oracles.large_motion import displaced_corners, smallest_jacobians

Field = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Least Jacobian of a map from which targets are sampled.
_LEAST = 0.2


def run(first: int, count: int) -> None:
    """Solve random problems and print the numbers of faults, refusals and missed targets."""
    random_large_motion.run(first, count, make_case, points=10)


def make_case(number: int) -> Case:
    """Return a random problem; for even numbers, its targets belong to a map without folds."""
    random, known = np.random.default_rng(number), number % 2 == 0
    shape = tuple(int(size) for size in random.integers(8, 19, 3))
    spacing = (1.0, 1.0, 1.0)
    if random.random() < 0.5:  # oblong voxels, in any unit
        spacing = tuple(float(size) for size in 2 ** random.uniform(-1, 1, 3))
    m = _tissue(random, shape, known)
    tissue, rigid = m > 0, np.isinf(m)
    c, y = np.zeros((2, *shape, 3))
    if random.random() < 0.5:
        c[0] = c[-1] = c[:, 0] = c[:, -1] = 1
        c[:, :, 0] = c[:, :, -1] = 1
    else:
        c[0] = 1
    c[~tissue] = 0
    kind = str(random.choice(["drag", "rim", "none", "landmarks"]))
    at = _target(random, shape, kind) & tissue & ~rigid
    size = min(shape)
    place = np.moveaxis(np.indices(shape, dtype=np.float64), 0, -1)
    if known:
        held = (c[..., 0] > 0) | at
        y[held] = _smooth_map(random, shape)[held]
    elif kind == "drag":
        y[at] = random.normal(size=3) * size / 6 * random.choice([1.0, 2.0])
    elif kind == "rim" and at.any():
        y[at] = (place[at] - place[at].mean(axis=0)) * random.uniform(-0.5, 1.0)
    else:
        y[at] = random.normal(size=(int(at.sum()), 3))
    moves = y * np.array(spacing)
    penalty = math.inf
    c[at] = 1
    if not known and not rigid.any() and random.random() < 0.3:
        penalty = float(10 ** random.uniform(-2, 1))
        c[at] = random.uniform(0.3, 1)
    prior = NeoHookeanPrior(float(random.choice([0.0, 0.3, 0.45, 0.49])), penalty=penalty)
    loads = None
    if random.random() < 0.3:
        loads = Loads(growth=np.where(_ball(random, shape) & ~rigid, random.uniform(-0.3, 1), 0))
    return Case(
        Problem(observed=moves, confidence=c, stiffness=m, spacing=spacing, loads=loads),
        prior,
        known,
    )


def _tissue(random: np.random.Generator, shape: tuple[int, ...], known: bool) -> Field:
    """Return stiffness of several values, with holes and rigid bodies."""
    m = np.ones(shape)
    decades = random.choice([1.0, 2.0, 3.0])
    for _ in range(int(random.integers(0, 3))):
        m[_ball(random, shape)] = 10 ** random.uniform(0, decades)
    if random.random() < 0.3:
        m[_ball(random, shape)] = 0
    if not known and random.random() < 0.3:
        body = _ball(random, shape)
        inner = np.zeros(shape, dtype=np.bool_)
        inner[2:-2, 2:-2, 2:-2] = True
        m[body & inner & (m > 0)] = np.inf
    return m


def _ball(random: np.random.Generator, shape: tuple[int, ...]) -> Mask:
    centre = random.uniform(0.2, 0.8, 3) * shape
    radius = random.uniform(1.2, min(shape) / 3)
    off = np.moveaxis(np.indices(shape), 0, -1) - centre
    return np.asarray(np.linalg.norm(off, axis=-1) < radius)


def _target(random: np.random.Generator, shape: tuple[int, ...], kind: str) -> Mask:
    """Return a mask of the sites with a target."""
    at = np.zeros(shape, dtype=np.bool_)
    if kind == "none":
        return at
    if kind == "landmarks":
        for _ in range(int(random.integers(3, 10))):
            at[tuple(random.integers(1, np.array(shape) - 1))] = True
        return at
    ball = _ball(random, shape)
    return ball if kind == "drag" else ball & ~scipy.ndimage.binary_erosion(ball)


def _smooth_map(random: np.random.Generator, shape: tuple[int, ...]) -> Field:
    """Return a smooth random displacement, in voxels, with Jacobians of at least `_LEAST`."""
    noise = random.normal(size=(3, *shape))
    smooth = [scipy.ndimage.gaussian_filter(each, min(shape) / 5) for each in noise]
    d = np.stack(smooth, axis=-1)
    d *= random.uniform(1, 6) / np.abs(d).max()
    while smallest_jacobians(displaced_corners(d), 5).min() < _LEAST:
        d *= 0.8
    return d

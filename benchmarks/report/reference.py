"""Reference fields: direct solves in float64, refined until they are exact.

The residual is computed from displacement differences within each element, in extended precision if
available: at a contrast of 1e7, an assembled matrix loses the forces of the soft part by rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy import ndimage

from napari_hmrf import ElasticPrior
from report.assembly import (
    CORNERS,
    Float64Array,
    System,
    assemble,
    element_modulus,
    element_stiffness,
    factorise,
)
from report.tissues import Images

#: Estimated error of a reference, in pixels: an upper bound of its last correction.
KNOWN = 1e-6
_MOST_CORRECTIONS = 30


def pull(images: Images, prior: ElasticPrior, d: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the total force of the elements at each site, (H, W, 2), in the precision of `d`."""
    k = element_stiffness(prior, images.spacing).astype(d.dtype)
    modulus = element_modulus(images).astype(d.dtype)[..., None]
    height, width = images.shape
    places = [np.s_[i : height - 1 + i, j : width - 1 + j] for i, j in CORNERS]
    ways = [modulus * (d[place] - d[places[0]]) for place in places]
    total = np.zeros_like(d)
    for here, place in enumerate(places):
        # A translation exerts no force, so displacements are relative to the first corner.
        total[place] += sum(ways[there] @ k[here, :, there].T for there in (1, 2, 3))
    return total


def refined(
    images: Images,
    prior: ElasticPrior,
    system: System,
    factor: Callable[[Float64Array], Float64Array],
    solution: Float64Array,
) -> Float64Array:
    """Return the exact field (H, W, 2) in pixels, refined from a direct solution.

    Parameters
    ----------
    images : Images or Problem
        Observations and stiffness.
    prior : ElasticPrior
        Prior of the tissue.
    system : System
        System of the images and the prior.
    factor : callable
        Function that solves the system for another load.
    solution : ndarray
        Direct solution for the load of the system.

    Raises
    ------
    RuntimeError
        If the corrections do not decrease below `KNOWN`.
    """
    field = system.field(solution).astype(np.longdouble)
    held = images.known[system.free].ravel()
    sizes: list[float] = []
    for _ in range(_MOST_CORRECTIONS):
        rest = -pull(images, prior, field)[system.free].ravel()
        rest[held] = 0
        correction = factor(rest.astype(np.float64))
        field[system.free] += correction.reshape(-1, 2)
        sizes.append(float(np.abs(correction).max()))
        if sizes[-1] <= KNOWN:
            return field.astype(np.float64)
    raise RuntimeError(f"the reference stays {sizes[-1]:.2g} px from exact")


def exact_field(images: Images, prior: ElasticPrior) -> Float64Array:
    """Return the field of least energy, (H, W, 2), in pixels."""
    system = assemble(images, prior)
    factor = factorise(system.matrix)
    return refined(images, prior, system, factor.solve, factor.solve(system.load))


def bodies(bone: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Return the number of the rigid body at each site, from 1, or 0; shape (H, W).

    A body consists of all sites of connected elements with a corner in a bone.

    Raises
    ------
    ValueError
        If two bodies share a site.
    """
    element = bone[:-1, :-1] | bone[:-1, 1:] | bone[1:, :-1] | bone[1:, 1:]
    numbers, _ = ndimage.label(element)
    around = np.pad(numbers, 1)
    corners = np.stack([around[i : i - 1 or None, j : j - 1 or None] for i, j in CORNERS])
    most = corners.max(axis=0)
    if ((corners > 0) & (corners != most)).any():
        raise ValueError("two bodies meet in a site")
    return most


def rigid_field(images: Images, prior: ElasticPrior) -> Float64Array:
    """Return the field (H, W, 2), in pixels, of tissue that is rigid where m = inf.

    Only the soft elements are assembled; the sites of a body have its three degrees of freedom.
    """
    bone = np.isinf(images.stiffness)
    system = assemble(
        Images(images.observed, images.confidence, np.where(bone, 0, images.stiffness)), prior
    )
    body = bodies(bone)
    place = np.argwhere(system.free)
    of = body[system.free]
    alone = np.flatnonzero(of == 0)
    count = 2 * len(alone)
    number = np.empty(2 * len(alone), dtype=np.int64)
    number[0::2], number[1::2] = 2 * alone, 2 * alone + 1
    rows, cols, values = [number], [np.arange(count)], [np.ones(count)]
    for each in range(1, body.max() + 1):
        at = np.flatnonzero(of == each)
        for component, mode in zip((0, 1), _rigid_modes(place[at], body, each), strict=True):
            rows.append(np.repeat(2 * at + component, 3))
            cols.append(np.tile(count + 3 * (each - 1) + np.arange(3), len(at)))
            values.append(mode.ravel())
    shape = (2 * len(place), count + 3 * int(body.max()))
    motions = sp.csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=shape
    )
    found = factorise(motions.T @ system.matrix.tocsr() @ motions).solve(motions.T @ system.load)
    field = system.field(motions @ found)
    for each in range(1, body.max() + 1):
        at = np.argwhere(body == each)
        motion = found[count + 3 * (each - 1) :][:3]
        for component, mode in zip((0, 1), _rigid_modes(at, body, each), strict=True):
            field[at[:, 0], at[:, 1], component] = mode @ motion
    return field


def _rigid_modes(
    at: npt.NDArray[np.int64], body: npt.NDArray[np.int32], number: int
) -> tuple[Float64Array, Float64Array]:
    """Return the row and column displacement of sites in a body's three motions, (sites, 3)."""
    row, col = (at - np.argwhere(body == number).mean(axis=0)).T
    one, none = np.ones(len(at)), np.zeros(len(at))
    return np.stack([one, none, -col], axis=-1), np.stack([none, one, row], axis=-1)

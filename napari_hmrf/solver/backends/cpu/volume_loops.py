"""Loops of volumes, called with the arrays of a level; `image_loops` has the same functions.

`exact` are the elements of the finest level for the loops in double precision.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.solver.backends.cpu import hexahedra, volume
from napari_hmrf.solver.backends.cpu.layout import Table, flat, rows, whole_starts
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.priors.elements import ElasticMaterial, lame_ratio

Vector = npt.NDArray[np.float32]
Elements = tuple[Any, ...]

#: Index of the shear modulus among the parameters of an element.
SHEAR = 0


# Transfer between levels


def restrict(level: Any, forces: Vector, coarse: Any, out: Vector) -> None:
    """Restrict forces to a vector of the next coarser level."""
    places = coarse.layout.starts, coarse.layout.tissue
    volume.restrict(flat(forces), level.layout.starts, level.layout.stored, flat(out), *places)


def interpolate(level: Any, coarse: Any) -> None:
    """Add the interpolated correction of the next coarser level to the components that move."""
    arrays = _with_tables(coarse.correction, coarse, level.correction, level)
    volume.interpolate(*arrays, flat(level.inverse), level.reach)


def add_relaxed(level: Any, coarse: Any, out: Vector) -> None:
    """Add the interpolated correction, filtered for the data term (`data_weights`)."""
    springs = map(flat, (level.inverse, level.weight, level.mixed))
    volume.add_relaxed(*_with_tables(coarse.correction, coarse, out, level), *springs, level.reach)


def _with_tables(of_coarse: Vector, coarse: Any, of_fine: Vector, fine: Any) -> tuple[Any, ...]:
    """Return vectors of two levels, each with its table of rows."""
    return flat(of_coarse), coarse.layout.starts, flat(of_fine), fine.layout.starts


# Elements of elastic tissue


def parameters(material: ElasticMaterial) -> int:
    """Return the number of parameters of an element: mu, or mu and lambda."""
    return 1 if isinstance(material.poisson, float) else 2


constants = hexahedra.constants


def write_elements(
    material: ElasticMaterial, m: npt.NDArray[Any], most: float, lame: npt.NDArray[Any]
) -> float:
    """Write the parameters of the elements, relative to the stiffness `most`.

    Return the ratio lambda / mu of all elements, or 1 if each element has its own lambda.
    """
    nu, scale = material.poisson, 0.125 / most
    if isinstance(nu, float):
        volume.elements(m, m, True, scale / (2 + 2 * nu), lame)
        return float(lame_ratio(nu, strain=True))
    volume.elements(m, loops.only_read(nu), False, scale, lame)
    return 1.0


def exact_elements(grid: tuple[int, ...]) -> None:
    """Return None: to save memory, elements are stored in single precision only."""


def exact(lame: Vector, share: float, shape: npt.NDArray[np.float64]) -> Elements:
    """Return the elements of the finest level for the loops in double precision."""
    return flat(lame), np.float64(share), shape


coarsen = volume.coarsen


def diagonal(level: Any, out: Vector) -> None:
    """Write the diagonal of the stiffness matrix."""
    starts, tissue, _ = _tissue(level)
    volume.diagonal(*level.elements, level.shape, starts, tissue, flat(out))


def _tissue(level: Any) -> tuple[Table, Table, int]:
    """Return the table of rows, the spans of the tissue and the width of a padded row."""
    return level.layout.starts, level.layout.tissue, level.layout.planes[-1]


# Smoothing and products, in single precision


def parts(depth: int) -> int:
    """Return the number of threads among which the planes of a level are divided."""
    return volume.parts(depth)


def begin(level: Any, paces: Vector) -> int:
    """Run the first step from zero; return 1."""
    load, inverse, correction = map(rows, (level.load, level.inverse, level.correction))
    mixed = None if level.mixed is None else rows(level.mixed)
    volume.start(load, inverse, mixed, correction, paces[0, 0])
    return 1


def smooth(level: Any, paces: Vector) -> None:
    """Run Chebyshev steps, alternating between the correction and the other array."""
    arrays = map(flat, (level.correction, level._other, level.load))
    volume.smooth.in_turns(len(paces), *arrays, *level.system, level.where, paces, level.parts)


def leave(level: Any, coarse: Any) -> None:
    """Restrict the residual, filtered for the data term, to the load of the next coarser level."""
    # `_other` can store the residual: the next step has no momentum and does not read `_other`.
    d, load, out = map(flat, (level.correction, level.load, level._other))
    if level.mixed is None:
        _write_rest(level, level.correction, level.load, (1, 1), level._other)
    else:
        *tissue, inverse, weight, _, mixed, shape = level.system
        about = *tissue, inverse, weight, mixed, shape, level.where
        volume.filtered_rest(d, load, *about, out, level.parts)
    restrict(level, level._other, coarse, coarse.load)


def apply(level: Any, direction: Vector, image: Vector) -> float:
    """Compute ``image = A @ direction``; return ``direction . image``."""
    _write_rest(level, direction, direction, (0, -1), image)
    level.add_points(direction, level.inverse, image)  # the loop has added the precision
    product: float = level.product(direction, image)
    return product


def _write_rest(level: Any, d: Vector, load: Vector, factors: tuple[int, int], out: Vector) -> None:
    """Write a multiple of the residual; `factors` are those of the load and of the result."""
    given, scale = map(np.float32, factors)
    about = flat(d), flat(load), given, level.layout.starts, *level.system, level.where
    volume.rest(*about, scale, flat(out), level.parts)


def advance(
    level: Any, d: Any, share: float, rest: Any, direction: Any, image: Any, length: float
) -> float:
    """Add ``share * direction`` to planes, and subtract ``length * image`` from a residual.

    Return ``rest . rest``.
    """
    starts, tissue, _ = _tissue(level)
    of_d, *others = map(flat, (d, rest, direction, image))
    shares = d.dtype.type(share), rest.dtype.type(length)
    table = whole_starts(level.layout.planes)
    volume.advance(of_d, table, shares[0], *others, shares[1], starts, tissue, level.totals)
    return float(level.totals.sum())


# Residuals, forces and energy, in double precision


def balance(
    level: Any, exact: Elements, d: Planes, load: Planes | None, share: float, out: Vector
) -> tuple[float, float]:
    """Write ``share * (load - A d)``; return its largest absolute value and its norm."""
    given = (flat(d), 0.0) if load is None else (flat(load), 1.0)
    data, inverse = level.exact_data, flat(level.inverse)
    weights = (inverse, 0.0, None) if data is None else (flat(data[:3]), 1.0, flat(data[3:]))
    *tissue, shape = exact
    about = *tissue, inverse, *weights, shape, level.where
    vectors = flat(d), *given, whole_starts(d.shape[1:])
    volume.rest(*vectors, *about, share, flat(out), level.parts)
    most, square = level.weigh(out, out)
    return most, math.sqrt(square)


def pull(level: Any, exact: Elements, d: Planes, out: Planes) -> None:
    """Write the forces of the elements, -A d, at all components."""
    about = whole_starts(d.shape[1:]), *exact, _tissue(level)
    volume.pull(flat(d), *about, flat(out), level.parts)


def work(level: Any, exact: Elements, d: Planes) -> tuple[float, float]:
    """Return d . A d and ||A d||^2."""
    products, squares = np.zeros((2, level.grid[0]))
    data = None if level.exact_data is None else flat(level.exact_data)
    *tissue, shape = exact
    about = whole_starts(d.shape[1:]), *tissue, data, shape, _tissue(level)
    volume.work(flat(d), *about, products, squares, level.parts)
    return float(products.sum()), float(squares.sum())


def exact_diagonal(level: Any, exact: Elements) -> Planes:
    """Return the diagonal of the stiffness matrix, as planes, from values in single precision."""
    out = level.vector()
    diagonal(level, out)
    planes: Planes = level.planes(out).astype(np.float64)
    return planes

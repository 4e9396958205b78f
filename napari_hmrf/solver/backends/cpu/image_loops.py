"""Loops of images, called with the arrays of a level; `volume_loops` has the same functions.

`exact` are the elements of the finest level for the loops in double precision.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.solver.backends.cpu import (
    assembly,
    data_weights,
    elastic,
    elastic_exact,
    forces,
    vectors,
)
from napari_hmrf.solver.backends.cpu.layout import Table, flat, whole_rows
from napari_hmrf.solver.backends.cpu.transfer import PAD
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Review
from napari_hmrf.solver.priors.elements import ElasticMaterial

Vector = npt.NDArray[np.float32]
Elements = tuple[Any, ...]

#: Index of the shear modulus among the parameters of an element.
SHEAR = 1
# Coefficients (scale, ahead, back) of a Chebyshev step that changes nothing.
_NO_STEP = np.zeros(3, dtype=np.float32)


# Transfer between levels


def restrict(level: Any, forces: Vector, coarse: Any, out: Vector) -> None:
    """Restrict forces, as planes, to the next coarser level."""
    vectors.restrict(forces, out)


def interpolate(level: Any, coarse: Any) -> None:
    """Add the interpolated correction of the next coarser level to the components that move."""
    arrays = flat(coarse.correction), coarse.layout.starts, flat(level.correction)
    elastic.interpolate(*arrays, flat(level.inverse), level.where)


def add_relaxed(level: Any, coarse: Any, out: Vector) -> None:
    """Add the interpolated correction, filtered for the data term (`data_weights`)."""
    springs = level.inverse, level.weight, level.mixed
    data_weights.add_relaxed(coarse.correction, *springs, out)


# Elements of elastic tissue


def parameters(material: ElasticMaterial) -> int:
    """Return the number of parameters of an element."""
    return 2


def constants(shape: Sequence[float]) -> npt.NDArray[np.float64]:
    """Return the constants of the loops for the shape of a pixel."""
    return np.array(shape, dtype=np.float64)


def write_elements(
    material: ElasticMaterial, m: npt.NDArray[Any], most: float, lame: npt.NDArray[Any]
) -> float:
    """Write the parameters of the elements, relative to the stiffness `most`; return 1."""
    nu = material.poisson
    one, each = (nu, m) if isinstance(nu, float) else (0.0, loops.only_read(nu))
    assembly.elements(m, one, each, isinstance(nu, float), material.strain, 0.25 / most, lame)
    return 1.0


def exact_elements(grid: tuple[int, ...]) -> Planes:
    """Return planes for the elements of the finest level in double precision."""
    return np.zeros((2, *(size + 2 * PAD for size in grid)))


def exact(lame: Planes, share: float, shape: npt.NDArray[np.float64]) -> Elements:
    """Return the elements of the finest level for the loops in double precision."""
    return flat(lame), shape


coarsen = assembly.coarsen


def diagonal(level: Any, out: Vector) -> None:
    """Write the diagonal of the stiffness matrix."""
    starts, _, tissue = level.layout.rows
    assembly.diagonal(flat(level.lame), starts, tissue, level.shape, flat(out))


# Smoothing and products, in single precision


def parts(height: int) -> int:
    """Return the number of threads among which the rows of a level are divided."""
    return forces.parts(height)


def begin(level: Any, paces: Vector) -> int:
    """Run the first step from zero, or two steps if there are no others; return their number."""
    # The loop does not store the displacement after step 1, which step 3 would require.
    second = paces[1] if len(paces) == 2 else _NO_STEP
    load, out = flat(level.load), flat(level.correction)
    elastic.begin(load, *level.system, level.where, out, paces[0, 0], *second, level.parts)
    return 2 if len(paces) == 2 else 1


def smooth(level: Any, paces: Vector) -> None:
    """Run a single Chebyshev step."""
    (pace,) = paces
    d, load, out = map(flat, (level.correction, level.load, level._other))
    elastic.smooth(d, load, *level.system, level.where, out, *pace, level.parts)


def leave(level: Any, coarse: Any) -> None:
    """Restrict the residual, filtered for the data term, to the load of the next coarser level."""
    starts, _, tissue = coarse.layout.rows
    d, load, out = map(flat, (level.correction, level.load, coarse.load))
    elastic.leave(d, load, *level.system, level.where, out, starts, tissue, level.parts)


def apply(level: Any, direction: Vector, image: Vector) -> float:
    """Compute ``image = A @ direction``; return ``direction . image``."""
    starts, _, width = level.where
    about = (
        flat(level.moving_inverse),
        _data(level),
        level.shape,
        (starts, level.moving_spans, width),
    )
    arrays = flat(direction), flat(level.lame), *about, flat(image), level.totals
    if level.finishes_cycle:  # on a small level, waking other threads takes longer than the loop
        elastic.apply_part(*arrays, 0, len(level.moving_spans))
    else:
        elastic.apply(*arrays, level.parts)
    of_points: float = level.add_points(direction, level.moving_inverse, image)
    return float(level.totals.sum()) + of_points


# Residuals, forces and energy, in double precision


def balance(
    level: Any, exact: Elements, d: Planes, load: Planes | None, share: float, out: Vector
) -> tuple[float, float]:
    """Write ``share * (load - A d)``; return its largest absolute value and its norm."""
    given = (flat(d), 0.0) if load is None else (flat(load), 1.0)
    lame, shape = exact
    most, squares = np.zeros((2, len(level.spans)))
    where = _where_of(d, level.moving_spans)
    about = lame, _data(level), where, flat(level.moving_inverse), level.layout.starts, shape
    elastic_exact.balance(flat(d), *given, *about, share, flat(out), most, squares, level.parts)
    return float(most.max()), math.sqrt(squares.sum())


def pull(level: Any, exact: Elements, d: Planes, out: Planes) -> None:
    """Write the forces of the elements, -A d, at all components."""
    elastic_exact.pull(flat(d), *exact, _where_of(d), flat(out), level.parts)


def work(level: Any, exact: Elements, d: Planes) -> tuple[float, float]:
    """Return d . A d and ||A d||^2."""
    products, squares = np.zeros((2, len(level.spans)))
    lame, shape = exact
    about = lame, _data(level), shape, _where_of(d)
    elastic_exact.work(flat(d), *about, products, squares, level.parts)
    return float(products.sum()), float(squares.sum())


def review(
    level: Any,
    exact: Elements,
    spans: Table,
    moves: HeldPlanes,
    values: Vector,
    load: Planes | None,
) -> Review:
    """Return what decides whether a displacement, shape (H, W, 2), is a solution.

    `spans` are the start and stop column of the tissue of each row. `moves` is the mask of free
    components: it is smaller than ``level.inverse``.
    """
    lame, shape = exact
    totals, lines = np.zeros((6, len(values))), values.reshape(len(values), -1)
    given = (np.zeros((2, 1)), 0.0) if load is None else (flat(load), 1.0)
    where = level.layout.starts, spans, level.layout.planes[-1]
    about = lame, flat(moves), where, shape
    elastic_exact.review(lines, *given, *about, totals, level.parts)
    most, squares, product, forces, work, farthest = totals
    return Review(
        most=float(most.max()),
        norm=math.sqrt(squares.sum()),
        energy=float(product.sum()) / 2,
        forces=math.sqrt(forces.sum()),
        work=float(work.sum()),
        farthest=float(farthest.max()),
    )


def exact_diagonal(level: Any, exact: Elements) -> Planes:
    """Return the diagonal of the stiffness matrix, as planes."""
    out: Planes = np.zeros((2, *level.layout.planes))
    lame, shape = exact
    starts, _, columns = whole_rows(level.layout.planes)
    assembly.diagonal(lame, starts, columns, shape, flat(out))
    return out


def _data(level: Any) -> Any:
    return None if level.exact_data is None else flat(level.exact_data)


def _where_of(d: Planes, spans: Table | None = None) -> tuple[Table, Table, int]:
    """Return the table of rows of planes, the spans or all columns, and the width of a row."""
    starts, _, columns = whole_rows(d.shape[1:])
    return starts, columns[PAD:-PAD] if spans is None else spans, d.shape[-1]

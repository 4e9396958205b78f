"""Exact rotations of rigid tissue.

A linear solver moves a rigid body to first order in its rotation, which enlarges the body by half
of the square of the angle. `turned` replaces this motion by the nearest exact rotation (Kabsch
1976).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.rigid.bodies import bodies_of, rigid_sites
from napari_hmrf.solver.problem import Problem


def turned(
    displacement: npt.NDArray[np.floating],
    stiffness: npt.NDArray[np.float32],
    spacing: Sequence[float],
) -> npt.NDArray[np.floating]:
    """Return a displacement in which each rigid body is moved by a rotation and a translation.

    Parameters
    ----------
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
    stiffness : ndarray, shape (H, W) or (D, H, W)
        Infinite in rigid tissue.
    spacing : sequence of float
    """
    exact = displacement.astype(np.float64)
    for sites in bodies_of(stiffness):
        before = np.stack(sites, axis=-1) * np.asarray(spacing)
        after = before + exact[sites]
        centre, moved = before.mean(axis=0), after.mean(axis=0)
        left, _, right = np.linalg.svd((after - moved).T @ (before - centre))
        # A reflection is never the motion of a body.
        left[:, -1] *= np.sign(np.linalg.det(left @ right))
        exact[sites] = (before - centre) @ (left @ right).T + moved - before
    return exact


def with_rigid_held(problem: Problem, displacement: npt.NDArray[np.floating]) -> Problem:
    """Return a problem in which rigid tissue is held at a given displacement.

    The rigid tissue of the result has the largest finite stiffness, so that the displacement may be
    an exact rotation.

    Parameters
    ----------
    problem : Problem
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
    """
    m = problem.stiffness
    sites, soft = rigid_sites(m), np.isfinite(m)
    largest = m[soft].max(initial=0)
    return Problem(
        observed=np.where(sites[..., None], displacement, problem.observed),
        confidence=np.where(sites[..., None], 1, problem.confidence),
        stiffness=np.where(soft, m, largest if largest > 0 else 1),
        spacing=problem.spacing,
        loads=problem.loads,
        precision=problem.precision,
        landmarks=problem.landmarks,
    )

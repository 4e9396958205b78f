"""Loads on tissue (growth, weight, pressure, traction and cavities) and reaction forces.

Loads are passed to a `Problem` as its argument `loads`. The operator ``+`` adds two loads::

    from napari_hmrf import Problem, solve
    from napari_hmrf.loads import growth

    given = {"observed": observed, "confidence": confidence, "stiffness": stiffness}
    solution = solve(Problem(**given, loads=growth(0.2 * tumour)))

A `Study` derives its loads from its `Material`, `BoundaryRule` and `Motion`.
"""

from napari_hmrf.solver.body_forces import cavity, pressure, traction, weight
from napari_hmrf.solver.loads import Loads, growth
from napari_hmrf.solver.reactions import reactions

__all__ = ["Loads", "cavity", "growth", "pressure", "reactions", "traction", "weight"]

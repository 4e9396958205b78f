"""Comparison of the paper's model and elastic tissue with finite elements.

The sample is a brain with an outline that expands by 10 pixels. The package contains its
finite-element displacement, which was computed in plane stress with a Poisson's ratio of 0.3.
"""

import numpy as np

from napari_hmrf import ElasticPrior, Multigrid, SeilerPrior, solve
from napari_hmrf.data import reference_displacement, sample

problem = sample("expansion").problem
reference = reference_displacement("expansion")

solutions = (
    solve(problem, SeilerPrior()),  # 70 sweeps on each level of the quadtree
    solve(problem, SeilerPrior(), optimizer=Multigrid()),  # the limit of many sweeps
    solve(problem, ElasticPrior(poisson=0.3)),
)
for solution in solutions:
    apart = np.linalg.norm(solution.displacement - reference, axis=-1)[problem.tissue]
    rms = np.sqrt((apart**2).mean())
    model = solution.provenance.model
    print(f"{model}: {rms:.4f} px from finite elements, {solution.iterations} iterations")

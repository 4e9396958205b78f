"""What a study is refused for before any work, said of the parts that people know."""

from __future__ import annotations

import math

import numpy as np

from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.study.study import Study


def refuse_rigid(study: Study) -> None:
    """Refuse rigid tissue of a prior that cannot have it.

    Raises
    ------
    ProblemError
        Naming the tissue, what in it is rigid and what to do.
    """
    prior, tissue = study.prior, study.tissue
    if isinstance(prior, ElasticPrior) and prior.penalty == math.inf:
        return
    labels, rigid = tissue.labels, [row for row in tissue.materials if row.is_rigid]
    painted = [row for row in rigid if labels is not None and row.label in labels]
    which = [f"'{row.name or row.label}'" for row in painted]
    if tissue.stiffness is not None and (tissue.stiffness == np.inf).any():
        which = ["an infinite stiffness"]
    if which:
        raise LayerError(
            study.named("tissue", "image"),
            f"has rigid tissue ({' and '.join(which)}), which the paper's model cannot have, nor "
            "any in which what is held may slip. Take the elastic model with 'holding force' "
            "under 'Advanced' at 'held exactly', or give it a number.",
        )

"""Priors: the energies of the models of tissue, as reference implementations."""

from napari_hmrf.solver.priors.cliques import line_steps, line_weights
from napari_hmrf.solver.priors.elastic import ElasticPrior
from napari_hmrf.solver.priors.neo_hookean import NeoHookeanPrior
from napari_hmrf.solver.priors.seiler import SeilerPrior, SiteParabola

#: Priors of elastic tissue, which has Poisson's ratios, bears loads and may be rigid.
Elastic = ElasticPrior | NeoHookeanPrior
#: Priors that `solve` accepts.
Prior = SeilerPrior | ElasticPrior | NeoHookeanPrior

__all__ = [
    "Elastic",
    "ElasticPrior",
    "NeoHookeanPrior",
    "Prior",
    "SeilerPrior",
    "SiteParabola",
    "line_steps",
    "line_weights",
]

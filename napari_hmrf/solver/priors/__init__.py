"""Priors: energies of the tissue models, as reference implementations."""

from napari_hmrf.solver.priors.cliques import line_steps, line_weights
from napari_hmrf.solver.priors.elastic import ElasticPrior
from napari_hmrf.solver.priors.neo_hookean import NeoHookeanPrior
from napari_hmrf.solver.priors.seiler import SeilerPrior, SiteParabola

#: Elastic priors: they have a Poisson's ratio and support loads and rigid tissue.
Elastic = ElasticPrior | NeoHookeanPrior
#: All priors that `solve` accepts.
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

"""What is known of tissue before anything is observed: the energies, as the equations say them."""

from napari_hmrf.solver.priors.cliques import line_steps, line_weights
from napari_hmrf.solver.priors.elastic import ElasticPrior
from napari_hmrf.solver.priors.neo_hookean import NeoHookeanPrior
from napari_hmrf.solver.priors.seiler import SeilerPrior, SiteParabola

#: Tissue that is strained: it has Poisson's ratios, bears loads and may be rigid.
Elastic = ElasticPrior | NeoHookeanPrior
#: What `solve` takes.
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

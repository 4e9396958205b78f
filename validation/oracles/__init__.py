"""Reference solutions: one definition for each model.

==================  ================================================================================
module              reference
==================  ================================================================================
`elasticity`        linear elasticity in images and volumes, with elements by scikit-fem
`large_motion`      neo-Hookean tissue in images and volumes, by Newton's method
`large_sliding`     sliding parts in large motion, from the energy of their contact
`posterior`         data, landmarks and drift, by sparse and dense algebra
`paper`             cliques, energies and fields of Seiler et al., and their algorithm move by move
`exact`             fields of images in 32 digits, with observations that slip, for `make trust`
`slipping`          observations that may slip beside all other inputs, by dense algebra
`parts`             cavities and sliding parts, by direct solutions
`calculix`          decks and fields of CalculiX, another program
==================  ================================================================================

A reference takes a `Problem` and a prior for their numbers only. It does not call the elements or
the forces of the package.
"""

import functools

from napari_hmrf.solver.connected import connected


def followed(prior_of):
    """Return a decorator for functions that compute the field of a problem from its equations.

    The function then receives the problem whose observations and forces are at sites with an
    equation, and the other sites follow in its result. `prior_of` returns the prior from the
    arguments of the function.
    """

    def decorate(field_of):
        @functools.wraps(field_of)
        def complete(problem, *given, **options):
            joined = connected(problem, prior_of(*given))
            field = field_of(joined.problem, *given, **options)
            joined.extend(field)
            return field

        return complete

    return decorate

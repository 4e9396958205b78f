"""Reference fields of tissue in which some sites are in no element or clique."""

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

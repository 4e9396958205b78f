"""Reference solutions: one definition for each model.

==================  ================================================================================
module              reference
==================  ================================================================================
`paper`             cliques, energies and fields of Seiler et al.
`literal`           the paper's algorithm, one move at a time
==================  ================================================================================

A reference takes a `Problem` and a prior for their numbers only. It does not call the elements, the
energies or the forces of the package.
"""

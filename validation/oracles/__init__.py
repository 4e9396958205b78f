"""Reference solutions: one definition for each model.

==================  ================================================================================
module              reference
==================  ================================================================================
`elasticity`        linear elasticity in images and volumes, with elements by scikit-fem
`large_motion`      neo-Hookean tissue in images and volumes, by Newton's method
`posterior`         data, landmarks, drift and sliding parts, by sparse and dense algebra
`paper`             cliques, energies and fields of Seiler et al.
`literal`           the paper's algorithm, one move at a time
`exact`             fields of images in 32 digits, with observations that slip, for `make trust`
`parts`             cavities and sliding parts of small problems, by a dense system
`calculix`          decks and fields of CalculiX, another program
==================  ================================================================================

A reference takes a `Problem` and a prior for their numbers only. It does not call the elements or
the forces of the package.
"""

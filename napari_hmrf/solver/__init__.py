"""Solver, from the problem to its solution. It imports neither napari nor Qt.

A solve has five steps:

1. *Problem.* `problem` contains the observed displacement, its confidence and the stiffness of each
   site, all validated; `loads` adds growth and forces.
2. *Model.* `priors` defines the energy of the tissue. The `material` of a prior contains the data
   that the kernels read. `solve` passes the prior to a backend (`backends`), which builds the
   model.
3. *Hierarchy.* `coarse_levels` defines the coarser grids of the model, for cycles; `quadtree`
   defines the levels of the paper's schedule.
4. *Cycle.* `optimizers` determine the order of the work: `optimizers.icm` sweeps the levels from
   coarse to fine; `optimizers.cycle` runs down and up the levels as a preconditioner for
   `optimizers.krylov`; `optimizers.newton` repeats such solves for large motion.
5. *Solution.* `solve` converts the field to units of length and returns a `solution` with the
   estimated error, the energies, and a record of the run.

`operator` prepares a problem once and solves it for any forces, with all observations at rest.
`live_solver` repeats these steps while a user edits the problem: the latest request wins, and each
solve starts from earlier solutions (`warm_start`).
"""

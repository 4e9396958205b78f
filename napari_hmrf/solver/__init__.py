"""The method: from a problem to its solution. It imports neither napari nor Qt.

A solve passes through five steps:

1. *Problem.* `problem` holds the observed displacement, its confidence and the stiffness of each
   site, checked; `loads` adds growth and forces.
2. *Model.* `priors` defines the energy of tissue. The `material` of a prior is what the kernels
   read of it; `solve` passes it to a backend (`backends`), which builds the model there.
3. *Hierarchy.* `coarse_levels` says how the model is repeated on ever coarser grids, for cycles;
   `quadtree` gives the levels of the paper's schedule.
4. *Cycle.* `optimizers` decide the order of work: `optimizers.icm` sweeps the levels from coarse to
   fine, `optimizers.cycle` runs down and up the levels as a preconditioner for `optimizers.krylov`,
   and `optimizers.newton` repeats that for large motion. Each calls kernels by name.
5. *Solution.* `solve` scales the field to lengths and returns a `solution`, with its estimated
   error, the energies, and the record of the run.

`live_solver` repeats this while a user edits: the latest request wins, and each solve starts from
the last solution (`warm_start`).
"""

"""Studies: the inputs of a displacement field, their edits with undo, and their solution.

A field is computed in five steps, without napari or Qt:

1. *Study.* `study` represents all inputs as one immutable value: grid, tissue, motion, pictures,
   energy and optimizer. A script creates a study with ``Study(...)``, ``io/`` reads it from a file,
   and ``layers/`` from the selected layers. `models` defines the energy and optimizer of each named
   model.
2. *Edit.* In the window, `session` stores the parts that the user edits: the drawing of each
   slice, the table of each layer, and the choices for each image. `edit_history` can undo edits to
   these parts.
3. *Problem.* `ground` converts labels, rules and brightness to stiffness and observations, and adds
   the drawing. The result is a ``Problem``, which consists of arrays, with its energy and
   optimizer. `without_effect` lists inputs that have no effect on the problem.
4. *Solve.* ``solve_study()`` in `ground` solves the problem once, from a cold start. In the window,
   `engine` solves the newest study, starting from the last solution, and warps its image. During a
   drag, `drag_preview` selects a tolerance and a `coarse_grid` that allow several images a second.
5. *Solution.* The ``Solution`` is in the unit of the grid and includes its position in the world,
   so ``io/`` can write it to files and ``layers/`` can display it. `shortcomings` adds notes on
   folds, and on motion that was applied only in part.
"""

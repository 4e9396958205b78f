"""Studies: the inputs of a field, their edits with undo, and their interactive solution.

A field is computed in five steps, with neither napari nor Qt:

1. *Study.* `study` holds all inputs as one immutable value: grid, tissue, motion, pictures, energy
   and optimizer. A script makes it with ``Study(...)``, ``io/`` reads it from a file, and
   ``layers/`` from the chosen layers. `models` gives the energy and the optimizer of a named model.
2. *Edit.* In the window, `study_model` keeps the parts that the user edits: the drawing of each
   slice, the table of each layer, the choices for each image. `edit_history` undoes edits of them.
3. *Problem.* `ground` reads labels, rules and brightness as stiffness and observations, and puts
   the drawing on top. The result is a ``Problem`` with its energy and optimizer, all arrays.
   `without_effect` lists inputs that change nothing in it.
4. *Solve.* ``solve_study()`` of `ground` solves it once, from a cold start. In the window, `engine`
   solves the newest study, from the last solution, and moves its image; during a drag,
   `drag_preview` sets a tolerance and a `coarse_grid` that give several pictures a second.
5. *Solution.* The ``Solution`` is in the unit of the grid and has its place, so that ``io/`` can
   write it to files and ``layers/`` can show it. `shortcomings` adds notes on folds, and on motion
   that was applied only in part.
"""

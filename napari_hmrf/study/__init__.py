"""Study of a deformation: its inputs, its choices with undo, and its interactive solution."""

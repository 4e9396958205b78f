"""Study of a deformation: its inputs, the choices in the window with undo, and the live solve."""

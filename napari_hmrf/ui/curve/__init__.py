"""The editor of the curve that gives stiffness from the intensity of an image."""

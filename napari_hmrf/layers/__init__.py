"""Conversion between napari layers and the solver: layers to a study, a solution to layers.

Nothing in this package needs a window. The data of layers are copied when they are read.
"""

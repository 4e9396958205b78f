"""Layers of napari: inputs that are read as a study, and results that are shown.

Nothing here needs a window, and no layer is kept: pixels that are read are copied.
"""

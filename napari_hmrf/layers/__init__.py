"""Between napari's layers and the solver: layers become a problem, a solution becomes layers.

Nothing here needs a window, and nothing here keeps a layer: what is read is copied.
"""

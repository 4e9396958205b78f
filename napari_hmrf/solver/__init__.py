"""The method: from a problem to its solution. It knows no napari and no Qt."""

"""Display of the result in the dock and the viewer."""

"""Conversion of napari layers to studies, and of solutions to napari layers.

This package does not require a window. Layer data are copied when they are read.
"""

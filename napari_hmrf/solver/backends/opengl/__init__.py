"""Kernels as OpenGL shaders: fragment shaders (OpenGL 3.3) or compute shaders (OpenGL 4.3)."""

from napari_hmrf.solver.backends.opengl.backend import OpenGLBackend
from napari_hmrf.solver.backends.opengl.context.context import is_software_renderer
from napari_hmrf.solver.backends.opengl.context.report import describe
from napari_hmrf.solver.backends.opengl.support import missing_shaders

__all__ = ["OpenGLBackend", "describe", "is_software_renderer", "missing_shaders"]

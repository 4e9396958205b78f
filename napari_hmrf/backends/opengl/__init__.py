"""The kernels as OpenGL shaders, drawn (OpenGL 3.3) or dispatched (4.3) from the same text."""

from napari_hmrf.backends.opengl.backend import OpenGLBackend
from napari_hmrf.backends.opengl.context import is_software_renderer

__all__ = ["OpenGLBackend", "is_software_renderer"]

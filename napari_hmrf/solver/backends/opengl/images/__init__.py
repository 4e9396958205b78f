"""Kernels on images: textures, and passes of shaders over them."""

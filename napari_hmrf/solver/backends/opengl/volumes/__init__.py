"""Kernels on volumes: storage buffers, and passes of compute shaders over them."""

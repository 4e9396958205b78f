"""Shader programs, composed from the files of `shaders/`."""

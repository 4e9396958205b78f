"""NumPy implementation of the host's part of linear models, for shaders.

These modules are used until the compiled loops of `backends.cpu` are available. Each module has a
counterpart of the same name there, which is several times faster but requires compilation.
"""

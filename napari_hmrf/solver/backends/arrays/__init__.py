"""NumPy implementation of the host's part of linear models, for shaders.

It is used until the compiled loops of `backends.cpu` are available. Each module has a counterpart
of the same name there. It is several times slower, but needs no compilation.
"""

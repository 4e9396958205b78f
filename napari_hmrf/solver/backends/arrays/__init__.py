"""The host's part of linear models in NumPy, for shaders that run before loops are compiled.

Each module is the twin of the module of the same name in `backends.cpu`. It is several times
slower, but needs no compilation.
"""

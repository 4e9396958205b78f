"""The host's part of a linear model in NumPy: what the shaders need before any loop is compiled.

Each module is the twin of the one of its name in `backends.cpu`, several times slower and ready at
once.
"""

"""Computation in this process: its compute thread, its compiled loops, and its workspace.

All solves run on one thread (`thread`), because OpenGL and numba both require it. `compile_cache`
compiles the loops for the processor and stores them on disk. What a solve keeps for later solves is
in the `workspace`.
"""

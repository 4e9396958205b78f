"""Compilation of the processor's loops, once per machine, and their cache on disk."""

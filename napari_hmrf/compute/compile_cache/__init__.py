"""Compilation of the loops for the processor, once per machine, and their disk cache."""

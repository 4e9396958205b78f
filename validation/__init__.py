"""Validation of the package: reference solutions, shared by the tests and by the benchmarks."""

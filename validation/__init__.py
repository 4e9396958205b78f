"""Validation of the package: accuracy studies, and reference solutions that the tests share."""

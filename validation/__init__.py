"""Validation of the package: accuracy studies, random problems and reference solutions."""

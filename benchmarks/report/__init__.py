"""Validation report: one module per section, and shared modules.

`python benchmarks/validation_report.py` writes the page. A section is a function that takes
`Settings` and returns a `Section`. If a tool is not installed, its section contains a line about
it.
"""

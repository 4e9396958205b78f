"""The validation report: one module for each of its sections, and what they share.

`python benchmarks/validation.py` writes the page. A section is a function from `Settings` to a
`Section`; a tool that is not installed makes a line in its section, and no failure.
"""

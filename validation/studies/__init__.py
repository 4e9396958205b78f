"""Accuracy studies: cases, comparisons with references, and tables, by physics."""

"""Batches of cases: tables of images or studies, with parameter sweeps, solved in parallel.

Example::

    from napari_hmrf.cases import read_cases, solve_cases

    if __name__ == "__main__":  # the worker processes import this file
        solve_cases(read_cases("cases.csv"), "results")
"""

from napari_hmrf.io.batch import BatchProgress, solve_cases
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.case_records import CaseOutcome
from napari_hmrf.io.case_tables import NamedCase, read_cases

__all__ = ["BatchProgress", "Case", "CaseOutcome", "NamedCase", "read_cases", "solve_cases"]

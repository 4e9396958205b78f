"""Earlier results of studies, which are shown again when undo or redo restores a study."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.study import Study

#: Largest number of results to store.
MOST_RESULTS = 16
#: Largest size of the stored displacements together, in bytes. Larger fields are not stored.
MOST_BYTES = 128 * 2**20


class StudyResults:
    """Latest results of studies, with the study of each result.

    A result of large motion depends on the edits before it, because each solve starts from earlier
    solutions and its work is limited. The same study may therefore have another result when it is
    solved again, for instance after an undo.
    """

    def __init__(self) -> None:
        # In the order in which the results were stored or used, latest last.
        self._results: list[_Result] = []

    def add(self, study: Study, solution: Solution) -> None:
        """Store the result of a study; the oldest results are dropped if there are too many.

        Parameters
        ----------
        study : Study
        solution : Solution
            Solution on the full grid. A preview, whose settings are not those of the study, is
            ignored.
        """
        if solution.provenance.parameters["optimizer"] != study.optimizer.parameters:
            return
        self._results = [each for each in self._results if not each.study.same_as(study)]
        # The digests are copied, because they would keep the arrays of the problem in memory.
        record = replace(solution.provenance, inputs=dict(solution.provenance.inputs))
        self._results.append(_Result(study, replace(solution, provenance=record)))
        while len(self._results) > MOST_RESULTS or self._size > MOST_BYTES:
            del self._results[0]

    def find(self, study: Study) -> Solution | None:
        """Return the stored solution of a study, perhaps with another budget, or None."""
        for number in reversed(range(len(self._results))):
            if self._results[number].belongs_to(study):
                found = self._results.pop(number)
                self._results.append(found)
                return found.solution
        return None

    @property
    def _size(self) -> int:
        """Size of the stored displacements, in bytes."""
        return sum(each.solution.displacement.nbytes for each in self._results)


class _Result(NamedTuple):
    """Solution of a study."""

    study: Study
    solution: Solution

    def belongs_to(self, study: Study) -> bool:
        """Return whether the solution is a result of a study."""
        own, optimizer = self.study, study.optimizer
        if own.motion.drawing != study.motion.drawing:
            return False  # the usual case, which is fast
        if isinstance(own.optimizer, Multigrid) and isinstance(optimizer, Multigrid):
            own = replace(own, optimizer=replace(own.optimizer, budget=optimizer.budget))
        return own.same_as(study)

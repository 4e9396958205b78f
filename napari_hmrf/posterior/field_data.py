"""Measured displacements, to which properties of tissue are fitted."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_numbers
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.uncertain_landmarks import Landmarks, interpolated

Float64Array = npt.NDArray[np.float64]

#: Error of a displacement, relative to the standard deviation of the measurement.
_ACCURACY = 0.02
#: Smallest and largest tolerance of a solve, in pixels.
_TOLERANCES = (1e-4, 0.01)


class FieldData:
    """Measured displacements, in units of their standard deviations.

    `seen` is True where a component was measured, shape (H, W, 2) or (D, H, W, 3); `values` and
    `sd` belong to these components.
    """

    def __init__(
        self,
        seen: npt.NDArray[np.bool_],
        values: Float64Array,
        sd: Float64Array,
        landmarks: Landmarks | None,
        spacing: tuple[float, ...],
    ) -> None:
        self._seen, self._values, self._sd = seen, values, sd
        self._landmarks, self._spacing = landmarks, spacing
        sds = [sd] if seen.any() else []
        if landmarks is not None:
            sds.append(landmarks.sd.ravel())
        self.least_sd = float(min(each.min() for each in sds))

    @classmethod
    def of(
        cls,
        problem: Problem,
        measured: npt.ArrayLike | None,
        sd: npt.ArrayLike | None,
        landmarks: Landmarks | None,
    ) -> FieldData:
        """Check measured displacements."""
        grid, axes = problem.shape, len(problem.shape)
        if measured is None and landmarks is None:
            raise ProblemError("measured", "is missing. Pass a displacement field or landmarks.")
        field = np.full((*grid, axes), np.nan)
        if measured is not None:
            field = np.array(as_numbers("measured", measured), dtype=np.float64)
            if field.shape != (*grid, axes):
                raise ProblemError(
                    "measured",
                    f"has shape {field.shape}, but stiffness has shape {grid}, so "
                    f"{(*grid, axes)} is needed.",
                )
            if sd is None:
                raise ProblemError("sd", "is missing: state how large the errors of measured are.")
        spread = np.array(1.0 if sd is None else as_numbers("sd", sd), dtype=np.float64)
        if spread.shape not in ((), grid) or not (np.isfinite(spread) & (spread > 0)).all():
            raise ProblemError("sd", f"is not a positive length, or an array of shape {grid}.")
        if np.isinf(field).any():
            raise ProblemError(
                "measured", "is infinite at some sites. Pass NaN where it is unknown."
            )
        free = problem.tissue & ~problem.known.all(axis=-1)
        seen = free[..., np.newaxis] & ~np.isnan(field)
        if measured is not None and not seen.any():
            raise ProblemError("measured", "has no values in tissue that is free to move.")
        if landmarks is not None:
            landmarks.check(problem.stiffness, problem.spacing)
        spread = np.broadcast_to(spread[..., np.newaxis], field.shape)[seen]
        return cls(seen, field[seen], spread, landmarks, problem.spacing)

    def misfit(self, displacement: npt.NDArray[Any]) -> Float64Array:
        """Return the differences from the measured motion, in standard deviations."""
        parts = [(displacement[self._seen] - self._values) / self._sd]
        if self._landmarks is not None:
            observed = self._landmarks.displacement(self._spacing)
            found = interpolated(displacement, self._landmarks.points) - observed
            parts.append((found / self._landmarks.sd).ravel())
        return np.concatenate(parts)

    def derivative(self, displacement: npt.NDArray[Any], response: Float64Array) -> Float64Array:
        """Return the derivatives of the differences, which are the same at any displacement."""
        parts = [response[self._seen] / self._sd]
        if self._landmarks is not None:
            found = interpolated(response, self._landmarks.points)
            parts.append((found / self._landmarks.sd).ravel())
        return np.concatenate(parts)

    def variance(self, differences: Float64Array) -> float:
        """Return the variance of the differences, which is 1: their unit is the sd."""
        return 1.0

    def covariance(self, slopes: Float64Array, differences: Float64Array) -> Float64Array:
        """Return the covariance of the properties.

        Differences that are larger than their errors make the properties less certain.

        Parameters
        ----------
        slopes : ndarray, shape (p, k)
            Derivatives of p differences with respect to k properties.
        differences : ndarray, shape (p,)
            Differences at the solution.
        """
        freedom = max(1, differences.size - slopes.shape[1])
        misfit = float(differences @ differences) / freedom
        return np.asarray(np.linalg.inv(slopes.T @ slopes) * max(1.0, misfit))

    def tolerance(self, problem: Problem) -> float:
        """Return the tolerance of a solve, in pixels, at which its error is negligible."""
        low, high = _TOLERANCES
        return min(max(_ACCURACY * self.least_sd / problem.unit, low), high)

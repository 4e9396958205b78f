"""Result of a registration: motion between two images, and its data for further edits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.inverse_field import Inverse, inverse_displacement
from napari_hmrf.field.resample import sampled
from napari_hmrf.real_arrays import as_numbers
from napari_hmrf.registration.alignment import matrix_in_pixels
from napari_hmrf.registration.image_data import Relation
from napari_hmrf.registration.matching import Step
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.uncertain_landmarks import Landmarks, typical_stiffness
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.study import Motion
from napari_hmrf.tissue.drawing import Drawing

Float64Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Registration:
    """Motion of the tissue of the fixed image to its position in the moving image.

    Attributes
    ----------
    solution : Solution
        Displacement field on the grid of the fixed image: tissue at X moves to X + d(X). Without
        an alignment, the same tissue is at X + d(X) in the moving image.
    matrix : ndarray, shape (n + 1, n + 1)
        Alignment: homogeneous matrix from moved positions to positions in the moving image, in the
        unit of the spacing. The identity if the images were not aligned.
    moving_spacing : tuple of float
        Size of a pixel of the moving image along each axis.
    observed : ndarray, shape (H, W, 2) or (D, H, W, 3), float32
        Displacement that the images observe at each site.
    precision : ndarray, shape (H, W, 2, 2) or (D, H, W, 3, 3), float32
        Precision of `observed`, relative to the typical stiffness of the tissue.
    residual : float
        Root mean square of the difference of locally normalized brightness.
    similarity_before, similarity : float
        Correlation of the locally normalized images before and after the motion, at most 1.
    sd : float
        Suggested standard deviation of each component of the displacement in the tissue, in the
        unit of the spacing, from the residual and the precision; about right on average, but not at
        each site.
    history : tuple of Step
        Record of each step.
    prior : ElasticPrior
        Prior of the tissue.
    landmarks : Landmarks or None
        Landmarks that the motion follows, too.
    relation : {"same", "inverse", "from fixed", "from moving"}
        Relation of the brightness of both images: bright tissue is bright in both, or dark in one
        of them, or the brightness of one image is another function of that of the other.
    missing : ndarray of bool, shape (H, W) or (D, H, W), or None
        Mask of the tissue of the fixed image without counterpart in the moving image, which has no
        effect; None if there is none.
    """

    solution: Solution
    matrix: Float64Array
    moving_spacing: tuple[float, ...]
    observed: npt.NDArray[np.float32]
    precision: npt.NDArray[np.float32]
    residual: float
    similarity_before: float
    similarity: float
    sd: float
    history: tuple[Step, ...]
    prior: ElasticPrior
    landmarks: Landmarks | None = None
    relation: Relation = "same"
    missing: npt.NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        return (
            f"Registration({self.solution!r}, similarity {self.similarity_before:.2f} before and "
            f"{self.similarity:.2f} after, sd {self.sd:.2g}, {self.folds} folds)"
        )

    @property
    def displacement(self) -> npt.NDArray[np.floating]:
        """Displacement of the fixed image's tissue, shape ([D,] H, W, n), as in a `Solution`."""
        return self.solution.displacement

    @cached_property
    def inverse(self) -> Inverse:
        """Inverse of the displacement, and its error: from moved positions to their origins."""
        here = self.solution
        return inverse_displacement(here.displacement, spacing=here.spacing, tissue=here.tissue)

    @cached_property
    def folds(self) -> int:
        """Number of sites at which the displacement folds tissue."""
        return self.solution.count_folds()

    def move(self, points: npt.ArrayLike) -> Float64Array:
        """Return the positions of points of the fixed image in the moving image.

        Parameters
        ----------
        points : array_like, shape (N, n)
            Positions in pixels of the fixed image.

        Returns
        -------
        ndarray, shape (N, n), float64
            Positions in pixels of the moving image.

        Raises
        ------
        ProblemError
            As for `Solution.move`.
        """
        return self._in_moving(self.solution.move(points, extend=True))

    def resample(self, moving: npt.ArrayLike, *, order: int = 1, fill: float = 0) -> Any:
        """Move an image from the grid of the moving image to that of the fixed image.

        The result looks like the fixed image, or, for labels of the moving image and ``order=0``,
        contains the labels of the fixed image.

        Parameters
        ----------
        moving : array_like
            Image on the grid of the moving image, optionally with colour channels.
        order : int
            Order of the interpolating spline, from 0 (nearest neighbour) to 5.
        fill : float
            Value of pixels whose tissue is outside of the moving image.

        Returns
        -------
        ndarray
            Image on the grid of the fixed image, with the dtype of `moving`.

        Raises
        ------
        ProblemError
            If the image is not numeric or has another number of axes.
        """
        image, shape = as_numbers("moving", moving), self.solution.tissue.shape
        axes = len(shape)
        if image.ndim not in (axes, axes + 1):
            raise ProblemError(
                "moving",
                f"has shape {image.shape}, but the registration has {axes} axes. Pass an image on "
                "the grid of the moving image.",
            )
        sites = np.moveaxis(np.indices(shape, dtype=np.float64), 0, -1)
        places = self._in_moving(sites + self.displacement / np.asarray(self.solution.spacing))
        last = np.array(image.shape[:axes]) - 1
        outside = ((places < -0.5) | (places > last + 0.5)).any(axis=-1)
        resampled = sampled(image, np.clip(places, 0, last), order)
        resampled[outside] = fill
        return resampled

    @property
    def problem(self) -> Problem:
        """Tissue that the images and the landmarks observe, without other constraints."""
        here = self.solution
        assert here.elasticity is not None
        m = here.elasticity.stiffness
        return Problem(
            observed=self.observed,
            confidence=np.zeros_like(self.observed),
            stiffness=m,
            spacing=here.spacing,
            precision=np.float32(typical_stiffness(m)) * self.precision,
            landmarks=self.landmarks,
        )

    def motion(self) -> Motion:
        """Return the motion of a study that moves the tissue as the images and landmarks do.

        The study may be edited: tissue that is pulled, held or made rigid moves the tissue around
        it, as far as the images allow.
        """
        drawing, marks = Drawing(), self.landmarks
        if marks is not None:
            sd = marks.sd.reshape(len(marks.points), -1)[:, 0]
            drawing = Drawing.from_landmarks(marks.points, marks.targets, radius=1.0, sd=sd)
        measured = MeasuredMotion(self.observed, self.precision, self.record, self.missing)
        return Motion(measured=measured, drawing=drawing)

    @property
    def record(self) -> dict[str, Any]:
        """Record of the registration for a study, in JSON types."""
        return {
            "matrix": self.matrix.tolist(),
            "before": self.similarity_before,
            "similarity": self.similarity,
            "relation": self.relation,
            "missing sites": 0 if self.missing is None else int(self.missing.sum()),
            "residual": self.residual,
            "sd": self.sd,
        }

    def _in_moving(self, pixels: Float64Array) -> Float64Array:
        """Convert positions in pixels of the fixed image to pixels of the moving image."""
        axes = pixels.shape[-1]
        if np.array_equal(self.matrix, np.eye(axes + 1)) and (
            self.moving_spacing == self.solution.spacing
        ):
            return pixels
        matrix = matrix_in_pixels(self.matrix, self.solution.spacing, self.moving_spacing)
        return np.asarray(pixels @ matrix[:axes, :axes].T + matrix[:axes, axes])


def relation_in_words(relation: Relation) -> str:
    """Describe how the brightness of two images is related, as a clause."""
    return {
        "same": "bright tissue is bright in both images",
        "inverse": "the images have opposite contrast: bright tissue of one is dark in the other",
        "from fixed": "the images have different contrasts: the moving image is compared with the "
        "brightness that is expected from the fixed image",
        "from moving": "the images have different contrasts: the fixed image is compared with the "
        "brightness that is expected from the moving image",
    }[relation]


def agreement_in_words(before: float, after: float) -> str:
    """Describe the similarity of two images: "16 % before, 39 % after"."""
    shares = (f"{100 * max(value, 0.0):.0f} %" for value in (before, after))
    return "{} before, {} after".format(*shares)

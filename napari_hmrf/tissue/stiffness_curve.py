"""Stiffness as a function of image intensity, defined by a curve that the user draws.

If tissues differ in brightness, painting them is not necessary: a curve through a few points maps
each intensity to a stiffness, and intensities below a threshold are void. A curve is immutable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, asdict, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from napari_hmrf.checks import (
    Choice,
    CurvePoints,
    Flag,
    Number,
    Text,
    checked,
    convert,
)
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_numbers
from napari_hmrf.solver.problem import FloatArray
from napari_hmrf.tissue.surroundings import void_threshold

Between = Literal["straight", "smooth"]
Point = tuple[float, float]

#: Points of an initial curve: percentiles of the intensity, and stiffnesses of the paper's soft
#: tissue, normal tissue and tumour.
PERCENTILES = (5.0, 50.0, 95.0)
STIFFNESSES = (10.0, 20.0, 40.0)
#: Number of linear pieces that approximate a smooth curve between two points. The relative error is
#: about 1e-5.
_NODES = 64


@checked
class StiffnessCurve:
    """Callable curve that maps image intensities to stiffnesses.

    Between its points the curve is linear or smooth. A smooth curve is a monotone cubic (PCHIP),
    which does not exceed the range of the two neighbouring points. Beyond the outer points the
    curve is constant. NaN is void.

    Attributes
    ----------
    points : tuple of (float, float)
        Two or more pairs of intensity, in the unit of the image, and stiffness (Young's modulus,
        above 0), sorted by increasing intensity.
    void_below : float, optional
        Intensity below which there is no tissue and the stiffness is 0.
    between : {"straight", "smooth"}
        Kind of interpolation between the points.
    logarithmic : bool
        If True, interpolate the logarithm of the stiffness, because the stiffnesses of tissues
        differ by orders of magnitude.
    unit : str
        Unit of stiffness, for display only, because only ratios matter.

    Raises
    ------
    ArgumentError
        If there are fewer than two points, if the intensities do not increase, or if a value is
        invalid; the message states valid values.
    """

    points: CurvePoints
    _: KW_ONLY
    void_below: Number | None = None
    between: Annotated[Between, Choice()] = "straight"
    logarithmic: Flag = True
    unit: Text = ""

    def __post_init__(self) -> None:
        intensities = [intensity for intensity, _ in self.points]
        for before, after in pairwise(intensities):
            if before >= after:
                twice = "twice" if before == after else f"after {before:g}"
                raise ValueError(
                    f"points have intensity {after:g} {twice}. List each once, in increasing order"
                )

    def __call__(self, intensities: npt.ArrayLike) -> FloatArray:
        """Map the intensity of each pixel to a stiffness.

        Parameters
        ----------
        intensities : array_like of numbers, any shape
            Intensities of an image, or the `luminance` of a colour image. Masked pixels are void.

        Returns
        -------
        ndarray of the same shape, float32
            Argument `stiffness` of a `Problem`; 0 in void.

        Raises
        ------
        ProblemError
            If the intensities are not real numbers.
        """
        image = _as_intensities(intensities)
        mask, image = np.ma.getmaskarray(image), np.ma.getdata(image)
        if image.dtype.kind == "b":
            image = image.view(np.uint8)
        if image.dtype.kind in "iu" and image.dtype.itemsize <= 2:
            # Compute each possible value once. A negative intensity indexes the table from its end.
            numbers = np.arange(256**image.dtype.itemsize).astype(image.dtype)
            values: FloatArray = self._at(numbers)[image]
        else:
            values = self._at(image)
        if mask.any():
            values[mask] = 0
        return values

    @cached_property
    def _nodes(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Nodes of the piecewise linear curve: intensity, and stiffness or its logarithm."""
        intensities, stiffnesses = np.array(self.points).T
        heights = np.log(stiffnesses) if self.logarithmic else stiffnesses
        if self.between == "straight":
            return intensities, heights
        from scipy.interpolate import PchipInterpolator  # heavy: scipy

        steps = np.arange(_NODES) / _NODES
        spans = np.diff(intensities)[:, None]
        fine = np.append((intensities[:-1, None] + steps * spans).ravel(), intensities[-1])
        return fine, PchipInterpolator(intensities, heights)(fine)

    def _at(self, image: npt.NDArray[Any]) -> FloatArray:
        heights = np.interp(image.astype(np.float64, copy=False), *self._nodes)
        values = np.asarray(np.exp(heights) if self.logarithmic else heights, dtype=np.float32)
        void = np.isnan(image)
        if self.void_below is not None:
            void |= image < self.void_below
        return np.where(void, np.float32(0), values)

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest stiffness of all points."""
        stiffnesses = [stiffness for _, stiffness in self.points]
        return min(stiffnesses), max(stiffnesses)

    def as_dict(self) -> dict[str, Any]:
        """Return the curve as a dictionary of JSON types, for the metadata of a layer."""
        return {**asdict(self), "points": [list(point) for point in self.points]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> StiffnessCurve:
        """Create a curve from a dictionary that `as_dict` returned.

        Raises
        ------
        ArgumentError
            If the dictionary is not from `as_dict`, or if a value is invalid.
        """
        curve: StiffnessCurve = convert(cls, values, "curve")
        return curve

    @classmethod
    def from_percentiles(
        cls,
        intensities: npt.ArrayLike,
        void_below: float | None = None,
    ) -> StiffnessCurve:
        """Create an initial curve for an image, with higher stiffness for brighter pixels.

        Parameters
        ----------
        intensities : array_like of numbers, any shape
            Intensities of the image.
        void_below : float, optional
            Intensity below which there is no tissue; darker pixels are ignored.

        Returns
        -------
        StiffnessCurve

        Raises
        ------
        ProblemError
            If the image does not have two different intensities.
        """
        values = np.ma.masked_invalid(_as_intensities(intensities)).compressed().astype(float)
        if void_below is not None:
            values = values[values >= void_below]
        if not values.size or values.min() == values.max():
            raise _bad(
                "cannot be made: the tissue of the image has a single intensity. Choose another "
                "image or slice"
            )
        nodes = [float(f"{value:.5g}") for value in np.percentile(values, PERCENTILES)]
        points = dict(zip(nodes, STIFFNESSES, strict=True))
        if len(points) < 2:  # most pixels of the image have one value
            ends = (float(values.min()), float(values.max()))
            points = dict(zip(ends, (STIFFNESSES[0], STIFFNESSES[-1]), strict=True))
        return cls(tuple(sorted(points.items())), void_below=void_below)


def first_curve(picture: npt.NDArray[Any]) -> StiffnessCurve:
    """Create an initial curve: brighter pixels are stiffer, and dark surroundings are void.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W)

    Returns
    -------
    StiffnessCurve

    Raises
    ------
    ProblemError
        If the tissue of the image has a single intensity.
    """
    return StiffnessCurve.from_percentiles(picture, void_below=void_threshold(picture))


def with_point(curve: StiffnessCurve, at: int | None, point: Point | None) -> StiffnessCurve:
    """Return a curve with one point added, moved or removed.

    Parameters
    ----------
    curve : StiffnessCurve
    at : int or None
        Index of the point to move or remove; None to add a point.
    point : (float, float) or None
        New intensity and stiffness; None to remove the point.

    Returns
    -------
    StiffnessCurve

    Raises
    ------
    ArgumentError
        If the new points do not define a valid curve.
    """
    others = [each for number, each in enumerate(curve.points) if number != at]
    added = [] if point is None else [point]
    return replace(curve, points=tuple(sorted([*others, *added])))


def _as_intensities(values: npt.ArrayLike) -> npt.NDArray[Any]:
    image = np.ma.asanyarray(values) if np.ma.isMA(values) else as_numbers("intensities", values)
    if image.dtype.kind not in "biuf":
        raise _bad(f"cannot come from intensities of type {image.dtype}. Use real numbers")
    return image


def _bad(message: str) -> ProblemError:
    return ProblemError("stiffness curve", f"{message}.")

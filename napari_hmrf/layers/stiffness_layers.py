"""Layers of stiffness made from an image's intensity by a curve, which they keep."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.label_colours import stiffness_colours
from napari_hmrf.layers.metadata import METADATA, TISSUE, known_of
from napari_hmrf.layers.pixel_copy import copy_slice
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import LayerData
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.transform import place_of
from napari_hmrf.study.layer_names import LayerError, full_resolution
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve, luminance
from napari_hmrf.tissue.surroundings import background_of, surrounds

#: So far above what surrounds it tissue begins, on the way to its usual intensity.
_ABOVE = 0.01
#: A picture of more values than this is computed where it is looked at, as stacks are.
_PLAIN = 2**26


class StiffnessStack:
    """A stack seen through a curve: a slice is computed when it is looked at, and not before.

    Parameters
    ----------
    source : array_like, shape (..., H, W) or (..., H, W, 3 or 4)
        Of numpy, dask, zarr or the like.
    curve : StiffnessCurve
    coloured : bool
        Whether the last axis is one of colours.

    Attributes
    ----------
    shape, ndim, dtype, size
        As of an array of float32.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, source: Any, curve: StiffnessCurve, coloured: bool = False) -> None:
        self._source, self._curve, self._coloured = source, curve, coloured
        self.shape: tuple[int, ...] = tuple(source.shape[:-1] if coloured else source.shape)
        self.ndim = len(self.shape)
        self.size = int(np.prod(self.shape))

    def __getitem__(self, index: Any) -> npt.NDArray[np.float32]:
        index = index if isinstance(index, tuple) else (index,)
        if self._coloured and any(part is Ellipsis for part in index):
            index = (*index, slice(None))
        part = self._source[index]
        return stiffness_of(part, self._curve, self._coloured)

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """All of it, slice by slice."""
        if self.ndim <= 2:
            return self[()].astype(dtype or self.dtype)
        return np.stack([self[at] for at in range(self.shape[0])]).astype(dtype or self.dtype)


def stiffness_of(
    picture: Any, curve: StiffnessCurve, coloured: bool = False
) -> npt.NDArray[np.float32]:
    """How stiff the pixels of a picture are.

    Parameters
    ----------
    picture : array_like, shape (...) or (..., 3 or 4)
    curve : StiffnessCurve
    coloured : bool
        Whether the last axis is one of colours, of which the luminance counts.
    """
    if hasattr(picture, "compute"):  # of dask, whose own conversion would lose a mask
        picture = picture.compute()
    picture = np.ma.asanyarray(picture) if np.ma.isMA(picture) else np.asarray(picture)
    return curve(luminance(picture) if coloured else picture)


def intensities_of(image: Any, view: View | None = None) -> npt.NDArray[Any]:
    """Copy the intensities of the slice that is shown; of colours, the luminance.

    Parameters
    ----------
    image : napari.layers.Image
    view : View, optional
        Which slice; by default the first, of the last two axes.

    Returns
    -------
    ndarray, shape (H, W)

    Raises
    ------
    ProblemError
        If it cannot be read.
    """
    picture = copy_slice(image, Frame.of(image, view))
    return luminance(picture) if image.rgb else picture


def first_curve(image: Any, view: View | None = None) -> StiffnessCurve:
    """Guess a curve from the slice that is shown: brighter is stiffer, dark surroundings are void.

    Parameters
    ----------
    image : napari.layers.Image
    view : View, optional

    Raises
    ------
    ProblemError
        If the slice cannot be read or is of one value.
    """
    picture = intensities_of(image, view)
    around = background_of(picture)
    void_below = None
    if surrounds(around) and not around.all():
        dark, rest = (part[np.isfinite(part)] for part in (picture[around], picture[~around]))
        if dark.size and rest.size:
            # Just above nearly all of it: dark places inside, such as fluid, stay tissue.
            darkest, usual = float(np.percentile(dark, 99)), float(np.median(rest))
            void_below = float(f"{darkest + _ABOVE * (usual - darkest):.4g}")
    try:
        return StiffnessCurve.from_percentiles(picture, void_below=void_below)
    except ProblemError as error:
        raise LayerError(
            image,
            "is of one value in this slice, so that no curve can tell tissues apart. Choose "
            "another image or slice.",
        ) from error


def stiffness_layer(image: Any, curve: StiffnessCurve) -> LayerData:
    """A layer of stiffness in the place of an image, of all its slices.

    Parameters
    ----------
    image : napari.layers.Image
    curve : StiffnessCurve

    Returns
    -------
    LayerData
        Of an Image layer, whose metadata keep the curve and the image's name. Both docks take it
        as tissue as soon as it is added to the viewer.
    """
    unit = f" ({curve.unit})" if curve.unit else ""
    attributes = {
        "name": f"{image.name} stiffness{unit}",
        "metadata": _metadata(image, curve),
        "contrast_limits": _limits(curve),
        "colormap": stiffness_colours(),
        "opacity": 0.5,
        "rgb": False,
        "multiscale": False,
        **place_of(image),
    }
    return LayerData(_data(image, curve), attributes, "image")


def update_stiffness(layer: Any, image: Any, curve: StiffnessCurve) -> None:
    """Have a layer of stiffness say what another curve says.

    Parameters
    ----------
    layer : napari.layers.Image
        Of `stiffness_layer`; what the user changed of its looks stays.
    image : napari.layers.Image
        It comes from.
    curve : StiffnessCurve

    Raises
    ------
    ProblemError
        If the image is not of the layer's size any more.
    """
    data = _data(image, curve)
    if tuple(data.shape) != tuple(layer.data.shape):
        raise LayerError(
            image,
            f"is not of the size of '{layer.name}' any more. Make the tissue from it anew.",
        )
    layer.metadata.update(_metadata(image, curve))
    layer.data = data
    layer.contrast_limits = _limits(curve)


def curve_of(layer: Any) -> StiffnessCurve | None:
    """The curve that a layer's metadata keep, if they keep one that can be read."""
    try:
        return StiffnessCurve.from_dict(known_of(layer)["curve"])
    except (KeyError, ProblemError):
        return None


def source_name(layer: Any) -> str:
    """What the image was called that a layer of stiffness comes from."""
    return str(known_of(layer).get("source", ""))


def _data(image: Any, curve: StiffnessCurve) -> Any:
    source = full_resolution(image)
    # One slice is at hand as a plain array; of a stack what is not looked at costs nothing.
    if image.ndim <= 2 and math.prod(source.shape) <= _PLAIN:
        return stiffness_of(source, curve, image.rgb)
    return StiffnessStack(source, curve, image.rgb)


def _metadata(image: Any, curve: StiffnessCurve) -> dict[str, Any]:
    known = {"role": TISSUE, "curve": curve.as_dict(), "source": str(image.name)}
    return {METADATA: {**known, "unit": curve.unit} if curve.unit else known}


def _limits(curve: StiffnessCurve) -> tuple[float, float]:
    """To the stiffest, and from less than the softest, so that only what is void lies below."""
    softest, stiffest = curve.range
    return min(softest / 2, stiffest / 256), stiffest

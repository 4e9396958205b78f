"""MONAI transform for random deformations, which requires the optional dependency ``monai``.

No other module imports MONAI or this module.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any

import numpy as np

from napari_hmrf.augmentation.random_deformation import RandomDeformation
from napari_hmrf.errors import ArgumentError
from napari_hmrf.extras import how_to_install
from napari_hmrf.field.live_warp import Picture
from napari_hmrf.field.resample import emptiness

try:
    from monai.config import KeysCollection
    from monai.transforms import MapTransform, RandomizableTransform
    from monai.utils import (
        TransformBackends,
        convert_to_dst_type,
        convert_to_numpy,
        ensure_tuple_rep,
    )
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] != "monai":
        raise
    raise ModuleNotFoundError(
        f"MONAI is not installed: {how_to_install('monai')}.", name="monai"
    ) from error

#: Spline order of each interpolation mode of MONAI.
_ORDERS = {"bilinear": 1, "nearest": 0}


class RandPhysicalDeformationd(RandomizableTransform, MapTransform):
    """Transform that warps all arrays of a dictionary with the same random deformation.

    The interface is similar to `Rand2DElasticd` and `Rand3DElasticd`, but the deformation is
    physical: bone stays rigid, air is void, and tissue does not fold. Arrays are channel-first, and
    their type is preserved: NumPy array, torch tensor or `MetaTensor`.

    Parameters
    ----------
    keys : hashable or sequence of hashable
        Keys of arrays, (channels, H, W) or (channels, D, H, W), on the grid of the deformation.
    deformation : RandomDeformation or callable
        Deformation of the case that all dictionaries belong to, or a callable that returns the
        deformation for a dictionary, for example for its subject.
    prob : float
        Probability that a dictionary is deformed.
    mode : {"bilinear", "nearest"} or sequence of these
        Interpolation of each key: "bilinear" for images, "nearest" for labels.
    allow_missing_keys : bool
        If True, ignore keys that a dictionary does not have.

    Raises
    ------
    ArgumentError
        If a mode is unknown, or `deformation` is neither a RandomDeformation nor callable.
    """

    backend = [TransformBackends.NUMPY]  # noqa: RUF012 - MONAI's convention

    def __init__(
        self,
        keys: KeysCollection,
        deformation: RandomDeformation | Callable[[Mapping[Hashable, Any]], RandomDeformation],
        *,
        prob: float = 0.1,
        mode: Any = "bilinear",
        allow_missing_keys: bool = False,
    ) -> None:
        MapTransform.__init__(self, keys, allow_missing_keys)
        RandomizableTransform.__init__(self, prob)
        self.mode = ensure_tuple_rep(mode, len(self.keys))
        if not set(self.mode) <= set(_ORDERS):
            raise ArgumentError(f"mode must be one of {', '.join(_ORDERS)}, not {self.mode}")
        if not (isinstance(deformation, RandomDeformation) or callable(deformation)):
            raise ArgumentError("deformation must be a RandomDeformation or a callable")
        self.deformation = deformation
        self._seed = 0

    def randomize(self, data: Any = None) -> None:
        """Draw at random whether the next dictionary is deformed, and the seed of its sample."""
        super().randomize(data)
        self._seed = int(self.R.randint(2**31 - 1))

    def __call__(self, data: Mapping[Hashable, Any]) -> dict[Hashable, Any]:
        """Return a copy of a dictionary, with its arrays deformed.

        Parameters
        ----------
        data : mapping
            Dictionary, which is not modified.

        Returns
        -------
        dict

        Raises
        ------
        ProblemError
            If an array is not on the grid of the deformation.
        """
        result = dict(data)
        self.randomize(result)
        if not self._do_transform:
            return result
        deformation = self.deformation
        if not isinstance(deformation, RandomDeformation):
            deformation = deformation(result)
        sample = deformation.sample(self._seed)
        keys = list(self.key_iterator(result, self.mode))
        pictures = []
        for key, mode in keys:
            channels_last = np.moveaxis(convert_to_numpy(result[key]), 0, -1)
            fill = emptiness(channels_last, channels_last.ndim) if mode == "bilinear" else 0
            pictures.append(Picture(channels_last, order=_ORDERS[mode], fill=fill))
        for (key, _), moved in zip(keys, sample.pictures(*pictures), strict=True):
            channels_first = np.ascontiguousarray(np.moveaxis(moved, -1, 0))
            result[key] = convert_to_dst_type(channels_first, result[key])[0]
        return result

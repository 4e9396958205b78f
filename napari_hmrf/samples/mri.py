"""Sample of a real MRI, which scikit-image downloads once."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import HmrfError

#: Distance between slices and size of pixels, relative to the size of a pixel.
MRI_SCALE = 2.0, 1.0, 1.0


def mri_slices() -> npt.NDArray[Any]:
    """Return ten slices of the MRI of a head, from the volume data archive of Stanford University.

    Returns
    -------
    ndarray of uint16, shape (10, 256, 256)

    Raises
    ------
    HmrfError
        If the file is not on this computer yet and cannot be downloaded.
    """
    import skimage.data  # heavy: skimage

    try:
        return np.asarray(skimage.data.brain())
    except (ImportError, OSError) as error:
        raise HmrfError(
            "the MRI cannot be downloaded (0.5 MB, once). Connect to the internet and try again, "
            "or open the sample 'Brain to pull', which needs no download."
        ) from error

"""Volumes whose axes are stored in another order than the axes of the patient."""

import numpy as np

#: Voxels along the axes of the patient, each 2 x 1 x 1 mm, and orders of the stored axes.
SHAPE = (5, 6, 7)
STORED = {"PIR": (1, 2, 0), "SAR": (2, 1, 0), "LPS": (0, 1, 2)}


def write_scan(path, order):
    """Write a volume of 5 x 6 x 7 voxels of 2 x 1 x 1 mm, with its axes in another order."""
    import SimpleITK as sitk  # optional: SimpleITK

    image = sitk.GetImageFromArray(np.ones(SHAPE, np.float32))
    image.SetSpacing((1, 1, 2))
    image.SetOrigin((3, 4, 5))
    sitk.WriteImage(sitk.PermuteAxes(image, order), str(path))
    return path

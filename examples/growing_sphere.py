"""Growth of a sphere in a scan, in one slice and in the whole volume.

The sphere has a radius of 10 mm, and its radius would grow by 20 % without constraints. The script
reads scan.nii.gz, and writes the deformed images and the displacement fields as NIfTI files. It
requires SimpleITK.
"""

import numpy as np
import SimpleITK as sitk

from napari_hmrf import Material, Motion, Study, Tissue, solve_study
from napari_hmrf.fields import export_field, grid_of_image, measure

scan = sitk.ReadImage("scan.nii.gz")
middle = scan.GetSize()[2] // 2
materials = (Material(1, "tissue", 1.0), Material(2, "tumour", 4.0, growth=0.2))
for name, index, part in (("slice", middle, scan[:, :, middle]), ("volume", None, scan)):
    grid = grid_of_image(scan, slice=index)  # including the position of the scan
    offset = (np.indices(grid.shape).T - np.array(grid.shape) / 2) * grid.spacing  # in mm
    labels = np.where(np.linalg.norm(offset, axis=-1).T < 10, 2, 1)
    study = Study(grid, Tissue(labels=labels, materials=materials), Motion(hold_edge=True))
    solution = solve_study(study)
    deformed = sitk.GetImageFromArray(solution.warp(sitk.GetArrayFromImage(part)))
    deformed.CopyInformation(part)
    sitk.WriteImage(deformed, f"{name}-deformed.nii.gz")
    export_field(f"{name}-field.nii.gz", solution)
    print(f"{name}: the tumour grows by {measure(solution, labels)[1].size_change:.0f} %")

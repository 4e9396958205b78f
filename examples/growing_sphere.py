"""Growth of a sphere in a scan, in one slice and in the whole volume.

The sphere has a radius of 10 mm, and its radius would grow by 20 % without constraints. The script
reads scan.nii.gz, and writes the deformed images and the displacement fields as NIfTI files. It
requires SimpleITK.
"""

import numpy as np
import SimpleITK as sitk

from napari_hmrf import Grid, Material, Motion, Study, Tissue, solve_study

scan = sitk.ReadImage("scan.nii.gz")
middle = scan.GetSize()[2] // 2
materials = (Material(1, "tissue", 1.0), Material(2, "tumour", 4.0, growth=0.2))
for name, index, part in (("slice", middle, scan[:, :, middle]), ("volume", None, scan)):
    grid = Grid.from_image(scan, slice=index)  # including the position of the scan
    offset = (np.indices(grid.shape).T - np.array(grid.shape) / 2) * grid.spacing  # in mm
    labels = np.where(np.linalg.norm(offset, axis=-1).T < 10, 2, 1)
    study = Study(grid, Tissue(labels=labels, materials=materials), Motion(hold_edge=True))
    solution = solve_study(study)
    deformed = sitk.GetImageFromArray(solution.warp(sitk.GetArrayFromImage(part)))
    deformed.CopyInformation(part)
    sitk.WriteImage(deformed, f"{name}-deformed.nii.gz")
    solution.export(f"{name}-field.nii.gz")
    print(f"{name}: the tumour grows by {solution.measure(labels)[1].size_change:.0f} %")

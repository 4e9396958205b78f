"""Landmarks with standard deviations, and landmark files of BigWarp and 3D Slicer.

`Drawing.from_landmarks` creates a drawing that moves tissue from points to target positions, and
`Grid.to_pixels` converts the points of a file to pixels::

    from napari_hmrf import Drawing, Grid
    from napari_hmrf.landmarks import read_points

    pairs, grid = read_points("landmarks.csv"), grid_of_image("scan.nii.gz")
    source = grid.to_pixels(pairs.points, pairs.unit)
    target = grid.to_pixels(pairs.targets, pairs.unit)
    drawing = Drawing.from_landmarks(source, target, radius=3)

With a standard deviation, as in ``Drawing.from_landmarks(..., sd=0.5)``, tissue may miss a target.
`Landmarks` are such points of a `Problem`. The tissue follows each point according to its standard
deviation, and the strain scale of the tissue::

    landmarks = Landmarks(pairs.points, pairs.targets, sd=0.5, scale=StrainScale(strain=0.1))
    none = np.zeros((*stiffness.shape, 2))
    given = {"observed": none, "confidence": none, "stiffness": stiffness}
    solution = solve(Problem(**given, landmarks=landmarks))

If no other motion is known, `spline` interpolates landmarks smoothly inside the tissue::

    displacement = spline(landmarks, stiffness > 0, spacing=1)

`fit_spline` also returns the standard deviation of this displacement.
"""

from napari_hmrf.io.landmark_files import LandmarkFile, read_points, write_points
from napari_hmrf.registration.landmark_spline import Spline, fit_spline, spline
from napari_hmrf.solver.uncertain_landmarks import Landmarks, StrainScale

__all__ = [
    "LandmarkFile",
    "Landmarks",
    "Spline",
    "StrainScale",
    "fit_spline",
    "read_points",
    "spline",
    "write_points",
]

"""Landmark files of BigWarp and 3D Slicer.

`Drawing.from_landmarks` creates a drawing that moves tissue from points to target positions, and
`Grid.to_pixels` converts points from mm to pixels::

    from napari_hmrf import Drawing
    from napari_hmrf.landmarks import read_points

    pairs = read_points("landmarks.csv")
    drawing = Drawing.from_landmarks(pairs.points, pairs.targets, radius=3)
"""

from napari_hmrf.io.landmark_files import LandmarkFile, read_points, write_points

__all__ = ["LandmarkFile", "read_points", "write_points"]

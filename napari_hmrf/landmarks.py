"""Files of landmarks: points of BigWarp and 3D Slicer.

`Drawing.from_landmarks` moves tissue by pairs of points, and `Grid.to_pixels` converts points in
mm to pixels::

    from napari_hmrf import Drawing
    from napari_hmrf.landmarks import read_points

    pairs = read_points("landmarks.csv")
    drawing = Drawing.from_landmarks(pairs.points, pairs.targets, radius=3)
"""

from napari_hmrf.io.landmark_files import LandmarkFile, read_points, write_points

__all__ = ["LandmarkFile", "read_points", "write_points"]

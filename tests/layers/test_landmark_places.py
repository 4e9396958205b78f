"""Tests of landmark files of BigWarp beside an image with a place: from its first voxel."""

import napari
import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Layer

from napari_hmrf.contributions import open_landmarks, open_scan
from napari_hmrf.io.case import read_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.layers.slice_view import frame_of
from tests.support.stored_scans import SHAPE, STORED, write_scan


@pytest.mark.parametrize("order", STORED.values(), ids=STORED)
def test_landmarks_lie_in_the_window_where_the_shell_puts_them(tmp_path, monkeypatch, order):
    scan = str(write_scan(tmp_path / "scan.nii.gz", order))
    at, to = np.array([3.0, 2.0, 4.0]), np.array([3.0, 3.0, 4.0])  # x, y, z from the first voxel
    stored = [",".join(map(str, place[list(order)])) for place in (at, to)]
    marks = tmp_path / "marks.csv"
    marks.write_text(f"Pt-0,true,{stored[0]},{stored[1]}\n")
    viewer = ViewerModel()
    image = viewer.add_layer(Layer.create(*open_scan(scan)(scan)[0]))
    monkeypatch.setattr(napari, "current_viewer", lambda: viewer)
    where, should = (Layer.create(*made) for made in open_landmarks(str(marks))(str(marks)))
    (mark,) = read_case(Case(tmp_path / "scan.nii.gz", boundary=marks)).motion.drawing.marks
    assert image.data.shape == SHAPE
    for layer, place in ((where, mark.source), (should, mark.target)):
        seen = image.world_to_data(layer.data_to_world(layer.data[0]))
        np.testing.assert_allclose(seen, place, atol=1e-4)
    assert bool(frame_of(image).file_axes) == (order != (0, 1, 2))

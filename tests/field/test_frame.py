"""Conversion between slice and layer coordinates."""

import numpy as np

from napari_hmrf.field.frame import Frame


def test_arrows_of_a_slice_start_in_the_slice_and_stay_in_it():
    frame = Frame.at((3.0, 1.0, 1.0), ("pixel",) * 3, index=(7, 0, 0))
    (start, step) = frame.put_vectors(np.array([[(2.0, 4.0), (1.0, -1.0)]]))[0]
    assert start.tolist() == [7, 2, 4]
    assert step.tolist() == [0, 1, -1]

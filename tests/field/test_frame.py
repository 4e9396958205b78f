"""Conversion between slice and layer coordinates."""

import numpy as np

from napari_hmrf.field.frame import Frame


def test_arrows_of_a_slice_start_in_the_slice_and_stay_in_it():
    frame = Frame.at((3.0, 1.0, 1.0), ("pixel",) * 3, index=(7, 0, 0))
    (start, step) = frame.put_vectors(np.array([[(2.0, 4.0), (1.0, -1.0)]]))[0]
    assert start.tolist() == [7, 2, 4]
    assert step.tolist() == [0, 1, -1]


def test_one_length_in_two_units_is_one_place():
    frame = Frame.at((0.5, 2.0), ("mm", "mm"))
    assert frame.same_place(Frame.at((500.0, 2000.0), ("um", "um")), (6, 7))
    assert not frame.same_place(Frame.at((0.5, 2.0), ("um", "um")), (6, 7))


def test_a_new_layer_of_one_slice_of_a_turned_volume_lies_on_this_slice():
    affine = np.array([[0, -1, 0, 9], [1, 0, 0, -5], [0, 0, 1, 2], [0, 0, 0, 1.0]])
    frame = Frame.at((3.0, 1.0, 0.5), ("mm",) * 3, index=(7, 0, 0), affine=affine)
    place = frame.placement(image=True)
    first = affine @ [*place["translate"], 1]
    np.testing.assert_allclose(first, np.array(frame.matrix) @ [7, 0, 0, 1])

"""Equality of arrays, by which models, checks and warm starts are recognized."""

import numpy as np
import pytest

from napari_hmrf.real_arrays import are_equal


@pytest.mark.parametrize("count", [0, 1, 7, 8, 300_001])
@pytest.mark.parametrize("kind", [np.bool_, np.uint8, np.float32, np.float64])
def test_arrays_differ_if_their_last_value_does(count, kind):
    one = np.arange(count).astype(kind)
    assert are_equal(one, one.copy())
    if count:
        other = one.copy()
        other[-1] = not other[-1]
        assert not are_equal(one, other)


def test_arrays_differ_if_their_shape_or_type_does():
    one = np.zeros((2, 4), np.float32)
    assert not are_equal(one, one.reshape(4, 2))
    assert not are_equal(one, one.astype(np.float64))
    assert not are_equal(one, None)
    assert are_equal(None, None)


def test_strided_arrays_and_values_that_are_not_numbers_are_compared():
    one = np.full((6, 6), np.nan)
    assert are_equal(one[::2, 1:], one[::2, 1:].copy())

"""Quadtree of figure 3 of the paper."""

import itertools

import numpy as np
import pytest

from napari_hmrf.solver.quadtree import levels, nearest_pixels


def test_a_300_pixel_image_has_the_papers_ten_levels():
    tree = levels((300, 300))
    assert [level.number for level in tree] == list(range(10))
    assert [level.shape[0] for level in tree] == [300, 150, 75, 38, 19, 10, 5, 3, 2, 1]
    # 70 sweeps on each level give the 700 iterations of table 1.
    assert 70 * len(tree) == 700


@pytest.mark.parametrize("shape", [(1, 2), (1, 17), (2, 2), (5, 300), (257, 31), (1024, 1024)])
def test_the_root_is_one_site_and_each_level_halves(shape):
    tree = levels(shape)
    assert tree[0].shape == shape
    assert tree[-1].shape == (1, 1)
    for fine, coarse in itertools.pairwise(tree):
        assert coarse.shape == tuple(-(-size // 2) for size in fine.shape)
        assert coarse.sites < fine.sites


@pytest.mark.parametrize("shape", [(300, 300), (7, 12), (1, 9)])
def test_each_site_samples_the_pixel_nearest_to_its_centre(shape):
    for level in levels(shape):
        for size, pixels in zip(shape, nearest_pixels(level, shape), strict=True):
            width = 2**level.number
            centre = np.arange(len(pixels)) * width + (width - 1) / 2
            past = centre > size - 1  # only some of the pixels of the last site exist
            assert (pixels[past] == size - 1).all()
            # The pixel with the larger index, of two that are equally near.
            assert np.isin((pixels - centre)[~past], (0, 0.5)).all()


def test_the_finest_level_is_the_image():
    rows, cols = nearest_pixels(levels((4, 3))[0], (4, 3))
    assert rows.tolist() == [0, 1, 2, 3]
    assert cols.tolist() == [0, 1, 2]

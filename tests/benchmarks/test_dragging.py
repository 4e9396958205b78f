"""Tests of the benchmark of dragging: counters and the comparison of two checkouts."""

import threading
from pathlib import Path

import dragging
import numpy as np
from counting import Counts, counted
from napari.layers import Image


def test_short_lived_arrays_of_the_size_of_an_image_are_counted():
    image = np.zeros((40, 50), np.float32)
    counts = Counts()
    with counted(image.size, counts):
        kept = image.copy()
        assert np.sqrt(kept).sum() == 0
        image[:5].copy()
        other = threading.Thread(target=image.copy)
        other.start()
        other.join()
    assert counts.arrays == {"napari": 2}, "the copy or its square root was not counted"
    assert counts.megabytes == 2 * image.nbytes / 1e6
    image.copy()
    assert counts.arrays.total() == 2, "an array was counted after the context"
    np.testing.assert_array_equal(kept, image)


def test_reads_of_layers_are_counted_only_if_the_package_reads():
    from napari_hmrf.layers.metadata import role_of

    layer, counts = Image(np.zeros((4, 5)), name="MR"), Counts()
    with counted(10**9, counts):
        assert role_of(layer) is None
        assert layer.metadata == {}
        assert layer.data.shape == (4, 5)
    assert counts.metadata == {"MR": 1}, "a read by the test was counted"
    assert not counts.data
    role_of(layer)
    assert counts.metadata.total() == 1


def test_two_checkouts_alternate_and_ratios_are_computed_in_pairs(monkeypatch):
    order = []

    class Worker:
        def __init__(self, checkout, *_):
            self.name = checkout.name

        def drag(self, seconds, count=False):
            order.append(self.name)
            lag = 0.01 * len(order) * (1 if self.name == "mine" else 2)
            return {"late": [lag] * 3, "moves": 4, "thread": 0.1, "cpu": 0.3}

        def end(self):
            order.append("end")

    monkeypatch.setattr(dragging, "Worker", Worker)
    said = dragging.compare("solver", 64, "grey", [Path("mine"), Path("other")], 3, 1.0)
    assert order == ["mine", "other", "other", "mine", "mine", "other", "end", "end"]
    (median,) = (line for line in said.splitlines() if line.split()[0] == "median")
    # The pairs are 1 and 2 x 2, 4 and 2 x 3, 5 and 2 x 6.
    assert median.split()[1] == "0.42"
    assert "; 0.25 to 0.67)" in median, "the range of ratios is wrong"
    assert "per picture: 33.3 ms of the dragging thread" in said

"""A layer is visible if it is wanted and nothing hides it."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Image, Labels, Points

from napari_hmrf.layers.viewer_layers import layers_of


class Owner:
    """Something that hides layers."""


@pytest.fixture
def viewer():
    viewer = ViewerModel()
    for name in ("one", "two"):
        viewer.add_image(np.eye(4), name=name)
    return viewer


def test_a_layer_is_visible_again_when_the_last_owner_no_longer_hides_it(viewer):
    layers, (one, two), owner, other = layers_of(viewer), viewer.layers, Owner(), Owner()
    layers.hide_while(owner, [one, two])
    layers.hide_while(other, [one])
    layers.hide_while(owner, [])
    assert (one.visible, two.visible) == (False, True)
    layers.hide_while(other, [])
    assert one.visible


def test_a_layer_that_the_user_has_hidden_stays_hidden(viewer):
    layers, one, owner = layers_of(viewer), viewer.layers["one"], Owner()
    one.visible = False
    layers.hide_while(owner, [one])
    layers.hide_while(owner, [])
    assert not one.visible
    assert not layers.is_wanted(one)


def test_a_layer_wanted_while_it_is_hidden_appears_afterwards(viewer):
    layers, one, owner = layers_of(viewer), viewer.layers["one"], Owner()
    layers.want(one, wanted=False)
    layers.hide_while(owner, [one])
    layers.want(one)
    assert not one.visible
    layers.hide_while(owner, [])
    assert one.visible


def test_an_eye_clicked_by_the_user_counts_until_something_changes(viewer):
    layers, one, owner = layers_of(viewer), viewer.layers["one"], Owner()
    layers.want(one, wanted=False)
    one.visible = True
    assert layers.is_wanted(one)
    layers.hide_while(owner, [one])
    layers.hide_while(owner, [])
    assert one.visible


def test_an_owner_that_has_gone_hides_nothing(viewer):
    layers, one, owner = layers_of(viewer), viewer.layers["one"], Owner()
    layers.hide_while(owner, [one])
    del owner
    layers.want(one)
    assert one.visible


def test_an_unchanged_layer_keeps_its_mode(viewer):
    labels = viewer.add_labels(np.zeros((4, 4), int))
    labels.mode = "paint"
    layers_of(viewer).want(labels)
    assert labels.mode == "paint"  # napari ends the mode at each assignment


def test_a_new_layer_leaves_the_selection_as_it_is(viewer):
    layers, (one, two), events = layers_of(viewer), viewer.layers, []
    viewer.layers.selection = {one}
    viewer.layers.selection.events.active.connect(events.append)
    layers.add(Points([[1, 1]], name="new"), layers.above(one))
    assert [layer.name for layer in viewer.layers] == ["one", "new", "two"]
    assert viewer.layers.selection.active is one
    assert not events
    viewer.layers.selection = {one, two}
    layers.add(Points([[1, 1]], name="newer"))
    assert viewer.layers.selection == {one, two}
    layers.add(Points([[1, 1]], name="top"), select=True)
    assert viewer.layers.selection.active.name == "top"


@pytest.mark.parametrize("kind", [Image, Labels])
def test_a_hidden_layer_is_added_to_a_3d_view(viewer, kind):
    viewer.dims.ndisplay = 3
    layer = kind(np.ones((3, 4, 5), np.uint8), visible=False)
    layers_of(viewer).add(layer)
    assert not layer.visible
    assert not layers_of(viewer).is_wanted(layer)


def test_data_are_overwritten_in_place_without_an_event(viewer):
    layers, events = layers_of(viewer), []
    layer = viewer.add_image(np.zeros((4, 4)))
    layer.events.data.connect(events.append)
    array = layer.data
    assert layers.overwrite(layer, np.eye(4))
    assert layer.data is array
    np.testing.assert_array_equal(array, np.eye(4))
    assert not events
    for other in (np.eye(5), np.eye(4, dtype=np.float32)):
        assert not layers.overwrite(layer, other)
    array.setflags(write=False)
    assert not layers.overwrite(layer, np.ones((4, 4)))
    np.testing.assert_array_equal(array, np.eye(4))

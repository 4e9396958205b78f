"""Layers of a result are shown as long as they belong to what is shown."""

import numpy as np
import pytest
from napari.components import ViewerModel

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.result_layers import layer_on
from napari_hmrf.layers.viewer_undo import undo_of

HERE = Frame.at((1.0, 1.0), ("pixel",) * 2)


@pytest.fixture
def shown():
    """Return a function that shows a result of an image with the given parts."""
    viewer = ViewerModel()
    image = viewer.add_image(np.eye(4), name="scan")
    undo_of(viewer).session.choose_display(arrows=True)
    results = ResultLayers(viewer)

    def show(*parts):
        made = {}
        for part in parts:
            sort = "vectors" if part == "arrows" else "image"
            data = np.ones((1, 2, 2)) if part == "arrows" else np.eye(4)
            made[part] = layer_on(HERE, data, f"scan {part}", {"kind": part}, {}, sort)
        results.show(image, HERE, made)
        return results.at(image, HERE.slice_name)

    show.results = results
    yield show
    assert image in viewer.layers


def visible(result):
    return [part for part in ("image", "arrows") if result.layer(part).visible]


def test_a_part_that_the_latest_result_lacks_is_hidden_until_a_later_result_has_it(shown):
    result = shown("image", "arrows")
    assert visible(result) == ["image", "arrows"]
    shown("image")
    assert visible(result) == ["image"]
    shown("image", "arrows")
    assert visible(result) == ["image", "arrows"]


def test_a_part_that_the_user_has_hidden_stays_hidden_in_later_results(shown):
    result = shown("image", "arrows")
    result.layer("arrows").visible = False
    shown("image", "arrows")
    assert visible(result) == ["image"]
    result.set_wanted("arrows", True)
    assert visible(result) == ["image", "arrows"]


def test_arrows_over_an_image_are_shown_by_one_choice_for_all_results():
    viewer = ViewerModel()
    results, session = ResultLayers(viewer), undo_of(viewer).session
    vectors = layer_on(HERE, np.ones((1, 2, 2)), "arrows", {"kind": "arrows"}, {}, "vectors")
    sources = viewer.add_image(np.eye(4)), viewer.add_image(np.ones((4, 4)))
    tissue = viewer.add_labels(np.ones((4, 4), int))
    for source in (*sources, tissue):
        results.show(source, HERE, {"arrows": vectors})
    one, other, alone = (
        results.at(each, HERE.slice_name).layer("arrows") for each in viewer.layers[:3]
    )
    assert [each.visible for each in (one, other, alone)] == [False, False, True]
    session.choose_display(arrows=True)
    assert one.visible
    assert other.visible
    one.visible = False  # the eye in the layer list
    assert session.display.arrows is False
    assert not other.visible
    session.choose_display(overlay="grid")
    assert not other.visible


def test_no_part_is_shown_with_the_undeformed_image(shown):
    result = shown("image", "arrows")
    image = result.anchor()
    shown.results.show_undeformed(image, "paint")
    shown.results.show_undeformed(image, "comparison")
    assert visible(result) == []
    shown("image", "arrows")
    assert visible(result) == []
    shown.results.show_deformed(image, "comparison")
    assert result.is_before
    shown.results.show_deformed(image)
    assert not result.is_before
    assert visible(result) == ["image", "arrows"]


def test_paint_which_belongs_to_the_whole_motion_is_hidden_at_a_part_of_it(shown):
    result = shown("image", "painted")
    result.show_part(50, {"image": np.zeros((4, 4))})
    assert (result.layer("image").visible, result.layer("painted").visible) == (True, False)
    assert result.percent == 50
    result.show_whole()
    assert result.layer("painted").visible
    np.testing.assert_array_equal(result.layer("image").data, np.eye(4))

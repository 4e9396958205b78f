"""Tests of the menu of a result: measurements, exported files and layers moved along."""

import csv

import numpy as np
import pytest
from PIL import Image as Picture
from qtpy.QtWidgets import QFileDialog, QLabel, QTableWidget

from napari_hmrf import HmrfError, warp
from napari_hmrf.contributions import open_solution
from napari_hmrf.field.inverse_field import inverse_displacement
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.field.units import as_seen
from napari_hmrf.fields import read_field
from napari_hmrf.results.measurement import Measurement, measure
from napari_hmrf.solver.elastic_strain import strain_note
from tests.support.screen import Screen

MM = {"units": ("mm", "mm"), "scale": (0.5, 0.8)}


@pytest.fixture
def result(frame, small_sample, run, wait_for):
    """Return a function that makes a dock with a result: 20 x 24 pixels of gel, pushed right."""

    def make(**place):
        viewer, dock = frame.viewer, frame.open()
        dock.device = "cpu"
        dock.model, dock.live = "elastic", False
        shape = (*place.pop("more", ()), 20, 24)
        small_sample(viewer, shape, **place)
        run(dock)
        wait_for(lambda: not dock.busy)
        return dock, viewer

    return make


@pytest.fixture
def move_layers(wait_for):
    """Return a function that moves layers along with a result and returns the new layers."""

    def move(dock, viewer, *layers):
        dock.more.move_along(*layers)
        wait_for(lambda: not dock.busy)
        return [viewer.layers[f"{layer.name}, moved"] for layer in layers]

    return move


@pytest.fixture
def set_save_path(monkeypatch):
    """Return a function that sets the answer of the save dialog."""

    def answer(path):
        monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_, **__: (str(path), ""))

    return answer


# Layers moved along


def test_labels_and_channels_are_warped_without_new_values(result, move_layers):
    dock, viewer = result(**MM)
    rng = np.random.default_rng(0)
    cells = viewer.add_labels(rng.choice([0, 3, 7, 90], (20, 24)), name="cells", **MM)
    other = viewer.add_image(rng.random((20, 24)).astype(np.float32), name="T2", **MM)
    colours = viewer.add_image(
        rng.integers(0, 255, (20, 24, 3), dtype=np.uint8), name="H&E", rgb=True, **MM
    )
    found = move_layers(dock, viewer, cells, other, colours)
    d, tissue, spacing = dock.solution.displacement, dock.solution.tissue, (0.5, 0.8)
    for layer, new, order in zip((cells, other, colours), found, (0, 1, 1), strict=True):
        low = 0 if order == 0 or layer.rgb else layer.data.min()
        expected = warp(
            layer.data,
            d,
            spacing=spacing,
            tissue=tissue,
            order=order,
            fill=low.item() if low else 0,
        )
        np.testing.assert_array_equal(new.data, expected)
        np.testing.assert_array_equal(new.data_to_world((3, 4)), layer.data_to_world((3, 4)))
        assert viewer.layers.index(new) == viewer.layers.index(layer) + 1
    assert set(np.unique(found[0].data)) <= {0, 3, 7, 90}
    assert dock.status == "Moved along: 'cells, moved', 'T2, moved', 'H&E, moved'."
    assert dock.image.name == "MR", "a moved layer was selected as the image"


def test_points_and_shapes_move_with_the_tissue(result, move_layers):
    dock, viewer = result(**MM)
    at = np.array([[9.5, 6.0], [10.0, 20.5], [400.0, 3.0]])
    points = viewer.add_points(at, name="cells", features={"kind": [1, 2, 3]}, **MM)
    shapes = viewer.add_shapes(
        [
            [[5, 5], [12, 20]],
            [[4, 6], [4, 18], [14, 18], [14, 6]],
            [[5, 8], [5, 16], [9, 16], [9, 8]],
        ],
        shape_type=["line", "rectangle", "ellipse"],
        name="regions",
        **MM,
    )
    new, drawn = move_layers(dock, viewer, points, shapes)
    d, spacing = dock.solution.displacement, (0.5, 0.8)
    np.testing.assert_allclose(new.data[:2], moved_points(at[:2], d, spacing=spacing))
    np.testing.assert_array_equal(new.data[2], at[2])
    assert new.features["kind"].tolist() == [1, 2, 3]
    assert new.data[1, 1] > at[1, 1] + 2, "a point does not move right with the tissue"
    assert drawn.shape_type == ["line", "polygon", "polygon"]
    np.testing.assert_allclose(
        drawn.data[0], moved_points([[5, 5], [12, 20]], d, spacing=spacing), atol=1e-5
    )
    corners = moved_points([[4, 6], [4, 18]], d, spacing=spacing)
    np.testing.assert_allclose(drawn.data[1][[0, 8]], corners, atol=1e-5)


def test_all_frames_of_a_film_and_only_one_slice_of_a_volume_are_moved(result, move_layers):
    dock, viewer = result(
        more=(5,), units=("mm",) * 3, scale=(2.0, 0.5, 0.8), axis_labels=("z", "y", "x")
    )
    rng = np.random.default_rng(1)
    volume = viewer.add_labels(
        rng.integers(0, 4, (5, 20, 24)), name="organs", units=("mm",) * 3, scale=(2.0, 0.5, 0.8)
    )
    finer = viewer.add_image(  # The slice of the result extends from 3 to 5 mm.
        rng.random((12, 20, 24)), name="CT", units=("mm",) * 3, scale=(0.8, 0.5, 0.8)
    )
    film = viewer.add_image(rng.random((3, 5, 20, 24)), name="film", units=("s", "mm", "mm", "mm"),
                            scale=(1, 2.0, 0.5, 0.8))  # fmt: skip
    at = np.array([[2.2, 10, 20], [4.0, 10, 20]])
    points = viewer.add_points(at, name="cells", units=("mm",) * 3, scale=(2.0, 0.5, 0.8))
    found = move_layers(dock, viewer, volume, finer, film, points)
    solution = dock.solution
    how = {"spacing": solution.spacing, "tissue": solution.tissue}

    def changed(layer, new):
        return [tuple(index) for index in np.argwhere((layer.data != new.data).any(axis=(-2, -1)))]

    assert changed(volume, found[0]) == [(2,)]
    np.testing.assert_array_equal(
        found[0].data[2], warp(volume.data[2], solution.displacement, order=0, **how)
    )
    assert changed(finer, found[1]) == [(4,), (5,), (6,)]
    assert changed(film, found[2]) == [(0, 2), (1, 2), (2, 2)]
    assert found[3].data[0, 2] > 22
    np.testing.assert_array_equal(found[3].data[1], at[1])


def test_a_stack_with_an_unknown_axis_is_moved_as_a_whole(result, move_layers):
    dock, viewer = result()
    stack = np.random.default_rng(2).random((3, 2, 20, 24))
    layer = viewer.add_image(stack, name="channels")
    (new,) = move_layers(dock, viewer, layer)
    assert (new.data != stack).any(axis=(-2, -1)).all()


def test_an_image_on_another_grid_moves_with_the_tissue(result, move_layers):
    """Move a blob and a point on a grid that is finer, rotated by 90 degrees and larger."""
    dock, viewer = result(**MM)
    rows, cols = np.indices((90, 120))
    turned = {"affine": [[0, 0.3, -3.0], [-0.25, 0, 20.0], [0, 0, 1]], "units": ("mm", "mm")}
    at = np.array([[34.0, 26.0]])
    blob = np.exp(-((rows - 34) ** 2 + (cols - 26) ** 2) / 40).astype(np.float32)
    layer = viewer.add_image(blob, name="fine", **turned)
    labels = viewer.add_labels((blob > 0.5).astype(int) * 5, name="spot", **turned)
    points = viewer.add_points(at, name="mark", **turned)
    image, spot, mark = move_layers(dock, viewer, layer, labels, points)
    world = np.array(layer.data_to_world(at[0])) / [0.5, 0.8]
    to = moved_points([world], dock.solution.displacement, spacing=(0.5, 0.8))[0] * [0.5, 0.8]
    np.testing.assert_allclose(mark.data_to_world(mark.data[0]), to, atol=1e-6)
    assert np.linalg.norm(mark.data[0] - at[0]) > 3
    peak = np.unravel_index(image.data.argmax(), image.data.shape)
    np.testing.assert_allclose(peak, mark.data[0], atol=1.0)
    assert set(np.unique(spot.data)) == {0, 5}
    beside = np.s_[:, 100:]
    np.testing.assert_array_equal(image.data[beside], blob[beside])


def test_a_layer_with_other_units_is_refused_by_name(result):
    dock, viewer = result(**MM)
    in_pixels = viewer.add_labels(np.ones((20, 24), int), name="cells")
    with pytest.raises(HmrfError, match="'cells' has different units from the result"):
        dock.more.move_along(in_pixels)


def test_a_layer_moved_again_replaces_the_earlier_layer(result, move_layers, run, wait_for):
    dock, viewer = result()
    cells = viewer.add_labels(np.arange(480).reshape(20, 24), name="cells")
    (first,) = move_layers(dock, viewer, cells)
    dock.model = "paper"
    run(dock)
    wait_for(lambda: not dock.busy)
    (second,) = move_layers(dock, viewer, cells)
    assert first not in viewer.layers
    assert (first.data != second.data).any()


def test_the_menu_offers_the_layers_that_can_be_moved(result, wait_for):
    dock, viewer = result()
    viewer.add_points([[9, 9]], name="R&D")
    screen = Screen(dock)
    along = screen.entry("More", "Move along").menu()
    assert [each.text() for each in along.actions()] == [
        "Tissue", "Boundary", "R&&D", "All of these"
    ]  # fmt: skip
    viewer.layers["Tissue"].visible = False
    along.actions()[-1].trigger()
    wait_for(lambda: not dock.busy)
    assert viewer.layers["Tissue, moved"].visible, "the moved layer is hidden like its source"
    assert {"Tissue, moved", "Boundary, moved", "R&D, moved"} <= {e.name for e in viewer.layers}


# Measurements


def test_measurements_are_shown_and_saved_in_the_unit_of_the_image(result, set_save_path, tmp_path):
    dock, _ = result(**MM)
    set_save_path(tmp_path / "table.csv")
    (gel,) = dock.more.measure()
    assert gel == measure(dock.solution, dock.study.tissue.labels, names={1: "gel"})[0]
    assert gel.largest_displacement == pytest.approx(3.0, abs=0.01), (
        "the largest displacement, in mm, is not the painted one"
    )
    screen = Screen(dock)
    screen.entry("More", "Measurements").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    heads = [table.horizontalHeaderItem(at).text() for at in range(table.columnCount())]
    cells = dict(zip(heads, [table.item(0, at).text() for at in range(len(heads))], strict=True))
    kind = "elastic" if dock.solution.provenance.model == "elastic" else "in-plane"
    assert cells["tissue"] == "gel"
    assert cells[f"{kind} strain, mean (%)"] == f"{gel.mean_strain:.4g}"
    notes = [each.text() for each in table.window().findChildren(QLabel) if "Note:" in each.text()]
    assert notes == ([] if kind == "elastic" else [f"Note: {strain_note(dock.solution)}."])
    assert cells["moved, most (mm)"] == f"{gel.largest_displacement:.4g}"
    (save,) = [
        each
        for each in table.window().children()
        if getattr(each, "text", str)() == "Save .csv ..."
    ]
    save.click()
    table.window().close()
    with open(tmp_path / "table.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["name"], row["unit"]) == ("gel", "mm")
    assert float(row["mean_displacement"]) == gel.mean_displacement


def test_the_table_of_measurements_shows_negligible_values_as_zero(result, monkeypatch):
    """Use micrometres: a pixel is 0.5 um wide."""
    still = Measurement(1, "gel", 100, 25.0, 3.4e-7, -2e-8, 3.4e-7, 1e-9, 2e-5, folds=3)
    dock, _ = result()
    monkeypatch.setattr(dock.more, "measure", lambda: [still])
    Screen(dock).entry("More", "Measurements").trigger()
    (table,) = dock.native.window().findChildren(QTableWidget, "measurements")
    cells = [table.item(0, at).text() for at in range(table.columnCount())]
    assert cells[:8] == ["gel", "1", "25", "0", "0", "0", "0", "0"]
    assert as_seen(6e-4, (0.5, 2.0)) == 6e-4


def test_a_result_from_a_file_is_measured_with_the_current_labels(result, tmp_path):
    dock, viewer = result()
    one = dock.more.measure()
    path = str(dock.solution.write(tmp_path / "kept.npz"))
    ((data, attributes, _),) = open_solution(path)(path)
    dock.result = viewer.add_vectors(data, **attributes)
    assert dock.more.measure() == one
    viewer.layers.remove("Tissue")
    assert [each.name for each in dock.more.measure()] == ["tissue"]


# Files


def test_the_menu_saves_the_field_in_each_direction(result, set_save_path, wait_for, tmp_path):
    ending = ".nii.gz"
    pytest.importorskip("SimpleITK")
    dock, _ = result(**MM)
    screen, path = Screen(dock), tmp_path / f"back{ending}"
    set_save_path(path)
    screen.entry("More", "Export warp (backward)").trigger()
    wait_for(lambda: not dock.busy)
    assert dock.status.startswith(f"Saved back{ending}: the backward field, which moves images. ")
    solution = dock.solution
    back = inverse_displacement(
        solution.displacement, spacing=solution.spacing, tissue=solution.tissue
    )
    np.testing.assert_allclose(read_field(path).backward, back.displacement, atol=1e-5)
    assert f"{back.residual:.2g} px" in dock.status
    path = tmp_path / f"forth{ending}"
    set_save_path(path)
    screen.entry("More", "Export warp (forward)").trigger()
    wait_for(lambda: not dock.busy)
    assert dock.status == f"Saved forth{ending}: the forward field, which moves points."
    read = read_field(path).displacement
    np.testing.assert_allclose(read, solution.displacement, atol=1e-5)
    set_save_path(tmp_path / "forth.h5")
    screen.entry("More", "Export warp (forward)").trigger()
    wait_for(lambda: not dock.busy)
    assert dock.status.startswith("forth.h5: this format does not store the direction")


def test_a_failure_to_save_is_reported_in_a_plain_sentence(
    result, set_save_path, wait_for, tmp_path
):
    pytest.importorskip("SimpleITK")
    dock, _ = result(**MM)
    (tmp_path / "folder.mha").mkdir()
    for name, why in (
        ("gone/a.mha", "its folder does not exist. Create the folder first, or choose another."),
        ("folder.mha", "it is a folder. Choose a file name."),
    ):
        set_save_path(tmp_path / name)
        Screen(dock).entry("More", "Export warp (backward)").trigger()
        wait_for(lambda: not dock.busy)
        assert dock.status.endswith(f"cannot save the file: {why}")
        assert "Errno" not in dock.status


def test_the_menu_saves_a_film(result, set_save_path, wait_for, tmp_path, monkeypatch):
    dock, _ = result()
    set_save_path(tmp_path / "gel")
    Screen(dock).entry("More", "Save looping GIF ...").trigger()
    wait_for(lambda: not dock.busy)
    assert dock.status == "Saved gel.gif."
    with Picture.open(tmp_path / "gel.gif") as film:
        assert (film.n_frames > 10, film.info["loop"]) == (True, 0)
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    set_save_path(tmp_path / "gel.mp4")
    Screen(dock).entry("More", "Save as film").trigger()
    wait_for(lambda: not dock.busy)
    assert 'pip install ".[film]"' in dock.status
    assert not (tmp_path / "gel.mp4").exists()


def test_a_film_shows_the_visible_overlay_with_its_legend(result, wait_for, tmp_path):
    dock, _ = result(more=(6,))
    dock.extent = "volume"
    dock.deform()
    wait_for(lambda: not dock.busy)

    def film_with(overlay):
        dock.overlay = overlay
        wait_for(lambda: not dock.busy)
        dock.more.save_film(tmp_path / "gel.gif")
        wait_for(lambda: not dock.busy)
        with Picture.open(tmp_path / "gel.gif") as film:
            film.seek(12)
            return np.asarray(film.convert("RGB")).astype(int)

    plain = film_with("nothing")
    assert dock.status == "Saved gel.gif."
    assert not np.ptp(plain, axis=-1).any(), "the image is not grey"
    strained = film_with("equivalent")
    assert " with the overlay 'MR equivalent" in dock.status
    rows, cols = (size * 12 for size in plain.shape[:2])  # enlarged for the legend
    above, beside = strained.shape[0] - rows, strained.shape[1] - cols
    assert min(above, beside) > 10
    assert np.ptp(strained[above:, :cols], axis=-1).any(), "the strain is not shown"
    assert np.ptp(strained[above:, cols:], axis=-1).any(), "the colour bar is not shown"
    assert strained[:above].max() > 200, "the title is not shown"


def test_a_film_shows_an_overlay_without_a_scale(result, wait_for, tmp_path):
    dock, _ = result()
    dock.overlay = "labels"
    wait_for(lambda: not dock.busy)
    dock.more.save_film(tmp_path / "gel.gif")
    wait_for(lambda: not dock.busy)
    with Picture.open(tmp_path / "gel.gif") as film:
        assert np.ptp(np.asarray(film.convert("RGB")).astype(int), axis=-1).max() > 50


def test_a_film_without_the_visible_overlay_says_so(result, wait_for, tmp_path):
    dock, _ = result()
    dock.overlay = "observed"
    wait_for(lambda: not dock.busy)
    dock.more.save_film(tmp_path / "gel.gif")
    wait_for(lambda: not dock.busy)
    assert dock.status == "Saved gel.gif without 'MR given motion, elastic'."


def test_the_film_of_a_volume_shows_the_visible_slice(result, wait_for, tmp_path):
    dock, viewer = result(more=(6,))
    dock.extent = "volume"
    viewer.dims.order = (1, 0, 2)
    dock.deform()
    wait_for(lambda: not dock.busy)
    dock.more.save_film(tmp_path / "slice.gif")
    wait_for(lambda: not dock.busy)
    with Picture.open(tmp_path / "slice.gif") as film:
        assert film.size == (24, 6)
    viewer.dims.ndisplay = 3
    with pytest.raises(HmrfError, match="press napari's 2D/3D button first"):
        dock.more.save_film(tmp_path / "slice.gif")


def test_an_unsupported_format_or_a_missing_result_is_reported(
    result, set_save_path, wait_for, tmp_path
):
    dock, viewer = result()
    set_save_path(tmp_path / "field.txt")
    Screen(dock).entry("More", "Export warp (backward)").trigger()
    wait_for(lambda: not dock.busy)
    assert dock.status.startswith("field.txt: fields cannot be written in this format")
    viewer.layers.clear()
    with pytest.raises(HmrfError, match="There is no result yet"):
        dock.more.measure()

"""Tests of the contributions in the napari manifest."""

import json
from pathlib import Path

import numpy as np
import pytest
import skimage.data
from napari.components import ViewerModel
from napari.layers import Image, Labels, Layer
from npe2 import PluginManager, PluginManifest

import napari_hmrf
from napari_hmrf import ElasticPrior, Multigrid, Problem, SeilerPrior, solve
from napari_hmrf.contributions import (
    open_landmarks,
    open_scan,
    open_solution,
    open_study,
    sample_bar,
    sample_chest,
    sample_expansion,
    sample_growth,
    sample_head,
    sample_mass_effect,
    sample_mri,
    sample_pair,
    write_solution,
)
from napari_hmrf.errors import FileFormatError, HmrfError
from napari_hmrf.field.frame import PATIENT_AXES, Frame
from napari_hmrf.fields import read_field
from napari_hmrf.geometry import Geometry
from napari_hmrf.io.case import read_case
from napari_hmrf.io.case_options import Case
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.landmarks import write_points
from napari_hmrf.layers.metadata import METADATA, rows_of
from napari_hmrf.layers.read import Request
from napari_hmrf.layers.result_layers import result_layers
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.samples.chest import chest_phantom
from napari_hmrf.samples.head import GROWTH, SAMPLE_SIZE, head_phantom
from napari_hmrf.samples.phantoms import sample
from napari_hmrf.solver.optimizers import ICM
from tests.support.study_reader import read_layers


@pytest.fixture(scope="module")
def solution():
    y, c = np.zeros((8, 9, 2)), np.zeros((8, 9, 2))
    c[:, 0] = c[:, -1] = 1
    y[:, -1] = (0, 2)
    problem = Problem(observed=y, confidence=c, stiffness=np.ones((8, 9)), spacing=(1.0, 0.5))
    return solve(problem, SeilerPrior(), optimizer=ICM(20), backend="cpu")


@pytest.fixture
def arrows(solution):
    """Return the layer of arrows on slice 3 of a rotated stack."""
    stack = Image(
        np.zeros((5, 8, 9)),
        scale=(2.0, 1.0, 0.5),
        translate=(1, 2, 3),
        units=("mm",) * 3,
        axis_labels=("z", "y", "x"),
        rotate=[[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        name="T1",
    )
    frame = frame_of(stack)
    frame = Frame(**{**frame.__dict__, "index": (3, 0, 0)})
    return Layer.create(*result_layers(solution, frame).layers["arrows"])


def test_the_manifest_is_valid_and_every_command_exists():
    manifest = PluginManifest.from_distribution("napari-hmrf")
    for command in manifest.contributions.commands:
        assert callable(
            command.get_callable()
            if hasattr(command, "get_callable")
            else _imported(command.python_name)
        ), command.id
        assert not command.title.startswith("napari"), command.title


def _imported(python_name):
    import importlib

    module, _, name = str(python_name).partition(":")
    return getattr(importlib.import_module(module), name)


@pytest.mark.parametrize(
    ("opened", "drawn"),
    [
        (sample_expansion, sample("expansion")),
        (sample_growth, sample("mass-effect").growing()),
        (sample_mass_effect, sample("mass-effect")),
        (sample_bar, sample("bar")),
        (sample_chest, chest_phantom()),
    ],
    ids=["expansion", "growth", "mass-effect", "bar", "chest"],
)
def test_a_sample_gives_the_problem_of_its_phantom(opened, drawn):
    image, tissue, boundary = (Layer.create(*data) for data in opened())
    assert isinstance(image, Image)
    assert isinstance(tissue, Labels)
    request = Request(tissue=tissue, boundary=boundary, image=image)
    problem = read_layers(request, ElasticPrior(), Multigrid()).problem
    expected = drawn.problem
    for field in ("observed", "confidence", "stiffness"):
        np.testing.assert_array_equal(getattr(problem, field), getattr(expected, field))
    assert (problem.loads is None) == (expected.loads is None)
    if expected.loads is not None:
        assert problem.loads.same_as(expected.loads)
    assert (problem.sliding is None) == (expected.sliding is None)
    if expected.sliding is not None:
        np.testing.assert_array_equal(problem.sliding.labels, expected.sliding.labels)


def test_the_pair_has_two_images_and_tissue_that_does_not_grow_yet():
    before, tissue, after = (Layer.create(*data) for data in sample_pair())
    assert (before.name, after.name) == ("Before", "After")
    assert before.data.shape == after.data.shape == tissue.data.shape
    assert not any(row.grows for row in rows_of(tissue, "tissue"))
    assert not after.visible


def test_the_real_mri_has_thick_slices_and_needs_a_download_once(monkeypatch):
    slices = np.zeros((10, 16, 16), np.uint16)
    monkeypatch.setattr(skimage.data, "brain", lambda: slices)
    (data, settings, kind), *others = sample_mri()
    assert not others
    layer = Layer.create(data, settings, kind)
    assert tuple(layer.scale) == (2, 1, 1)
    assert np.array_equal(layer.data, slices)

    def offline():
        raise ConnectionError("no route to host")

    monkeypatch.setattr(skimage.data, "brain", offline)
    with pytest.raises(HmrfError, match="needs no download"):
        sample_mri()


@pytest.fixture(scope="module")
def head_layers():
    return [Layer.create(*data) for data in sample_head()]


def test_the_sample_volume_gives_the_problem_of_its_phantom(head_layers):
    image, tissue, boundary = head_layers
    view = View((1, 2), (0.0, 0.0, 0.0), volume=True)
    request = Request(tissue=tissue, boundary=boundary, image=image, view=view)
    problem = read_layers(request, ElasticPrior(), Multigrid()).problem
    expected = head_phantom(SAMPLE_SIZE, growth=GROWTH).problem
    assert problem.spacing == pytest.approx((2.0,) * 3)
    for field in ("observed", "confidence", "stiffness"):
        np.testing.assert_array_equal(getattr(problem, field), getattr(expected, field))


def test_the_sample_volume_has_patient_axes_and_is_deformed_as_a_whole(head_layers):
    for layer in head_layers:
        assert layer.axis_labels == tuple(PATIENT_AXES)
        assert [str(unit) for unit in layer.units] == ["millimeter"] * 3
        np.testing.assert_allclose(layer.extent.world.mean(axis=0), 0, atol=1e-6)
    image, tissue, _ = head_layers
    assert image.metadata[METADATA]["extent"] == "volume"
    tumour = np.argwhere(tissue.data == 3).mean(axis=0)
    superior, posterior, left = tissue.data_to_world(tumour)
    assert (superior > 5, posterior > 20, left > 20) == (True,) * 3


def test_samples_are_writeable_and_their_tables_are_valid_json():
    for data, attributes, _ in sample_bar():
        assert data.flags.writeable
        json.dumps(attributes["metadata"])


def test_saved_arrows_are_read_back_with_solution_and_place(arrows, solution, tmp_path):
    path = tmp_path / "kept.npz"
    data, attributes, _ = arrows.as_layer_data_tuple()
    assert write_solution(str(path), data, attributes) == [str(path)]
    reader = open_solution(str(path))
    ((found, kwargs, kind),) = reader(str(path))
    again = Layer.create(found, kwargs, kind)
    assert again.name == "kept"
    np.testing.assert_array_equal(again.data, arrows.data)
    assert again.units == arrows.units
    assert again.axis_labels == arrows.axis_labels
    np.testing.assert_allclose(
        again.data_to_world(again.data[5, 0]), arrows.data_to_world(arrows.data[5, 0])
    )
    kept = again.metadata[METADATA]["solution"]
    np.testing.assert_array_equal(kept.displacement, solution.displacement)
    np.testing.assert_array_equal(kept.energy, solution.energy)


def test_a_solution_without_a_layer_lies_at_the_origin(solution, tmp_path):
    path = str(solution.write(tmp_path / "script.npz"))
    ((data, kwargs, kind),) = open_solution(path)(path)
    layer = Layer.create(data, kwargs, kind)
    np.testing.assert_array_equal(layer.scale, (1.0, 0.5))


def test_foreign_arrows_are_not_saved_as_a_solution(tmp_path):
    with pytest.raises(ValueError, match="'flow' is not a result"):
        write_solution(
            str(tmp_path / "x.npz"), np.zeros((1, 2, 2)), {"name": "flow", "metadata": {}}
        )
    assert not list(tmp_path.iterdir())


def test_foreign_archives_are_left_to_other_readers(tmp_path, solution):
    foreign = tmp_path / "foreign.npz"
    np.savez(foreign, a=np.zeros(3))
    ours = str(solution.write(tmp_path / "ours.npz"))
    assert open_solution(str(foreign)) is None
    assert open_solution([ours, str(foreign)]) is None
    assert open_solution(str(tmp_path / "missing.npz")) is None
    assert len(open_solution([ours, ours])([ours, ours])) == 2


def test_a_file_with_an_invalid_frame_is_refused_by_name(solution, tmp_path):
    from dataclasses import replace

    path = str(replace(solution, frame={"plane": "up"}).write(tmp_path / "odd.npz"))
    with pytest.raises(FileFormatError, match=r"odd\.npz"):
        open_solution(path)(path)


@pytest.fixture
def viewer():
    """Return a viewer without a window that finds the readers and writers of the package."""
    PluginManager.instance().discover()  # A window discovers plugins at its start.
    return ViewerModel()


def test_napari_saves_and_opens_the_result(viewer, arrows, tmp_path):
    viewer.add_layer(arrows)
    path = str(tmp_path / "by napari.npz")
    assert viewer.layers.save(path, plugin="napari-hmrf") == [path]
    (layer,) = viewer.open(path, plugin="napari-hmrf")
    np.testing.assert_array_equal(layer.data, arrows.data)


def test_napari_reports_that_a_result_or_a_study_is_damaged(viewer, solution, tmp_path):
    for name in ("a.npz", "a.study"):
        path = solution.write(tmp_path / name)
        path.write_bytes(path.read_bytes()[:400])
    with pytest.raises(FileFormatError, match=r"a\.npz: not a valid .* it is damaged"):
        viewer.open(str(tmp_path / "a.npz"), plugin="napari-hmrf")
    assert open_study(str(tmp_path / "a.study"))  # reading reports the error
    with pytest.raises(FileFormatError, match=r"a\.study: not a valid .* it is damaged"):
        read_case(Case(tmp_path / "a.study"))


def test_the_field_of_a_result_is_exported_for_other_tools(arrows, solution, tmp_path):
    data, attributes, _ = arrows.as_layer_data_tuple()
    (path,) = write_solution(str(tmp_path / "field.mha"), data, attributes)
    assert 0 < np.abs(read_field(path).displacement).max() < 2.5


@pytest.mark.usefixtures("without_child")
def test_saving_a_field_in_napari_reports_the_error_of_its_inverse(viewer, arrows, tmp_path):
    from napari.utils.notifications import notification_manager

    viewer.add_layer(arrows)
    path = str(tmp_path / "field.h5")
    assert viewer.layers.save(path, plugin="napari-hmrf") == [path]
    said = notification_manager.records[-1].message
    assert said.startswith("Saved field.h5: the backward field, which moves images. ")
    viewer.layers.clear()
    (layer,) = viewer.open(path, plugin="napari-hmrf")
    assert np.abs(layer.data[:, 1]).max() > 0.5, "the saved field has no motion when it is opened"


@pytest.mark.parametrize(
    ("name", "is_offered"), [("DICOMDIR", True), ("dicomdir", True), ("notes", False)]
)
def test_a_table_of_contents_of_dicom_is_given_to_the_reader_of_scans(tmp_path, name, is_offered):
    plugins = PluginManager()
    plugins.register(PluginManifest.from_file(Path(napari_hmrf.__file__).parent / "napari.yaml"))
    found = plugins.iter_compatible_readers([str(tmp_path / name)])
    assert ("napari-hmrf.open_scan" in {each.command for each in found}) == is_offered


def test_a_scan_is_opened_at_its_place_in_the_patient(tmp_path):
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    place = Geometry.of_itk((4, 5, 6), (2.0, 0.5, 0.7), (-10.0, 20.0, 5.0), turn)
    pixels = np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6)
    path = str(write_image(tmp_path / "head.scan.nii.gz", ImageFile(pixels, place)))
    ((data, attributes, kind),) = open_scan(path)(path)
    layer = Layer.create(data, attributes, kind)
    assert layer.name == "head.scan"
    assert [str(unit) for unit in layer.units] == ["millimeter"] * 3
    np.testing.assert_array_equal(layer.data, pixels)
    for z, y, x in ((0, 0, 0), (3, 4, 5), (1, 4, 0)):
        lps = place.origin + turn @ (np.array([x, y, z]) * [0.7, 0.5, 2.0])
        np.testing.assert_allclose(layer.data_to_world((z, y, x)), lps[::-1], atol=1e-5)
    one = str(write_image(tmp_path / "one.mha", ImageFile(pixels[0], place)))
    ((data, attributes, kind),) = open_scan(one)(one)
    assert Layer.create(data, attributes, kind).data.shape == (1, 5, 6), (
        "a slice of a volume lost an axis"
    )


def test_a_padded_ct_is_displayed_with_the_contrast_of_air_and_tissue(tmp_path):
    pixels = np.full((1, 40, 40), -1000, np.int16)
    pixels[:, 10:30, 10:30], pixels[:, :4], pixels[:, 20, 20] = 40, -3024, 600
    path = str(write_image(tmp_path / "ct.mha", ImageFile(pixels)))
    ((data, attributes, kind),) = open_scan(path)(path)
    assert Layer.create(data, attributes, kind).contrast_limits == [-1000, 600]


def test_a_folder_without_a_scan_is_left_to_other_readers(tmp_path):
    assert open_scan(str(tmp_path)) is None
    (tmp_path / "notes.txt").write_text("of the scan")
    assert open_scan(str(tmp_path)) is None


def test_landmarks_of_slicer_lie_at_their_place_in_the_patient(tmp_path):
    path = str(write_points(tmp_path / "nose.mrk.json", [[5.0, 20.0, -10.0]]))
    ((data, attributes, kind),) = open_landmarks(path)(path)
    layer = Layer.create(data, attributes, kind)
    np.testing.assert_array_equal(layer.data_to_world(layer.data[0]), (5.0, 20.0, -10.0))
    assert [str(unit) for unit in layer.units] == ["millimeter"] * 3


def test_pairs_of_bigwarp_become_two_layers_of_points_in_the_same_order(tmp_path):
    path = str(write_points(tmp_path / "pairs.csv", [[1.0, 2], [3, 4]], [[1.5, 2], [3, 5]]))
    where, should = (Layer.create(*made) for made in open_landmarks(path)(path))
    assert (where.name, should.name) == ("pairs", "pairs, should be")
    np.testing.assert_array_equal(should.data - where.data, [[0.5, 0], [0, 1]])
    assert "sd" not in should.features
    path = str(write_points(path, [[1.0, 2], [3, 4]], [[1.5, 2], [3, 5]], sd=[0.5, 2]))
    _, should = (Layer.create(*made) for made in open_landmarks(path)(path))
    assert should.features["sd"].tolist() == [0.5, 2]
    others = tmp_path / "others.csv"
    others.write_text("index,axis-0,axis-1\n0,1,2\n")
    assert open_landmarks(str(others)) is None, "napari reads this file itself"


def test_pairs_of_bigwarp_have_the_unit_of_the_open_image(viewer, tmp_path, monkeypatch):
    monkeypatch.setattr("napari.current_viewer", lambda: viewer)
    viewer.add_image(np.zeros((8, 9)), scale=(2, 2), units=("mm", "mm"))
    path = write_points(tmp_path / "pairs.csv", [[1.0, 2], [3, 4]], [[1.5, 2], [3, 5]])
    where, should = viewer.open(path, plugin="napari-hmrf")
    assert {str(unit) for each in (where, should) for unit in each.units} == {"millimeter"}


@pytest.mark.parametrize(
    ("name", "is_only"),
    [
        ("a.study", True),
        ("a.mrk.json", True),
        ("a.fcsv", True),
        ("a.nii.gz", False),
        ("A.NII", False),
        ("a.npz", False),
        ("a.dcm", False),
    ],
)
def test_napari_offers_this_reader_and_asks_only_if_it_has_its_own(name, is_only):
    manager = PluginManager.instance()
    manager.discover()
    plugins = {reader.plugin_name for reader in manager.iter_compatible_readers([name])}
    assert "napari-hmrf" in plugins
    assert (plugins == {"napari-hmrf"}) == is_only


def test_the_dock_is_listed_in_the_menus():
    manifest = PluginManifest.from_distribution("napari-hmrf")
    menus = manifest.contributions.menus
    assert "napari-hmrf.soft_tissue" in [item.command for item in menus["napari/layers/transform"]]
    assert [widget.display_name for widget in manifest.contributions.widgets] == ["Soft tissue"]


def test_a_study_saved_with_another_suffix_is_opened_as_a_study(tmp_path):
    from napari_hmrf import Grid, Motion, Study, write_study

    path = write_study(tmp_path / "mine.npz", Study(Grid((8, 8), (1.0, 1.0)), motion=Motion(True)))
    assert open_solution(str(path)) is open_study(str(path)) is not None

"""A field that leads back is kept as it was stored, and inverted only where it is asked for."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Layer

from napari_hmrf.cli import main
from napari_hmrf.contributions import open_scan
from napari_hmrf.field import inverse_field
from napari_hmrf.field.displacement_field import DisplacementField
from napari_hmrf.field.inverse_field import inverse_displacement, origins_at
from napari_hmrf.field.moved_points import interpolate_linearly, interpolate_with_slopes
from napari_hmrf.fields import read_field
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.layers.field_layer import field_of
from napari_hmrf.solver.problem import grid_in_words
from tests.support.exchanged_fields import FieldCase

pytest.importorskip("SimpleITK")


@pytest.fixture
def inverted(monkeypatch):
    """How many points were inverted, each time that some were."""
    counts, by_newton = [], inverse_field._by_newton

    def counted(pixels, targets, near=None):
        counts.append(len(targets))
        return by_newton(pixels, targets, near)

    monkeypatch.setattr(inverse_field, "_by_newton", counted)
    return counts


@pytest.fixture
def volume(tmp_path):
    """A file of a volume that leads back, and what it was made of."""
    case = FieldCase("3-D")
    case.direction = np.eye(3)  # napari slices no layer at an angle
    case.write(tmp_path / "warp.mha")
    return case, tmp_path / "warp.mha"


def test_to_open_a_volume_inverts_no_more_than_the_arrows_that_are_drawn(volume, inverted):
    case, path = volume
    inverted.clear()
    ((data, attributes, kind),) = open_scan(str(path))(str(path))
    assert sum(inverted) == len(data) < np.prod(case.shape) / 4
    starts = data[:, 0].astype(int)
    pixels = read_field(path).displacement / case.spacing
    np.testing.assert_allclose(data[:, 1], pixels[tuple(starts.T)], atol=1e-4)
    # On a slice, the sites of that slice.
    field = field_of(Layer.create(data, attributes, kind))
    inverted.clear()
    there = replace(field.frame, index=(9, 0, 0))
    seen = field.on(there, case.shape[1:])
    assert sum(inverted) == np.prod(case.shape[1:])
    assert seen.known.all()
    np.testing.assert_allclose(
        seen.displacement / there.spacing, pixels[9][..., list(there.plane)], atol=1e-4
    )


def test_between_its_sites_a_field_that_leads_back_is_inverted_exactly(volume):
    case, path = volume
    points = np.random.default_rng(2).uniform(0, np.array(case.shape) - 1, (300, 3))
    back = read_field(path).field
    assert back.back
    steps = back.at(points) / case.spacing
    returned = interpolate_linearly(back.vectors, points + steps) / case.spacing
    assert np.abs(steps + returned).max() < 1e-6
    forth = DisplacementField(case.displacement, case.spacing)
    inside = ((points > 4) & (points < np.array(case.shape) - 5)).all(axis=1)
    assert np.abs(steps - forth.at(points) / case.spacing)[inside].max() < 0.05


def test_images_of_a_volume_are_moved_by_a_field_that_leads_back_without_an_inverse(
    volume, inverted, tmp_path
):
    case, path = volume
    write_image(tmp_path / "scan.tif", ImageFile(np.ones(case.shape, np.uint8)))
    inverted.clear()
    assert main(["apply", str(path), str(tmp_path / "scan.tif"), "-o", str(tmp_path / "out")]) == 0
    assert inverted == []


def test_a_volume_is_no_field_of_a_slice_which_is_said_before_it_is_inverted(
    volume, inverted, tmp_path, capsys
):
    case, path = volume
    labels = tmp_path / "labels.tif"
    write_image(labels, ImageFile(np.ones(case.shape, np.uint8)))
    inverted.clear()
    options = ["--labels", str(labels), "--boundary", str(path), "--slice", "3"]
    assert main(["solve", str(labels), *options, "-o", str(tmp_path / "out")]) != 0
    said = f"warp.mha: is {grid_in_words(case.shape)} in millimeter, but the image"
    assert said in capsys.readouterr().err
    assert inverted == []


def test_the_inverse_of_a_volume_is_that_of_its_points_some_at_once(inverted, monkeypatch):
    case = FieldCase("3-D")
    monkeypatch.setattr(inverse_field, "_AT_ONCE", 5000)
    back, residual = inverse_displacement(case.displacement, spacing=case.spacing)
    assert sum(inverted) == np.prod(case.shape)
    assert max(inverted) <= 5000
    pixels, sites = case.displacement / case.spacing, case.sites.reshape(-1, 3)
    expected = (origins_at(pixels, sites) - sites).reshape(back.shape)
    np.testing.assert_allclose(back / case.spacing, expected, atol=1e-12)
    assert residual < 1e-6


def test_slopes_are_those_between_the_corners_of_a_cell_and_none_beyond_the_edge():
    dice = np.random.default_rng(0)
    field, points = dice.normal(size=(5, 1, 7, 3)), dice.uniform(-2, 9, (500, 3))
    values, slopes = interpolate_with_slopes(field, points)
    np.testing.assert_allclose(values, interpolate_linearly(field, points), atol=1e-12)
    for axis, along in enumerate(1e-6 * np.eye(3)):
        ends = interpolate_linearly(field, points + along) - interpolate_linearly(
            field, points - along
        )
        np.testing.assert_allclose(slopes[..., axis], ends / 2e-6, atol=1e-6)
    np.testing.assert_array_equal(slopes[..., 1], 0)
    np.testing.assert_array_equal(slopes[points[:, 0] > 4][..., 0], 0)

"""Backward displacement fields: stored as read, and inverted only where needed."""

from dataclasses import replace

import numpy as np
import pytest
from napari.layers import Layer

from napari_hmrf.cli import main
from napari_hmrf.contributions import open_scan
from napari_hmrf.field import inverse_field
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.inverse_field import inverse_displacement, origins_at
from napari_hmrf.field.moved_points import interpolate_linearly, interpolate_with_slopes
from napari_hmrf.fields import read_field
from napari_hmrf.io.images import ImageFile, write_image
from napari_hmrf.layers.field_layer import field_of
from napari_hmrf.real_arrays import grid_in_words
from tests.support.exchanged_fields import FieldCase

pytest.importorskip("SimpleITK")


@pytest.fixture
def inversion_counts(monkeypatch):
    """Return a list of the number of points of each inversion."""
    counts, by_newton = [], inverse_field._by_newton

    def counted(pixels, targets, near=None):
        counts.append(len(targets))
        return by_newton(pixels, targets, near)

    monkeypatch.setattr(inverse_field, "_by_newton", counted)
    return counts


@pytest.fixture
def volume(tmp_path):
    """Return a backward volume field and the path of its file."""
    case = FieldCase("3-D")
    case.direction = np.eye(3)  # napari does not slice rotated layers
    case.write(tmp_path / "warp.mha")
    return case, tmp_path / "warp.mha"


def test_opening_a_volume_inverts_only_the_sites_of_the_drawn_arrows(volume, inversion_counts):
    case, path = volume
    inversion_counts.clear()
    ((data, attributes, kind),) = open_scan(str(path))(str(path))
    assert sum(inversion_counts) == len(data) < np.prod(case.shape) / 4
    starts = data[:, 0].astype(int)
    pixels = read_field(path).displacement / case.spacing
    np.testing.assert_allclose(data[:, 1], pixels[tuple(starts.T)], atol=1e-4)
    # A slice inverts only its own sites.
    field = field_of(Layer.create(data, attributes, kind))
    inversion_counts.clear()
    there = replace(field.frame, index=(9, 0, 0))
    seen = field.on(there, case.shape[1:])
    assert sum(inversion_counts) == np.prod(case.shape[1:])
    assert seen.known.all()
    np.testing.assert_allclose(
        seen.displacement / there.spacing, pixels[9][..., list(there.plane)], atol=1e-4
    )


def test_a_backward_field_is_inverted_exactly_between_its_sites(volume):
    case, path = volume
    points = np.random.default_rng(2).uniform(0, np.array(case.shape) - 1, (300, 3))
    back = read_field(path)
    assert back.back
    steps = back.at(points) / case.spacing
    returned = interpolate_linearly(back.vectors, points + steps) / case.spacing
    assert np.abs(steps + returned).max() < 1e-6
    forth = Field(case.displacement, back.geometry)
    inside = ((points > 4) & (points < np.array(case.shape) - 5)).all(axis=1)
    assert np.abs(steps - forth.at(points) / case.spacing)[inside].max() < 0.05


def test_a_backward_field_warps_the_images_of_a_volume_without_an_inverse(
    volume, inversion_counts, tmp_path
):
    case, path = volume
    write_image(tmp_path / "scan.tif", ImageFile(np.ones(case.shape, np.uint8)))
    inversion_counts.clear()
    assert main(["apply", str(path), str(tmp_path / "scan.tif"), "-o", str(tmp_path / "out")]) == 0
    assert inversion_counts == []


def test_a_volume_field_for_a_slice_is_rejected_before_it_is_inverted(
    volume, inversion_counts, tmp_path, capsys
):
    case, path = volume
    labels = tmp_path / "labels.tif"
    write_image(labels, ImageFile(np.ones(case.shape, np.uint8)))
    inversion_counts.clear()
    options = ["--labels", str(labels), "--boundary", str(path), "--slice", "3"]
    assert main(["solve", str(labels), *options, "-o", str(tmp_path / "out")]) != 0
    said = f"warp.mha: is {grid_in_words(case.shape)} in millimeter, but the image"
    assert said in capsys.readouterr().err
    assert inversion_counts == []


def test_a_volume_is_inverted_in_batches_of_points(inversion_counts, monkeypatch):
    case = FieldCase("3-D")
    monkeypatch.setattr(inverse_field, "_AT_ONCE", 5000)
    back, residual = inverse_displacement(case.displacement, spacing=case.spacing)
    assert sum(inversion_counts) == np.prod(case.shape)
    assert max(inversion_counts) <= 5000
    pixels, sites = case.displacement / case.spacing, case.sites.reshape(-1, 3)
    expected = (origins_at(pixels, sites) - sites).reshape(back.shape)
    np.testing.assert_allclose(back / case.spacing, expected, atol=1e-12)
    assert residual < 1e-6


def test_slopes_are_those_of_the_cell_and_zero_beyond_the_edge():
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

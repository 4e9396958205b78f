"""Tests that the colours of a result differ, also for colour-blind users in a simulation."""

import numpy as np
import pytest
from napari.utils.colormaps.standardize_color import transform_color

from napari_hmrf.field.colormaps import OPACITY
from napari_hmrf.layers.label_colours import DRAWN, mark_look, quantity_colours
from napari_hmrf.layers.paint_layer import COLOURS

#: Matrices of Machado et al. (2009) for linear RGB, at full severity.
SIMULATIONS = {
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
}
#: All viewers of the colour of folds: as above, with tritanopia and without colour blindness.
ALL_VIEWERS = {
    **SIMULATIONS,
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
    "normal": np.eye(3),
}
#: Difference in CIELAB that is obvious side by side; the smallest visible difference is 2.3.
OBVIOUS = 12.0
RGB_TO_XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]


GREYS = np.repeat(np.linspace(0, 1, 101)[:, None], 3, axis=1)


def distance_seen_with(simulation):
    """Return a function of the distance of two colours in CIELAB, as seen in a simulation."""

    def seen(colour):
        rgb = np.asarray(colour, float)[..., :3]
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        linear = np.clip(linear @ np.transpose(simulation), 0, 1)
        xyz = linear @ np.transpose(RGB_TO_XYZ) / (0.9505, 1, 1.089)
        x, y, z = np.moveaxis(np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 4 / 29), -1, 0)
        return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)

    return lambda one, other: np.linalg.norm(seen(one) - seen(other), axis=-1)


@pytest.fixture(params=SIMULATIONS)
def distance(request):
    """Return a function of the distance of two colours, as a colour-blind user sees them."""
    return distance_seen_with(SIMULATIONS[request.param])


@pytest.fixture(params=ALL_VIEWERS)
def distance_for_all(request):
    """Return a function of the distance of two colours, as any user sees them."""
    return distance_seen_with(ALL_VIEWERS[request.param])


@pytest.mark.parametrize(
    ("layer_opacity", "least"), [(1.0, 2.0), (OPACITY, 1.5)], ids=["legend", "over the image"]
)
@pytest.mark.parametrize("signed", [True, False])
def test_folds_differ_from_all_colours_of_strain(distance_for_all, signed, layer_opacity, least):
    scale = quantity_colours(signed, folds=True)
    colours = np.asarray(scale.map(np.linspace(0.001, 1, 101)))[:, None]
    opacity = layer_opacity * colours[..., 3:]
    seen = opacity * colours[..., :3] + (1 - opacity) * GREYS
    folds = layer_opacity * scale.low_color[:3] + (1 - layer_opacity) * GREYS
    assert distance_for_all(folds, seen).min() > least * OBVIOUS


@pytest.mark.parametrize("others", [GREYS, [DRAWN]], ids=["greys", "drawn arrows"])
def test_marks_of_folds_differ_from_tissue_and_drawn_arrows(distance_for_all, others):
    mark = mark_look()["colormap"].color_dict[1]
    assert distance_for_all(mark, others).min() > 2 * OBVIOUS


def test_compression_differs_from_stretch_of_the_same_size(distance):
    size = np.linspace(0.1, 0.5, 9)
    scale = quantity_colours(signed=True)
    assert distance(scale.map(0.5 - size), scale.map(0.5 + size)).min() > 2 * OBVIOUS


@pytest.mark.parametrize("signed", [True, False])
def test_successive_fifths_of_a_scale_differ(distance, signed):
    colours = quantity_colours(signed).map(np.linspace(0, 1, 6))
    assert distance(colours[:-1], colours[1:]).min() > OBVIOUS


def test_painted_actions_differ_pairwise(distance):
    colours = np.array(list(COLOURS.values()))
    one, other = np.triu_indices(len(colours), 1)
    assert distance(colours[one], colours[other]).min() > OBVIOUS


def test_red_marks_would_not_differ_from_stretch(distance):
    stretched = quantity_colours(signed=True).map(np.linspace(0.5, 1, 51))
    assert distance(transform_color("red"), stretched).min() < OBVIOUS / 2

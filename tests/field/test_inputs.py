"""Each function on fields names the input that it refuses."""

import numpy as np
import pytest

from napari_hmrf import ProblemError, warp
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.strain import (
    deformation_gradient,
    equivalent_strain,
    fold_mask,
    principal_strains,
    small_strain,
    strain_through_slice,
)
from napari_hmrf.fields import (
    arrows,
    count_folds,
    deformation_grid,
    jacobian_determinant,
    magnitude,
)

STILL = np.zeros((6, 6, 2))
NAN = np.full((6, 6, 2), np.nan)
IMAGE = np.zeros((6, 6))
BYTES = np.zeros((6, 6), np.uint8)
RAGGED = [[1], [1, 2]]
VOLUME, STILL_VOLUME = np.zeros((6, 7, 8)), np.zeros((6, 7, 8, 3))


def live(image, displacement=STILL, tissue=None, spacing=(1, 1)):
    return Warper(image, spacing=spacing)(displacement, tissue)


def slice_of(number, displacement=STILL_VOLUME, tissue=None, volume=VOLUME):
    return Warper(volume, spacing=(1,) * volume.ndim).slice(number, displacement, tissue)


#: Calls with an invalid input, by the name of this input.
INVALID = {
    "displacement": [
        lambda: jacobian_determinant(IMAGE, spacing=1),
        lambda: small_strain(IMAGE, spacing=1),
        lambda: count_folds(RAGGED, spacing=1),
        lambda: magnitude(0),
        lambda: magnitude("far"),
        lambda: magnitude(1j * STILL),
        lambda: warp(IMAGE, IMAGE, spacing=1),
        lambda: warp(IMAGE, None, spacing=1),
        lambda: warp(IMAGE, np.zeros((6, 6, 3)), spacing=1),
        lambda: warp(IMAGE, NAN, spacing=1),
        lambda: warp(VOLUME, np.zeros((6, 7, 8, 2)), spacing=1),
        lambda: live(IMAGE, np.zeros((6, 7, 2))),
        lambda: live(IMAGE, NAN),
        lambda: slice_of(3, STILL_VOLUME[1:]),
        lambda: slice_of(3, np.nan * STILL_VOLUME),
    ],
    "image": [
        lambda: warp(np.zeros((5, 6)), STILL, spacing=1),
        lambda: warp(np.zeros(6), STILL, spacing=1),
        lambda: warp(1j * IMAGE, STILL, spacing=1),
        lambda: warp(RAGGED, STILL, spacing=1),
        lambda: warp(VOLUME[0], STILL_VOLUME, spacing=1),
        lambda: live(np.zeros(5)),
        lambda: live([Picture(np.eye(6)), Picture(np.eye(5))]),
    ],
    "spacing": [
        lambda: warp(IMAGE, STILL, spacing=(1.0,)),
        lambda: warp(IMAGE, STILL, spacing=(1.0, 0.0)),
        lambda: warp(IMAGE, STILL, spacing="fine"),
        lambda: live(IMAGE, spacing=(1, 0)),
        lambda: count_folds(STILL, spacing=(1, -1)),
        lambda: deformation_gradient(STILL, spacing=(1, 0)),
        lambda: jacobian_determinant(STILL_VOLUME, spacing=(1.0, 1.0)),
    ],
    "tissue": [
        lambda: warp(IMAGE, STILL, spacing=1, tissue=np.ones((3, 3))),
        lambda: live(IMAGE, tissue=np.ones(6)),
        lambda: slice_of(3, tissue=np.ones((7, 8))),
        lambda: arrows(STILL, spacing=1, tissue=np.ones((3, 4))),
        lambda: arrows(STILL, spacing=1, tissue=RAGGED),
        lambda: fold_mask(STILL, spacing=1, tissue=np.ones((3, 4))),
    ],
    "order": [
        *(lambda order=order: warp(IMAGE, STILL, spacing=1, order=order) for order in (6, -1, 1.5)),
        lambda: live([Picture(IMAGE, order=7)]),
    ],
    "fill": [
        lambda: warp(BYTES, STILL, spacing=1, fill=300),
        lambda: warp(BYTES, STILL, spacing=1, fill=np.nan),
        lambda: warp(IMAGE, STILL, spacing=1, fill="black"),
        lambda: live([Picture(BYTES, order=1, fill=300)]),
    ],
    "number": [lambda: slice_of(20), lambda: slice_of(0, STILL, volume=IMAGE)],
    "about": [
        lambda: arrows(STILL, spacing=1, about=0),
        lambda: arrows(STILL, spacing=1, about="many"),
    ],
    "every": [
        lambda every=every: deformation_grid(STILL, spacing=1, every=every)
        for every in (0, 2.5, np.inf, "wide")
    ],
    "pieces": [
        lambda pieces=pieces: deformation_grid(STILL, spacing=1, pieces=pieces)
        for pieces in (0, None)
    ],
    "strain": [
        lambda strain=strain: principal_strains(strain)
        for strain in (np.zeros((4, 3)), "none", 1j * np.eye(2))
    ],
    "through": [lambda: equivalent_strain(np.eye(2), "none")],
    "poisson": [
        lambda: strain_through_slice(np.eye(2), 0.5),
        lambda: strain_through_slice(np.eye(2), 0.3j),
    ],
}


@pytest.mark.parametrize("name", INVALID)
def test_an_error_names_the_invalid_input(name):
    for number, call in enumerate(INVALID[name]):
        with pytest.raises(ProblemError) as caught:
            call()
        assert caught.value.field == name, f"call {number} for {name}"


def test_a_grid_of_lines_is_for_slices_only():
    with pytest.raises(ProblemError, match="slices"):
        deformation_grid(STILL_VOLUME, spacing=1)

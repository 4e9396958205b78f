"""ANTs moves images by our files as tissue moves. Only where antspyx is installed."""

import numpy as np
import pytest
from test_fields import PLACES, Case, inside

from napari_hmrf.field.inverse_field import inverse_displacement

ants = pytest.importorskip("ants")


@pytest.mark.parametrize("name", PLACES)
def test_ants_moves_an_image_as_the_tissue_moves(name, tmp_path):
    case, path = Case(name), tmp_path / "field.nii.gz"
    case.write(path)
    back = inverse_displacement(case.displacement, spacing=tuple(case.size)).displacement
    for axis in range(case.n):
        values = case.sites[..., axis]
        there = ants.from_numpy(
            np.ascontiguousarray((values if case.n == case.axes else values[np.newaxis]).T),
            origin=case.origin,
            spacing=case.spacing[::-1],
            direction=case.direction,
        )
        moved = ants.apply_transforms(there, there, [str(path)], interpolator="linear")
        seen = np.squeeze(moved.numpy().T)
        expected = values + back[..., axis] / case.size[axis]
        np.testing.assert_allclose(seen[inside(case)], expected[inside(case)], atol=0.02)

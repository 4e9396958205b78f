"""Displacement fields for exchange with other tools, and SimpleITK's interpretation of them."""

import numpy as np
import pytest

from napari_hmrf.fields import read_field, write_field

sitk = pytest.importorskip("SimpleITK")

#: Shape, spacing ([z,] y, x) in mm, and largest displacement in pixels.
PLACES = {
    "2-D": ((44, 60), (1.3, 0.7), 3),
    "slice": ((44, 60), (3.0, 1.3, 0.7), 3),
    "3-D": ((20, 36, 44), (2.0, 1.3, 0.7), 0.8),
}


class FieldCase:
    """Invertible motion on an oblique grid with oblong pixels and a shifted origin."""

    def __init__(self, name):
        self.shape, self.spacing, far = PLACES[name]
        self.n, self.axes = len(self.shape), len(self.spacing)
        self.size = np.array(self.spacing[-self.n :])
        at = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1)
        share = at / (np.array(self.shape) - 1)
        still = np.sin(np.pi * share).prod(axis=-1, keepdims=True)  # Zero at the border.
        wave = np.stack([np.cos(2 * share[..., -1 - k] + k) for k in range(self.n)], axis=-1)
        self.displacement = far * still * wave * self.size
        turn = np.linalg.qr(np.random.default_rng(7).normal(size=(self.axes, self.axes)))[0]
        self.direction = turn * np.sign(np.linalg.det(turn))
        self.origin = tuple(np.linspace(-30, 41, self.axes))
        self.sites = at.astype(float)

    @property
    def whole(self):
        """Displacement on all axes of the place; a slice does not move along the third axis."""
        if self.n == self.axes:
            return self.displacement
        return np.pad(self.displacement, [(0, 0)] * self.n + [(1, 0)])[np.newaxis]

    def vectors(self, kind=np.float64):
        """Return the displacement as a SimpleITK image, as another tool writes a backward field."""
        turned = (self.whole[..., ::-1] @ self.direction.T).astype(kind)
        made = sitk.GetImageFromArray(turned, isVector=True)
        made.CopyInformation(self.image(np.zeros(self.shape)))
        return made

    def write(self, path, **options):
        place = {"spacing": self.spacing, "origin": self.origin, "direction": self.direction}
        return write_field(path, self.displacement, **place, **options)

    def image(self, values):
        """Return values as a SimpleITK image at the same place."""
        made = sitk.GetImageFromArray(values if self.n == self.axes else values[np.newaxis])
        made.SetSpacing(self.spacing[::-1])
        made.SetOrigin(self.origin)
        made.SetDirection(self.direction.ravel())
        return made


def transform_in(path):
    """Return the transform that SimpleITK reads from a file."""
    if path.name.endswith(".h5"):
        return sitk.ReadTransform(str(path))
    return sitk.DisplacementFieldTransform(sitk.ReadImage(str(path), sitk.sitkVectorFloat64))


def inside(case):
    return (slice(4, -4),) * case.n


def check_field_file(case, path):
    """Assert that a file of vectors, read as a forward field, has the field and place of a case."""
    field = read_field(path, forward=True)
    away = (field.displacement - case.whole) / case.spacing
    assert np.abs(away).max() < 1e-4
    np.testing.assert_allclose(field.spacing, case.spacing, rtol=1e-6)
    np.testing.assert_allclose(field.origin, case.origin, atol=1e-5)
    np.testing.assert_allclose(field.direction, case.direction, atol=1e-6)

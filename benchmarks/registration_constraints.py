"""Rigid bone and missing tissue in the registration of a volume, with known motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf import warp
from napari_hmrf.fields import green_lagrange_strain
from napari_hmrf.registration import register

Array = npt.NDArray[Any]

#: Sites along an axis; radius of the bone, and radius at which the motion ends.
_SIZE, _BONE, _END = 64, 14, 28
#: Rotation of the bone in degrees, and its shift in voxels.
_ANGLE, _SHIFT = 8, 1.5
#: Centre, relative to that of the bone, and radius of the artefact.
_CENTRE, _RADIUS = (0, 0, 20), 7


def print_constraints() -> None:
    """Print the errors and strains with and without knowledge of bone and of an artefact."""
    place = np.moveaxis(np.indices((_SIZE,) * 3), 0, -1) - (_SIZE - 1) / 2
    away = np.linalg.norm(place, axis=-1)
    part = np.clip((_END - away) / (_END - _BONE), 0, 1)
    angle = np.radians(_ANGLE) * part
    cosine, sine = np.cos(angle), np.sin(angle)
    z, y, x = np.moveaxis(place, -1, 0)
    turned = np.stack([z + _SHIFT * part, cosine * y - sine * x, sine * y + cosine * x], axis=-1)
    truth, bone = turned - place, away < _BONE
    rng = np.random.default_rng(0)
    before = ndimage.gaussian_filter(rng.normal(size=bone.shape), 1.8)
    before = (before - before.min()) / np.ptp(before)
    after = 0.7 * warp(before, truth, spacing=1) + 0.1 + rng.normal(scale=0.01, size=bone.shape)

    def error(found: Array, where: Array) -> float:
        return float(np.linalg.norm(found - truth, axis=-1)[where].mean())

    soft = (away > _BONE + 1) & (away < _END - 2)
    print("| bone | largest strain in it | mean error in it (voxels) | in soft tissue around it |")
    print("| --- | --- | --- | --- |")
    for name, stiffness in (("unknown", None), ("rigid", np.where(bone, np.inf, 1.0))):
        found = register(before, after, spacing=1, stiffness=stiffness).displacement
        strain = np.abs(green_lagrange_strain(found, spacing=1))[away < _BONE - 1].max()
        print(f"| {name} | {strain:.1e} | {error(found, bone):.3f} | {error(found, soft):.3f} |")

    artefact = np.linalg.norm(place - _CENTRE, axis=-1) < _RADIUS
    damaged = np.where(artefact, before.max(), before)
    around = ndimage.binary_dilation(artefact, iterations=5) & ~artefact
    print("\n| artefact in the first image | mean error within 5 voxels around it |")
    print("| --- | --- |")
    cases = (("none", before, None), ("compared", damaged, None), ("masked", damaged, ~artefact))
    for name, image, mask in cases:
        found = register(image, after, spacing=1, masks=mask).displacement
        print(f"| {name} | {error(found, around):.3f} |")

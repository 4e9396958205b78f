"""Tests that a scan means the same in every orientation, kind of grid and door.

SimpleITK and nibabel say where the voxels, landmarks and displacements are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Layer

from napari_hmrf import Drawing, Motion, Pictures, Study, solve_study
from napari_hmrf.contributions import open_landmarks, open_scan
from napari_hmrf.fields import grid_of_image, read_field
from napari_hmrf.io.apply import apply_field, read_field_file
from napari_hmrf.io.case import read_case
from napari_hmrf.io.case_options import Case, RegistrationCase
from napari_hmrf.io.fields import export_field
from napari_hmrf.io.registration_files import register_files
from napari_hmrf.landmarks import read_points, write_points
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.slice_view import View, frame_of

sitk = pytest.importorskip("SimpleITK")

#: Largest distance, in voxels, between two answers that agree.
CLOSE = 1e-4
#: Order of the stored axes, and axes that are stored backwards.
ORIENTATIONS = [*product(permutations(range(3)), product((False, True), repeat=3))]
#: Spacing along z, y and x in mm, rotation angles about two axes in degrees, and slices.
GRIDS = {
    "axial": ((1.0, 1.0, 1.0), (0, 0), 5),
    "oblique": ((1.5, 1.0, 1.2), (25, -15), 5),
    "anisotropic": ((3.0, 0.7, 0.9), (0, 0), 5),
    "2-D": ((2.0, 1.0, 0.8), (10, 0), 1),
}
FILES = {"NIfTI": ".nii.gz", "NRRD": ".nrrd", "MetaImage": ".mha"}
DOORS = [*FILES, "layer", "SimpleITK", "nibabel"]
#: Change of brightness per mm along x, y and z of LPS, which identifies the position of a voxel.
SLOPE = np.array([1.0, 0.7, -1.3])
#: Voxel of a landmark, its target, and another voxel, along the axes z, y and x of the patient.
SOURCE, TARGET, OTHER = np.array([[0, 2, 2], [0, 2, 3], [0, 3, 3]])


@dataclass(frozen=True)
class Scan:
    """Scan of a patient that is stored in one orientation."""

    order: tuple[int, ...]
    backwards: tuple[bool, ...]
    kind: str
    width: int = 6

    @cached_property
    def _grid(self):
        """Stored shape, and steps and first voxel in LPS, for the array axes and x, y, z."""
        spacing, angles, slices = GRIDS[self.kind]
        (a, b), shape = np.radians(angles), (slices, self.width, self.width + 1)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        turn = turn @ [[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]
        steps = turn[:, ::-1] * spacing
        return np.array(shape), steps, np.array([-11.0, 23.0, 5.0])

    def stored(self, voxel):
        """Return the stored array index of a voxel along z, y and x of the patient."""
        shape, _, _ = self._grid
        index = np.where(self.backwards, (shape - 1 - voxel)[list(self.order)], 0)
        return np.where(self.backwards, index, np.asarray(voxel)[list(self.order)])

    def world(self, voxel):
        """Return the position of a voxel in LPS."""
        _, steps, first = self._grid
        return first + steps @ voxel

    @cached_property
    def image(self):
        """The scan as an image of SimpleITK, whose brightness tells the position."""
        shape, steps, first = self._grid
        steps, first = steps[:, list(self.order)], first.copy()
        size = shape[list(self.order)]
        for axis in np.flatnonzero(self.backwards):
            first += steps[:, axis] * (size[axis] - 1)
            steps[:, axis] *= -1
        at = np.moveaxis(np.indices(tuple(size)), 0, -1) @ steps.T + first
        image = sitk.GetImageFromArray((at @ SLOPE + 100).astype(np.float32))
        lengths = np.linalg.norm(steps, axis=0)
        image.SetSpacing(lengths[::-1].tolist())
        image.SetOrigin(first.tolist())
        image.SetDirection((steps / lengths)[:, ::-1].ravel().tolist())
        return image

    @property
    def voxel(self):
        """Smallest side of a voxel, in mm."""
        return min(GRIDS[self.kind][0])

    def far(self, points, expected):
        """Return the largest distance between points in LPS, in voxels."""
        return np.abs(np.asarray(points) - expected).max() / self.voxel


def test_simpleitk_finds_each_voxel_of_the_scans_of_this_file():
    for order, backwards in ORIENTATIONS:
        scan = Scan(order, backwards, "oblique")
        at = scan.stored(SOURCE)[::-1].tolist()
        assert scan.far(scan.image.TransformIndexToPhysicalPoint(at), scan.world(SOURCE)) < 1e-9
        assert scan.image.GetPixel(at) == pytest.approx(scan.world(SOURCE) @ SLOPE + 100)


def write_pair(scan, folder, suffix):
    """Write the landmark with its target along the axes of a file, from its first voxel."""
    spacing = np.array(scan.image.GetSpacing()[::-1])
    source, target = (scan.stored(at) * spacing for at in (SOURCE, TARGET))
    return write_points(folder / f"pair{suffix}", [source], [target])


def write_patient_points(scan, folder, voxel):
    """Write one voxel as a position in the patient, for 3D Slicer."""
    return write_points(folder / f"{voxel}.mrk.json", [scan.world(voxel)[::-1]])


def as_nibabel(scan):
    """Return the parts of a nibabel image that describe its grid, as nibabel reads the scan."""
    nibabel = pytest.importorskip("nibabel")
    steps = np.reshape(scan.image.GetDirection(), (3, 3)) * scan.image.GetSpacing()
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = steps, scan.image.GetOrigin()
    affine[:2] *= -1
    return nibabel.Nifti1Image(sitk.GetArrayFromImage(scan.image).T, affine)


def study_by(door, scan, folder):
    """Return the study of a scan in which the landmark is the only motion."""
    if door in FILES:
        path = folder / f"scan{FILES[door]}"
        sitk.WriteImage(scan.image, str(path))
        return read_case(Case(path, boundary=write_pair(scan, folder, ".csv"), hold_edge=True))
    if door == "layer":
        return study_of_layer(scan, folder)
    if door == "SimpleITK":
        given, pixels = scan.image, sitk.GetArrayFromImage(scan.image)
    else:
        given = as_nibabel(scan)
        pixels = np.asarray(given.dataobj)
    across = pixels.shape.index(1) if scan.kind == "2-D" else None
    grid = grid_of_image(given, **({} if across is None else {"slice": 0, "axis": across}))
    at = grid.to_pixels([scan.world(voxel)[::-1] for voxel in (SOURCE, TARGET)])
    drawing = Drawing.from_landmarks(at[:1], at[1:], radius=0.1)
    image = np.squeeze(pixels, across)
    return Study(grid, motion=Motion(drawing=drawing, hold_edge=True), pictures=Pictures(image))


def study_of_layer(scan, folder):
    path = folder / "scan.nrrd"
    sitk.WriteImage(scan.image, str(path))
    viewer = ViewerModel()
    (data,) = open_scan(str(path))(str(path))
    image = viewer.add_layer(Layer.create(*data))
    points = []
    for voxel in (SOURCE, TARGET):
        file = str(write_patient_points(scan, folder, voxel))
        points += [Layer.create(*each) for each in open_landmarks(file)(file)]
    view = View.of(viewer.dims, volume=scan.kind != "2-D")
    frame = frame_of(image, view)
    shape = tuple(image.data.shape[axis] for axis in frame.plane)
    marks = read_landmarks(*points, frame, shape, view, radius=0.1)
    return study_from_layers(
        Request(image=image, view=view, drawing=Drawing(tuple(marks)), hold_edge=True)
    )


def world_of(grid, pixels):
    """Return the positions in LPS of pixels of a grid, from the matrix of its place."""
    index = np.tile(np.array(grid.place.index, float), (len(pixels), 1))
    index[:, list(grid.place.plane)] = pixels
    matrix = np.array(grid.place.matrix)
    return (index @ matrix[:-1, :-1].T + matrix[:-1, -1])[:, ::-1]


CASES = [*product(ORIENTATIONS, GRIDS, DOORS)]


def some(cases, step):
    """Return the cases, of which the suite runs every `step`-th and the campaign the others."""
    return [
        pytest.param(
            *case,
            marks=[pytest.mark.campaign] if number % step else [],
            id="-".join([_name(case[0]), *case[1:]]),
        )
        for number, case in enumerate(cases)
    ]


def _name(orientation):
    return "".join(
        f"{'-' if back else '+'}{'zyx'[axis]}" for axis, back in zip(*orientation, strict=True)
    )


@pytest.mark.filterwarnings("ignore:Non-orthogonal slicing")
@pytest.mark.parametrize(("orientation", "kind", "door"), some(CASES, 29))
def test_a_scan_means_the_same_in_every_orientation(orientation, kind, door, tmp_path):
    scan = Scan(*orientation, kind)
    source, target = scan.world(SOURCE), scan.world(TARGET)
    study = study_by(door, scan, tmp_path)
    grid = study.grid

    sites = np.argwhere(np.ones(grid.shape, bool))
    brightness = world_of(grid, sites) @ SLOPE + 100
    found = np.asarray(study.pictures.image)[tuple(sites.T)]
    assert np.abs(found - brightness).max() < CLOSE * scan.voxel, "a voxel is in another place"
    (mark,) = study.motion.drawing.marks
    ends = world_of(grid, np.array([mark.source, mark.target]))
    assert scan.far(ends, [source, target]) < CLOSE, "a landmark is in another place"
    assert scan.far(world_of(grid, grid.to_pixels([source[::-1]])), source) < CLOSE
    if door == "SimpleITK":  # along the axes of the file, as BigWarp
        stored = scan.stored(SOURCE) * scan.image.GetSpacing()[::-1]
        assert scan.far(world_of(grid, grid.to_pixels([stored], "")), source) < CLOSE

    solution = solve_study(study, backend="cpu")
    forward, backward = tmp_path / "forward.nrrd", tmp_path / "backward.nrrd"
    export_field(forward, solution, forward=True)
    export_field(backward, solution)
    moves, images = (
        sitk.DisplacementFieldTransform(sitk.ReadImage(str(path), sitk.sitkVectorFloat64))
        for path in (forward, backward)
    )
    moved = moves.TransformPoint(source.tolist())
    assert scan.far(moved, target) < CLOSE, "an exported displacement is another one"
    other = moves.TransformPoint(scan.world(OTHER).tolist())

    field = read_field_file(forward)
    for voxel, expected in ((SOURCE, target), (OTHER, other)):
        path = write_patient_points(scan, tmp_path, voxel)
        apply_field(field, path, tmp_path / "moved.mrk.json", labels=False)
        found = read_points(tmp_path / "moved.mrk.json").points[0]
        assert scan.far(found[::-1], expected) < CLOSE, "a landmark is moved elsewhere"

    path, result = tmp_path / "scan.nrrd", tmp_path / "moved.nrrd"
    sitk.WriteImage(scan.image, str(path))
    apply_field(read_field_file(backward), path, result, labels=False)
    # Written along the axes of the field.
    ours = sitk.Resample(
        sitk.ReadImage(str(result)), scan.image, sitk.Transform(3, sitk.sitkIdentity)
    )
    theirs = sitk.Resample(scan.image, scan.image, images, sitk.sitkLinear, -1.0)
    theirs = sitk.GetArrayFromImage(theirs)
    inside = theirs > 0
    assert inside.mean() > 0.3
    ours = sitk.GetArrayFromImage(ours)
    assert np.abs(ours - theirs)[inside].max() < 10 * CLOSE * scan.voxel, "an image moves elsewhere"


@pytest.mark.parametrize(
    ("orientation", "kind"), some([*product(ORIENTATIONS, list(GRIDS)[:3])], 36)
)
def test_a_scan_does_not_move_to_itself_in_another_orientation(orientation, kind, tmp_path):
    scan, upright = Scan(*orientation, kind, 16), Scan((0, 1, 2), (False,) * 3, kind, 16)
    for name, each in (("fixed", upright), ("moving", scan)):
        values = sitk.GetArrayFromImage(each.image)
        textured = sitk.GetImageFromArray(np.sin(values / 2) + 0.1 * values)
        textured.CopyInformation(each.image)
        sitk.WriteImage(textured, str(tmp_path / f"{name}.nrrd"))
    register_files(RegistrationCase(tmp_path / "fixed.nrrd", tmp_path / "moving.nrrd"), tmp_path)
    field = read_field(tmp_path / "fixed to moving field.mha")
    assert np.abs(field.displacement).max() < CLOSE * scan.voxel

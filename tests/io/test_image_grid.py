"""Tests of the place of grids, studies and exported fields."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from napari_hmrf import (
    ArgumentError,
    Arrow,
    Drawing,
    Grid,
    HmrfError,
    Motion,
    Problem,
    ProblemError,
    Provenance,
    Solution,
    Study,
    Tissue,
    read_study,
    solve,
    solve_study,
    warp,
    write_study,
)
from napari_hmrf.cli import main
from napari_hmrf.fields import Frame, grid_of_image, read_field
from napari_hmrf.io.fields import export_field
from napari_hmrf.io.images import read_image

sitk = pytest.importorskip("SimpleITK")

SHAPE = 9, 12, 10
SPACING = 2.0, 1.0, 1.5  # In the order z, y, x.
#: Largest difference of the image between neighbouring pixels.
STEEPEST = 20.0
ORIGIN = -20.0, 35.0, 12.0  # In the order x, y, z.


def oblique():
    """Return the directions of a volume that was tilted twice and has a reversed first axis."""
    one, two = np.radians(25), np.radians(-15)
    first = [[np.cos(one), -np.sin(one), 0], [np.sin(one), np.cos(one), 0], [0, 0, 1]]
    second = [[1, 0, 0], [0, np.cos(two), -np.sin(two)], [0, np.sin(two), np.cos(two)]]
    return np.array(first) @ np.array(second) @ np.diag([-1.0, 1.0, 1.0])


def scan():
    z, y, x = np.indices(SHAPE)
    image = sitk.GetImageFromArray(50 + 20 * np.sin(0.7 * z + 0.3) * np.cos(0.5 * y) + 3.0 * x)
    image.SetSpacing(SPACING[::-1])
    image.SetOrigin(ORIGIN)
    image.SetDirection(oblique().ravel().tolist())
    return image


def nibabel_of(image, unit="mm"):
    """Return the image as nibabel stores it: axes x, y, z, in millimetres in RAS+ coordinates.

    The object has only the attributes that are read.
    """
    n = 3
    affine = np.eye(4)
    affine[:n, :n] = np.array(image.GetDirection()).reshape(n, n) * np.array(image.GetSpacing())
    affine[:n, n] = image.GetOrigin()
    return SimpleNamespace(
        affine=np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine,
        dataobj=sitk.GetArrayFromImage(image).transpose(2, 1, 0),
        header=SimpleNamespace(get_xyzt_units=lambda: (unit, "sec")),
    )


def solved(grid, far=0.8):
    """Solve a smooth motion of the middle by a fraction of a pixel along each axis."""
    n = len(grid.shape)
    bumps = [np.sin(np.pi * np.linspace(0, 1, size)) ** 2 for size in grid.shape]
    bump = np.prod(np.meshgrid(*bumps, indexing="ij"), axis=0)
    y = bump[..., None] * far * np.array(grid.spacing) * (1, -0.5, 0.7)[:n]
    tissue = Tissue(stiffness=np.ones(grid.shape))
    motion = Motion(observed=y, confidence=np.ones(grid.shape))
    return solve_study(Study(grid, tissue, motion), backend="cpu")


def resampled(image, path):
    """Return the image that SimpleITK resamples with the field of a file."""
    field = sitk.ReadImage(str(path), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(field)
    moved = sitk.Resample(image, image, transform, sitk.sitkLinear, 0.0)
    return sitk.GetArrayFromImage(moved)


def image_and_array(kind, image, tmp_path):
    """Return the image in a form that `grid_of_image` accepts, and its array."""
    if kind == "nibabel":
        given = nibabel_of(image)
        return given, np.asarray(given.dataobj)
    if kind == "simpleitk":
        return image, sitk.GetArrayFromImage(image)
    path = tmp_path / f"scan{kind}"
    sitk.WriteImage(image, str(path))
    return path, sitk.GetArrayFromImage(image)


@pytest.mark.parametrize("kind", ["simpleitk", "nibabel", ".nii.gz"])
def test_simpleitk_and_warp_move_a_volume_alike(kind, tmp_path):
    image = scan()
    given, pixels = image_and_array(kind, image, tmp_path)
    grid = grid_of_image(given)
    assert (grid.shape, grid.unit) == (pixels.shape, "millimeter")
    np.testing.assert_allclose(sorted(grid.spacing), sorted(SPACING), rtol=1e-6)
    solution = solved(grid)
    path = tmp_path / "field.mha"
    residual = export_field(path, solution)
    by_us = warp(pixels, solution.displacement, spacing=grid.spacing)
    if kind == "nibabel":
        by_us = by_us.transpose(2, 1, 0)
    by_them = resampled(image, path)
    inner = (slice(1, -1),) * 3  # ITK moves nothing outside its grid.
    np.testing.assert_allclose(by_them[inner], by_us[inner], atol=0.015 * STEEPEST)
    assert residual < 0.01
    still = sitk.GetArrayFromImage(image)
    assert np.abs(by_us - still).max() > 2


@pytest.mark.parametrize(("kind", "axis"), [("simpleitk", 0), ("nibabel", 1), ("simpleitk", 2)])
def test_the_field_of_a_slice_moves_only_that_slice(kind, axis, tmp_path, capsys):
    image = scan()
    given, pixels = image_and_array(kind, image, tmp_path)
    grid, seen = grid_of_image(given, slice=3, axis=axis), pixels.take(3, axis)
    assert grid.shape == seen.shape
    solution = solved(grid)
    by_us = warp(seen, solution.displacement, spacing=grid.spacing)

    export_field(tmp_path / "field.mha", solution)
    by_them = resampled(image, tmp_path / "field.mha")
    if kind == "nibabel":
        by_them = by_them.transpose(2, 1, 0)
    np.testing.assert_allclose(
        by_them.take(3, axis)[1:-1, 1:-1], by_us[1:-1, 1:-1], atol=0.05, err_msg="by SimpleITK"
    )

    sitk.WriteImage(image, str(tmp_path / "scan.nrrd"))
    write_study(tmp_path / "a.study", Study(grid, Tissue(stiffness=np.ones(grid.shape))), solution)
    assert read_study(tmp_path / "a.study").study.grid == grid
    told = ["apply", str(tmp_path / "a.study"), str(tmp_path / "scan.nrrd")]
    assert main([*told, "--out", str(tmp_path / "out")]) == 0, capsys.readouterr().err
    moved = read_image(tmp_path / "out" / "scan.nrrd").pixels
    if kind == "nibabel":
        moved = moved.transpose(2, 1, 0)
    np.testing.assert_allclose(moved.take(3, axis), by_us, atol=1e-3)
    np.testing.assert_array_equal(np.delete(moved, 3, axis), np.delete(pixels, 3, axis))


def test_a_slice_with_unknown_place_is_refused_for_a_volume(tmp_path, capsys):
    sitk.WriteImage(scan(), str(tmp_path / "scan.nii.gz"))
    grid = Grid(SHAPE[1:], SPACING[1:])
    study = Study(grid, Tissue(stiffness=np.ones(grid.shape)))
    write_study(tmp_path / "a.study", study, solved(grid))
    told = ["apply", str(tmp_path / "a.study"), str(tmp_path / "scan.nii.gz")]
    assert main([*told, "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert "is a volume of 9 slices" in said
    assert "does not state which" in said
    assert "--slice" in said
    assert not (tmp_path / "out" / "scan.nii.gz").exists()


def test_a_field_without_a_place_is_exported_only_on_request(tmp_path):
    grid, path = Grid(SHAPE, SPACING), tmp_path / "field.mha"
    solution = solved(grid)
    with pytest.raises(ProblemError, match=r"has no position.*grid_of_image.*placed=False"):
        export_field(path, solution)
    assert not path.exists()
    export_field(path, solution, placed=False)
    assert sitk.ReadImage(str(path)).GetOrigin() == (0, 0, 0)
    # A solution of a Problem has the place of the given grid.
    problem = Problem(
        observed=np.zeros((*SHAPE, 3)),
        confidence=np.ones((*SHAPE, 3)),
        stiffness=np.ones(SHAPE),
        spacing=SPACING,
    )
    of_problem = solve(problem, backend="cpu")
    export_field(path, of_problem, grid=grid_of_image(scan()))
    np.testing.assert_allclose(sitk.ReadImage(str(path)).GetOrigin(), ORIGIN)
    np.testing.assert_allclose(sitk.ReadImage(str(path)).GetDirection(), oblique().ravel())
    with pytest.raises(ProblemError, match=r"has pixels of 2 x 1 x 1\.5"):
        export_field(path, solved(Grid(SHAPE, (1, 1, 1))), grid=grid_of_image(scan()))
    with pytest.raises(ProblemError, match="Pass the grid of its image"):
        export_field(path, solution, grid=grid_of_image(scan(), slice=2))


def test_pictures_have_pixels_without_a_place(tmp_path):
    from skimage.io import imsave

    imsave(tmp_path / "photo.png", np.zeros((5, 6, 3), np.uint8), check_contrast=False)
    grid = grid_of_image(tmp_path / "photo.png")
    assert grid == Grid((5, 6), (1.0, 1.0))
    pull = Motion(hold_edge=True, drawing=Drawing((Arrow((2, 3), (0, 1), 1),)))
    solution = solve_study(Study(grid, Tissue(stiffness=np.ones((5, 6))), pull), backend="cpu")
    with pytest.raises(
        ProblemError, match=r"For pictures \(.png, .tif\), which have no position, pass"
    ):
        export_field(tmp_path / "a.mha", solution)
    with pytest.raises(
        ProblemError,
        match="grid: has no position in world coordinates, as is the case for pictures",
    ):
        export_field(tmp_path / "a.mha", solution, grid=grid)


def test_an_array_or_a_missing_slice_is_refused():
    image = scan()
    for wrong, said in (
        (np.zeros((3, 4)), r"For an array, which has no position"),
        (SimpleNamespace(affine=np.eye(4), dataobj=np.zeros((2, 3, 4, 5))), "has shape"),
    ):
        with pytest.raises(ArgumentError, match=said):
            grid_of_image(wrong)
    with pytest.raises(ArgumentError, match=r"has 12 slices along axis 1. Pass 0 to 11"):
        grid_of_image(image, slice=12, axis=1)
    with pytest.raises(ArgumentError, match="axis is 3"):
        grid_of_image(image, slice=0, axis=3)
    with pytest.raises(ArgumentError, match="Leave slice out"):
        grid_of_image(sitk.Image([5, 6], sitk.sitkFloat32), slice=0)
    with pytest.raises((OSError, HmrfError)):
        grid_of_image("no such file.nii")


def test_a_place_must_fit_its_grid():
    flat = Frame.at((1.0, 1.0), ("mm", "mm"))
    with pytest.raises(ProblemError, match="has 3 axes, but its place has 2"):
        Grid((3, 4, 5), (1.0, 1.0, 1.0), place=flat)
    with pytest.raises(ProblemError, match="of type str"):
        Grid((3, 4), (1.0, 1.0), place="here")


@pytest.mark.parametrize(
    ("unit", "millimetres"), [("mm", 1), ("unknown", 1), ("meter", 1000), ("micron", 0.001)]
)
def test_the_unit_of_a_nibabel_header_is_converted_to_millimetres(unit, millimetres):
    expected = grid_of_image(nibabel_of(scan()))
    given = nibabel_of(scan(), unit)
    given.affine[:3] /= millimetres
    grid = grid_of_image(given)
    assert grid.unit == "millimeter"
    np.testing.assert_allclose(grid.spacing, expected.spacing)
    np.testing.assert_allclose(grid.place.matrix, expected.place.matrix)


def test_an_unknown_unit_of_a_nibabel_header_is_refused():
    with pytest.raises(ProblemError, match=r"has the unit 'inch'.*set_xyzt_units"):
        grid_of_image(nibabel_of(scan(), "inch"))


class NiftiHeader(dict):
    """Header of a NIfTI image of nibabel with the given codes and one affine."""

    def __init__(self, affine, qform_code, sform_code):
        super().__init__(qform_code=qform_code, sform_code=sform_code)
        self.affine = affine

    def get_qform(self):
        return self.affine

    get_sform = get_qform

    def get_xyzt_units(self):
        return "mm", "sec"


def test_a_nibabel_image_whose_header_states_no_place_is_refused():
    given = nibabel_of(scan())
    given.header = NiftiHeader(given.affine, 1, 0)
    assert grid_of_image(given).place is not None
    given.header = NiftiHeader(given.affine, 0, 0)
    with pytest.raises(ProblemError, match=r"states no place.*set_sform"):
        grid_of_image(given)


def placed_field(place=None, unit="", spacing=SPACING):
    """Return a solution without motion, with or without a place."""
    shape = SHAPE
    return Solution(
        displacement=np.zeros((*shape, 3), np.float32),
        energy=np.zeros(1),
        levels=(),
        tissue=np.ones(shape, bool),
        spacing=spacing,
        provenance=Provenance("cpu", ""),
        frame=None if place is None else place.as_dict(),
        unit=unit,
    )


def moved_scan():
    image = scan()
    image.SetOrigin((-20.0, 35.0, 27.0))
    return image


def test_a_field_is_not_exported_to_another_place_than_its_own(tmp_path):
    here, elsewhere = grid_of_image(scan()), grid_of_image(moved_scan())
    solution = placed_field(here.place, "mm")
    export_field(tmp_path / "a.mha", solution, grid=here)
    with pytest.raises(ProblemError, match="is not in the same place as the field"):
        export_field(tmp_path / "b.mha", solution, grid=elsewhere)
    assert not (tmp_path / "b.mha").exists()


@pytest.mark.parametrize("unit", ["millimeter", "", "um"])
def test_a_field_of_the_same_spacing_is_exported_on_a_grid(unit, tmp_path):
    sizes = tuple(1000 * size for size in SPACING) if unit == "um" else SPACING
    solution = placed_field(unit=unit, spacing=sizes)
    export_field(tmp_path / "a.mha", solution, grid=grid_of_image(scan()))
    np.testing.assert_allclose(sitk.ReadImage(str(tmp_path / "a.mha")).GetSpacing(), SPACING[::-1])


@pytest.mark.parametrize("unit", ["um", "furlong", "second"])
def test_a_field_in_another_unit_than_its_grid_is_not_exported(unit, tmp_path):
    with pytest.raises(ProblemError, match=f"the field has pixels of 2 x 1 x 1.5 {unit}"):
        export_field(tmp_path / "a.mha", placed_field(unit=unit), grid=grid_of_image(scan()))


@pytest.mark.parametrize(("unit", "factor"), [("um", 1e-3), ("cm", 10), ("pixel", 1)])
def test_a_field_at_the_origin_is_written_in_millimetres(unit, factor, tmp_path):
    solution = placed_field(unit=unit)
    solution = replace(solution, displacement=solution.displacement + np.float32(0.5))
    export_field(tmp_path / "a.mha", solution, placed=False, forward=True)
    field = read_field(tmp_path / "a.mha")
    np.testing.assert_allclose(field.spacing, np.array(SPACING) * factor)
    np.testing.assert_allclose(field.displacement[4, 5, 5], 0.5 * factor, rtol=1e-6)


def test_a_field_without_a_unit_of_length_is_not_exported(tmp_path):
    with pytest.raises(ProblemError, match="'second', which is not a unit of length"):
        export_field(tmp_path / "a.mha", placed_field(unit="second"), placed=False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"spacing": (1.0, 1.0, 1.0)}, r"has pixels of 1 x 1 x 1 mm, but its place has"),
        ({"spacing": (4.0, 2.0, 3.0)}, r"has pixels of 4 x 2 x 3 mm, but its place has"),
        ({"unit": "um"}, r"has pixels of 2 x 1 x 1\.5 um, but its place has pixels of .* mm"),
    ],
)
def test_a_field_whose_place_contradicts_its_spacing_is_not_exported(change, said, tmp_path):
    solution = replace(placed_field(grid_of_image(scan()).place, "mm"), **change)
    with pytest.raises(ProblemError, match=said):
        export_field(tmp_path / "a.mha", solution)


@pytest.mark.parametrize("name", ["forward", "placed"])
def test_a_text_is_refused_as_a_flag_of_an_export(name, tmp_path):
    solution = placed_field(grid_of_image(scan()).place, "mm")
    with pytest.raises(ArgumentError, match=f"{name} must be True or False, not 'no'"):
        export_field(tmp_path / "a.mha", solution, **{name: "no"})


def test_a_nibabel_image_without_an_affine_is_refused():
    given = nibabel_of(scan())
    given.affine = None
    with pytest.raises(ArgumentError, match=r"has the affine None\. Pass an image with a 4 x 4"):
        grid_of_image(given)

"""Tests of the benchmark of high contrast: cases, exact fields and the table."""

import hard
import numpy as np
import pytest
from fem import plane_stress_displacement
from report import rivals, tissues
from report.reference import bodies, exact_field, rigid_field
from report.rivals import PRIOR, Run, distance

from napari_hmrf import ElasticPrior, Problem
from napari_hmrf.data import phantom

N = 17


@pytest.mark.parametrize("size", [N, 97])
@pytest.mark.parametrize("case", tissues.TISSUES)
def test_a_case_has_soft_stiff_and_moving_tissue(case, size):
    layout = tissues.TISSUES[case](size)
    images = layout.images(1e4)
    problem = Problem(images.observed, images.confidence, images.stiffness)
    PRIOR.resolved(problem)  # Raises an error for tissue that could move freely.
    inside = images.stiffness[images.tissue]
    assert inside.min() == 1
    assert inside.max() == 1e4
    assert np.isin(np.unique(layout.pattern[~layout.void]), [0, 0.5, 1]).all()
    assert np.ptp(images.observed[images.known[..., 0]], axis=0).max() > 0.5
    again = tissues.TISSUES[case](size).images(1e4)
    assert rivals.digest(again) == rivals.digest(images), "the case is not reproducible"


@pytest.mark.parametrize("name", ["expansion", "mass-effect"])
def test_a_phantom_is_unchanged_at_its_own_contrast(name):
    images = tissues.TISSUES[name](48).images(tissues.PHANTOM_CONTRAST)
    np.testing.assert_allclose(
        images.stiffness, phantom(name, 48).problem.stiffness / 10, rtol=1e-6
    )


@pytest.mark.parametrize("case", tissues.TISSUES)
def test_the_exact_field_equals_that_of_other_finite_elements(case):
    images = tissues.TISSUES[case](N).images(1e2)
    other = plane_stress_displacement(
        Problem(images.observed, images.confidence, images.stiffness), 0.3
    )
    assert distance(exact_field(images, PRIOR), other) < 1e-6


@pytest.mark.parametrize(
    "prior", [PRIOR, ElasticPrior(0.499, plane="strain")], ids=["stress", "strain"]
)
@pytest.mark.parametrize("case", ["noise-2", "fibres", "mass-effect"])
def test_the_exact_field_is_in_equilibrium_even_at_a_contrast_of_1e7(case, prior):
    images = tissues.TISSUES[case](N).images(1e7)
    field = exact_field(images, prior)
    free = ~images.known & images.tissue[..., None]
    # Tolerance: rounding of the stiff part, below the forces of the soft part at 1e-7 px.
    assert np.abs(prior.forces(images, field)[free]).max() < 1e-12


@pytest.mark.parametrize("bone", tissues.BONES)
def test_a_rigid_bone_is_the_limit_of_a_stiff_bone(bone):
    drawn = tissues.BONES[bone](33)
    images = tissues.bone_images(drawn)
    body = bodies(drawn) > 0
    field = rigid_field(images, PRIOR)
    assert hard.largest_strain(field, body) < 1e-12
    assert np.abs(field[body]).max() > 0.5
    # The rim of the bone is a mean with soft sites, but remains stiff.
    stiff = tissues.Images(
        images.observed, images.confidence, np.where(drawn, np.float32(1e6), images.stiffness)
    )
    assert distance(field, exact_field(stiff, PRIOR)) < 1e-3


def test_two_rigid_bodies_that_share_a_site_are_refused():
    bone = np.zeros((9, 9), dtype=bool)
    bone[1:3, 1:3] = bone[4:6, 4:6] = True
    with pytest.raises(ValueError, match="meet in a site"):
        bodies(bone)


def test_a_row_has_the_times_and_errors_of_all_solvers(tmp_path, monkeypatch):
    monkeypatch.setattr(hard, "KEPT", tmp_path)
    images = tissues.TISSUES["inclusion"](N).images(4.0)
    alone = hard.measure("inclusion", N, 4.0, images, alone=True)
    assert alone.ours.error <= rivals.WITHIN
    assert alone.superlu is None
    (kept,) = tmp_path.iterdir()
    row = hard.measure("inclusion", N, 4.0, images, alone=False)
    assert [kept] == list(tmp_path.iterdir())
    assert row.ours.iterations == alone.ours.iterations > 0
    assert row.superlu.error < 1e-6
    assert len(row.cells) == len(alone.cells) == len(hard.HEADER)
    if rivals.has_pyamg():
        assert row.pyamg.error <= rivals.WITHIN
    page = tmp_path / "page.md"
    hard.write_page(page, [row, alone])
    assert "| inclusion | 17 | 4e0 |" in page.read_text(encoding="utf-8")


def test_rows_of_earlier_runs_are_stored_and_replaced_by_newer_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(hard, "KEPT", tmp_path / "new")
    assert hard.kept() == []
    peer = Run(None, seconds=1.0, error=0.0)
    large, small, again = (
        hard.Row("ribs", size, 1e2, Run(None, seconds=seconds, error=1e-4), None, peer)
        for size, seconds in ((257, 1.0), (97, 1.0), (97, 0.5))
    )
    for row in (large, small, again):
        hard.keep(row)
    assert [row.cells for row in hard.kept()] == [again.cells, large.cells]


def test_the_summary_lists_wrong_slow_and_refused_cases():
    peer = Run(None, seconds=1.0, error=0.0)
    found = [
        hard.Row("ribs", 257, 1e2, Run(None, seconds=0.4, error=1e-4), None, peer),
        hard.Row("ribs", 257, 1e4, Run(None, seconds=1.5, error=2e-3), None, peer),
        hard.Row("ribs", 257, 1e5, Run(None, seconds=0.1, reported=1e-3, error=0.1), None, peer),
        hard.Row("ribs", 257, 1e7, Run(None, fault="refused"), None, peer),
    ]
    lines = "\n".join(hard.summary(found))
    assert "4 rows, of which 3 were solved" in lines
    assert "refused: 1 rows (ribs 257 1e7)" in lines
    assert "true error above 0.003 px: 1 rows (ribs 257 1e5)" in lines
    assert "ratio above 1.3: 1 rows (ribs 257 1e4)" in lines
    assert "at most half of the better peer's time: 1 of 4 (25%)" in lines

"""What was found before is made use of, and trusted as far as it is known to hold."""

import gc
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Multigrid, NeoHookeanPrior, Problem, solve
from napari_hmrf.data import phantom
from napari_hmrf.solver.warm_start import combine_solutions

WITHIN = Multigrid(0.01)
PRIOR = ElasticPrior()
PROBLEM = phantom("mass-effect", 96).problem
PATCH = (np.arange(96)[:, None, None] < 30) & (PROBLEM.confidence > 0)


def pushed(by, across=0.0, c=PROBLEM.confidence, m=PROBLEM.stiffness, spacing=(1.0, 1.0)):
    """The problem with a patch moved further, in pixels along both axes."""
    step = np.array([by, across]) * spacing
    return Problem(PROBLEM.observed * np.array(spacing) + step * PATCH, c, m, spacing=spacing)


def well_known(backend="cpu", **about):
    """Two solutions, better than will be asked for."""
    problems = [pushed(by, **about) for by in (0, 1)]
    return [solve(each, PRIOR, optimizer=Multigrid(1e-3), backend=backend) for each in problems]


@pytest.mark.parametrize("backend", ["cpu", "opengl"])
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 0.5)])
def test_a_patch_that_goes_on_as_before_needs_no_cycle(backend, spacing):
    known = well_known(backend, spacing=spacing)
    further = pushed(2, spacing=spacing)
    found = solve(further, PRIOR, optimizer=WITHIN, backend=backend, initial=known)
    exact = solve(further, PRIOR, optimizer=Multigrid(1e-5), backend=backend)
    assert found.iterations == 0
    assert len(found.energy) == 1
    assert found.mean_energy == pytest.approx(exact.mean_energy, rel=1e-3)
    # Known by what they are wrong by themselves: once the one, twice the other.
    known_by = known[0].convergence.error + 2 * known[1].convergence.error
    assert found.convergence.error == pytest.approx(known_by, rel=1e-3)
    apart = np.abs(found.displacement - exact.displacement).max() / spacing[0]
    assert apart <= found.convergence.error <= WITHIN.tolerance
    assert 0 < found.convergence.residual < 0.01


def test_what_was_moved_and_comes_back_is_known():
    known = well_known()
    assert solve(pushed(0.4), PRIOR, optimizer=WITHIN, backend="cpu", initial=known).iterations == 0
    assert (
        solve(pushed(1), PRIOR, optimizer=WITHIN, backend="cpu", initial=known[1]).iterations == 0
    )


def test_errors_add_up_until_they_are_too_large_and_a_cycle_brings_them_down():
    known, cycles = well_known()[::-1], []
    for by in range(2, 30):
        found = solve(pushed(by), PRIOR, optimizer=WITHIN, backend="cpu", initial=known)
        assert found.convergence.error <= WITHIN.tolerance
        cycles.append(found.iterations)
        known = [found, *known][:4]
    assert cycles[0] == 0
    assert 0 < sum(cycles) < len(cycles)
    exact = solve(pushed(29), PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=WITHIN.tolerance)


def softer_within():
    """Tissue that is softer where it hardly strains: what is left over there hardly tells."""
    m = PROBLEM.stiffness.copy()
    m[60:80, 20:40] *= 1e-3
    return m


def held_elsewhere():
    c = PROBLEM.confidence.copy()
    c[48, 48] = 1
    return c


@pytest.mark.parametrize(
    "edited",
    [
        pushed(2, across=0.5),
        pushed(2, m=softer_within()),
        pushed(2, c=held_elsewhere()),
    ],
    ids=["to a side", "softer", "held elsewhere"],
)
def test_another_problem_is_not_taken_for_known(edited):
    found = solve(edited, PRIOR, optimizer=WITHIN, backend="cpu", initial=well_known())
    exact = solve(edited, PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
    assert found.iterations > 0
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=WITHIN.tolerance)


def test_a_push_that_soft_tissue_hardly_resists_is_a_push_all_the_same():
    m = np.where(np.arange(96)[:, None] < 34, 1e-5, 1) * PROBLEM.stiffness
    found = solve(
        pushed(2, across=0.5, m=m), PRIOR, optimizer=WITHIN, backend="cpu", initial=well_known(m=m)
    )
    exact = solve(pushed(2, across=0.5, m=m), PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
    assert found.iterations > 0
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=WITHIN.tolerance)


def test_another_poissons_ratio_is_not_taken_for_known():
    found = solve(
        pushed(2), ElasticPrior(0.2), optimizer=WITHIN, backend="cpu", initial=well_known()
    )
    assert found.iterations > 0


def test_tissue_that_was_another_in_between_is_not_taken_for_known():
    known = well_known()
    solve(pushed(0, m=softer_within()), PRIOR, optimizer=WITHIN, backend="cpu")
    assert solve(pushed(2), PRIOR, optimizer=WITHIN, backend="cpu", initial=known).iterations > 0


def test_a_copy_is_not_taken_for_what_was_found_nor_what_was_changed_since():
    known = well_known()
    copies = [replace(each, displacement=each.displacement.copy()) for each in known]
    assert solve(pushed(2), PRIOR, optimizer=WITHIN, backend="cpu", initial=copies).iterations > 0
    place = np.s_[30:36, 44:50]
    assert PROBLEM.tissue[place].all()
    assert not PROBLEM.known[place].any(), "what is observed is looked at anyway"
    known[1].displacement[place] += 0.3
    found = solve(pushed(2), PRIOR, optimizer=WITHIN, backend="cpu", initial=known)
    assert found.iterations > 0
    exact = solve(pushed(2), PRIOR, optimizer=Multigrid(1e-5), backend="cpu")
    np.testing.assert_allclose(found.displacement, exact.displacement, atol=WITHIN.tolerance)


def test_what_nobody_has_any_more_is_forgotten():
    known = well_known()
    model = models_last()
    for by in range(5):
        solve(pushed(by), PRIOR, optimizer=WITHIN, backend="cpu", initial=known)
    del known
    gc.collect()
    found = solve(pushed(7), PRIOR, optimizer=WITHIN, backend="cpu")
    assert [known() is found.displacement for known, _ in model.earlier._qualities] == [True]


def models_last():
    from napari_hmrf.solver.backends.cpu import elastic_model

    return elastic_model._last[0]


def test_a_result_without_a_cycle_can_be_saved_and_read(tmp_path):
    found = solve(pushed(2), PRIOR, optimizer=WITHIN, backend="cpu", initial=well_known())
    read = type(found).read(found.write(tmp_path / "found.npz"))
    assert (read.iterations, len(read.energy)) == (0, 1)


def test_shares_add_up_to_one_and_bring_the_patch_where_it_is_to_be():
    solutions = [*well_known(), solve(pushed(0, 1), PRIOR, optimizer=WITHIN, backend="cpu")]
    begin = combine_solutions(solutions, pushed(3, -2))
    assert sum(begin.shares) == pytest.approx(1)
    assert begin.shares[1:] == pytest.approx((3, -2), abs=1e-3)
    assert begin.missing < 1e-4
    assert combine_solutions(solutions[0], pushed(3)).missing == pytest.approx(3, rel=1e-5)


@pytest.mark.parametrize("prior", [PRIOR, NeoHookeanPrior()])
def test_thin_tissue_that_is_not_observed_any_more_is_at_rest_as_in_a_cold_start(prior):
    y, c = np.zeros((2, 40, 40, 2))
    m = np.zeros((40, 40))
    m[:30], m[32:36, 5] = 1, 1
    c[0], c[29] = 1, 1
    y[29, :, 0] = 0.5
    c[32:36, 5], y[32:36, 5] = 1, 2
    before = solve(Problem(y, c, m), prior, optimizer=WITHIN, backend="cpu")
    assert (before.displacement[32:36, 5] == 2).all()
    c[32:36] = 0
    after = solve(Problem(y, c, m), prior, optimizer=WITHIN, backend="cpu", initial=before)
    assert (after.displacement[32:36] == 0).all()
    assert after.displacement[29, 0, 0] == pytest.approx(0.5, abs=1e-6)

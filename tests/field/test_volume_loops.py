"""Compiled loops for volumes, compared with NumPy and SciPy."""

from itertools import permutations

import numba
import numpy as np
import pytest

from napari_hmrf import ElasticPrior, Multigrid, Problem, ProblemError, solve
from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.compute.compile_cache.stage import PREPARING
from napari_hmrf.field import tetrahedron_raster
from napari_hmrf.field.deformation import (
    determinant_or_fold,
    jacobian_determinant,
    smallest_determinant,
)
from napari_hmrf.field.moved_points import moved_points
from napari_hmrf.field.resample import resample
from napari_hmrf.field.strain import (
    deformation_gradient,
    green_lagrange_strain,
    small_strain,
)
from napari_hmrf.field.warp import inverse_raster, moved_sites

SIZE = (1.5, 1.0, 0.7)
#: Edge paths from the first corner of a cell to its last, as in `tetrahedron_raster`.
WAYS = list(permutations(range(3)))
#: Roughness and shift of each kind of motion.
MOTIONS = {"smooth": (0.1, 0), "shifted": (0.0, 2.3), "rough": (1.5, 1), "torn": (0.2, 0)}


def random_motion(kind, seed=0, shape=(6, 7, 8)):
    """Return a displacement in the unit of SIZE and tissue with void."""
    random = np.random.default_rng([seed, *map(ord, kind)])
    rough, shift = MOTIONS[kind]
    d = rough * random.normal(size=(*shape, 3)) + shift * random.uniform(-1, 1, 3)
    if kind == "torn":
        d[: shape[0] // 2] = 2 * shape[0] / 3, 0, 0
    return d * SIZE, random.random(shape) < random.choice([0.7, 0.95, 1])


def corners(way):
    steps = np.eye(3, dtype=int)[list(way)]
    return np.concatenate([np.zeros((1, 3), int), np.cumsum(steps, axis=0)])


def rasterise_one_by_one(moved, tissue):
    """Return the source and the state of each voxel; the first tetrahedron to cover it wins."""
    places = np.argwhere(np.ones(tissue.shape, bool))
    source, state = np.zeros(moved.shape), np.zeros(tissue.shape, int)
    for value in (2, 1):
        for cell in np.ndindex(*np.subtract(tissue.shape, 1)):
            for way in WAYS:
                sites = np.array(cell) + corners(way)
                if not tissue[tuple(sites.T)].all():
                    continue
                first, *others = moved[tuple(sites.T)]
                edges = np.transpose(others - first)
                volume = np.linalg.det(edges) * np.linalg.det(np.eye(3)[list(way)])
                if abs(volume) < 1e-12 or (volume > 0) != (value == 2):
                    continue
                shares = np.linalg.solve(edges, (places - first).T).T
                inside = (shares.min(axis=1) >= -1e-9) & (shares.sum(axis=1) <= 1 + 1e-9)
                for place, share in zip(places[inside], shares[inside], strict=True):
                    at, origin = tuple(place), sites[0] + share @ (sites[1:] - sites[0])
                    if state[at] < value:
                        state[at], source[at] = value, origin
                    elif value == 2 and np.abs(source[at] - origin).max() > 1:
                        state[at] = 3
    return source, state


@pytest.mark.parametrize(
    ("kind", "seed", "shape"),
    [
        *((kind, 0, (4, 5, 6)) for kind in MOTIONS),
        *(pytest.param(kind, 1, (6, 7, 8), marks=pytest.mark.campaign) for kind in MOTIONS),
    ],
)
def test_the_rasteriser_draws_each_cell_as_its_tetrahedra(kind, seed, shape, monkeypatch):
    monkeypatch.setattr(tetrahedron_raster, "refine", lambda *_: None)
    d, tissue = random_motion(kind, seed, shape)
    moved, tissue = moved_sites(d, SIZE, tissue)
    source, state = inverse_raster(moved, tissue)
    expected, states = rasterise_one_by_one(moved, tissue)
    covered = states > 0
    assert covered.sum() > 20
    np.testing.assert_array_equal(state[covered], states[covered])
    np.testing.assert_allclose(source[covered], expected[covered], atol=1e-8)
    assert set(np.unique(state[~covered])) <= {0, 2}  # outlines
    still = ~tissue & (state == 0)
    np.testing.assert_array_equal(source[still], np.argwhere(still))


@pytest.mark.parametrize("seed", [0, 1])
def test_the_inverse_map_inverts_the_motion_of_points(seed):
    d, size = random_motion("smooth", seed)[0], SIZE
    tissue = np.ones(d.shape[:3], bool)
    tissue[0, 0, 0] = False
    moved, _ = moved_sites(d, size, tissue)
    source, state = inverse_raster(moved, tissue)
    inner = np.s_[1:-1, 1:-1, 1:-1]
    assert (state[inner] == 2).all()
    origins = source[inner].reshape(-1, 3)
    within = (origins >= 0).all(axis=1) & (origins <= np.array(tissue.shape) - 1).all(axis=1)
    whole = within & (origins > 1).any(axis=1)  # the first cell lacks a site
    ends = moved_points(origins[whole], d, spacing=size)
    sites = np.moveaxis(np.indices(tissue.shape), 0, -1)[inner].reshape(-1, 3)
    np.testing.assert_allclose(ends, sites[whole], atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [*((kind, (11, 9, 10)) for kind in MOTIONS), ("smooth", (1, 7, 8)), ("rough", (2, 1, 3))],
)
def test_compiled_determinants_match_numpy(kind, shape, monkeypatch):
    d, tissue = random_motion(kind, shape=shape)
    asked = [
        lambda: smallest_determinant(d, SIZE, tissue),
        lambda: jacobian_determinant(d, spacing=SIZE, tissue=tissue),
        lambda: determinant_or_fold(d, SIZE, tissue),
    ]
    found = [each() for each in asked]
    monkeypatch.setattr(loops, "ready_for_volumes", lambda: False)
    for one, each in zip(found, asked, strict=True):
        assert one.dtype == np.float32
        np.testing.assert_array_equal(one, each())
    if kind == "rough" and min(shape) > 1:
        assert (found[0] <= 0).any()


@pytest.mark.parametrize("kind", MOTIONS)
def test_compiled_strains_match_numpy(kind, monkeypatch):
    d, tissue = random_motion(kind, shape=(10, 4, 5))
    asked = deformation_gradient, small_strain, green_lagrange_strain
    found = [each(d, spacing=SIZE, tissue=tissue) for each in asked]
    monkeypatch.setattr(loops, "ready_for_volumes", lambda: False)
    for one, each in zip(found, asked, strict=True):
        np.testing.assert_array_equal(one, each(d, spacing=SIZE, tissue=tissue))


KINDS = ["u1", "i2", "u2", "i4", "i8", "u8", "f2", "f4", "f8", ">f4", ">i8", "bool"]


@pytest.mark.parametrize(
    ("kind", "order"),
    [*((kind, 1) for kind in KINDS), *((kind, order) for kind in ("u1", "f4") for order in (0, 2))],
)
def test_compiled_resampling_matches_scipy(kind, order, monkeypatch):
    random, shape = np.random.default_rng(4), (7, 6, 5)
    source = random.uniform(-2, 8, (*shape, 3))
    covered = random.random(shape) < 0.8
    source[~covered] = np.nan
    image = random.integers(0, 2 if kind == "bool" else 120, (*shape, 2)).astype(kind)
    if image.dtype.kind in "iu":
        image.flat[::7] = np.iinfo(kind).max
    if image.dtype.kind == "f":
        image.flat[::37], image.flat[5] = np.nan, np.inf
    for picture in (image, image[..., 0]):
        found = resample(picture, source, covered, order=order, fill=1)
        with monkeypatch.context() as none:
            none.setattr(loops, "ready_for_volumes", lambda: False)
            expected = resample(picture, source, covered, order=order, fill=1)
        assert found.dtype.name == picture.dtype.name
        np.testing.assert_allclose(found.astype(float), expected.astype(float), rtol=1e-3)


def test_an_infinite_source_position_is_reported():
    source = np.zeros((3, 3, 3, 3))
    source[1, 1, 1, 2] = np.inf
    with pytest.raises(ProblemError, match="are NaN or infinite at 1 covered pixels"):
        resample(np.zeros((3, 3, 3)), source, np.ones((3, 3, 3)))


class CompilingMultigrid(Multigrid):
    """Iteration that compiles a further loop, like volumes in double precision."""

    def run(self, *arguments):
        numba.njit(lambda number: number + 1)(1.0)
        return super().run(*arguments)


def test_compilation_during_a_solve_is_reported():
    c = np.zeros((6, 6, 6, 3))
    c[0] = c[-1] = 1
    problem, told = Problem(observed=c, confidence=c, stiffness=np.ones(c.shape[:3])), []
    solve(problem, ElasticPrior(), optimizer=Multigrid(), backend="cpu")
    how = {"backend": "cpu", "progress": lambda monitor: told.append(monitor.message)}
    solve(problem, ElasticPrior(), optimizer=CompilingMultigrid(), **how)
    said = [number for number, words in enumerate(told) if words.startswith(PREPARING)]
    assert said
    assert said[-1] < len(told) - 1

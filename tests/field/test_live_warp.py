"""Repeated warps of the same pictures, compared with `warp`."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from napari_hmrf import warp
from napari_hmrf.compute.compile_cache.loops import only_read
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.field.interpolation import look_up
from napari_hmrf.field.live_warp import Picture, Warper
from napari_hmrf.field.triangle_raster import rasterise, rasterise_displaced
from napari_hmrf.field.warp import moved_sites

SHAPE = (37, 45)


def rough_field(seed, amplitude, shape=SHAPE):
    """Return waves, a shift and noise that folds some tissue."""
    random = np.random.default_rng(seed)
    row, col = np.indices(shape) / max(shape) * 6
    waves = np.stack([np.sin(row + 1.3 * col), np.cos(1.1 * row - col)], axis=-1)
    noise = random.uniform(-1, 1, (*shape, 2)) * random.choice([0, 0.2, 1])
    return (amplitude * (waves + noise + random.uniform(-1, 1, 2))).astype(np.float32)


def some_tissue(seed, shape=SHAPE):
    """Return bodies with ragged borders, thin lines and single pixels."""
    random = np.random.default_rng(seed)
    row, col = np.indices(shape)
    tissue = np.hypot(row - 18, col - 15) < 13
    tissue[5:30, 36:42] = True
    tissue[33] = tissue[:, 44] = True
    return tissue ^ (random.random(shape) < 0.03)


def moved(warper, *arguments, **keywords):
    return compute_thread.submit(lambda: warper(*arguments, **keywords)).result()


def image_of(kind, shape=SHAPE):
    random = np.random.default_rng(3)
    if kind == "colour":
        return random.integers(0, 256, (*shape, 3)).astype(np.uint8)
    if kind == "gaps":
        image = random.normal(size=shape).astype(np.float32)
        image[4:6, 7], image[20, 20] = np.nan, np.inf
        return image
    dtype = np.dtype(kind)
    if dtype.kind == "f":
        return random.normal(size=shape).astype(dtype)
    top = 1 if dtype.kind == "b" else np.iinfo(dtype).max
    return random.integers(0, top, shape, dtype=np.uint64).astype(dtype)


KINDS = ["uint8", "colour", "float32", "gaps", "bool", "uint16", "float16", "float64", "int64"]


@pytest.mark.parametrize(
    ("kind", "order"),
    [
        *((kind, 1) for kind in [*KINDS, ">u2"]),
        *((kind, order) for kind in ("colour", "gaps", "int64") for order in (0, 3)),
    ],
)
def test_the_live_warp_matches_warp_for_every_type_of_image(kind, order):
    image, d, tissue = image_of(kind), rough_field(1, 2.5), some_tissue(1)
    fill = 1
    (found,) = moved(Warper([Picture(image, order=order, fill=fill)], spacing=(1, 1)), d, tissue)
    expected = warp(image, d, spacing=1, order=order, tissue=tissue, fill=fill)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@settings(max_examples=20)
@example(1528, 3.0, (1, 1), 1.0)
@given(
    st.integers(0, 10_000),
    st.sampled_from([0.0, 0.4, 3.0, 15.0, 500.0]),
    st.sampled_from([(1, 1), (2.0, 0.5), (0.31, 0.77)]),
    st.sampled_from([0.0, 0.25, 0.9, 1.0, -1.0]),
)
def test_the_live_warp_matches_warp_for_random_motion_with_folds(
    seed, amplitude, spacing, fraction
):
    d = rough_field(seed, amplitude) * np.float32(spacing)
    tissue = some_tissue(seed) if seed % 2 else None
    image = image_of("colour" if seed % 3 else "uint8")
    (found,) = moved(Warper(image, spacing=spacing), d, tissue, fraction)
    part = fraction * d.astype(float)
    expected = warp(image, part, spacing=spacing, tissue=tissue)
    # A value halfway between two integers may be rounded either way.
    exact = warp(image.astype(float), part, spacing=spacing, tissue=tissue)
    half = np.abs(exact - np.floor(exact) - 0.5) < 1e-9
    np.testing.assert_array_equal(found[~half], expected[~half])
    assert np.abs(found[half].astype(int) - expected[half].astype(int)).max(initial=0) <= 1


@pytest.mark.parametrize("bands", [1, 2, 5, 37])
def test_the_number_of_bands_does_not_change_the_result(bands):
    d, tissue = rough_field(5, 4.0), some_tissue(5)
    d[:, 36:42, 1] += 2 * (38.5 - np.arange(36, 42)) + 3  # turn a body over
    d, tissue = only_read(d), only_read(tissue)
    moved, _ = moved_sites(d, (1, 1), tissue)
    source, state = rasterise(moved, tissue)
    ours = np.empty((*SHAPE, 2)), np.empty((SHAPE[0], 2)), np.zeros_like(source), state.copy()
    fine = np.empty(SHAPE[0], bool)

    def draw():
        rasterise_displaced(d, (1.0, 1.0), 1.0, tissue, bands, *ours, fine)

    compute_thread.submit(draw).result()
    assert fine.all()
    np.testing.assert_array_equal(ours[3], state)
    np.testing.assert_array_equal(ours[2][state > 0], source[state > 0])
    assert {0, 1, 2, 3} == set(np.unique(state)), "the field should have folded"


def test_a_warp_does_not_depend_on_earlier_warps():
    image = image_of("uint8")
    warper = Warper(image, spacing=(1, 1))
    for seed, amplitude in ((1, 5.0), (2, 0.0), (3, 50.0), (4, 1.0)):
        d, tissue = rough_field(seed, amplitude), some_tissue(seed)
        np.testing.assert_array_equal(
            moved(warper, d, tissue)[0], warp(image, d, spacing=1, order=1, tissue=tissue)
        )


def test_a_delivered_image_is_not_overwritten():
    warper = Warper(image_of("uint8"), spacing=(1, 1))
    (first,) = moved(warper, rough_field(1, 3.0))
    before = first.copy()
    moved(warper, rough_field(2, 3.0))
    np.testing.assert_array_equal(first, before)


def test_several_pictures_are_warped_together():
    image, labels, d = image_of("uint8"), image_of("int64") % 7, rough_field(1, 3.0)
    one, two = moved(Warper([Picture(image), Picture(labels, order=0)], spacing=(1, 1)), d)
    np.testing.assert_array_equal(one, warp(image, d, spacing=1))
    np.testing.assert_array_equal(two, warp(labels, d, spacing=1, order=0))


@pytest.mark.parametrize("kind", ["int64", "uint64"])
def test_large_labels_keep_every_bit(kind):
    numbers = np.random.default_rng(3).integers(0, 256, (*SHAPE, 8), np.uint8)
    labels, d = numbers.view(kind)[..., 0], rough_field(1, 3.0)
    labels[:, ::2] = np.iinfo(kind).max  # not exact as a float
    labels[::2] |= labels.dtype.type(0x7FF0 << 48)
    (found,) = moved(Warper([Picture(labels, order=0)], spacing=(1, 1)), d)
    np.testing.assert_array_equal(found, warp(labels, d, spacing=1, order=0))


def test_no_image_type_compiles_a_loop_for_another_signature():
    def there():
        return [set(loop.compiled.signatures) for loop in (look_up, rasterise_displaced)]

    def move(kind, order, read_only):
        image, still = np.ones((9, 9), kind), np.zeros((9, 9, 2), np.float32)
        image.setflags(write=not read_only)
        still.setflags(write=not read_only)
        moved(Warper([Picture(image, order=order)], spacing=(1, 1)), still)

    for kind in ("uint8", "float32", "float64"):
        move(kind, 1, read_only=False)
    before = there()
    for kind in "?bBhHiIlLefd":
        for order in (0, 1):
            move(kind, order, read_only=False)
            move(kind, order, read_only=True)
    assert there() == before


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (2, 2), (7, 13)])
def test_images_of_any_shape_are_warped(shape):
    image, d = image_of("uint8", shape), rough_field(0, 1.0, shape)
    np.testing.assert_array_equal(
        moved(Warper(image, spacing=(1, 1)), d)[0], warp(image, d, spacing=1)
    )


def test_the_displacement_of_void_is_ignored():
    image, tissue = image_of("uint8"), some_tissue(1)
    d = np.where(tissue[..., None], np.float32([0, 0]), np.float32(np.nan))
    np.testing.assert_array_equal(moved(Warper(image, spacing=(1, 1)), d, tissue)[0], image)


def test_any_thread_can_warp_pictures():
    image, d = image_of("uint8"), rough_field(0, 1.0)
    (found,) = Warper(image, spacing=(1, 1))(d)
    np.testing.assert_array_equal(found, warp(image, d, spacing=1))
    volume = np.random.default_rng(1).random((6, 7, 8))
    motion = np.full((6, 7, 8, 3), 0.5, np.float32)
    (plane,) = Warper(volume, spacing=(1, 1, 1)).slice(3, motion)
    np.testing.assert_allclose(plane, warp(volume, motion, spacing=1)[3], atol=1e-6)

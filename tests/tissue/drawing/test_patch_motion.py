"""Tests of patches that hold each of their pixels at a displacement of its own."""

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import Arrow, Drawing, Landmark, ProblemError
from napari_hmrf.study.coarse_grid import CoarseGrid
from napari_hmrf.tissue.drawing import Canvas
from napari_hmrf.tissue.drawing.canvas import box_of, covered
from napari_hmrf.tissue.drawing.extents import SliceInVolume
from napari_hmrf.tissue.drawing.patch_motion import PatchMotion, present_motion

SPACING = (0.5, 2.0)


def field_at(points):
    """Return a smooth displacement at points in pixels, which is not linear."""
    rows, cols = np.moveaxis(np.asarray(points, dtype=float), -1, 0)[-2:]
    along = np.stack([np.sin(rows / 9) * cols / 20, 3 * np.cos(cols / 7)], axis=-1)
    return np.concatenate([np.ones((*rows.shape, np.shape(points)[-1] - 2)), along], axis=-1)


def held(mark, shape, motion=field_at, spacing=SPACING):
    """Return a mark that holds its patch at a present motion."""
    box = box_of(mark, spacing, tuple(slice(0, size) for size in shape))
    return replace(mark, motion=present_motion(box, spacing, motion))


def sites(shape):
    return np.moveaxis(np.indices(shape), 0, -1)


@pytest.mark.parametrize("radius", [1.0, 8.0, 40.0])
def test_a_held_patch_keeps_the_motion_of_each_pixel(radius):
    shape = (200, 90)
    mark = held(Arrow((60.3, 30.6), (0, 0), radius), shape)
    observed = Drawing((mark,)).render(Canvas.blank(shape, SPACING)).observed
    under = covered(mark, SPACING, tuple(slice(0, size) for size in shape))
    error = np.abs(observed - field_at(sites(shape)))[under].max()
    assert error < (0.1 if radius == 40 else 1e-3)
    assert not observed[~under].any()
    assert len(mark.motion.values) <= 2 * 4096


def test_a_held_patch_of_one_component_leaves_the_other_component_free():
    mark = held(Arrow((20, 30), (0, 0), 6.0, components="col"), (50, 60))
    canvas = Drawing((mark,)).render(Canvas.blank((50, 60), SPACING))
    assert not canvas.confidence[..., 0].any()
    assert canvas.observed[20, 32, 1] == pytest.approx(field_at((20, 32))[1], abs=1e-3)


def test_the_motion_beside_tissue_does_not_change_the_motion_of_tissue():
    tissue = sites((200, 90))[..., 0] < 61

    def in_tissue(points):
        inside = tissue[tuple(points.astype(int).T)]
        return np.where(inside[:, np.newaxis], field_at(points), np.nan)

    mark = held(Arrow((50, 30), (0, 0), 40.0), tissue.shape, in_tissue)
    observed = Drawing((mark,)).render(Canvas.blank(tissue.shape, SPACING)).observed
    assert observed[59:61, 30] == pytest.approx(field_at([(59, 30), (60, 30)]), abs=0.1)


def test_tissue_that_moves_as_a_block_has_no_motion_of_single_pixels():
    for by in ((0.0, 0.0), (3.0, -2.0)):
        assert (
            held(Arrow((20, 30), by, 6.0), (50, 60), lambda at, by=by: at * 0 + by).motion is None
        )
    assert held(Arrow((20, 30), (1, 1), 6.0), (50, 60), lambda at: at * np.nan).motion is None


@pytest.mark.parametrize(
    "mark", [Arrow((20, 30), (1, 2), 6.0), Landmark((20, 30), (21, 30), 6.0)], ids=["arrow", "mark"]
)
def test_a_held_patch_is_saved_and_painted_on_a_coarse_grid(mark):
    drawing = Drawing((held(mark, (50, 60)),))
    assert Drawing.from_dict(drawing.as_dict()) == drawing
    assert len(repr(drawing.marks[0])) < 300
    coarse = CoarseGrid(2).drawing(drawing)
    canvas = coarse.render(Canvas.blank((25, 30), (1.0, 4.0)))
    assert canvas.observed[11, 15] == pytest.approx(field_at((22, 30)), abs=1e-3)


def test_patches_with_equal_values_are_equal_and_other_values_are_seen():
    mark = held(Arrow((20, 30), (1, 2), 6.0), (50, 60))
    values = mark.motion.values.copy()
    same = replace(mark, motion=replace(mark.motion, values=values.tolist()))
    assert (same, hash(same)) == (mark, hash(mark))
    values[7] += 1e-3
    assert replace(mark, motion=replace(mark.motion, values=values)) != mark
    assert replace(mark, motion=None) != mark


def test_the_values_of_a_patch_cannot_be_changed_and_are_shared_by_edited_marks():
    values = np.zeros(4, np.float32)
    motion = PatchMotion((1, 2), 1, (1, 2), values)
    values[0] = 9
    assert not motion.values.any()
    with pytest.raises(ValueError, match="read-only"):
        motion.values[0] = 9
    mark = Arrow((1, 2), (0, 0), 6.0, motion=motion)
    for other in (replace(mark, radius=8.0), CoarseGrid(2).drawing(Drawing((mark,))).marks[0]):
        assert other.motion.values is motion.values


@pytest.mark.parametrize("axes", [(1, 2), (0, 1), (2, 0)])
def test_a_held_patch_of_a_slice_is_carried_to_the_volume_and_back(axes):
    place = SliceInVolume(axes, 7)
    mark = held(Arrow((20, 30), (1, 2), 6.0), (50, 60))
    raised = place.to_volume(mark)
    at, by = [7, 7, 7], [0.0, 0.0, 0.0]
    for axis, index, along in zip(axes, (22, 31), field_at((22, 31)), strict=True):
        at[axis], by[axis] = index, along
    box = tuple(slice(index, index + 1) for index in at)
    assert raised.motion.on(box).ravel() == pytest.approx(by, abs=1e-3)
    assert place.to_slice(raised) == mark


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": (1.0,)},
        {"shape": (0, 2)},
        {"step": 0},
        {"start": (np.nan, 1)},
        {"start": (1, 2, 3)},
        {"values": (0.0, 1.0, 2.0, np.nan)},
        {"values": (0.0, 1.0, 2.0, 1e300)},
    ],
    ids=str,
)
def test_an_incomplete_motion_is_refused(wrong):
    right = {"start": (1, 2), "step": 1, "shape": (1, 2), "values": (0.0, 1.0, 2.0, 3.0)}
    assert PatchMotion(**right).array.shape == (1, 2, 2)
    with pytest.raises(ProblemError, match="invalid motion"):
        PatchMotion(**{**right, **wrong})

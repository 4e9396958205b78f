"""Unfolded problem: one field for each of the parts that slide along each other (`coupling`)."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.field.neighbours import around_sites, in_elements, of_corners
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.coupling import Box, Coupling, Index
from napari_hmrf.solver.interface_normals import interface_surface
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.priors import Elastic
from napari_hmrf.solver.priors.elements import stiffest
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.uncertain_landmarks import ROUNDING, Landmarks, corners_of

Mask = npt.NDArray[np.bool_]
Values = npt.NDArray[Any]

#: Stiffness of a copy, relative to the part's own sites next to it. An element has the mean
#: stiffness of its sites, so a copy adds almost nothing; 0 would remove the element.
COPY_STIFFNESS = 1e-8
# Number of sites around an interface that determine its normals.
_MARGIN = 50


class UnfoldedProblem(Problem):
    """Problem on the unfolded grid of the parts, with their coupling.

    Attributes
    ----------
    between : Coupling
        Coupling of the parts.
    """

    between: Coupling

    @property
    def coupling(self) -> Coupling:
        """Coupling of the parts."""
        return self.between

    def with_coupling(self, between: Coupling) -> UnfoldedProblem:
        """Return the same problem with another coupling."""
        made = copy.copy(self)
        object.__setattr__(made, "between", between)
        return made


class _Part(NamedTuple):
    """Part in its box: its own sites, and the copies of sites of other parts."""

    number: int
    box: Index
    own: Mask
    copies: Mask


def unfolded(problem: Problem, prior: Elastic) -> tuple[UnfoldedProblem, Elastic]:
    """Return the unfolded problem of sliding parts, and the prior for its grid.

    Parameters
    ----------
    problem : Problem
        Problem with `SlidingParts`.
    prior : ElasticPrior or NeoHookeanPrior
    """
    m = problem.stiffness
    _, numbers, parts, between = _layout.get(
        lambda last: last.is_valid_for(problem), lambda: _layout_of(problem)
    )
    boxes, grid = between.boxes, between.own.shape

    def of_own(values: Values) -> Values:
        """Return values at own sites, and 0 elsewhere."""
        made = np.zeros((*grid, *values.shape[m.ndim :]), values.dtype)
        for part, box in zip(parts, boxes, strict=True):
            made[box.unfolded][part.own] = values[box.image][part.own]
        made.setflags(write=False)
        return made

    def of_all(values: Values) -> Values:
        """Return values at own sites, and the mean of the own soft sites around a copy."""
        made = of_own(values).copy()
        for part, box in zip(parts, boxes, strict=True):
            _fill(made[box.unfolded], part, part.own & ~problem.rigid[box.image])
        made.setflags(write=False)
        return made

    stiffness = of_all(m).copy()
    for part, box in zip(parts, boxes, strict=True):
        of_part = stiffness[box.unfolded]
        if problem.rigid[box.image][part.own].all():
            of_part[part.copies] = stiffest(m)  # all elements are rigid, whatever this value
        else:
            of_part[part.copies] *= np.float32(COPY_STIFFNESS)
    stiffness.setflags(write=False)
    loads = problem.loads
    if loads is not None:
        loads = Loads(
            growth=None if loads.growth is None else of_all(loads.growth),
            force=None if loads.force is None else of_own(loads.force),
            spacing=loads.spacing,
        )
    made = object.__new__(UnfoldedProblem)
    for name, value in {
        "observed": of_own(problem.observed),
        "confidence": of_own(problem.confidence),
        "stiffness": stiffness,
        "spacing": problem.spacing,
        "loads": loads,
        "precision": None if problem.precision is None else of_own(problem.precision),
        "landmarks": _landmarks_of_parts(problem, numbers, boxes),
        "sliding": None,
        "between": between,
    }.items():
        object.__setattr__(made, name, value)
    if isinstance(prior.poisson, np.ndarray):
        prior = replace(prior, poisson=of_all(prior.poisson))
    return made, prior


class _Layout(NamedTuple):
    """Parts and coupling of the last problem, cached because each frame of a drag needs them."""

    problem: Problem
    numbers: npt.NDArray[np.intp]
    parts: list[_Part]
    between: Coupling

    def is_valid_for(self, problem: Problem) -> bool:
        """Return whether a problem has the same parts; its observations may differ."""
        one, two = self.problem.sliding, problem.sliding
        assert one is not None
        assert two is not None
        return (
            self.problem.spacing == problem.spacing
            and one.strength == two.strength
            and np.array_equal(one.labels, two.labels)
            and are_equal(self.problem.stiffness, problem.stiffness)
        )


_layout: Kept[_Layout] = Kept(is_large=True)


def _layout_of(problem: Problem) -> _Layout:
    """Return the parts and their coupling."""
    numbers = _numbers(problem)
    parts = list(_parts(numbers, problem.stiffness))
    boxes = _boxes(parts)
    ends = np.array([[side.stop for side in box.unfolded] for box in boxes])
    own = np.zeros(tuple(map(int, ends.max(axis=0))), np.bool_)
    for part, box in zip(parts, boxes, strict=True):
        own[box.unfolded] = part.own
    return _Layout(problem, numbers, parts, _coupling(problem, numbers, parts, boxes, own))


def _numbers(problem: Problem) -> npt.NDArray[np.intp]:
    """Return the number of the part of each site of tissue, from 1; 0 in void."""
    assert problem.sliding is not None
    numbers = np.zeros(problem.shape, np.intp)
    tissue = problem.tissue
    numbers[tissue] = np.unique(problem.sliding.labels[tissue], return_inverse=True)[1] + 1
    return numbers


def _parts(numbers: npt.NDArray[np.intp], m: Values) -> Iterator[_Part]:
    """Yield the parts; the box of a part includes its copies."""
    for number, found in enumerate(scipy.ndimage.find_objects(numbers), start=1):
        compute_thread.check_cancelled()
        box = tuple(
            slice(max(side.start - 1, 0), min(side.stop + 1, length))
            for side, length in zip(found, numbers.shape, strict=True)
        )
        own = numbers[box] == number
        elements = in_elements(m[box]) & of_corners(own, np.logical_or)
        copies = around_sites(elements, np.logical_or) & ~own
        yield _Part(number, box, own, copies)


def _boxes(parts: list[_Part]) -> tuple[Box, ...]:
    """Place the boxes below each other, with a row of void between them."""
    boxes, start = [], 0
    for part in parts:
        sizes = part.own.shape
        across = tuple(slice(0, size) for size in sizes[1:])
        boxes.append(Box(part.box, (slice(start, start + sizes[0]), *across)))
        start += sizes[0] + 1
    return tuple(boxes)


def _landmarks_of_parts(
    problem: Problem, numbers: npt.NDArray[np.intp], boxes: tuple[Box, ...]
) -> Landmarks | None:
    """Return the landmarks in the field of the part that owns the site nearest to each of them."""
    marks = problem.landmarks
    if marks is None:
        return None
    elements, within = corners_of(marks.points, problem.shape)
    nearest = elements + (within > 0.5)
    starts = np.array(
        [[there.start - here.start for here, there in zip(*box, strict=True)] for box in boxes]
    )
    moves = starts[numbers[tuple(nearest.T)] - 1]
    # A point on the far side of its element must not count as a point of the next element, which
    # may not exist in this field.
    points = elements + moves + np.minimum(within, 1 - ROUNDING)
    return marks.placed(points, marks.scale.resolved(problem.stiffness, problem.spacing))


def _fill(values: Values, part: _Part, known: Mask) -> None:
    """Set the values of copies to the mean of the known sites around them, in place.

    A copy without such sites, which is beside rigid tissue only, gets the mean of all known sites.
    """
    if not known.any():
        return
    counts = _sums(known.astype(np.float64))[part.copies]
    flat = values.reshape(*part.own.shape, -1)
    for number in range(flat.shape[-1]):
        own = np.where(known, flat[..., number], 0).astype(np.float64)
        means = _sums(own)[part.copies] / np.maximum(counts, 1)
        means[counts < 0.5] = own.sum() / np.count_nonzero(known)
        values.reshape(*part.own.shape, -1)[..., number][part.copies] = means


def _sums(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the sums over each site and the sites around it."""
    return np.asarray(scipy.ndimage.convolve(values, np.ones((3,) * values.ndim), mode="constant"))


def _coupling(
    problem: Problem,
    numbers: npt.NDArray[np.intp],
    parts: list[_Part],
    boxes: tuple[Box, ...],
    own: Mask,
) -> Coupling:
    """Return the coupling of each copy with the site that it copies."""
    axes, m = numbers.ndim, problem.stiffness
    at: list[Values] = []
    second: list[Values] = []
    of_copy: list[Values] = []
    for part, box in zip(parts, boxes, strict=True):
        inside = np.argwhere(part.copies)
        at.append(inside + np.array([side.start for side in box.image]))
        origin = np.array([side.start for side in box.unfolded])
        second.append(np.ravel_multi_index(tuple((inside + origin).T), own.shape))
        of_copy.append(np.full(len(inside), part.number))
    sites, copied = np.concatenate(at), np.concatenate(of_copy)
    owner = numbers[tuple(sites.T)]
    first = np.zeros(len(sites), np.intp)
    soft = np.full(len(sites), np.inf)
    for part, box in zip(parts, boxes, strict=True):
        start = np.array([side.start for side in box.image])
        move = np.array([side.start for side in box.unfolded]) - start
        mine = owner == part.number
        first[mine] = np.ravel_multi_index(tuple((sites[mine] + move).T), own.shape)
        near = scipy.ndimage.maximum_filter(np.where(part.own, m[box.image], 0), 3)
        both = mine | (copied == part.number)
        soft[both] = np.minimum(soft[both], near[tuple((sites[both] - start).T)])
    normals, distances = np.zeros((len(sites), axes)), np.zeros(len(sites))
    low, high = np.minimum(owner, copied), np.maximum(owner, copied)
    for one, two in np.unique(np.stack([low, high], axis=1), axis=0):
        compute_thread.check_cancelled()
        mine = (low == one) & (high == two)
        normals[mine], distances[mine] = _surface(
            numbers, int(one), int(two), sites[mine], problem.spacing
        )
    assert problem.sliding is not None
    soft = np.minimum(soft, stiffest(m))  # also between two rigid bodies
    strength = problem.sliding.strength * soft * problem.unit ** (axes - 2)
    distances /= problem.unit
    return Coupling(first, np.concatenate(second), normals, distances, strength, m, boxes, own)


def _surface(
    numbers: npt.NDArray[np.intp],
    one: int,
    two: int,
    sites: npt.NDArray[np.intp],
    spacing: tuple[float, ...],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the interface between two parts (`interface_surface`), from a box around its sites."""
    size = np.asarray(spacing) / max(spacing)
    margin = np.ceil(_MARGIN / size).astype(int)
    low = np.maximum(sites.min(axis=0) - margin, 0)
    high = np.minimum(sites.max(axis=0) + margin + 1, numbers.shape)
    near = numbers[tuple(itertools.starmap(slice, zip(low, high, strict=True)))]
    return interface_surface(near == one, near == two, sites - low, spacing)

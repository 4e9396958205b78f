"""Problem as its sites with an equation see it, and the motion of the others (`followers`).

A solve moves the sites that have an equation. Before the solve, forces on the other sites, the
orphans, move to the sites that they follow, and so do observations that no observation of tissue
beside them represents: the nearest connected site takes them. After the solve, the orphans follow.

Elastic tissue moves the sites of its elements. In the paper's model, a component of a site has an
equation if the site is in a clique that contributes to this component. A clique of the centred
reading determines its middle site only, so the end of a line that is one site wide has no equation,
although it is in a clique. In this reading, such lines therefore follow as a whole, and leave the
solve, except pixels that are observed in all components that are in a clique. What follows relies
on sites that are observed, or in the middle of a clique: in this reading, others stay at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.followers import Followers, around, find_followers, followers_of, remembered
from napari_hmrf.field.neighbours import in_elements
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.priors import Prior, SeilerPrior
from napari_hmrf.solver.priors.seiler import in_cliques
from napari_hmrf.solver.problem import Problem, variant_of

Mask = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]


class Connected(NamedTuple):
    """Problem whose observations and forces are at sites with an equation.

    Attributes
    ----------
    problem : Problem
        Problem to solve; the given problem, if nothing had to move.
    given : Problem
    followers : tuple of (Followers or None)
        Orphans in each component of the displacement, whose observations and forces move.
    extension : tuple of (Followers or None)
        Sites in each component that follow after the solve: orphans that are not held exactly. In
        the paper's model, they also follow sites that are, wherever these are.
    acts : ndarray of bool, shape (2, H, W) or (3, D, H, W), or None
        Mask of the components in a clique, in the paper's model.
    notes : tuple of str
        Clauses for the user.
    """

    problem: Problem
    given: Problem
    followers: tuple[Followers | None, ...]
    extension: tuple[Followers | None, ...]
    acts: Mask | None
    notes: tuple[str, ...]

    def extend(self, displacement: npt.NDArray[np.floating]) -> None:
        """Let the orphans follow, in place, except where they are held exactly.

        Parameters
        ----------
        displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
            Displacement of the solve, in the unit of the spacing.
        """
        flat = displacement.reshape(-1, displacement.shape[-1])
        if self.problem.tissue is not self.given.tissue:
            left = self.given.tissue & ~self.problem.tissue
            seen = left[..., None] & self.given.known
            displacement[seen] = self.given.observed[seen]
        for component, each in enumerate(self.extension):
            if each is None:
                continue
            held = _at(self.given.known, component, each.sites)
            exact = _at(self.given.confidence, component, each.sites) >= 1
            if self.acts is not None:
                exact |= self.acts[component].ravel()[each.sites]
            free = np.flatnonzero(~(held & exact))
            moved = each.values @ flat[each.sources, component].astype(np.float64)
            flat[each.sites[free], component] = moved[free]

    def carried(self, force: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return forces, shape (H, W, 2) or (D, H, W, 3), that act on connected sites only."""
        first = self.followers[0]  # only elastic tissue has forces, and its components are alike
        return force if first is None else first.carried(force)

    def returned(self, reaction: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return reactions, with those of observations that have moved at their orphans again."""
        if self.problem is self.given:
            return reaction
        taken = self.problem.known & ~self.given.known
        of_observed = np.where(taken, 0.0, reaction)
        flat = of_observed.reshape(-1, reaction.shape[-1])
        for component, each in enumerate(self.followers):
            if each is None:
                continue
            at = _at(self.given.known, component, each.sites)
            at &= _at(taken, component, each.nearest)
            near, place, count = np.unique(
                each.nearest[at], return_inverse=True, return_counts=True
            )
            flat[each.sites[at], component] = (_at(reaction, component, near) / count)[place]
        return of_observed

    @property
    def without_orphans(self) -> Problem:
        """Problem to solve, without the precision of orphans, which have no energy."""
        first, precision = self.followers[0], self.problem.precision
        if first is None or precision is None or not _tensors(precision)[first.sites].any():
            return self.problem
        rest = precision.copy()
        _tensors(rest)[first.sites] = 0
        rest.setflags(write=False)
        return variant_of(self.problem, precision=rest)


def connected(problem: Problem, prior: Prior | None) -> Connected:
    """Return a problem whose observations and forces are at sites with an equation.

    Parameters
    ----------
    problem : Problem
    prior : Prior or None
        By default elastic tissue.
    """
    axes = len(problem.shape)
    solved, acts, bridges = problem, None, 0
    if isinstance(prior, SeilerPrior):
        solved, of_components, extension, acts, bridges = _of_cliques(problem, prior)
    else:
        found = followers_of(problem.tissue, None, problem.rigid if problem.has_rigid else None)
        of_components = extension = (found,) * axes
        bridges = 0 if found is None else found.bridges
    sites, block = ("voxels", "2 x 2 x 2") if axes == 3 else ("pixels", "2 x 2")
    where, there = f"in no {block} block of tissue", "of such a block"
    if isinstance(prior, SeilerPrior):
        where, there = "in no clique for a component of its motion", "in such a clique"
    notes = []
    if any(each is not None for each in of_components):
        solved, moved = _with_moved_observations(solved, problem.known, of_components, acts)
        if moved:
            notes.append(
                f"{_count(moved, sites)} {where}, so the nearest {sites[:-1]} {there} takes the "
                "observation"
            )
        solved = _with_moved_forces(solved, of_components[0])
    if bridges:
        notes.append(
            f"tissue that is one {sites[:-1]} wide joins pieces of tissue, but transmits no force "
            f"between them ({bridges} {sites})"
        )
    return Connected(solved, problem, of_components, extension, acts, tuple(notes))


def _count(number: int, sites: str) -> str:
    return f"1 observed {sites[:-1]} is" if number == 1 else f"{number} observed {sites} are"


def _at(values: npt.NDArray[Any], component: int, sites: Indices) -> npt.NDArray[Any]:
    return np.asarray(values.reshape(-1, values.shape[-1])[sites, component])


def _tensors(precision: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return precision.reshape(-1, *precision.shape[-2:])


_Each = tuple[Followers | None, ...]


class _Window(NamedTuple):
    """Smallest box that contains all tissue.

    Attributes
    ----------
    grid : tuple of int
        Shape of the grid.
    box : tuple of slice
    """

    grid: tuple[int, ...]
    box: tuple[slice, ...]

    @classmethod
    def of(cls, tissue: Mask) -> _Window:
        axes = range(tissue.ndim)
        along = (tissue.any(axis=tuple(each for each in axes if each != axis)) for axis in axes)
        ends = (np.flatnonzero(each)[[0, -1]] if each.any() else (0, 0) for each in along)
        return cls(tissue.shape, tuple(slice(int(first), int(last) + 1) for first, last in ends))

    def view(self, values: Mask) -> Mask:
        """Return the values in the box; a box of one slice is an image."""
        within = np.ascontiguousarray(values[self.box])
        is_slice = within.ndim == 3 and 1 in within.shape
        return within.squeeze(within.shape.index(1)) if is_slice else within

    def in_grid(self, sites: Indices) -> Indices:
        """Return the flat indices in the grid of sites of the box."""
        shape = tuple(each.stop - each.start for each in self.box)
        at = zip(np.unravel_index(sites, shape), self.box, strict=True)
        moved = tuple(each + box.start for each, box in at)
        indices: Indices = np.ravel_multi_index(moved, self.grid).astype(np.intp)
        return indices

    def placed(self, found: Followers) -> Followers:
        """Return followers of the box with their indices in the grid."""
        return replace(
            found,
            sites=self.in_grid(found.sites),
            nearest=self.in_grid(found.nearest),
            sources=self.in_grid(found.sources),
        )


class _Lines(NamedTuple):
    """Lines one site wide that follow blocks in the centred reading, and so leave the solve.

    Attributes
    ----------
    sites : ndarray of int, shape (m,)
    acts : ndarray of bool, shape (m, 2) or (m, 3)
        Mask of their components that are in a clique.
    bridges : int
    """

    sites: Indices
    acts: Mask
    bridges: int

    @classmethod
    def of(cls, tissue: Mask, window: _Window, spacing: tuple[float, ...]) -> _Lines | None:
        found = followers_of(window.view(tissue))
        if found is None:
            return None
        sites = window.in_grid(found.sites)
        acts = in_cliques(tissue, spacing).reshape(tissue.ndim, -1)[:, sites].T
        return cls(sites, acts, found.bridges)


def _of_cliques(problem: Problem, prior: SeilerPrior) -> tuple[Problem, _Each, _Each, Mask, int]:
    """Return the problem to solve, the followers of `Connected`, the cliques and the bridges."""
    tissue, spacing = problem.tissue, problem.spacing
    blanket, solved = prior.conditional == "blanket", problem

    def of_lines() -> tuple[_Window, _Lines | None]:
        window = _Window.of(tissue)
        return window, None if blanket else _Lines.of(tissue, window, spacing)

    kind = blanket, spacing
    window, lines = remembered((*kind, "lines"), (tissue,), of_lines)
    bridges = 0 if lines is None else lines.bridges
    if lines is not None:
        known = problem.known.reshape(-1, tissue.ndim)[lines.sites]
        away = lines.sites[(lines.acts & ~known).any(axis=1)]
        m = problem.stiffness.copy()
        m.reshape(-1)[away] = 0
        m.setflags(write=False)
        solved = variant_of(problem, stiffness=m)
        for name in ("tissue", "rigid", "known"):
            vars(solved).pop(name, None)

    def of_tissue() -> tuple[Mask, Mask, Mask, bool]:
        cliques, middle = (
            in_cliques(solved.tissue, spacing, middle=only) for only in (False, True)
        )
        joined = cliques.copy()
        if lines is not None:
            joined.reshape(tissue.ndim, -1)[:, lines.sites] = False
        return cliques, middle, joined, bool(joined[:, tissue].all())

    cliques, middle, joined, is_whole = remembered(kind, (tissue, solved.tissue), of_tissue)
    if is_whole:
        none = (None,) * tissue.ndim
        return solved, none, none, cliques, bridges
    known, certain = (np.moveaxis(each, -1, 0) for each in (problem.known, problem.confidence >= 1))
    held = known & (certain | cliques)

    def find() -> tuple[_Each, _Each]:
        sure = np.ones_like(middle) if blanket else middle | known
        within = window.view(tissue)
        elements = in_elements(within)

        def of(connected: Mask) -> _Each:
            pairs = zip(map(window.view, connected), map(window.view, sure), strict=True)
            found = (
                find_followers(within, each, each if blanket else elements, meant)
                for each, meant in pairs
            )
            return tuple(None if each is None else window.placed(each) for each in found)

        # An observation that no clique and no other site takes is the displacement of its site.
        followers, alone = of(joined), known & ~cliques
        for each, component in zip(followers, alone, strict=True):
            if each is not None:
                component.flat[each.sites] = False
        more = joined | held | alone
        return followers, followers if np.array_equal(more, joined) else of(more)

    parts = tissue, solved.tissue, *held, *known
    followers, extension = remembered((*kind, "held"), parts, find)
    return solved, followers, extension, cliques, bridges


def _with_moved_forces(problem: Problem, found: Followers | None) -> Problem:
    loads = problem.loads
    if found is None or loads is None or loads.force is None:
        return problem
    if not loads.force.reshape(-1, loads.force.shape[-1])[found.sites].any():
        return problem
    force = found.carried(loads.force)
    return variant_of(problem, loads=Loads(growth=loads.growth, force=force, spacing=loads.spacing))


def _with_moved_observations(
    problem: Problem, known: Mask, of_components: Sequence[Followers | None], acts: Mask | None
) -> tuple[Problem, int]:
    """Return the problem with observations of orphans at the nearest sites, and their number.

    The mask `known` has the observations of all tissue, also of sites that left the solve.
    An observation is not moved if tissue beside this site has an observation of its own: it then is
    the end of a mark that extends over connected tissue.
    """
    changed: dict[str, npt.NDArray[Any]] = {}
    moved: set[int] = set()
    confidence, observed = problem.confidence, problem.observed
    for component, found in enumerate(of_components):
        if found is None:
            continue
        moves = _at(known, component, found.sites)
        if acts is not None:
            moves &= ~acts[component].ravel()[found.sites]
        at = np.flatnonzero(moves)
        beside, near = _beside(problem, found, at)
        at = at[~(near & _at(problem.known, component, beside)).any(axis=1)]
        if not len(at):
            continue
        if not changed:
            changed = {"confidence": confidence.copy(), "observed": observed.copy()}
        _take(changed, found, at, component, confidence, observed)
        moved.update(found.sites[at].tolist())
    first = of_components[0]
    if problem.precision is not None and first is not None:
        tensors = _tensors(problem.precision)
        at = np.flatnonzero(tensors[first.sites].any(axis=(1, 2)))
        beside, near = _beside(problem, first, at)
        given = tensors[beside].any(axis=(-2, -1))
        given |= problem.known.reshape(-1, len(problem.shape))[beside].any(axis=-1)
        at = at[~(near & given).any(axis=1)]
        if changed:  # a site that is held takes no other observation
            taken = changed["confidence"].reshape(-1, observed.shape[-1])[first.nearest[at]]
            at = at[~taken.any(axis=1)]
        if len(at):
            changed.setdefault("observed", observed.copy())
            changed["precision"] = problem.precision.copy()
            _take_precision(changed, first, at, problem)
            moved.update(first.sites[at].tolist())
    if not changed:
        return problem, 0
    for values in changed.values():
        values.setflags(write=False)
    return variant_of(problem, **changed), len(moved)


def _beside(problem: Problem, found: Followers, at: Indices) -> tuple[Indices, Mask]:
    """Return the nearest sites of orphans and those around them, and a mask of all but orphans."""
    sites, inside = around(found.nearest[at], problem.shape)
    return sites, inside & ~np.isin(sites, found.sites)


def _take(
    changed: dict[str, npt.NDArray[Any]],
    found: Followers,
    at: Indices,
    component: int,
    confidence: npt.NDArray[Any],
    observed: npt.NDArray[Any],
) -> None:
    """Let the nearest sites take the mean of the most certain observations, in place."""
    sites, place = np.unique(found.nearest[at], return_inverse=True)
    certain, seen = (_at(each, component, found.sites[at]) for each in (confidence, observed))
    most = np.zeros(len(sites), np.float32)
    np.maximum.at(most, place, certain)
    counts = certain == most[place]
    mean = np.bincount(place, seen * counts) / np.bincount(place, counts)
    changed["confidence"].reshape(-1, confidence.shape[-1])[sites, component] = most
    changed["observed"].reshape(-1, observed.shape[-1])[sites, component] = mean


def _take_precision(
    changed: dict[str, npt.NDArray[Any]], found: Followers, at: Indices, problem: Problem
) -> None:
    """Let the nearest sites take the quadratic observations of orphans together, in place."""
    assert problem.precision is not None
    sites, place = np.unique(found.nearest[at], return_inverse=True)
    axes = len(problem.shape)
    tensors = _tensors(problem.precision)[found.sites[at]]
    seen = problem.observed.reshape(-1, axes)[found.sites[at]].astype(np.float64)
    total, pull = np.zeros((len(sites), axes, axes)), np.zeros((len(sites), axes))
    np.add.at(total, place, tensors)
    np.add.at(pull, place, np.einsum("sij,sj->si", tensors, seen))
    _tensors(changed["precision"])[sites] = total
    together = np.einsum("sij,sj->si", np.linalg.pinv(total, hermitian=True), pull)
    changed["observed"].reshape(-1, axes)[sites] = together

"""Solution of a linear system to a tolerance, by cycles or by a direct factorization.

Tissue is *mild* if a cycle reduces all of its motions. If the tissue is not mild, the iteration is
first tested in a trial run, the *rehearsal*, on a random field with a known solution
(`self_check.Rehearsal`). If its error estimate is reliable there, the iteration solves the problem.
Otherwise, or if the iteration stalls, the system is factorized.

The estimates of `krylov` are too small if the iteration has not found the softest motion. They are
multiplied by a margin that depends on what it may have missed:

===========================  =========  ==========================================================
tissue                       rehearsal  margin
===========================  =========  ==========================================================
mild, compressible image     no         1.5; a slow motion, which mild tissue has not, ends the run
mild image beside a gap      no         1.15, and the estimate must hold for an eigenvalue of 0.005
other mild tissue            no         4
other, or weakly held        yes        4 times the ratio of true to estimated error there, at
                                        least 1.5; 1.5 times more in volumes and for a warm
                                        start, 4 times more with rigid bodies close together
===========================  =========  ==========================================================

``python -m benchmarks.campaign images volumes gaps`` compares them with true errors. Large motion
(`newton`), slip (`slip`) and the centred reading (`centred`) have estimates of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto
from functools import partial
from typing import Any

import numpy as np

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.direct.dissection import Singular
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.direct.sparse_factors import Links
from napari_hmrf.solver.backends.earlier_results import Quality, StartQuality
from napari_hmrf.solver.backends.linear import Balance, LinearModel, OnDevice, Planes, Review
from napari_hmrf.solver.optimizers.base import (
    Monitor,
    Report,
    factorizing,
    part_done,
    words_of_cycle,
)
from napari_hmrf.solver.optimizers.cycle import Cycle, Smoothing
from napari_hmrf.solver.optimizers.krylov import ConjugateGradients, Step
from napari_hmrf.solver.optimizers.self_check import BELIEVABLE, Rehearsal
from napari_hmrf.solver.priors.cliques import SeilerMaterial
from napari_hmrf.solver.priors.elements import ElasticMaterial
from napari_hmrf.solver.volume_memory import IN_DOUBLE, ORDINARY, fits

#: Message for a system that cannot be factorized in double precision.
BARELY_HELD = (
    "a part of the tissue is barely held, so double precision cannot resolve its motion. Hold more "
    "of it, or reduce the ratio of the stiffest to the softest tissue"
)
# Tolerance of a rehearsal in double precision, which must include the softest motions.
_REHEARSED_DOUBLE = 1e-5
# Factor on the largest number of cycles in double precision, where no factorization is available.
_IN_DOUBLE = 8
# Safety factor on the ratio of true to estimated error that a rehearsal has measured, and on the
# error estimate of any volume.
_MARGIN = 4.0
# Additional safety factor for a volume that is not mild.
_VOLUME_MARGIN = 1.5
# Smallest eigenvalue that cycles find in images of mild, compressible tissue. Cycles that find a
# smaller eigenvalue may have missed others.
_MILD_LEAST = 0.1
# Smallest eigenvalue that cycles find in images of nearly incompressible tissue with low contrast.
_MILD_LEAST_INCOMPRESSIBLE = 0.05
# Eigenvalue of a motion of parts beside a gap of void, such as a flap, that cycles may miss. Its
# energy is so small that they find it only after all other motions have converged.
_UNSEEN = 0.005
# Safety factor on the error estimate of mild tissue with a gap of void. It is smaller than usual,
# because the iteration continues until an eigenvalue of `_UNSEEN` would not matter.
_GAP_MARGIN = 1.15
# Smallest safety factor of any error estimate, because an estimate is for a single component and
# depends on the eigenvalues found so far.
_LEAST_MARGIN = 1.5
# Additional safety factor for a warm start where tissue is not mild, because only the slowest
# motions have not converged.
_WARM_MARGIN = 1.5
# Ratio of the reported error to the estimate that ends an iteration. The reported error never
# exceeds the tolerance.
_REPORTED = 1.5
# Largest accepted ratio of true to estimated error for sliding parts, whose factorization is slow.
# The error estimate is multiplied by this ratio and by a safety factor.
_BELIEVABLE_COUPLED = 30.0
# Number of sites up to which a factorization takes no longer than a rehearsal and a few cycles.
_FEW = 1024
# Stiffness of springs on rigid bodies whose parts turn freely at hinges, as a fraction of the
# diagonal.
_HINGE_SPRINGS = 1e-6
# Largest number of search directions for free motions at hinges between touching rigid bodies.
_MOST_HINGES = 40
# Largest ratio of successive direct-solve corrections that still counts as progress.
_FALL = 0.25
# Correction, relative to the largest displacement (at least 1 pixel), up to which any decrease
# counts as progress.
_ROUNDING = 1e-15
# Correction, relative to the largest displacement (at least 1 pixel), up to which the solve may end
# without progress.
_STALLED = 1e-7
# Range of the largest residual, in the model's units, whose squares single precision sums up.
_LEAST_FORCE, _MOST_FORCE = 1e-12, 1e12


class _SlowMotionError(Exception):
    """Signal raised when cycles find a slow motion, which does not occur in mild tissue."""


class _Interrupted(Enum):
    """Reason for which cycles end without a step."""

    SLOW = auto()
    INDEFINITE = auto()
    IDLE = auto()


class Refinement:
    """Iterative refinement: residuals in double precision, corrections by cycles or factorization.

    Parameters
    ----------
    max_iterations : int
        Number of cycles after which a run fails.
    model : LinearModel
    smoothing : Smoothing
    report : callable
    is_firm : bool
        True if the constrained sites resist all motions about equally well.
    start_quality : StartQuality, optional
        Smallest eigenvalue and error from the solves of a warm start; None for a cold start.

    Attributes
    ----------
    estimate : float
        Reported estimate of the error of the field, in pixels, with a safety margin.
    error : float
        Error estimate that ended the last run, in pixels, without this margin.
    residual : float
        Norm of the residual forces, in double precision.
    energies : list of float
        Total energy after each cycle; the initial energy if there was no cycle.
    cycles : int
        Number of cycles; each solve with the factorization counts as one cycle.
    is_rough : bool
        True if the next run may end before it has found the slowest motions of earlier runs.
    """

    def __init__(
        self,
        max_iterations: int,
        model: LinearModel,
        smoothing: Smoothing,
        report: Report,
        is_firm: bool = True,
        start_quality: StartQuality | None = None,
    ) -> None:
        self._most, self._model, self._report, self._start_quality = (
            max_iterations,
            model,
            report,
            start_quality,
        )
        self._slowest = 1.0 if start_quality is None else start_quality.least
        self._mild = model.mild and is_firm
        self._believable = _BELIEVABLE_COUPLED if _is_coupled(model) else BELIEVABLE
        # A bound method would create a reference cycle, which would keep the factorization in
        # memory until garbage collection.
        self._iteration = ConjugateGradients(
            Cycle(model, smoothing), partial(_double_level_of, model)
        )
        self._patience = smoothing.patience
        self.estimate = self.error = math.inf
        self._unseen_error = 0.0
        self.is_rough = False
        self.residual = 0.0
        self.energies: list[float] = []
        self.cycles = 0
        self._gains: list[float] = []
        self._first: float | None = None
        self._underestimate: float | None = None
        self._low: Planes | None = None
        self._factors_tried = False

    def pull(self, d: Planes) -> Planes:
        """Return the forces of the tissue after the last run, without the rounding error of `d`."""
        return self._model.pull(d, self._low).copy()

    def run(
        self, d: Planes, load: Planes | None, tolerance: float, known: Quality | None = None
    ) -> None:
        """Solve for equilibrium with a load, within `tolerance` pixels; change `d` in place.

        Parameters
        ----------
        d : ndarray, planes
            Initial displacement, in pixels.
        load : ndarray, planes, or None
            Force on each component, or None if there is no load.
        tolerance : float
            Largest accepted error of the field, in pixels.
        known : Quality, optional
            Quality of `d`. If it is sufficient, only the residual of `d` is checked.

        Raises
        ------
        ConvergenceError
            If neither cycles nor the factorization reach the tolerance.
        """
        balance = self._model.balance(d, load)
        self.residual, self._low, self._gains = balance.norm, None, []
        self._unseen_error = 0.0
        if self._keeps(known, balance, tolerance):
            return
        if balance.most == 0:
            self.error = self.estimate = 0.0
        elif self._model.earlier.factors is not None or not self._iterate(
            d, load, tolerance, balance
        ):
            self._solve(d, load, tolerance)

    def run_on_device(
        self, d: OnDevice, tolerance: float, known: Quality | None = None
    ) -> Review | None:
        """Reduce the error of a displacement on the device by cycles.

        Parameters
        ----------
        d : OnDevice
            Initial displacement, which is changed.
        tolerance : float
            Largest accepted error of the field, in pixels.
        known : Quality, optional
            Quality of `d`. If it is sufficient, only the residual of `d` is checked.

        Returns
        -------
        Review or None
            Review of the solution. None if single precision or cycles may not suffice; `run` then
            solves from the start, in another `Refinement`.
        """
        earlier = self._model.earlier
        if not self._mild or earlier.slow or earlier.factors is not None:
            return None
        if known is not None:
            review = d.review()
            if self._keeps(known, review, tolerance):
                self.residual = review.norm
                return review
        balance, before = d.balance(), math.inf
        if balance.most == 0:
            self.error = self.estimate = 0.0
            return d.review()
        if not (_LEAST_FORCE < balance.most < _MOST_FORCE and self._trust()):
            return None
        margin = self._choose_margin()
        while True:
            end = self._run_cycles(d, balance, tolerance, margin, watch=before == math.inf)
            if isinstance(end, _Interrupted):
                if end is _Interrupted.SLOW:
                    self._distrust()
                return None
            review = d.review()
            worst = self._estimate_error(review, end, margin)
            if worst <= tolerance:
                self._accept(tolerance)
                return review
            if self._too_long or not worst < 0.5 * before:
                return None
            balance, before = d.balance(), worst

    @property
    def least(self) -> float:
        """Smallest eigenvalue found by cycles, including the cycles of the warm start."""
        return self._iteration.least

    @property
    def worst(self) -> float:
        """Largest plausible error, in pixels, if cycles have missed a slow motion.

        The last run would have met this tolerance, too.
        """
        return max(self.estimate, self._unseen_error)

    @property
    def by_factors(self) -> bool:
        """True if the system is factorized."""
        return self._model.earlier.factors is not None

    def set_energy(self, energy: float) -> None:
        """Record the energy after each cycle of the last run, given the final total energy."""
        gains = self._gains or [0.0]
        self.energies += list(energy + np.cumsum([0.0, *gains[:0:-1]])[::-1])
        self._gains = []

    def _iterate(self, d: Planes, load: Planes | None, tolerance: float, balance: Balance) -> bool:
        """Reduce the error by cycles; return whether it is reliably within the tolerance."""
        if not self._prepare():
            return False
        if self._needs_rehearsal:
            self._rehearse(d.shape)
            balance = self._model.balance(d, load)  # the rehearsal overwrote the residual
        if not self._trust():
            return False
        margin, before = self._choose_margin(), math.inf
        # A slow motion stops only the first run, before `d` has changed.
        watch = self._mild and len(self._model.shape) == 2
        while True:
            end = self._run_cycles(d, balance, tolerance, margin, watch)
            if end is _Interrupted.SLOW:
                return self._begin_again(d, load, tolerance)
            if end is _Interrupted.INDEFINITE and self._take_care():
                balance = self._model.balance(d, load)
                continue
            if isinstance(end, _Interrupted):
                return False
            balance, watch = self._model.balance(d, load, balance.most), False
            worst = self._estimate_error(balance, end, margin)
            if worst <= tolerance:
                self._accept(tolerance)
                return True
            stays = not worst < 0.5 * before
            if self._too_long or (stays and not self._take_care()):
                return False
            self._model.earlier.care, before = self._iteration.care, worst

    def _prepare(self) -> bool:
        """Prepare the iteration for rigid bodies; return whether cycles are worth a try."""
        earlier = self._model.earlier
        self._mild = self._mild and not earlier.slow
        if not self._mild and self._factors_first and factors_fit(self._model):
            self._factors_tried = True
            return False
        if not self._deflate_bodies():
            return False
        while self._iteration.care < earlier.care:
            self._iteration.take_care()
        return True

    @property
    def _needs_rehearsal(self) -> bool:
        """True if no trial run has yet shown how reliable the error estimate of cycles is."""
        known = self._model.earlier.underestimate is not None or self._underestimate is not None
        return not (known or self._mild) and self._model.iterates

    def _rehearse(self, shape: tuple[int, ...]) -> None:
        """Measure the error estimate in trial runs, with more care until it is believable."""
        self._underestimate = self._rehearsed_ratio(shape)
        while self._underestimate > self._believable and self._take_care():
            self._underestimate = self._rehearsed_ratio(shape)

    def _trust(self) -> bool:
        """Keep what is known of the error estimate; return whether it is believable."""
        earlier, iteration = self._model.earlier, self._iteration
        if earlier.underestimate is None and self._model.iterates:
            if self._underestimate is None:
                self._underestimate = 1.0  # mild tissue needs no trial run
            earlier.underestimate = self._underestimate
            earlier.least, earlier.care = iteration.least, iteration.care
        if earlier.underestimate is None or earlier.underestimate > self._believable:
            return False
        iteration.least = min(iteration.least, earlier.least)
        if not self.is_rough:
            # The slowest motions dominate the error that earlier runs have left.
            iteration.expect(self._slowest)
        return True

    def _choose_margin(self) -> float:
        """Return the safety factor on the error estimate, and set what cycles may leave unseen."""
        model, earlier = self._model, self._model.earlier
        volume, moves = len(model.shape) == 3, earlier.deflation
        # Cycles find every motion of a single body, but may miss relative motions of close bodies.
        sees_bodies = model.bodies is None or (moves is not None and not moves.close)
        is_sure = self._mild and not volume and model.material.compressible and sees_bodies
        is_gapped = not volume and _is_gapped(model)
        self._iteration.unseen = _UNSEEN if is_gapped else 1.0
        margin = _GAP_MARGIN if is_gapped and self._mild else _LEAST_MARGIN
        if not is_sure:
            assert earlier.underestimate is not None
            margin = max(_MARGIN * earlier.underestimate, _MARGIN if volume else margin)
        if volume and not self._mild:
            margin *= _VOLUME_MARGIN
        if moves is not None and moves.close:
            margin *= _MARGIN
        if self._start_quality is not None and not is_sure:
            margin *= _WARM_MARGIN
        return margin

    def _run_cycles(
        self,
        d: Planes | OnDevice,
        balance: Balance,
        tolerance: float,
        margin: float,
        watch: bool,
    ) -> Step | _Interrupted:
        """Run cycles until the estimated error is within the tolerance, or they take too long.

        Return the last step, or why there is none. If `watch` is True, a slow motion ends the run.
        """
        last: Step | None = None

        def enough(latest: Step) -> bool:
            nonlocal last
            last = latest
            self._gains.append(balance.unit**2 * latest.gain)
            error = balance.unit * max(margin * latest.error, _LEAST_MARGIN * latest.worst_error)
            self._report_cycle(error, tolerance)
            if watch and self._is_slow:
                raise _SlowMotionError
            return error <= tolerance or self._too_long

        try:
            self._iteration.run(balance, d, enough)
        except _SlowMotionError:
            return _Interrupted.SLOW
        except FloatingPointError:
            return _Interrupted.INDEFINITE
        self._slowest = min(self._slowest, self._iteration.run_least)
        return _Interrupted.IDLE if last is None else last

    def _estimate_error(self, balance: Balance | Review, step: Step, margin: float) -> float:
        """Set the estimated error for the true residual; return its largest plausible value."""
        deflation = self._model.earlier.deflation
        self.residual = balance.norm
        self.estimate = margin * step.reach * self.residual
        if deflation is not None and isinstance(balance, Balance):
            self.estimate += deflation.remaining_distance(balance.rest) * balance.unit
        self._unseen_error = _LEAST_MARGIN * step.worst_reach * self.residual
        return self.worst

    def _keeps(self, known: Quality | None, found: Balance | Review, tolerance: float) -> bool:
        """Return whether the initial displacement is good enough, and take over its error."""
        if known is None or not known.suffices(tolerance, found.norm):
            return False
        self.error, self.estimate = known.error, min(_REPORTED * known.error, tolerance)
        return True

    def _accept(self, tolerance: float) -> None:
        """Report the estimated error, which is within the tolerance."""
        self.error = self.estimate
        self.estimate = min(max(self.estimate, self._least_error()), tolerance)

    @property
    def _is_slow(self) -> bool:
        """True if the current run has found a motion that does not occur in mild tissue."""
        compressible = self._model.material.compressible
        limit = _MILD_LEAST if compressible else _MILD_LEAST_INCOMPRESSIBLE
        return self._iteration.run_least < limit

    def _begin_again(self, d: Planes, load: Planes | None, tolerance: float) -> bool:
        """Restart the iteration, because the tissue is not mild."""
        self._distrust()
        self.cycles -= len(self._gains)
        self._gains = []
        return self._iterate(d, load, tolerance, self._model.balance(d, load))

    def _distrust(self) -> None:
        """Forget the error estimate of mild tissue, and remember that the tissue is not mild."""
        earlier = self._model.earlier
        earlier.slow, earlier.underestimate, self._underestimate = True, None, None
        self._iteration.least = 1.0

    def _least_error(self) -> float:
        """Return a lower bound on the reported error, independent of the residual."""
        reported = _REPORTED * self.estimate
        if self._start_quality is None or self._start_quality.least == 1:
            return reported
        # In the worst case, each cycle removes only this fraction of the error of a warm start.
        left = self._start_quality.error * (1 - self._iteration.least) ** len(self._gains)
        return max(reported, left)

    def _take_care(self) -> bool:
        """Switch to a better iteration and clear its arrays; return False if there is none."""
        more = self._iteration.take_care()
        if more:
            self._model.clear()
        return more

    def _deflate_bodies(self) -> bool:
        """Compute the motions induced by rigid bodies; return False if they are too similar."""
        model = self._model
        if model.bodies is None or not model.iterates:
            return True
        earlier = model.earlier
        if earlier.deflation is None:
            earlier.deflation = model.deflation(*self._iteration.steps)
        self._iteration.deflation = earlier.deflation
        return earlier.deflation is None or earlier.deflation.is_independent

    @property
    def _factors_first(self) -> bool:
        """True if cycles would fail or be slower than a factorization."""
        few, laced = math.prod(self._model.shape) <= _FEW, self._model.material.laced
        # With slipping observations, similar systems are solved in sequence. Later systems need
        # fewer cycles, but each factorization takes the same time.
        return few or laced or (self._model.slow and not self._factors_tried)

    @property
    def _too_long(self) -> bool:
        """True if a factorization is now faster than more cycles."""
        return len(self._gains) >= self._patience and factors_fit(self._model)

    @property
    def _cycles_at_most(self) -> int:
        """Number of cycles after which a run fails."""
        return self._most * (_IN_DOUBLE if self._iteration.in_double else 1)

    def _rehearsed_ratio(self, shape: tuple[int, ...]) -> float:
        """Return the ratio of the true to the estimated error in a rehearsal."""
        error = host.noise(shape)
        compute_thread.check_cancelled()
        error[~self._model.moves] = 0
        compute_thread.check_cancelled()
        self._project(error)
        length = Rehearsal()
        if self._iteration.in_double:
            length = Rehearsal(_REHEARSED_DOUBLE, self._cycles_at_most)
        model = self._model
        return length.run(self._iteration, error, lambda d: model.balance(d, None), self._report)

    def _project(self, d: Planes) -> None:
        if self._model.bodies is not None:
            self._model.bodies.project(d)

    def _solve(self, d: Planes, load: Planes | None, tolerance: float) -> None:
        """Reduce the error to the tolerance with a direct factorization."""
        known = f". The estimated error of the field is {self.estimate:.2g} px"
        factors = factorise(self._model, self._report, known if self.estimate < math.inf else "")
        self._unseen_error, before = 0.0, math.inf
        rest, self._low = self._left(d, load), np.zeros_like(d)
        directions = None if self._model.bodies is None else Directions(self._image)
        while rest.any():
            correction = factors.solve(rest)
            self._project(correction)
            self.cycles += 1
            self._gains.append(float((correction * rest).sum()) / 2)
            far = float(np.abs(correction).max())
            self._report(Monitor(f"direct solve {self.cycles}, error {far:.2g} px", 1.0))
            scale = max(1.0, float(np.abs(d).max()))
            stays = not far < (1.0 if far <= _ROUNDING * scale else _FALL) * before
            if directions is not None:
                stays = stays and directions.exhausted
                correction = directions.next(correction, rest)
            if stays and not max(far, before) <= _STALLED * scale:
                raise ConvergenceError(
                    f"the error of the field remains {far:.2g} px: double precision is not "
                    "accurate enough for this tissue. Hold more of it, or reduce the ratio of the "
                    "stiffest to the softest tissue"
                )
            add(d, self._low, correction)
            rest = self._left(d, load)
            self.residual = float(np.linalg.norm(rest))
            self.error = self.estimate = far
            last, before = before, far
            # The error after this correction is even smaller, by the ratio of the two corrections.
            if far <= tolerance:
                return
            if stays:
                self.error = self.estimate = _MARGIN * max(far, last)
                return
        self.error = self.estimate = 0.0

    def _left(self, d: Planes, load: Planes | None) -> Planes:
        """Return the residual of `d` for a load, with zeros at constrained components."""
        rest = self.pull(d) if load is None else self.pull(d) + load
        rest[~self._model.moves] = 0
        self._project(rest)
        return rest

    def _image(self, way: Planes) -> Planes:
        """Return the forces that hold a displacement, A d."""
        return -self._model.pull(way)

    def _report_cycle(self, estimate: float, tolerance: float) -> None:
        """Count and report a cycle; raise an error if there were too many."""
        self.cycles += 1
        cycles = len(self._gains)
        self._first = self._first or estimate
        done = part_done(self._first, estimate, tolerance)
        self._report(Monitor(words_of_cycle(self.cycles, estimate), done))
        if cycles >= self._cycles_at_most and estimate > tolerance:
            raise ConvergenceError(
                f"the error of the field is still {estimate:.2g} px after {cycles} cycles. "
                "Raise max_iterations, or reduce the ratio of the stiffest to the softest tissue"
            )


class Directions:
    """Conjugate search directions for a factorization that misses a few motions.

    In the factorized matrix, parts of a rigid body that touch in one site can rotate against each
    other. In the blanket reading, rounding errors hide the energy of bending. Further directions
    correct for such motions.

    Parameters
    ----------
    image : callable
        Function that returns the product of the true matrix and a displacement.
    """

    def __init__(self, image: Callable[[Planes], Planes]) -> None:
        self._image = image
        self._last: tuple[Planes, Planes, float] | None = None
        self._left = _MOST_HINGES

    @property
    def exhausted(self) -> bool:
        """True if the search has used the largest number of directions for hinges."""
        return self._left <= 0

    def next(self, correction: Planes, rest: Planes) -> Planes:
        """Make a correction conjugate to the previous one and scale it by a line search."""
        self._left -= 1
        if self._last is not None:
            way, image, bend = self._last
            correction -= (correction * image).sum() / bend * way
        image = self._image(correction)
        bend = float((correction * image).sum())
        if not bend > 0:
            return correction
        self._last = correction, image, bend
        return np.asarray((correction * rest).sum() / bend * correction)


def add(d: Planes, low: Planes, way: Planes) -> None:
    """Add a step to a displacement `d` + `low`, in place; `low` is the rounding error of `d`.

    Forces depend on differences between neighbours, and stiff tissue amplifies rounding errors.
    """
    change = low + way
    total = d + change
    taken = total - d
    np.add(d - (total - taken), change - taken, out=low)
    np.copyto(d, total)


def _double_level_of(model: LinearModel) -> Any:
    """Return the finest level in double precision, or None if it is not needed or too large."""
    if factors_fit(model) or not fits(model.shape, IN_DOUBLE - ORDINARY):
        return None
    return model.double_level


def factors_fit(model: LinearModel) -> bool:
    """Return whether a factorization is available.

    There is none for volumes in the paper's model.
    """
    exist = len(model.shape) == 2 or not isinstance(model.material, SeilerMaterial)
    return exist and Factors.fit(model.shape, _is_coupled(model))


def _is_coupled(model: LinearModel) -> bool:
    """Return whether parts of the tissue slide along each other."""
    return isinstance(model.material, ElasticMaterial) and model.material.coupling is not None


def _is_gapped(model: LinearModel) -> bool:
    """Return whether void lies between parts of elastic tissue."""
    return isinstance(model.material, ElasticMaterial) and model.material.is_gapped


def _links_of(model: LinearModel) -> Links | None:
    """Return the connections between the parts that slide along each other, or None."""
    material = model.material
    if not isinstance(material, ElasticMaterial) or material.coupling is None:
        return None
    coupling = material.coupling
    return Links(coupling.matrix() / material.unit, coupling.stiffness.shape, coupling.places())


def check_factors_fit(model: LinearModel, known: str = "") -> None:
    """Raise an error if no factorization is available.

    The text `known` is appended to the error message for volumes.

    Raises
    ------
    ConvergenceError
        If the factorization needs too much memory.
    """
    if _is_coupled(model) and not factors_fit(model):
        raise ConvergenceError(
            "cycles may miss motions of parts that slide along each other, and the tissue is "
            "too large for a factorization. Hold more of the tissue, reduce the ratio of the "
            f"stiffest to the softest tissue, or crop the image{known}"
        )
    if len(model.shape) == 3 and not factors_fit(model):
        raise ConvergenceError(
            "cycles may miss motions of this volume, and no factorization is available. "
            "Raise max_iterations, crop the volume, hold more of it, or reduce the ratio of "
            f"the stiffest to the softest tissue{known}"
        )
    if not factors_fit(model):
        raise ConvergenceError(
            "cycles may miss motions of this tissue, and a factorization needs "
            f"{Factors.required_memory(model.shape) / 2**30:.0f} GiB of memory. Crop the "
            "image, or reduce the ratio of the stiffest to the softest tissue"
        )


def factorise(model: LinearModel, report: Report, known: str = "") -> Factors:
    """Return the factorization of a model with its current constraints; the result is cached.

    The text `known` is appended to the error message for volumes.

    Raises
    ------
    ConvergenceError
        If the factorization needs too much memory or the system is singular in double precision.
    """
    if model.earlier.factors is None:
        check_factors_fit(model, known)

        report_part = factorizing(report)
        report_part(0.0)
        factors = partial(Factors, model.material, model.moves, report_part)
        try:
            model.earlier.factors = factors(links=_links_of(model))
        except Singular:
            if model.bodies is None:
                raise ConvergenceError(BARELY_HELD) from None
            # Parts of a body that touch in one site turn freely; see `Directions`.
            on_bodies = model.bodies.hold(np.zeros_like(model.moves))
            springs = np.where(on_bodies, _HINGE_SPRINGS * model.steepness, 0.0)
            try:
                model.earlier.factors = factors(springs)
            except Singular:
                raise ConvergenceError(BARELY_HELD) from None
    return model.earlier.factors

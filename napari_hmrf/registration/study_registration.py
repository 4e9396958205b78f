"""Registration of a study: its image and a second image, with its tissue and its other motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.registration.alignment import Kind, align
from napari_hmrf.registration.image_data import BoolArray, FloatArray
from napari_hmrf.registration.matching import Show, placeholder, without_placeholder
from napari_hmrf.registration.register import check_contrast, on_grid, registered
from napari_hmrf.registration.result import Registration
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.solve import CancelFlag, Progress
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.study import Study
from napari_hmrf.study.support import refuse_model, refuse_sliding_parts


@dataclass(frozen=True, eq=False)
class SecondPicture:
    """Second image of a study, on the grid of the study.

    Attributes
    ----------
    pixels : ndarray, shape ([D,] H, W), float32
        Brightness.
    known : ndarray of bool, shape ([D,] H, W)
        Mask of the pixels that the image covers.
    name : str
    """

    pixels: FloatArray
    known: BoolArray
    name: str = ""


@dataclass(frozen=True, eq=False)
class RegisteredStudy:
    """Study whose tissue follows the second image.

    Attributes
    ----------
    study : Study
        The study with the measured motion, and without a fixed edge.
    registration : Registration
    """

    study: Study
    registration: Registration


def register_study(
    study: Study,
    second: SecondPicture,
    *,
    alignment: Kind | None = None,
    missing: BoolArray | None = None,
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
    checkpoint: Callable[[], None] = lambda: None,
    show: Show | None = None,
) -> RegisteredStudy:
    """Move the tissue of a study until its image matches a second image.

    Held, pulled, sliding and rigid tissue, loads and landmarks of the study have their effect
    during the registration. The outer edge is not held, because the images show how it moves. An
    earlier registration is replaced.

    Parameters
    ----------
    study : Study
        Study with an image.
    second : SecondPicture
    alignment : {"rigid", "affine"}, optional
        Alignment of the second image, before tissue moves; not a motion of the tissue. The solution
        has a note if no alignment made the images clearly more similar.
    missing : ndarray of bool, shape ([D,] H, W), optional
        Mask of the tissue without counterpart in the second image; by default, it is found.
    progress, cancel
        As in `solve`.
    checkpoint : callable
        Called while the study is interpreted; it may raise an error to cancel the computation.
    show : callable, optional
        As in `match`.

    Returns
    -------
    RegisteredStudy

    Raises
    ------
    ProblemError
        If the study has no image, its model is not the elastic model, an image has no structure, or
        a part of the study is invalid.
    HmrfError
        If an alignment requires SimpleITK, which is not installed.
    Cancelled
        If `cancel` was set before the work was done.
    """
    image = study.intensities
    if image is None:
        raise ProblemError("image", "is missing. Choose the image to register.")
    refuse_model(study, "registration")
    sites = np.ones(study.grid.shape, np.bool_)
    nothing = MeasuredMotion(np.zeros((*sites.shape, sites.ndim), np.float32), placeholder(sites))
    free = replace(study.motion, measured=nothing, hold_edge=False)
    ground = Ground.of(replace(study, motion=free), checkpoint)
    statement = ground.statement()
    refuse_sliding_parts(study, statement.problem, "registration")
    prior = statement.prior
    assert isinstance(prior, ElasticPrior)
    pixels = np.asarray(image, np.float32)
    known = np.isfinite(pixels)
    fixed, counted = np.where(known, pixels, 0), (known, second.known)
    sizes = study.grid.spacing
    matrix: npt.NDArray[np.float64] = np.eye(len(sizes) + 1)
    notes: tuple[str, ...] = ()
    if alignment is not None:
        both: dict[str, Any] = {"spacing": sizes, "moving_spacing": sizes}
        matrix, notes = align(alignment, fixed, second.pixels, masks=counted, **both)
    images = on_grid(fixed, second.pixels, counted, sizes, sizes, matrix)
    with study.naming():
        check_contrast(images)
        found = registered(
            without_placeholder(statement.problem, ground.typical_stiffness),
            prior,
            images,
            unit=ground.typical_stiffness,
            matrix=matrix,
            moving_spacing=sizes,
            missing=missing,
            notes=notes,
            progress=progress,
            cancel=cancel,
            show=show,
        )
    record = {"second image": second.name, "alignment": alignment or ""} | found.record
    held = study.motion.unmeasured.hold_edge
    measured = MeasuredMotion(
        found.observed, found.precision, record, found.missing, frees_edge=held
    )
    done = replace(study, motion=replace(free, measured=measured))
    return RegisteredStudy(done, found)

"""Removed tissue: comparison with CalculiX, and with fields on refined grids."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf import (
    BoundaryRule,
    Cavity,
    ElasticPrior,
    Grid,
    Motion,
    Multigrid,
    Study,
    Tissue,
    build_problem,
    solve,
)
from report import load_cases
from report.page import Section, Settings, Target
from validation.oracles import calculix

Float64Array = npt.NDArray[np.float64]
POISSON = 0.3
#: Cases for the comparison with CalculiX: name, axes, plane and Poisson's ratio.
CALCULIX = (
    ("plane stress, CPE4 with textbook constants", 2, "stress", POISSON),
    ("plane strain, nu 0, CPE4", 2, "strain", 0.0),
    ("volume, nu 0, C3D8", 3, "strain", 0.0),
    ("volume, C3D8", 3, "strain", POISSON),
)
#: Contents of the cavity: pressure, fluid relative to the weight of the tissue, and level.
CONTENTS = {
    "nothing": (0.0, 0.0, 1.0),
    "pressure": (0.05, 0.0, 1.0),
    "fluid, 60 %": (0.0, 1.5, 0.6),
    "fluid, full": (0.0, 1.0, 1.0),
}
#: Largest accepted difference, in pixels or voxels.
_LARGEST = 0.01
#: Stiffness of the gel, in kPa, its weight and the weight of water, in kPa / mm, and its width.
_GEL, _WEIGHT, _WATER, _SIDE = 3.0, 0.0103, 0.00981, 60.0


def section(settings: Settings) -> Section:
    """Return the section with CalculiX and a block of gel."""
    page = Section("Removed tissue")
    _calculix(page, settings)
    _gel(page, settings)
    return page


def _calculix(page: Section, settings: Settings) -> None:
    if not calculix.is_there():
        page.missing("CalculiX", calculix.HOW)
        return
    rows, sizes = [], (settings.choose(96, 24), settings.choose(24, 10))
    for (name, axes, plane, nu), contents in (
        (case, contents) for case in CALCULIX for contents in CONTENTS
    ):
        size = sizes[axes - 2]
        off, most = to_calculix(size, axes, plane, nu, contents)
        rows.append([name, contents, f"{size}", f"{most:.2f} px", f"{off:.1e} px"])
        if (axes, nu) != (3, POISSON):  # CalculiX uses other elements for this case
            claim = f"resection to CalculiX, {name}, {contents}: largest difference in px"
            page.targets.append(Target(claim, off, _LARGEST))
    page.say(
        """**Question.** Does tissue move as in CalculiX if the same elements are removed and the
        same loads act? Blocks of random stiffness, in a range of a factor of ten, with oblong
        pixels, are fixed at their first plane. A rule removes an ellipse (an ellipsoid) in the
        middle. All tissue has a weight in an oblique direction. The input of CalculiX has only the
        remaining elements, the weight is gravity, and each face of the cavity bears the
        pressure of the fluid at its centre."""
    )
    header = ["case", "cavity", "pixels along a side", "displacement", "largest difference"]
    page.table(header, rows)
    page.say(
        """**Conclusion.** Without a fluid, the fields agree as far as the solver's tolerance, where
        both programs have the same elements. CalculiX distributes the pressure of a face equally to
        its corners, while the lower corners bear more of a fluid here. This causes the difference
        with a fluid. With a Poisson's ratio of 0.3, the elements of volumes differ, as for other
        loads."""
    )


def to_calculix(size: int, axes: int, plane: str, nu: float, contents: str) -> tuple[float, float]:
    """Return the largest difference and the largest displacement, in pixels."""
    case = load_cases.tissue(size, axes)
    whole = np.where(case.stiffness > 0, case.stiffness, 20.0)
    spacing, shape = case.spacing, whole.shape
    places = np.moveaxis(np.indices(shape), 0, -1)
    hole = np.linalg.norm((places - 0.55 * size) / (1.0, 0.7, 0.8)[:axes], axis=-1) < size / 4
    pressure, relative, level = CONTENTS[contents]
    heaviness = math.hypot(*case.pull)
    labels = np.where(hole, 1, 0)
    labels[0] = 2
    motion = Motion(
        labels=labels,
        rules=(BoundaryRule(1, "remove"), BoundaryRule(2, "fixed")),
        weight=case.pull,
        cavity=Cavity(pressure, relative * heaviness, level),
    )
    prior = ElasticPrior(nu, plane="stress" if plane == "stress" else "strain")
    study = Study(Grid(shape, spacing), Tissue(stiffness=whole), motion, prior=prior)
    problem = build_problem(study).problem
    found = solve(problem, prior, optimizer=Multigrid(1e-5), backend="cpu")

    # The surface and the pressure of CalculiX, from the geometry alone.
    near = scipy.ndimage.binary_dilation(hole, np.ones((3,) * axes)) & ~hole
    depth = places * spacing @ np.array(case.pull) / heaviness
    top, bottom = depth[near].min(), depth[near].max()
    presses = pressure + relative * heaviness * np.maximum(
        depth - bottom + level * (bottom - top), 0
    )
    theirs = calculix.loaded_field(
        np.where(hole, 0.0, whole),
        spacing,
        nu,
        stress=plane == "stress",
        strain=np.zeros(shape),
        pull=case.pull,
        surface=near,
        pressure=presses,
    )
    off = float(np.abs(found.displacement - theirs)[problem.tissue].max())
    return off / problem.unit, float(np.abs(theirs).max()) / problem.unit


def _gel(page: Section, settings: Settings) -> None:
    counts = {2: settings.choose((20, 40, 80, 160), (20, 40)), 3: settings.choose((10, 20), (10,))}
    finest = {2: settings.choose(640, 80), 3: settings.choose(80, 20)}
    rows = []
    for axes, contents in ((2, "nothing"), (2, "fluid, 60 %"), (3, "nothing"), (3, "fluid, 60 %")):
        known = gel_block(finest[axes], axes, contents)
        moves = float(np.nanmax(np.abs(known)))
        errors = []
        for count in counts[axes]:
            found = gel_block(count, axes, contents)
            every = (slice(None, None, finest[axes] // count),) * axes
            errors.append(float(np.sqrt(np.nanmean((found - known[every]) ** 2))))
        mm = [f"{error:.1e}" for error in errors]
        rows.append([f"{axes}-D", contents, f"{moves:.2f} mm", *mm, *[""] * (4 - len(mm))])
        if len(errors) > 1 and not settings.quick:
            order = math.log(errors[0] / errors[-1]) / math.log(counts[axes][-1] / counts[axes][0])
            rows[-1].append(f"{order:.2f}")
            claim = f"gel block, {axes}-D, {contents}: order"
            page.targets.append(Target(claim, order, 1.2, at_least=True))
        else:
            rows[-1].append("")
    page.say(
        f"""**Question.** Does the field of a cavity converge? A block of gel ({_GEL:g} kPa,
        {_SIDE:g} mm wide) stands on a table under its own weight. A square (a cube) of 30 % of its
        width is removed from its middle, and is empty, or filled with water up to 60 % of its
        height. The fields are compared with the field on {finest[2]} pixels ({finest[3]} voxels)
        along a side. The table shows the rms error in mm, for {", ".join(map(str, counts[2]))}
        pixels or {", ".join(map(str, counts[3]))} voxels along a side."""
    )
    sizes = [f"{n + 1}" for n in range(4)]
    page.table(["", "cavity", "displacement", *(f"grid {n}" for n in sizes), "order"], rows)
    page.say(
        """**Conclusion.** The error decreases with an order between one and two, as bilinear
        elements have beside the corners of a cavity, where the stress is singular."""
    )


def gel_block(count: int, axes: int, contents: str) -> Float64Array:
    """Return the displacement of a block of gel on a table, in mm; NaN in the cavity.

    Parameters
    ----------
    count : int
        Number of elements along a side, a multiple of 10.
    axes : int
    contents : str
        Contents of the cavity, as in `CONTENTS`.
    """
    shape, step = (count + 1,) * axes, _SIDE / count
    places = np.moveaxis(np.indices(shape), 0, -1) / count
    hole = ((places > 0.3 + 1e-9) & (places < 0.6 - 1e-9)).all(axis=-1)
    labels = np.where(hole, 1, 0)
    labels[-1] = 2
    _, relative, level = CONTENTS[contents]
    motion = Motion(
        labels=labels,
        rules=(BoundaryRule(1, "remove"), BoundaryRule(2, "fixed")),
        weight=(_WEIGHT, *(0.0,) * (axes - 1)),
        cavity=Cavity(fluid=_WATER if relative else 0.0, level=level),
    )
    tissue = Tissue(stiffness=np.full(shape, _GEL), unit="kPa")
    prior = ElasticPrior(0.45, plane="strain")
    stated = build_problem(Study(Grid(shape, step, "mm"), tissue, motion, prior=prior))
    found = solve(stated.problem, prior, optimizer=Multigrid(1e-5), backend="cpu")
    return np.where(hole[..., None], np.nan, found.displacement)

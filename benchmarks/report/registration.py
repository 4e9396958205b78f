"""Comparison with elastic image registration, as in figure 4c: intensities, no mechanics."""

from __future__ import annotations

import importlib.util
import time
from typing import Any

import numpy as np
import numpy.typing as npt
from paper import PHANTOMS

from napari_hmrf import ElasticPrior, Multigrid, solve, warp
from napari_hmrf.data import phantom
from napari_hmrf.fields import rmsd
from report.page import Section, Settings
from report.pictures import draw_differences, draw_grid, new_figure, save
from validation.oracles.elasticity import direct_solution

HOW = '`pip install -e ".[report]"`'


def is_there() -> bool:
    """Return whether SimpleITK is installed."""
    return importlib.util.find_spec("SimpleITK") is not None


def register(
    image: npt.NDArray[Any], moved: npt.NDArray[Any], spline: int
) -> npt.NDArray[np.float64]:
    """Find the position of each pixel of `image` in `moved`, by B-splines `spline` pixels apart.

    The original image is fixed and the deformed image is moving, so the transform maps X to
    X + d(X), the material displacement of the other fields. The registration uses mean squares,
    three resolutions and L-BFGS.

    Returns
    -------
    ndarray, shape (H, W, 2)
        Displacement in (row, col) order, in pixels.
    """
    import SimpleITK as sitk

    fixed, moving = (
        sitk.GetImageFromArray(np.asarray(each, dtype=np.float32)) for each in (image, moved)
    )
    mesh = [max(1, round(size / spline / 4)) for size in fixed.GetSize()]
    transform = sitk.BSplineTransformInitializer(fixed, mesh, 3)
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMeanSquares()
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsLBFGS2(numberOfIterations=50)
    method.SetShrinkFactorsPerLevel([4, 2, 1])
    method.SetSmoothingSigmasPerLevel([2, 1, 0])
    # The density of control points increases with the image resolution.
    method.SetInitialTransformAsBSpline(transform, inPlace=True, scaleFactors=[1, 2, 4])
    method.Execute(fixed, moving)
    found = sitk.TransformToDisplacementField(transform, sitk.sitkVectorFloat64, fixed.GetSize())
    return np.ascontiguousarray(sitk.GetArrayFromImage(found)[..., ::-1])


def section(settings: Settings) -> Section:
    """Return the section with the registration of an image that finite elements deformed."""
    page = Section("Elastic registration")
    if not is_there():
        page.missing("SimpleITK", HOW)
        return page
    size = settings.choose(300, 48)
    page.say(
        f"""**Question.** As in figure 4c: the image deformed by finite elements is registered to
        the input, from grey values alone. Does the field that explains the image equal that of
        the tissue? SimpleITK's cubic B-splines, mean squares, three resolutions, {size} x
        {size}. The elastic prior gets the boundary and the stiffness instead, and no grey
        values."""
    )
    rows = []
    for name in PHANTOMS:
        example = phantom(name, size)
        problem = example.problem
        truth = direct_solution(problem, ElasticPrior(0.3))
        moved = warp(example.image, truth, spacing=1, tissue=problem.tissue)
        found = {}
        for spline in settings.choose((20,), (12,)):
            started = time.perf_counter()
            field = register(example.image, moved, spline)
            title = f"registration, control points {spline} px apart"
            found[title] = field
            off, inner = _distances(field, truth, problem.tissue, problem.confidence)
            rows.append([name, title, off, inner, f"{time.perf_counter() - started:.1f} s"])
        run = solve(problem, ElasticPrior(0.3), optimizer=Multigrid(0.01), backend="cpu")
        elastic = run.displacement.astype(np.float64)
        off, inner = _distances(elastic, truth, problem.tissue, problem.confidence)
        rows.append([name, "elastic prior", off, inner, f"{run.provenance.seconds:.3f} s"])
        best = min(found, key=lambda key: rmsd(found[key], truth, problem.tissue))
        figure = new_figure(17, 4.4)
        first, second, *rest = figure.subplots(1, 5)
        for axes, title, field in (
            (first, "finite elements", truth),
            (second, f"registration, {best.rpartition('points ')[2]}", found[best]),
        ):
            draw_grid(axes, field, problem.tissue)
            axes.set_title(title)
        shown = draw_differences(rest, found[best], truth, problem.tissue)
        figure.colorbar(shown, ax=rest, label="registration - finite elements, px")
        for axes, what in zip(rest, ("magnitude", "x (col)", "y (row)"), strict=True):
            axes.set_title(what)
        path = save(figure, settings, f"{name}-registration")
        page.picture(path, f"{name}: elastic registration, as in figure 4c")
    page.table(["phantom", "field", "RMSD in the body", "away from the boundary", "time"], rows)
    page.say(
        """**Conclusion.** Registration makes the two images alike. Where grey values are
        informative (these phantoms have texture everywhere, and no noise), its RMSD is about that
        of the paper's converged prior (*The paper's tables*). It is wrong where grey values are not
        informative: along edges, and across interfaces of tissue, where the true strain jumps and
        the spline is smooth, as the paper observed; see the differences. This
        repeats the paper's comparison, which is not fair in either direction: registration has
        no information about the cause of the motion, and mechanics has no second image."""
    )
    return page


def _distances(field, truth, tissue, c) -> tuple[str, str]:
    free = tissue & (c == 0).all(axis=-1)
    return f"{rmsd(field, truth, tissue):.3f} px", f"{rmsd(field, truth, free):.3f} px"

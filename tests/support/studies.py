"""Studies as users make them: napari layers and the settings of the dock.

This module does not import the package. The metadata of a layer contain its table as JSON types.
A drawing has the format in which the motion layer stores it. `study_reader` converts a study to a
problem.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from napari.components import ViewerModel

METADATA = "napari-hmrf"
#: Rotated and translated to the position in the scanner, with oblong pixels.
TURNED = {"scale": (0.5, 0.8), "rotate": 20.0, "translate": (-30.0, 12.0)}
MIRRORED = [[1.0, 0.0, 0.0], [0.0, -0.6, 40.0], [0.0, 0.0, 1.0]]


@dataclass(frozen=True)
class Study:
    """Layers and settings of one study.

    Attributes
    ----------
    viewer : ViewerModel
        Viewer with the layers; its sliders determine the slice.
    image, tissue, boundary, confidence : napari.layers.Layer, optional
        Chosen layers.
    where, should : napari.layers.Points or napari.layers.Shapes, optional
        Landmarks and their targets; lines have no separate targets.
    landmarks : dict
        Radius and confidence of the landmarks, if set.
    drawing : list of dict, optional
        Marks drawn with the mouse; None if only layers determine the motion.
    hold_edge : bool
        Whether the outer edge of the tissue is fixed; used only with a drawing.
    curve : dict, optional
        Stiffness curve, if the tissue is derived from the intensity of the image.
    model : dict
        Model: "energy" is "elastic" or "paper". An elastic model has "poisson", "plane" and "grip"
        (largest holding force); a paper model has "schedule" and "penalty".
    """

    viewer: Any
    image: Any = None
    tissue: Any = None
    boundary: Any = None
    confidence: Any = None
    where: Any = None
    should: Any = None
    landmarks: dict[str, float] = field(default_factory=dict)
    drawing: list[dict[str, Any]] | None = None
    hold_edge: bool = True
    curve: dict[str, Any] | None = None
    model: dict[str, Any] = field(default_factory=lambda: {"energy": "elastic"})


def material(label, name, stiffness, poisson=0.45):
    return {"label": label, "name": name, "stiffness": stiffness, "poisson": poisson}


def rule(label, action, name="", vector=(0.0, 0.0), amount=0.0, confidence=(1.0, 1.0)):
    return {
        "label": label,
        "action": action,
        "vector": list(vector),
        "amount": amount,
        "confidence": list(confidence),
        "name": name,
    }


def of_tissue(*materials, unit="kPa"):
    return {METADATA: {"role": "tissue", "materials": list(materials), "unit": unit}}


def of_boundary(*rules):
    return {METADATA: {"role": "boundary", "rules": list(rules)}}


def arrow(at, by, radius, confidence=1.0, components="both"):
    return {
        "class": "Arrow",
        "at": at,
        "by": by,
        "radius": radius,
        "confidence": confidence,
        "components": components,
    }


def landmark(source, target, radius, confidence=1.0):
    return {
        "class": "Landmark",
        "source": source,
        "target": target,
        "radius": radius,
        "confidence": confidence,
    }


def stroke(action, line, radius, **more):
    return {"class": "Stroke", "action": action, "lines": [line], "radius": radius, **more}


def away(shape, row, col, rows=1.0, cols=1.0):
    """Return the distance of each pixel from a place, in radii of an ellipse."""
    down, along = np.indices(shape)
    return np.hypot((down - row) / rows, (along - col) / cols)


def brain(shape=(52, 60)):
    """Return an image of a brain in dark air, its labels (air to tumour) and its rim."""
    rows, cols = shape
    body = away(shape, rows / 2, cols / 2, 0.44 * rows, 0.42 * cols)
    tissue = np.where(body < 1, 1, 0).astype(np.uint8)
    tissue[away(shape, 0.5 * rows, 0.62 * cols, 0.12 * rows, 0.08 * cols) < 1] = 2
    tissue[away(shape, 0.42 * rows, 0.34 * cols, 5.0, 5.0) < 1] = 3
    down, along = np.indices(shape)
    texture = (7 * down + 3 * along) % 13
    image = np.where(tissue > 0, 90 + 40 * tissue.astype(int) + texture, texture // 4)
    return image.astype(np.uint8), tissue, (body < 1) & (body > 0.9)


BRAIN = (
    material(0, "air", 0.0),
    material(1, "normal tissue", 20.0, 0.45),
    material(2, "soft tissue", 10.0, 0.3),
    material(3, "tumour", 40.0, 0.48),
)


def painted(viewer, **place):
    """Add the painted brain with a fixed skull and a growing tumour; return the layers."""
    image, tissue, rim = brain()
    boundary = np.where(rim, 1, 0).astype(np.uint8)
    grown = away(image.shape, 0.42 * 52, 0.34 * 60)
    boundary[(grown < 6) & (grown > 3)] = 2
    rules = of_boundary(rule(1, "fixed", "skull"), rule(2, "expand", "tumour", amount=1.5))
    return {
        "viewer": viewer,
        "image": viewer.add_image(image, name="MR", **place),
        "tissue": viewer.add_labels(tissue, name="Tissue", metadata=of_tissue(*BRAIN), **place),
        "boundary": viewer.add_labels(boundary, name="Boundary", metadata=rules, **place),
    }


def growing_tumour_by_the_paper():
    return Study(**painted(ViewerModel()), model={"energy": "paper", "schedule": "paper"})


def growing_tumour_by_the_paper_converged():
    return Study(**painted(ViewerModel()), model={"energy": "paper", "schedule": "converged"})


def growing_tumour_in_oblong_pixels_turned():
    """Plane strain, where each tissue has its own Poisson's ratio."""
    return Study(**painted(ViewerModel(), **TURNED), model={"energy": "elastic", "plane": "strain"})


def bone_between_walls():
    """A rigid bone in muscle, and a wall that moves only along columns."""
    viewer = ViewerModel()
    shape = (48, 56)
    tissue = np.ones(shape, np.uint8)
    tissue[:4] = 0
    tissue[14:34, 24:32] = 2
    tissue[40:46, 40:50] = 7
    boundary = np.zeros(shape, np.uint8)
    boundary[4:, :3] = 1
    boundary[10:40, -3:] = 2
    table = of_tissue(
        material(0, "air", 0.0),
        material(1, "muscle", 3.0, 0.49),
        material(2, "bone", "rigid"),
        material(7, "tissue 7", 3.0, 0.49),
    )
    rules = of_boundary(
        rule(1, "fixed", "wall"),
        rule(2, "move", "press", vector=(2.0, -3.0), confidence=(0.0, 1.0)),
    )
    return Study(
        viewer,
        tissue=viewer.add_labels(tissue, name="Tissue", metadata=table),
        boundary=viewer.add_labels(boundary, name="Boundary", metadata=rules),
    )


def wall_with_little_grip():
    """A wall that slips if pulled too hard; half of it has a low confidence."""
    viewer = ViewerModel()
    shape = (48, 56)
    tissue = np.ones(shape, np.uint8)
    tissue[away(shape, 24, 30) < 9] = 2
    boundary = np.zeros(shape, np.uint8)
    boundary[:24, :2] = 1
    boundary[24:, :2] = 2
    boundary[18:30, -2:] = 3
    table = of_tissue(material(1, "fat", 2.3, 0.49), material(2, "gland", 8.0, 0.49))
    rules = of_boundary(
        rule(1, "fixed", "wall"),
        rule(2, "fixed", "doubted wall", confidence=(0.25, 0.5)),
        rule(3, "move", "probe", vector=(-1.0, 5.0)),
    )
    return Study(
        viewer,
        image=viewer.add_image(np.indices(shape).sum(axis=0).astype(float), name="US"),
        tissue=viewer.add_labels(tissue, name="Tissue", metadata=table),
        boundary=viewer.add_labels(boundary, name="Boundary", metadata=rules),
        model={"energy": "elastic", "grip": 0.02},
    )


def doubted_field_of_a_registration():
    """Arrows in every third pixel, with images of confidence and stiffness."""
    viewer = ViewerModel()
    shape = (48, 56)
    down, along = np.indices(shape)
    place = {"scale": (0.7, 0.7), "units": ("mm", "mm")}
    stiffness = (1 + 4 * np.exp(-(away(shape, 20, 30, 9, 12) ** 2))).astype(np.float32)
    stiffness[:, 50:] = 0
    starts = np.argwhere((down % 3 == 1) & (along % 3 == 1) & (along < 50))
    steps = 2 * np.stack([np.sin(starts[:, 1] / 9), np.cos(starts[:, 0] / 11)], axis=1)
    sure = np.clip(1.2 - away(shape, 24, 24, 30, 30), 0, 1)
    return Study(
        viewer,
        image=viewer.add_image((3 * down + along).astype(np.uint16), name="CT", **place),
        tissue=viewer.add_image(stiffness, name="Stiffness", **place),
        boundary=viewer.add_vectors(np.stack([starts, steps], axis=1), name="Field", **place),
        confidence=viewer.add_image(sure, name="Certainty", **place),
        model={"energy": "paper", "schedule": "converged", "penalty": 0.5},
    )


def landmarks_beside_a_painted_skull():
    """Two layers of points with their own scale, on top of paint; two of the points are close."""
    viewer = ViewerModel()
    layers = painted(viewer, **TURNED)
    place = layers["image"].data_to_world
    where = np.array([place(at) for at in [(18, 36), (34, 24), (34, 28.5), (26, 30)]])
    should = np.array([place(at) for at in [(19.5, 37), (33, 25), (33.5, 29), (26, 30)]])
    own = {"scale": (0.25, 0.25), "translate": (3.0, -2.0), "size": 1}
    return Study(
        **layers,
        where=viewer.add_points((where - own["translate"]) / 0.25, name="is at", **own),
        should=viewer.add_points((should - own["translate"]) / 0.25, name="should be at", **own),
        landmarks={"radius": 1.9},
    )


def lines_alone_in_a_mirrored_photograph():
    """A colour photograph with lines and a path, without paint."""
    viewer = ViewerModel()
    shape = (44, 54)
    down, along = np.indices(shape)
    place = {"affine": MIRRORED}
    colours = np.stack([4 * down, 4 * along, 2 * (down + along)], axis=-1).astype(np.uint8)
    stiffness = np.where(away(shape, 20, 20) < 8, 9, 2)
    lines = viewer.add_shapes(name="lines", **place)
    lines.add_lines(np.array([[[10.0, 12.0], [12.5, 14.0]], [[30.0, 40.0], [30.0, 40.0]]]))
    lines.add_paths(np.array([[34.0, 12.0], [36.0, 11.0], [35.0, 9.5]]))
    return Study(
        viewer,
        image=viewer.add_image(colours, name="Photograph", rgb=True, **place),
        tissue=viewer.add_image(stiffness, name="Stiffness", **place),
        where=lines,
        landmarks={"confidence": 0.5},
        model={"energy": "elastic", "poisson": 0.3, "plane": "strain"},
    )


def slice_of_a_stack_along_another_axis():
    """Slices 2 mm apart, displayed along another axis, with arrows on all slices."""
    viewer = ViewerModel()
    down, high, along = np.indices((40, 6, 44))
    place = {"scale": (0.5, 2.0, -0.6), "translate": (4.0, -3.0, 20.0), "units": "mm"}
    tissue = np.where(np.hypot(down - 19, along - 21) < 17, 1, 0).astype(np.uint8)
    tissue[np.hypot(down - 15, along - 26) < 2 + high] = 2
    vectors = [
        [(19 + 9 * row, each, 21 + 9 * col), (row * 1.5, 0, -1.0 + col + 0.1 * each)]
        for each in range(6)
        for row, col in [(0, 1), (0, -1), (1, 0), (-1, 0), (0.5, 0.8)]
    ]
    vectors.append([(10, 3, 20), (0, 1, 0)])
    table = of_tissue(
        material(0, "air", 0.0), material(1, "white matter", 2.1, 0.4), material(2, "fluid", 0.1, 0)
    )
    study = Study(
        viewer,
        image=viewer.add_image((down + 5 * high + along).astype(np.float32), name="T1", **place),
        tissue=viewer.add_labels(tissue, name="Tissue", metadata=table, **place),
        boundary=viewer.add_vectors(np.array(vectors, dtype=float), name="Arrows", **place),
    )
    viewer.dims.order = (1, 0, 2)
    viewer.dims.set_current_step(1, 3)
    return study


def tissue_by_brightness():
    """Tissue from a stiffness curve, with unconnected specks in the air."""
    viewer = ViewerModel()
    image, tissue, rim = brain()
    image = image.astype(np.float32)
    for speck in [(2, 3), (3, 50), (49, 55)]:
        image[speck[0] : speck[0] + 2, speck[1] : speck[1] + 2] = 150
    boundary = np.where(rim, 1, 0).astype(np.uint8)
    boundary[(tissue == 3) & (away(image.shape, 0.42 * 52, 0.34 * 60) > 3)] = 2
    rules = of_boundary(rule(1, "fixed"), rule(2, "move", vector=(1.5, 2.0)))
    points = [[100.0, 2.0], [150.0, 3.5], [215.0, 12.0]]
    return Study(
        viewer,
        image=viewer.add_image(image, name="MR"),
        boundary=viewer.add_labels(boundary, name="Boundary", metadata=rules),
        curve={
            "points": points,
            "void_below": 60.0,
            "between": "smooth",
            "logarithmic": True,
            "unit": "kPa",
        },
    )


def pulled_image():
    """An image with two pulls, a pin and a landmark, without another layer."""
    viewer = ViewerModel()
    image, _, _ = brain()
    return Study(
        viewer,
        image=viewer.add_image(image, name="MR", scale=(0.9, 0.9), units="mm"),
        drawing=[
            arrow((20.0, 22.5), (2.0, 3.5), 3.0),
            arrow((33.2, 38.0), (0.0, 0.0), 2.5),
            arrow((30.0, 18.0), (-1.5, 0.0), 2.0, components="row"),
            landmark((38.0, 29.0), (36.0, 30.5), 2.0),
        ],
    )


def every_brush_on_painted_tissue():
    """Strokes of all brushes over a painted boundary; tissue of low confidence slips."""
    layers = painted(ViewerModel())
    ring = [(34 + 4 * np.sin(t), 34 + 4 * np.cos(t)) for t in np.linspace(0, 2 * np.pi, 24)]
    strokes = [
        stroke("pin", [(10.0, 26.0), (10.0, 36.0)], 1.6),
        stroke("free", [(26.0, 5.0), (30.0, 6.0)], 2.5),
        stroke("move", [(24.0, 44.0), (30.0, 45.0)], 1.8, by=(0.5, -2.0)),
        stroke("expand", ring, 1.27, amount=0.8),
        stroke("tissue", [(20.0, 30.0), (26.0, 29.0)], 2.2, label=3),
        stroke("confidence", [(26.0, 45.0)], 4.0, confidence=0.01, softness=0.6),
    ]
    return Study(**layers, drawing=strokes)


def pieces_that_nobody_holds():
    """Two pieces of tissue and specks with a free edge; one piece is pulled and pinned."""
    viewer = ViewerModel()
    shape = (46, 56)
    stiffness = np.zeros(shape, np.float32)
    stiffness[4:40, 4:30] = 2
    stiffness[12:20, 10:18] = np.inf
    stiffness[10:30, 36:52] = 5
    stiffness[40, 20] = 2
    stiffness[40:42, 30:32] = 2
    return Study(
        viewer,
        image=viewer.add_image(np.where(stiffness > 0, 200, 100).astype(np.uint8), name="CT"),
        tissue=viewer.add_image(stiffness, name="Stiffness"),
        drawing=[arrow((34.0, 8.0), (0.0, 0.0), 2.5), arrow((15.0, 14.0), (0.0, 3.0), 1.0)],
        hold_edge=False,
    )


STUDIES = (
    growing_tumour_by_the_paper,
    growing_tumour_by_the_paper_converged,
    growing_tumour_in_oblong_pixels_turned,
    bone_between_walls,
    wall_with_little_grip,
    doubted_field_of_a_registration,
    landmarks_beside_a_painted_skull,
    lines_alone_in_a_mirrored_photograph,
    slice_of_a_stack_along_another_axis,
    tissue_by_brightness,
    pulled_image,
    every_brush_on_painted_tissue,
    pieces_that_nobody_holds,
)

"""Contributions of the napari plugin: sample data, readers, writers and commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import napari
import numpy as np
from napari.utils.notifications import show_info

from napari_hmrf.archive import is_damaged
from napari_hmrf.errors import FileFormatError, HmrfError
from napari_hmrf.field.brightness import limits_without_padding
from napari_hmrf.field.frame import Frame
from napari_hmrf.io.apply import FieldFile, read_field_file, write_field_file
from napari_hmrf.io.fields import FIELD_SUFFIXES, is_field_file
from napari_hmrf.io.images import is_scan, read_image, stem_of
from napari_hmrf.io.landmark_files import is_landmark_file, read_points
from napari_hmrf.io.study_file import is_study_file
from napari_hmrf.layers.field_layer import field_layer
from napari_hmrf.layers.label_colours import boundary_colours
from napari_hmrf.layers.landmarks import SD_FEATURE
from napari_hmrf.layers.metadata import (
    BOUNDARY,
    FILE_AXES,
    IMAGE,
    METADATA,
    TISSUE,
    file_axes_of,
    layer_metadata,
)
from napari_hmrf.layers.result_layers import result_layers
from napari_hmrf.layers.stored_axes import stored_axes
from napari_hmrf.samples.chest import chest_phantom
from napari_hmrf.samples.head import GROWTH, SAMPLE_SIZE, head_phantom
from napari_hmrf.samples.mri import MRI_SCALE, mri_slices
from napari_hmrf.samples.phantoms import image_pair, sample
from napari_hmrf.solver.solution import Solution, is_solution_file
from napari_hmrf.ui import opening

if TYPE_CHECKING:
    from napari_hmrf.samples.head import HeadPhantom
    from napari_hmrf.samples.phantoms import Phantom
    from napari_hmrf.ui.soft_tissue import SoftTissue

#: Message in napari's status bar while the first sample is being opened.
OPENING = "Opening the sample and 'Soft tissue' ..."
LayerData = tuple[Any, dict[str, Any], str]
PathOrPaths = str | list[str]


def _beside_dock(layers: Callable[[], list[LayerData]]) -> Callable[[], list[LayerData]]:
    """Return a function that returns the layers of a sample, and shows the dock beside them.

    If the user has chosen the sample, the window is painted during long imports, and the dock
    follows the layers. Otherwise it is there before the function returns.
    """

    @wraps(layers)
    def open_sample() -> list[LayerData]:
        viewer = napari.current_viewer()
        if viewer is not None and opening.is_interactive():
            viewer.status = OPENING
            opening.load()
            opening.after_painting(partial(dock, viewer))
        elif viewer is not None:
            dock(viewer)
        return layers()

    return open_sample


@_beside_dock
def sample_brain() -> list[LayerData]:
    """Return the layers of the first sample: a brain with its tissues, which nothing moves yet."""
    image, tissue, _ = phantom_layers(sample("expansion"))
    return [image, tissue]


@_beside_dock
def sample_mri() -> list[LayerData]:
    """Return the layer of a real MRI of a head, whose slices can be pulled."""
    settings = {"name": "Head MRI", "scale": MRI_SCALE, "metadata": layer_metadata(IMAGE)}
    return [(mri_slices(), settings, "image")]


@_beside_dock
def sample_expansion() -> list[LayerData]:
    """Return the layers of the expansion sample: a brain that expands outward."""
    return phantom_layers(sample("expansion"))


@_beside_dock
def sample_growth() -> list[LayerData]:
    """Return the layers of the growth sample: a brain with a growing tumour."""
    return phantom_layers(sample("mass-effect").growing())


@_beside_dock
def sample_mass_effect() -> list[LayerData]:
    """Return the layers of the paper's mass-effect sample: a tumour whose rim moves outward."""
    return phantom_layers(sample("mass-effect"))


@_beside_dock
def sample_pair() -> list[LayerData]:
    """Return the layers of the pair sample: a brain before and after its tumour grew."""
    brain, after = image_pair()
    image, tissue, _ = phantom_layers(brain)
    image[1]["name"] = "Before"
    second = {"name": "After", "metadata": layer_metadata(IMAGE), "visible": False}
    return [image, tissue, (after.copy(), second, "image")]


@_beside_dock
def sample_bar() -> list[LayerData]:
    """Return the layers of the two-tissue bar sample."""
    return phantom_layers(sample("bar"))


@_beside_dock
def sample_chest() -> list[LayerData]:
    """Return the layers of the chest sample: lungs that slide along the wall during a breath."""
    return phantom_layers(chest_phantom())


@_beside_dock
def sample_head() -> list[LayerData]:
    """Return the layers of the head sample: a volume of a head with a growing tumour."""
    return volume_layers(head_phantom(SAMPLE_SIZE, growth=GROWTH))


def volume_layers(head: HeadPhantom) -> list[LayerData]:
    """Return the layers of a head phantom in patient coordinates, marked as a volume to deform."""
    place = head.frame.placement()
    layers = [
        (data, {**attributes, **place}, kind) for data, attributes, kind in phantom_layers(head)
    ]
    layers[0][1]["metadata"][METADATA]["extent"] = "volume"
    return layers


def phantom_layers(phantom: Phantom | HeadPhantom) -> list[LayerData]:
    """Return the image, tissue and boundary layers of a phantom, with their tables."""
    # Copy the arrays of the phantom: they are read-only, but the user can paint on the layers.
    return [
        (
            phantom.image.copy(),
            {"name": phantom.title.split(maxsplit=1)[0], "metadata": layer_metadata(IMAGE)},
            "image",
        ),
        (
            phantom.tissue_labels.copy(),
            {
                "name": "Tissue",
                "opacity": 0.3,
                "metadata": layer_metadata(TISSUE, phantom.materials),
            },
            "labels",
        ),
        (
            phantom.boundary_labels.copy(),
            {
                "name": "Boundary",
                "opacity": 0.9,
                "colormap": boundary_colours(),
                "metadata": layer_metadata(BOUNDARY, phantom.boundary),
            },
            "labels",
        ),
    ]


def open_solution(path: PathOrPaths) -> Callable[[PathOrPaths], Sequence[Any]] | None:
    """Return a reader for results or a study saved as .npz, or None for other files.

    A file that is damaged, so that its kind is unknown, has a reader, which reports the error.
    """
    paths = _listed(path)
    if paths and all(is_solution_file(each) or is_damaged(each) for each in paths):
        return _read
    return open_study(path)


def _read(path: PathOrPaths) -> list[LayerData]:
    layers: list[LayerData] = []
    for each in _listed(path):
        try:
            arrows = result_layers(Solution.read(each)).layers["arrows"]
        except ValueError as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(f"{Path(each).name}: not a valid result: {error}") from error
        layers.append(arrows._replace(attributes={**arrows.attributes, "name": Path(each).stem}))
    return layers


def open_scan(path: PathOrPaths) -> Callable[[PathOrPaths], list[LayerData]] | None:
    """Return a reader for medical images and displacement fields, or None for other files."""
    paths = _listed(path)
    readable = paths and all(is_scan(each) or is_field_file(each) for each in paths)
    return _read_scans if readable else None


def _read_scans(path: PathOrPaths) -> list[LayerData]:
    layers: list[LayerData] = []
    for each in _listed(path):
        if is_field_file(each):
            layers.append(_field(each))
            continue
        image = read_image(each).upright
        metadata = layer_metadata(IMAGE)
        attributes = {
            "name": stem_of(each),
            "rgb": image.colours,
            "metadata": metadata,
        }
        if image.geometry is not None:
            attributes |= Frame.of_geometry(image.geometry).placement()
        if image.order:
            metadata[METADATA][FILE_AXES] = image.order
        pixels = image.pixels_in_place
        # Otherwise, all tissue of a padded CT image would be nearly white.
        if not image.colours and (limits := limits_without_padding(pixels)) is not None:
            attributes["contrast_limits"] = limits
        layers.append((pixels, attributes, "image"))
    return layers


def open_study(path: PathOrPaths) -> Callable[[PathOrPaths], list[tuple[None]]] | None:
    """Return a reader that opens a single study file in the dock, or None for other paths."""
    return _open_study if isinstance(path, str) and is_study_file(path) else None


def _open_study(path: PathOrPaths) -> list[tuple[None]]:
    dock().open_study(str(path))
    return [(None,)]  # no layers for napari to add, because the dock has added them


def open_landmarks(path: PathOrPaths) -> Callable[[PathOrPaths], list[LayerData]] | None:
    """Return a reader for landmark files of BigWarp and 3D Slicer, or None for other files."""
    paths = _listed(path)
    return _read_landmarks if paths and all(map(is_landmark_file, paths)) else None


def _read_landmarks(path: PathOrPaths) -> list[LayerData]:
    layers: list[LayerData] = []
    for each in _listed(path):
        file, name = read_points(each), stem_of(each)
        n = file.points.shape[1]
        place, axes = {"units": (file.unit,) * n}, [*range(n)]
        if not file.unit:
            place, axes = _place_of_images(n)
        layers.append((file.points[:, axes], {"name": name, **place}, "points"))
        if file.targets is not None:
            spreads = {} if file.sd is None else {"features": {SD_FEATURE: file.sd}}
            name = f"{name}, should be"
            layers.append((file.targets[:, axes], {"name": name, **place, **spreads}, "points"))
    return layers


def _place_of_images(n: int) -> tuple[dict[str, Any], list[int]]:
    """Return where points with `n` coordinates lie in the topmost image, and their axes in it.

    BigWarp stores landmarks in the unit of the image, from its first voxel and along the axes of
    its file, but it stores neither the unit nor the position of the image.

    Returns
    -------
    place : dict
        Keyword arguments of a layer.
    axes : list of int
        Axis of the points for each axis of the layer.
    """
    viewer = napari.current_viewer()
    images = [] if viewer is None else [each for each in viewer.layers if each.ndim >= n]
    known = [each for each in images if isinstance(each, napari.layers.Image)]
    if not known:
        return {"units": ("pixel",) * n}, [*range(n)]
    image = known[-1]
    place: dict[str, Any] = {"units": tuple(map(str, image.units[-n:]))}
    if image.ndim == n:
        names = ("translate", "rotate", "shear", "affine")
        place |= {name: getattr(image, name) for name in names}
        sizes = stored_axes(image).sizes
        place |= {"scale": 1 / np.array(sizes)} if sizes and all(sizes) else {}
    return place, [*(file_axes_of(image) if image.ndim == n else ())] or [*range(n)]


def _field(path: str) -> LayerData:
    """Return a layer with the forward or backward displacement field of a file, in pixels."""
    field, frame = read_field_file(path).in_pixels
    return field_layer(field, frame.placement(), stem_of(path))


def _listed(path: PathOrPaths) -> list[str]:
    """Return a path or a list of paths, as passed by napari, as a list."""
    return [path] if isinstance(path, str) else path


def write_solution(path: str, data: Any, attributes: dict[str, Any]) -> list[str]:
    """Save the result stored in a Vectors layer.

    Parameters
    ----------
    path : str
        Path of the file. With the suffix .npz, the complete result is saved. With a suffix that
        `write_field` supports, only the displacement field is saved, for other tools.
    data : ndarray, shape (N, 2, D)
        Displayed arrows; unused, because they represent only a part of the displacement field.
    attributes : dict
        Attributes of the layer, with the solution in the metadata.

    Returns
    -------
    list of str
        Path of the written file.

    Raises
    ------
    ValueError
        If the layer is not a result of this package.
    """
    known = attributes.get("metadata", {}).get(METADATA)
    solution = known.get("solution") if isinstance(known, dict) else None
    if not isinstance(solution, Solution):
        raise ValueError(
            f"the Vectors layer '{attributes.get('name', '')}' is not a result of "
            "'Soft tissue', so there is no solution to save. Save the arrow layer of a result."
        )
    if path.lower().endswith(FIELD_SUFFIXES):
        show_info(write_field_file(path, FieldFile.of(solution)))
        return [path]
    return [str(solution.write(path))]


#: Name of the dock in napari's menu; napari identifies an open dock by this name.
_TITLE = "Soft tissue (napari-hmrf)"


def dock(viewer: Any = None) -> SoftTissue:
    """Show the "Soft tissue" dock of a viewer, creating the dock if necessary.

    Parameters
    ----------
    viewer : napari.Viewer, optional
        Viewer of the dock; by default the current viewer.

    Returns
    -------
    SoftTissue
        Widget in the dock.

    Raises
    ------
    HmrfError
        If no viewer is open.
    """
    from napari_hmrf.ui.soft_tissue import SoftTissue  # heavy: ui

    viewer = napari.current_viewer() if viewer is None else viewer
    if viewer is None:
        raise HmrfError("No napari window is open. Start napari first.")
    widgets = viewer.window.dock_widgets.values()
    widget = next((each for each in widgets if isinstance(each, SoftTissue)), None)
    if widget is None:
        widget = SoftTissue(viewer)
        viewer.window.add_dock_widget(widget, name=_TITLE)
    frame = widget.native.parent()
    frame.show()
    frame.raise_()
    return widget


def deform_now() -> None:
    """Start a solve, like the "Deform" button."""
    dock().deform()


def live() -> None:
    """Switch live mode, in which every edit updates the result, on or off."""
    widget = dock()
    widget.live = not widget.live


def pull() -> None:
    """Activate or deactivate the tool that pulls tissue with the mouse."""
    widget = dock()
    if widget.active:
        widget.stop()
    else:
        widget.tool = "pull"
        widget.start()


def undo() -> None:
    """Undo the last edit."""
    dock().undo()


def redo() -> None:
    """Redo the last undone edit."""
    dock().redo()


def play() -> None:
    """Start or pause the animation of the deformation."""
    widget = dock()
    if widget.playing:
        widget.pause()
    else:
        widget.play()

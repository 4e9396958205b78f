"""napari contributions: samples, readers, writers and commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import napari
from napari.utils.notifications import show_info

from napari_hmrf.errors import FileFormatError, HmrfError
from napari_hmrf.io.apply import FieldFile, read_field_file, write_field_file
from napari_hmrf.io.fields import FIELD_SUFFIXES, is_field_file
from napari_hmrf.io.images import is_scan, read_image
from napari_hmrf.io.landmark_files import is_landmark_file, read_points
from napari_hmrf.io.study_file import is_study_file
from napari_hmrf.layers.field_layer import field_layer
from napari_hmrf.layers.label_colours import boundary_colours
from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, METADATA, TISSUE, described
from napari_hmrf.layers.result_layers import result_layers
from napari_hmrf.samples.head import SAMPLE_SIZE, head_phantom
from napari_hmrf.samples.phantoms import sample
from napari_hmrf.solver.solution import Solution, is_solution_file

if TYPE_CHECKING:
    from napari_hmrf.samples.head import HeadPhantom
    from napari_hmrf.samples.phantoms import Phantom
    from napari_hmrf.ui.soft_tissue import SoftTissue

LayerData = tuple[Any, dict[str, Any], str]
PathOrPaths = str | list[str]


def sample_expansion() -> list[LayerData]:
    """Open the brain that expands outward."""
    return _sample("expansion")


def sample_growth() -> list[LayerData]:
    """Open the brain with a growing tumour."""
    return phantom_layers(sample("mass-effect").growing())


def sample_mass_effect() -> list[LayerData]:
    """Open the brain with a tumour whose rim is pushed, as in the paper."""
    return _sample("mass-effect")


def sample_bar() -> list[LayerData]:
    """Open the bar of two tissues."""
    return _sample("bar")


def sample_head() -> list[LayerData]:
    """Open the head with a growing tumour, to be deformed as a volume."""
    return volume_layers(head_phantom(SAMPLE_SIZE))


def volume_layers(head: HeadPhantom) -> list[LayerData]:
    """Return the layers of a head, placed in the patient, to be deformed as a volume."""
    place = head.frame.placement()
    layers = [
        (data, {**attributes, **place}, kind) for data, attributes, kind in phantom_layers(head)
    ]
    layers[0][1]["metadata"][METADATA]["extent"] = "volume"
    return layers


def _sample(name: str) -> list[LayerData]:
    return phantom_layers(sample(name))


def phantom_layers(found: Phantom | HeadPhantom) -> list[LayerData]:
    """Return an image and its two painted layers, with the tables that the widget opens with."""
    # The stored arrays are read-only; layers are there to be painted on.
    return [
        (
            found.image.copy(),
            {"name": found.title.split(maxsplit=1)[0], "metadata": described(IMAGE)},
            "image",
        ),
        (
            found.tissue_labels.copy(),
            {
                "name": "Tissue",
                "opacity": 0.3,
                "metadata": described(TISSUE, found.materials),
            },
            "labels",
        ),
        (
            found.boundary_labels.copy(),
            {
                "name": "Boundary",
                "opacity": 0.9,
                "colormap": boundary_colours(),
                "metadata": described(BOUNDARY, found.boundary),
            },
            "labels",
        ),
    ]


def open_solution(path: PathOrPaths) -> Callable[[PathOrPaths], Sequence[Any]] | None:
    """Offer to read a saved result, or a study that was saved so; None for any other file."""
    paths = _listed(path)
    if paths and all(is_solution_file(each) for each in paths):
        return _read
    return open_study(path)


def _read(path: PathOrPaths) -> list[LayerData]:
    layers: list[LayerData] = []
    for each in _listed(path):
        try:
            made = result_layers(Solution.read(each)).layers["arrows"]
        except ValueError as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(f"{Path(each).name}: not a valid result: {error}") from error
        layers.append(made._replace(attributes={**made.attributes, "name": Path(each).stem}))
    return layers


def open_scan(path: PathOrPaths) -> Callable[[PathOrPaths], list[LayerData]] | None:
    """Offer to read a scan or a field where it lies in the patient; None for anything else."""
    paths = _listed(path)
    ours = paths and all(is_scan(each) or is_field_file(each) for each in paths)
    return _read_scans if ours else None


def _read_scans(path: PathOrPaths) -> list[LayerData]:
    layers: list[LayerData] = []
    for each in _listed(path):
        if is_field_file(each):
            layers.append(_field(each))
            continue
        image = read_image(each).upright
        attributes = {
            "name": Path(each).name.partition(".")[0],
            "rgb": image.colours,
            "metadata": described(IMAGE),
        }
        if image.place is not None:
            attributes |= image.place.frame().placement()
        layers.append((image.pixels_in_place, attributes, "image"))
    return layers


def open_study(path: PathOrPaths) -> Callable[[PathOrPaths], list[tuple[None]]] | None:
    """Offer to open a saved study in the dock; None for any other file, or for several."""
    return _open_study if isinstance(path, str) and is_study_file(path) else None


def _open_study(path: PathOrPaths) -> list[tuple[None]]:
    dock().open_study(str(path))
    return [(None,)]  # the layers are there already


def open_landmarks(path: PathOrPaths) -> Callable[[PathOrPaths], list[LayerData]] | None:
    """Offer to read landmarks of BigWarp or Slicer; None for any other file."""
    paths = _listed(path)
    return _read_landmarks if paths and all(map(is_landmark_file, paths)) else None


def _read_landmarks(path: PathOrPaths) -> list[LayerData]:
    layers: list[LayerData] = []
    for each in _listed(path):
        file, name = read_points(each), Path(each).name.partition(".")[0]
        n = file.points.shape[1]
        place = {"units": (file.unit,) * n if file.unit else _units_of_images(n)}
        layers.append((file.points, {"name": name, **place}, "points"))
        if file.targets is not None:
            layers.append((file.targets, {"name": f"{name}, should be", **place}, "points"))
    return layers


def _units_of_images(n: int) -> tuple[str, ...]:
    """The units of n axes of the newest image that is open: BigWarp's numbers are in those."""
    viewer = napari.current_viewer()
    images = [] if viewer is None else [each for each in viewer.layers if each.ndim >= n]
    known = [each.units for each in images if isinstance(each, napari.layers.Image)]
    return tuple(map(str, known[-1][-n:])) if known else ("pixel",) * n


def _field(path: str) -> LayerData:
    """A displacement field as a layer that holds it as it is stored, in pixels."""
    field, frame = read_field_file(path).in_pixels
    return field_layer(field, frame.placement(), Path(path).name.partition(".")[0])


def _listed(path: PathOrPaths) -> list[str]:
    """The files that napari speaks of: one, or several."""
    return [path] if isinstance(path, str) else path


def write_solution(path: str, data: Any, attributes: dict[str, Any]) -> list[str]:
    """Save the result that a layer of arrows belongs to: whole, or its field for other tools.

    Parameters
    ----------
    path : str
        Ends in .npz, or as `write_field` takes it.
    data : ndarray, shape (N, 2, D)
        The arrows; only some of what is saved.
    attributes : dict
        Of the layer; its metadata hold the solution.

    Returns
    -------
    list of str
        The file written.

    Raises
    ------
    ValueError
        If the arrows are not a result of this package.
    """
    known = attributes.get("metadata", {}).get(METADATA)
    solution = known.get("solution") if isinstance(known, dict) else None
    if not isinstance(solution, Solution):
        raise ValueError(
            f"the Vectors layer '{attributes.get('name', '')}' is not a result of "
            "'Soft tissue', so there is no solution to save. Save the layer of displacement arrows "
            "that it made."
        )
    if path.lower().endswith(FIELD_SUFFIXES):
        show_info(write_field_file(path, FieldFile.of(solution)))
        return [path]
    return [str(solution.write(path))]


#: As napari's menu names it, so that it finds it open.
_TITLE = "Soft tissue (napari-hmrf)"


def dock(viewer: Any = None) -> SoftTissue:
    """Show the dock of a viewer and return it; open one if there is none yet.

    Parameters
    ----------
    viewer : napari.Viewer, optional
        The one that is used now, if not given.

    Raises
    ------
    HmrfError
        If there is no window.
    """
    from napari_hmrf.ui.soft_tissue import SoftTissue  # heavy: ui

    viewer = napari.current_viewer() if viewer is None else viewer
    if viewer is None:
        raise HmrfError("There is no napari window open: start napari first.")
    widgets = viewer.window.dock_widgets.values()
    found = next((each for each in widgets if isinstance(each, SoftTissue)), None)
    if found is None:
        found = SoftTissue(viewer)
        viewer.window.add_dock_widget(found, name=_TITLE)
    frame = found.native.parent()
    frame.show()
    frame.raise_()
    return found


def deform_now() -> None:
    """Press Deform."""
    dock().deform()


def live() -> None:
    """Switch live mode on or off, in which the result follows every edit."""
    found = dock()
    found.live = not found.live


def pull() -> None:
    """Start or stop pulling tissue with the mouse."""
    found = dock()
    if found.active:
        found.stop()
    else:
        found.tool = "pull"
        found.start()


def undo() -> None:
    """Undo the last edit."""
    dock().undo()


def redo() -> None:
    """Redo the edit that was undone last."""
    dock().redo()


def play() -> None:
    """Play the deformation back and forth, or stop."""
    found = dock()
    if found.playing:
        found.pause()
    else:
        found.play()

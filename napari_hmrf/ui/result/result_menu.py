"""Further outputs of a result: pictures, numbers, fields, and moved copies of other layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from psygnal import Signal
from qtpy import QtWidgets
from qtpy.QtCore import Qt

from napari_hmrf.errors import HmrfError
from napari_hmrf.io.apply import FieldFile, write_field_file
from napari_hmrf.io.figures import write_result_pictures
from napari_hmrf.io.moving_pictures import write_movie
from napari_hmrf.io.tables import write_measurements
from napari_hmrf.io.uncertainty_files import write_uncertainty
from napari_hmrf.layers.field_layer import MOVED, can_move, picture_of, prepare_move, tissue_labels
from napari_hmrf.layers.film_colours import film_overlay
from napari_hmrf.layers.metadata import TISSUE, metadata_of, rows_of, tissue_recorded
from napari_hmrf.layers.result_layers import LayerData
from napari_hmrf.layers.slice_view import View, directions_of, plane_shown
from napari_hmrf.layers.viewer_layers import layers_of
from napari_hmrf.results.held_forces import HeldForce
from napari_hmrf.results.measurement import Measurement, measure
from napari_hmrf.solver.elastic_strain import strain_note
from napari_hmrf.tissue.drawing import Landmark
from napari_hmrf.ui.forms import add_entry, attempt, give_menu
from napari_hmrf.ui.jobs import Jobs
from napari_hmrf.ui.messages import ABOUT_PRECISELY, PRECISELY
from napari_hmrf.ui.result.landmark_table import LandmarkRows, LandmarkTable
from napari_hmrf.ui.result.moving_layers import MovingLayers
from napari_hmrf.ui.result.result_form import ResultForm
from napari_hmrf.ui.result.result_messages import NO_IMAGE, NO_RESULT
from napari_hmrf.ui.result.result_tables import forces_in_words, measurements_in_words
from napari_hmrf.ui.table_window import Cell, TableWindow

_FOR_IMAGES = "Fields (*.mha *.nrrd *.nii.gz *.h5)"
_FOR_POINTS = "Fields (*.mha *.nrrd *.nii.gz)"
_IMAGES = "Images (*.nii.gz *.nii *.mha *.nrrd *.tif)"
_FILMS = "Films (*.gif *.mp4)"
_BACK = "Moves images in SimpleITK, ANTs, elastix, Slicer: maps deformed to original positions"
_FORTH = "Moves points. Maps original to deformed positions; the file records the direction"
_BARS = (
    "Standard deviations along the motion and along each axis, as images on the undeformed image; "
    "choose 'uncertainty' in 'overlay' first"
)
_GIFS = "GIFs (*.gif)"
_GIF = (
    "Animation that repeats forever: the image deforms and returns, with the visible overlay and "
    "its legend; for web pages and slides"
)
_FILM = (
    "Film of the image as it deforms and returns, with the visible overlay and its legend: .gif, "
    "or .mp4 with imageio-ffmpeg"
)
_PICTURES = (
    "Figures as PNG files in a new folder: displacement, before and after, grid, area change, "
    "strain and energy. To save the canvas, use File > Save Screenshot."
)
_WITH_IT = (
    "New layer, moved with the tissue. In a volume at the same position, only the slice of this "
    "result moves. In films, channels and stacks without units, all slices move."
)


class ResultMenu:
    """Menu and buttons for further outputs of the displayed result.

    Long tasks run in the background; the outcome is reported as a message.

    Parameters
    ----------
    form : ResultForm
        Form with the buttons.
    viewer : napari.Viewer or ViewerModel
    shown : callable
        Returns the displayed result, or None.
    show_message : callable
        Called with each message.
    """

    #: Emitted with a list of `Path` after pictures have been written.
    saved = Signal(object)
    #: Emitted when the user chooses to solve the study from a cold start.
    precise_chosen = Signal()

    def __init__(
        self,
        form: ResultForm,
        viewer: Any,
        shown: Callable[[], MovingLayers | None],
        show_message: Callable[[str], None],
        jobs: Jobs,
    ) -> None:
        self._button, self._reference, self._viewer = form.more, form.reference, viewer
        self._look, self._show_message, self._jobs = shown, show_message, jobs
        #: Returns the rows of the table of landmarks, or None if there are none.
        self.landmarks: Callable[[], LandmarkRows | None] = lambda: None
        #: Sets the standard deviation of a landmark of the drawing.
        self.set_sd: Callable[[Landmark, float], None] = lambda _mark, _sd: None
        self._landmark_table: LandmarkTable | None = None
        give_menu(self._button, self._fill)

    def measure(self) -> tuple[Measurement, ...]:
        """Measure the deformation of each tissue, or of all tissue if there are no labels.

        Raises
        ------
        HmrfError
            If there is no result.

        Notes
        -----
        Once the uncertainty of the result is estimated, mean displacements have error bars.
        """
        shown = self._shown
        answer = shown.answer
        known = shown.estimated
        # The labels are too many, see `complete_result`.
        if known is not None and not known.labels:
            known = None
        labels, rows = answer.pictures.labels, tissue_recorded(shown.arrows)[0] or ()
        layer = tissue_labels(self._viewer.layers, answer) if labels is None else None
        if layer is not None:  # a result read from a file has no labels
            labels, rows, known = picture_of(layer, answer), rows_of(layer, TISSUE), None
        names = {row.label: row.name for row in rows}
        if labels is None:
            labels, names = np.ones(answer.shape, int), {1: "tissue"}
        return measure(answer.solution, labels, names=names, uncertainty=known)

    def save_pictures(self, folder: str | Path, own_folder: bool = False) -> None:
        """Write pictures into a folder or a new subfolder, then emit `saved`.

        Raises
        ------
        HmrfError
            If there is no result.
        """
        shown = self._shown
        answer = shown.answer
        subfolder = f"{answer.pictures.name or 'result'} pictures" if own_folder else ""
        arguments = Path(folder), answer.solution, shown.image, answer.unit, subfolder
        self._show_message("Saving pictures ...")
        work = partial(write_result_pictures, *arguments)
        self._jobs.submit(f"pictures in {folder}", work, self._on_saved)

    def save_field(self, path: str | Path, *, forward: bool = False) -> None:
        """Write the field for other tools, and report the accuracy of its inverse.

        Parameters
        ----------
        path : str or Path
        forward : bool
            If True, write the field that maps original positions to deformed positions; otherwise,
            write its inverse, which most tools need to resample images.

        Raises
        ------
        HmrfError
            If there is no result.
        """
        field = FieldFile.of(self._shown.answer.solution)
        self._jobs.submit(
            f"{path}", partial(write_field_file, path, field, forward=forward), self._show_message
        )

    def save_uncertainty(self, path: str | Path) -> None:
        """Write images of the standard deviations of patches; see `write_uncertainty`.

        Raises
        ------
        HmrfError
            If there is no result, or if its uncertainty is not estimated.
        """
        shown = self._shown
        if shown.estimated is None:
            raise HmrfError(
                "The uncertainty is not estimated. Choose 'uncertainty' in 'overlay' first."
            )
        # The solution of the estimate has neither the place of the layers nor the air removed.
        found = replace(shown.estimated, solution=shown.answer.solution)

        def show(paths: tuple[Path, ...]) -> None:
            along = "The first image is ± along the motion, the others along each axis."
            self._show_message(f"{_saved(paths)} {along}")

        self._jobs.submit(f"{path}", partial(write_uncertainty, path, found, placed=False), show)

    def save_film(self, path: str | Path) -> None:
        """Write a film of the image, or of the visible slice of a volume, moving back and forth.

        The film shows the visible overlay and its legend. See `write_movie` for the file formats.

        Raises
        ------
        HmrfError
            If there is no result, no image on the pixel grid of the result, or if a volume is
            displayed in 3D.
        """
        shown = self._shown
        if shown.image is None:
            raise HmrfError(NO_IMAGE)
        options: dict[str, Any] = {}
        if len(shown.answer.shape) == 3:
            if self._viewer.dims.ndisplay != 2:
                raise HmrfError(
                    "A film shows one slice of a volume: press napari's 2D/3D button first."
                )
            axis, number = plane_shown(shown.answer.frame, View.of(self._viewer.dims))
            options = {"axis": axis, "number": number}
        layer, content = shown.layers.layer("overlay"), ""
        if shown.overlay is not None and layer is not None and layer.visible:
            options["overlay"] = film_overlay(shown.overlay, layer, shown.answer.solution)
            content = f" without '{layer.name}'"
            if options["overlay"] is not None:
                content = f" with the overlay '{layer.name}'"
        work = partial(write_movie, path, shown.answer.solution, shown.image, **options)
        self._show_message("Saving the film ...")
        self._jobs.submit(
            f"{path}", work, lambda file: self._show_message(f"Saved {file.name}{content}.")
        )

    def save_gif(self, path: str | Path) -> None:
        """Write a looping GIF; see `save_film`. The suffix .gif is added if it is missing."""
        path = Path(path)
        self.save_film(path if path.suffix.lower() == ".gif" else f"{path}.gif")

    def move_along(self, *layers: Any) -> None:
        """Add moved copies of other layers, each above its original.

        Raises
        ------
        HmrfError
            If there is no result, or if a layer cannot be placed on the tissue of the result.
        """
        movers = [prepare_move(layer, self._shown.answer) for layer in layers]

        def add(made: list[LayerData]) -> None:
            for layer, each in zip(layers, made, strict=True):
                self._add(layer, each)
            names = ", ".join(f"'{each.attributes['name']}'" for each in made)
            self._show_message(f"Moved along: {names}.")

        kind = f"{[layer.name for layer in layers]} moved along"  # one kind of job per selection
        self._jobs.submit(kind, lambda: [move() for move in movers], add)

    def refresh_landmarks(self) -> None:
        """Update the table of landmarks, if it is open."""
        if self._landmark_table is not None:
            self._landmark_table.show_rows(self.landmarks())

    def release(self) -> None:
        """Close the table of landmarks."""
        if self._landmark_table is not None:
            self._landmark_table.close()

    @property
    def _shown(self) -> MovingLayers:
        if (shown := self._look()) is None:
            raise HmrfError(NO_RESULT)
        return shown

    def _add(self, layer: Any, made: LayerData) -> None:
        """Add a moved layer, which replaces the moved copy of an earlier result."""
        present, layers = self._viewer.layers, layers_of(self._viewer)
        name = made.attributes["name"]
        with layers.same_selection():
            if name in present and metadata_of(present[name]).get("kind") == MOVED:
                layers.remove(present[name])
            layers.add(layer.create(*made), layers.above(layer) if layer in present else None)

    def _fill(self) -> None:
        """Fill the menu with the entries that apply now."""
        menu, shown = self._button.menu(), self._look()
        source = None if shown is None else shown.source
        has_bars = shown is not None and shown.estimated is not None
        name = "result" if source is None else source.name
        menu.clear()
        about = "Displacement, change in area, and strain of each tissue"
        self._add_entry(menu, "Measurements ...", about, self._show_measurements)
        self._add_entry(menu, "Forces ...", "Forces that hold or move tissue", self._show_forces)
        about = "Distance of each landmark from its target, and its uncertainty (±), to be edited"
        pairs = self._add_entry(menu, "Landmarks ...", about, self._show_landmarks)
        pairs.setEnabled(self.landmarks() is not None)
        self._reference.add_to(menu)
        along = menu.addMenu("Move along")
        along.setToolTipsVisible(True)
        layers = [each for each in self._viewer.layers if can_move(each) and each is not source]
        along.setEnabled(bool(layers))
        for layer in layers:
            move = partial(self.move_along, layer)
            self._add_entry(along, str(layer.name), _WITH_IT, move)
        if len(layers) > 1:
            self._add_entry(along, "All of these", _WITH_IT, partial(self.move_along, *layers))
        backward, forward = self.save_field, partial(self.save_field, forward=True)
        outputs: tuple[tuple[str, str, Callable[[str], Any], str, str], ...] = (
            ("Export warp (backward)", _BACK, backward, "warp-backward.mha", _FOR_IMAGES),
            ("Export warp (forward)", _FORTH, forward, "warp-forward.nrrd", _FOR_POINTS),
            ("Export uncertainty", _BARS, self.save_uncertainty, "sd.nrrd", _IMAGES),
            ("Save looping GIF", _GIF, self.save_gif, f"{name}.gif", _GIFS),
            ("Save as film", _FILM, self.save_film, "film.gif", _FILMS),
        )
        for title, about, save, file, kinds in outputs:
            ask = partial(self._choose_file, save, title, file, kinds)
            entry = add_entry(menu, f"{title} ...", about, ask)
            entry.setEnabled(has_bars or save != self.save_uncertainty)
        add_entry(menu, "Save pictures ...", _PICTURES, self._on_save).setEnabled(shown is not None)
        menu.addSeparator()
        add_entry(menu, PRECISELY, ABOUT_PRECISELY, self.precise_chosen.emit)

    def _add_entry(self, menu: Any, title: str, about: str, action: Callable[[], object]) -> Any:
        return add_entry(menu, title, about, partial(attempt, action, self._show_message))

    def _on_save(self) -> None:
        title = "Choose where to create a folder of pictures"
        chosen = QtWidgets.QFileDialog.getExistingDirectory(self._button, title)
        if chosen:
            attempt(partial(self.save_pictures, chosen, own_folder=True), self._show_message)

    def _on_saved(self, paths: list[Path]) -> None:
        self._show_message(_saved(paths))
        self.saved.emit(paths)

    def _show_measurements(self) -> None:
        rows, answer = self.measure(), self._shown.answer
        unit, volume = answer.unit, len(answer.shape) == 3
        button = QtWidgets.QPushButton("Save .csv ...")
        words = measurements_in_words(rows, unit, volume=volume)
        note = strain_note(answer.solution)
        below = [QtWidgets.QLabel(f"Note: {note}.", wordWrap=True)] if note else []
        self._show_table("Measurements of each tissue", words, *below, button)
        save = partial(write_measurements, rows=rows, unit=unit, volume=volume)
        ask = partial(
            self._choose_file, save, "Save measurements", "measurements.csv", "Tables (*.csv)"
        )
        button.clicked.connect(lambda _: ask())

    def _show_forces(self) -> None:
        """Compute the forces that hold and move tissue, and show them in a table."""
        answer = self._shown.answer
        if answer.forces is None:
            raise HmrfError(
                "Forces are available for elastic tissue and large motion, after a solve in this "
                "session. Results of the paper's model and results from files have no forces."
            )
        ways, stiffness = directions_of(answer.frame, self._viewer), answer.solution.stress_unit

        def show(rows: tuple[HeldForce, ...]) -> None:
            words = forces_in_words(rows, ways, stiffness, answer.unit)
            self._show_table("Forces on tissue where it is held or moved", words)

        self._jobs.submit("forces", answer.forces, show)

    def _show_landmarks(self) -> None:
        """Show the landmarks in a table, which is updated with each result."""
        if self._landmark_table is None:
            window, refuse = self._button.window(), self._show_message
            table = LandmarkTable(window, lambda mark, sd: self.set_sd(mark, sd), refuse)
            table.finished.connect(self._on_landmarks_closed)
            self._landmark_table = table
        self.refresh_landmarks()
        self._landmark_table.show()
        self._landmark_table.raise_()

    def _on_landmarks_closed(self, *_: Any) -> None:
        self._landmark_table = None

    def _show_table(
        self, title: str, words: tuple[list[str], list[list[str]]], *below: QtWidgets.QWidget
    ) -> None:
        """Show a table in a separate window, with a note and buttons below."""
        window = TableWindow(self._button.window(), title, below=below)
        window.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        titles, rows = words
        window.show_cells(titles, [[*map(Cell, row)] for row in rows])
        window.show()

    def _choose_file(self, save: Callable[[str], Any], title: str, name: str, kinds: str) -> None:
        path, _ = QtWidgets.QFileDialog.getSaveFileName(self._button, title, name, kinds)
        if path:
            attempt(partial(save, path), self._show_message)


def _saved(paths: Sequence[Path]) -> str:
    return f"Saved in {paths[0].parent}: {', '.join(path.name for path in paths)}."

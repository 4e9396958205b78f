"""Binding of the dock's forms to the `Session`, and automatic choice of layers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

from napari.layers import Labels, Layer
from psygnal import Signal

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.field_layer import holds_field
from napari_hmrf.layers.image_choice import (
    image_covering,
    image_in_front,
    is_photograph,
    may_be_second,
    painted_on,
    shows_other_object,
)
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.metadata import BOUNDARY, role_of
from napari_hmrf.layers.slice_view import fits
from napari_hmrf.layers.viewer_layers import layers_of, shared
from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.study.session import BRIGHTNESS, DisplayChoice, ImageChoice, ModelChoice, Part
from napari_hmrf.tissue.material_presets import PLAIN, PRESETS, Preset
from napari_hmrf.tissue.row_table import change
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.forms import show_quietly
from napari_hmrf.ui.messages import EDGE_GOES, NEW_IMAGE, NOT_CHOSEN, SECOND, WELCOME


class FormBinding:
    """Two-way binding between the dock's forms and the `Session`.

    New layers are chosen automatically, without undo steps.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    form : DockForm

    Attributes
    ----------
    fields : dict of str to ValueWidget
        Widget for each attribute of `ImageChoice`.
    display : dict of str to ValueWidget
        Widget for each attribute of `DisplayChoice` except `arrows`, which `ResultView` shows.
    automatic : bool
        True while the program, rather than the user, changes values.
    """

    #: Emitted with a message about a choice that was made automatically after another choice.
    message = Signal(str)

    def __init__(self, viewer: Any, form: DockForm) -> None:
        self._viewer, self._form = viewer, form
        self._undo = undo = undo_of(viewer)
        self._session = session = undo.session
        motion = form.motion
        self.fields: dict[str, Any] = {
            "tissue": form.tissue.choice,
            "boundary": motion.boundary.choice,
            "confidence": motion.boundary.confidence,
            "without_border": form.tissue.border,
            "weight": motion.weight,
            "cavity": motion.cavity,
            "extent": form.extent,
            "compare_with": form.result.second,
            "preset": motion.fields.preset,
            **{each.name: each for each in motion.switches},
        }
        self.display: dict[str, Any] = {
            "live": form.model.in_detail.live,
            "device": form.model.in_detail.device,
            "overlay": form.result.overlay,
            "in_colours": form.result.in_colours,
        }
        self.automatic = False
        # True once the user has chosen or deformed an image; new images then do not replace it.
        self._image_is_fixed = False
        session.select(None)
        motion.boundary.choice.changed.connect(self._on_boundary)
        form.image.changed.connect(self._on_chosen)
        for field in (form.extent, form.tissue.choice, motion.boundary.choice):
            field.changed.connect(self._on_extent)
        # Chosen without an image, in a dock that was closed.
        if session.model_part in session.parts:
            form.model.choice = session.model
        for table in form.tables:
            table.changed.connect(self._write_tables)
        for field in (*self.fields.values(), form.model, form.model.in_detail):
            field.changed.connect(self.write, max_args=0)
        for name, field in self.display.items():
            field.changed.connect(partial(self._write_display, name))
            self._write_display(name, field.value)
        form.tissue.editor.plot.edited.connect(self._use_curve)
        form.tissue.editor.plot.settled.connect(lambda _: session.end())
        form.footer.undo.changed.connect(lambda _: undo.undo())
        form.footer.redo.changed.connect(lambda _: undo.redo())

        def show(*_: Any) -> None:
            form.footer.show_steps(undo, session.image)

        self._connections = EventConnections(
            (session.changed, self._on_changed),
            (session.selected, self._on_selected),
            (session.selected, show),
            (session.displayed, self._on_displayed),
            (session.steps_changed, show),
        )
        undo.bind_keys(self)
        self.write(step=False)
        show()

    @contextmanager
    def automatically(self) -> Iterator[None]:
        """Make changes inside the block without undo steps."""
        try:
            with self._showing():
                yield
        finally:
            self.write(step=False)  # does nothing inside an outer block

    @contextmanager
    def _showing(self) -> Iterator[None]:
        """Change the forms inside the block without writing their values back to the session.

        Writing back could change the session, because a form may round a value or not offer a
        layer.
        """
        before, self.automatic = self.automatic, True
        try:
            yield
        finally:
            self.automatic = before

    def settle(self) -> None:
        """Write automatic changes to the session now, rather than at the end of their block."""
        if self.automatic:
            self._write(step=False)

    # Automatic choice of layers

    def refresh(self, *_: Any) -> None:
        """Update the layer menus; if the image was removed, choose another image."""
        form, before = self._form, self._session.image
        with self.automatically():
            for choice in form.choices:
                choice.reset_choices()
            form.motion.landmarks.refresh()
            form.motion.landmarks.suggest()
            if before is not None and self._session.image is None:
                others = (form.tissue.choice.value, form.motion.boundary.confidence.value)
                images = [layer for layer in form.image.offered if layer not in others]
                self._image_is_fixed = self._image_is_fixed and bool(images)
                if images:
                    self._session.select(images[0])
                    layers_of(self._viewer).want(images[0])  # hidden as a second image
                else:  # the next image gets the defaults of a first image
                    usual = ImageChoice()
                    form.tissue.border.value = usual.without_border
                    for switch in form.motion.switches:
                        switch.value = getattr(usual, switch.name)
                    self._show_model(ModelChoice())

    def choose_first(self) -> None:
        """Choose the image to deform, preferably an edited image, and the layers painted on it."""
        self.refresh()
        viewer, offered = self._viewer, self._form.image.offered
        edited = self._drawn_on or shared(viewer, ResultLayers).sources
        with self.automatically():
            image = image_in_front(viewer, offered, edited)
            self._session.select(image)
            for layer in reversed(viewer.layers) if image is None else ():
                self._use_painted(layer)

    def begin(self) -> None:
        """Keep the chosen image when new layers are added."""
        self._image_is_fixed = True

    def use_layer(self, layer: Any) -> None:
        """Choose a new layer as a paint layer, as the image, or as the second image.

        It becomes the image if no other image is in use, or if it covers the image in use and
        shows another object, such as another sample.
        """
        session, is_offered = self._session, layer in self._form.image.offered
        is_same = session.image is not None and self._may_be_second(layer)
        begun = self._has_begun or (is_same and self._form.result.second.value is not None)
        if is_offered and not self.automatic:
            if is_same and self._choose_second(layer):
                self.message.emit(SECOND.format(self._form.image.value.name, layer.name))
                return
            if begun and self._covers(layer) and shows_other_object(session.image, layer):
                before: Any = session.image
                session.select(layer)
                self.message.emit(NEW_IMAGE.format(layer.name, before.name))
                return
        with self.automatically():
            if is_offered and not begun:
                session.select(layer)
            layers, image = self._viewer.layers, session.image
            if image is None or layer in painted_on(image, layers, self._form.view()):
                self._use_painted(layer)
        if is_offered and begun and not self.automatic:
            # Another message reports that a layer covers the image.
            self.message.emit("" if self._covers(layer) else NOT_CHOSEN.format(layer.name))

    @property
    def _has_begun(self) -> bool:
        """True if new images do not replace the image."""
        is_edited = self._session.image is not None and self._session.next_undo is not None
        return self._image_is_fixed or is_edited

    def _may_be_second(self, layer: Any) -> bool:
        """Return whether a layer may show the tissue of the image; during work, be strict."""
        image = self._session.image
        is_other = self._has_begun and shows_other_object(image, layer)
        return may_be_second(image, layer) and not is_other

    def _covers(self, layer: Any) -> bool:
        """Return whether a layer hides the image."""
        image = self._session.image
        return image is not None and image_covering(self._viewer, image) is layer

    def _choose_second(self, new: Any = None) -> bool:
        """Choose the only other image that may show the same tissue; return True if chosen.

        If `new` is given, only this layer is chosen. The layer is hidden if it is above the image
        to deform.
        """
        image, second = self._session.image, self._form.result.second
        if image is None or second.value is not None:
            return False
        painted = self._session.choice.layers
        others = [layer for layer in second.offered if self._may_be_second(layer)]
        others = [layer for layer in others if layer not in painted]
        if len(others) != 1 or new not in (None, others[0]):
            return False
        chosen, layers = others[0], self._viewer.layers
        with self.automatically():
            second.value = chosen
        if layers.index(chosen) > layers.index(image):
            layers_of(self._viewer).want(chosen, wanted=False)
        if layers.selection.active is chosen:  # napari makes each new layer active
            layers.selection.active = image
        return True

    def _use_painted(self, layer: Any) -> None:
        """Choose a painted layer for its role, unless that role already has a layer."""
        choice = self.fields.get(role_of(layer) or "")
        if choice is None or choice.value is not None or layer not in choice.offered:
            return
        # A painted boundary defines all fixed tissue.
        if role_of(layer) == BOUNDARY and layer.data.any():
            self._release_edge()
        choice.value = layer

    def _release_edge(self) -> None:
        """Release the edge without an event, because a boundary is being chosen."""
        show_quietly(self.fields["hold_edge"], False)

    @property
    def _drawn_on(self) -> list[Any]:
        """Images with a drawing on any slice."""
        parts = [part for part in self._session.parts if part.kind == "drawing" and part.layer]
        return [part.layer for part in parts if self._session.get(part).marks]

    def _on_extent(self, _: str) -> None:
        """Make napari's brush a ball if a volume is deformed, and a disc otherwise."""
        for choice in (self._form.tissue.choice, self._form.motion.boundary.choice):
            if isinstance(choice.value, Labels) and choice.value.ndim > 2:
                choice.value.n_edit_dimensions = 3 if self._form.extent.is_volume else 2

    def _on_boundary(self, layer: Any) -> None:
        """Release the edge if a field prescribes the motion; fix it if there is no boundary."""
        if holds_field(layer):
            if self.fields["hold_edge"].value:
                self.message.emit(EDGE_GOES.format(layer.name))
            self._release_edge()
        elif layer is None:
            self.fields["hold_edge"].value = True

    def _on_chosen(self, image: Any) -> None:
        """Select the image that is chosen in the menu."""
        self._image_is_fixed = self._image_is_fixed or not self.automatic
        self._session.select(image, is_gone=image is None)

    def _on_selected(self, image: Any, before: Any) -> None:
        """Show the earlier choices for an image, or choose layers for a new image.

        Raises
        ------
        HmrfError
            If the image is not in the viewer; the previous image remains selected.
        """
        form, session = self._form, self._session
        if image is not None and image not in form.image.offered:
            session.select(before)
            raise HmrfError(
                f"'{image.name}' is not an image in this viewer. Add it to the viewer first."
            )
        # Choices made before the first image, or for a removed image, apply to the next image.
        keep_choices = before is None or (image is None and self.automatic)
        known, choice = Part("choice", image) in session.parts, session.choice
        with self.automatically():
            if image is not form.image.value:
                form.image.value = image
            form.result.second.reset_choices()
            if image is not None:
                self._offer_presets(None)
            if not keep_choices:
                self._show(ImageChoice())
            if not keep_choices or session.model_part in session.parts:
                self._show_model(session.model)
            form.extent.show_for(image)
            form.tissue.offer(session.curve)
            if known and not session.image_is_gone:
                self._show(choice)
            elif image is not None:
                self._begin_with(image)

    def _offer_presets(self, chosen: Preset | None) -> None:
        """Offer all presets, and show the chosen one; by default, one for the kind of image."""
        image = self._session.image
        usual = PLAIN if image is not None and is_photograph(image) else PRESETS[0]
        self._form.motion.fields.offer_presets(usual, chosen)

    def _begin_with(self, image: Any) -> None:
        """Choose the layers painted on a new image, and drop choices that do not fit the image."""
        session, view = self._session, self._form.view()
        # Layers that are in use for other images are not chosen.
        others = [each for each in session.parts if each.kind == "choice" and each.layer]
        used_by_others = [
            layer
            for part in others
            if part.layer is not image
            for layer in session.get(part).layers
        ]
        for field in self.fields.values():
            layer = field.value
            # A displacement field may cover any region.
            if isinstance(layer, Layer) and not (holds_field(layer) or fits(layer, image, view)):
                field.value = None
        for layer in reversed(painted_on(image, self._viewer.layers, view)):
            if layer not in used_by_others:
                self._use_painted(layer)
        self._choose_second()

    def _show(self, choice: ImageChoice) -> None:
        """Show choices in the form, except layers that were removed."""
        with self.automatically():
            if choice.tissue == BRIGHTNESS:
                self._form.tissue.offer(self._session.curve)
            self._offer_presets(choice.preset)
            for name, field in self.fields.items():
                if name == "preset":
                    continue
                value, of_layers = getattr(choice, name), hasattr(field, "offered")
                field.value = value if not of_layers or value in field.choices else None

    def _show_model(self, model: ModelChoice) -> None:
        """Show the tissue model of an image in the form."""
        self._form.model.choice = model

    # From the forms to the session

    def release(self) -> None:
        """Disconnect from the session and the keys after the dock was closed or deleted."""
        self._undo.unbind_keys(self)
        self._connections.release()
        self.automatic = True  # a closed form must write nothing

    def write(self, *, step: bool = True) -> None:
        """Write the values of the forms to the session, unless the program is changing them."""
        if not self.automatic:
            self._write(step)

    def _write(self, step: bool) -> None:
        self._write_tables(automatic=not step)
        values = {name: field.value for name, field in self.fields.items()}
        self._session.choose(step=step, **values)
        self._session.choose_model(self._form.model.choice, step=step)

    def _write_display(self, name: str, value: Any) -> None:
        self._session.choose_display(**{name: value})

    def _write_tables(self, automatic: bool) -> None:
        for table in () if self.automatic and not automatic else self._form.tables:
            layer = table.layer
            if layer is None:
                continue
            before = self._session.table(table.role, layer)
            word = "" if automatic or before is None else change(before, table.contents, layer.name)
            self._session.set_table(table.role, layer, table.contents, word)

    @property
    def curve(self) -> StiffnessCurve | None:
        """Curve that maps brightness to stiffness, or None if no curve is in use; can be set."""
        return self._form.tissue.curve

    @curve.setter
    def curve(self, curve: StiffnessCurve | None) -> None:
        if curve is not None:
            self._use_curve(curve)
            self._session.end()
        elif self.curve is not None:
            self._form.tissue.choice.value = None

    def _use_curve(self, curve: StiffnessCurve) -> None:
        """Use a curve for the image: its first curve, or the next state of an edited curve."""
        image: Any = self._session.image
        if image is None:
            raise HmrfError(WELCOME)
        word = f"changed the curve of '{image.name}'"
        if self._session.curve is None:
            self._session.set_curve(curve, word)  # the first curve is not an undo step
        if self.curve is None:
            self._form.tissue.go_by(self._session.curve or curve)
        self._session.set_curve(curve, word)

    # From the session to the forms

    def _on_displayed(self, display: DisplayChoice) -> None:
        """Show how studies are displayed."""
        for name, field in self.display.items():
            if field.value != getattr(display, name):
                field.value = getattr(display, name)

    def _on_changed(self, part: Part, value: Any, _: Any = None) -> None:
        """Show a changed part in the form."""
        form = self._form
        if part.kind == "drawing":
            return
        with self._showing():
            is_current = part.layer is self._session.image
            if part.kind == "model" and is_current:
                form.model.choice = value
            elif part.kind == "choice" and is_current:
                self._show(value)
                value = replace(value, preset=self.fields["preset"].value)
                for layer in value.layers:  # undo may restore a layer that was removed
                    if isinstance(layer, Layer) and layer not in self._viewer.layers:
                        value = value.without(layer)
                self._session.amend(part, value)
            elif part.kind == "curve" and is_current:
                form.tissue.offer(value)
                if self._session.choice.tissue == BRIGHTNESS:
                    form.tissue.go_by(value)
            for table in form.tables:
                if part == Part(table.role, table.layer):
                    table.contents = value

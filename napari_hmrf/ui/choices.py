"""What is chosen in a dock, and its undo: each image has choices of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from napari.layers import Labels, Layer, Vectors
from psygnal import Signal

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.edit_history import CHOICE, CURVE, DRAWING, MODEL, Slot, steps_of
from napari_hmrf.layers.field_layer import holds_field
from napari_hmrf.layers.image_choice import image_covering, image_in_front, painted_on, uncover
from napari_hmrf.layers.image_result import ResultLayers
from napari_hmrf.layers.metadata import BOUNDARY, change, role_of
from napari_hmrf.layers.read import Request
from napari_hmrf.layers.slice_view import fits
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import Listening
from napari_hmrf.ui.messages import CHOOSE, EDGE_GOES, NOT_CHOSEN, WELCOME

#: Of the viewer, and no layer.
_THE_MODEL = Slot(MODEL, "")
#: What is done to the model and to the choices of an image, in words; the first that differs says
#: it, and how it is solved in detail is no step.
_WORDS = {
    "model": "chose another model",
    "plane": "chose another plane",
    "poisson": "changed Poisson's ratio",
    "tissue": "chose what says how stiff tissue is",
    "boundary": "chose another boundary",
    "confidence": "chose what says how sure the boundary is",
    "border": "changed whether the dark border is tissue",
    "edge": "changed whether the edge is held",
    "weight": "changed the weight",
    "extent": "changed between slice and volume",
}


class Choices:
    """Chooses layers as they come, and those of an image when it is chosen.

    Each edit of what is chosen is a step, as are those of tables and curves; what is undone is
    shown in the form.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    form : DockForm

    Attributes
    ----------
    fields : dict of str to ValueWidget
        With what each image has of its own.
    by_itself : bool
        Whether what is chosen now is nobody's doing.
    """

    #: What was chosen with something else, in words.
    said = Signal(str)

    def __init__(self, viewer: Any, form: DockForm) -> None:
        self._viewer, self._form = viewer, form
        self._steps = steps = steps_of(viewer)
        self._edits = steps.edits
        motion = form.motion
        self.fields: dict[str, Any] = {
            "tissue": form.tissue.choice,
            "boundary": motion.boundary.choice,
            "confidence": motion.boundary.confidence,
            "border": form.tissue.border,
            "edge": motion.edge,
            "weight": motion.weight,
            "extent": form.extent,
            "second": form.result.second,
        }
        self._beginning = self.values
        self._image: Any = None
        self.by_itself = False
        # Whether somebody chose an image, or none, or had one deformed.
        self._by_hand = False
        # Whether there is no image any more.
        self._lost = False
        motion.boundary.choice.changed.connect(self._on_boundary)
        form.image.changed.connect(self._on_image)
        for field in (form.extent, form.tissue.choice, motion.boundary.choice):
            field.changed.connect(self._on_extent)
        form.model.values = self._edits.get(_THE_MODEL, {})  # of a dock that was closed
        for table in form.tables:
            table.changed.connect(lambda by_itself: self._keep(self._tables, by_itself))
        for field in (form.image, *self.fields.values(), form.model, form.model.in_detail):
            field.changed.connect(self.note, max_args=0)
        form.tissue.editor.plot.edited.connect(self._take_curve)
        form.tissue.editor.plot.settled.connect(self._edits.end)
        form.footer.undo.changed.connect(lambda _: steps.undo())
        form.footer.redo.changed.connect(lambda _: steps.redo())
        show = partial(form.footer.show_steps, steps)
        self._heard = Listening((self._edits.changed, self._on_undone), (self._edits.moved, show))
        steps.bind_keys(self)
        self.note(by_itself=True)
        show()

    @property
    def values(self) -> dict[str, Any]:
        """What goes with the image, by name; to be set, too: a layer that is gone is none."""
        return {name: field.value for name, field in self.fields.items()}

    @values.setter
    def values(self, values: Mapping[str, Any]) -> None:
        with self.nobody_chooses():
            for name, value in values.items():
                field = self.fields[name]
                layer = hasattr(field, "offered")
                field.value = value if not layer or value in field.choices else None

    @contextmanager
    def nobody_chooses(self) -> Iterator[None]:
        """What is chosen meanwhile is chosen by itself."""
        before, self.by_itself = self.by_itself, True
        try:
            yield
        finally:
            self.by_itself = before
            if not before:
                self.note(by_itself=True)

    @property
    def request(self) -> Request:
        """All that is chosen, with the slice that is shown and no drawing.

        Raises
        ------
        HmrfError
            If there is nothing to work on.
        """
        form, boundary = self._form, self._form.motion.boundary
        image, tissue = form.image.value, form.tissue.layer
        if image is None and (self._lost or not isinstance(tissue, Labels)):
            raise HmrfError(CHOOSE if self._viewer.layers else WELCOME)
        arrows = isinstance(boundary.choice.value, Vectors)
        return Request(
            image=image,
            tissue=tissue,
            materials=form.tissue.table.rows,
            boundary=boundary.choice.value,
            rules=boundary.table.rows,
            confidence=boundary.confidence.value if arrows else None,
            view=form.view(),
            hold_edge=form.motion.edge.value,
            drawing=Drawing(),
            preset=form.motion.fields.preset.value,
            without_border=form.tissue.border.value,
            curve=form.tissue.curve,
            weight=form.motion.weight.value,
        )

    def look(self, *_: Any) -> None:
        """Look again at which layers there are; another image takes the place of one that left."""
        form, before = self._form, self._form.image.value
        with self.nobody_chooses():
            for choice in form.choices:
                choice.reset_choices()
            form.motion.boundary.landmarks.look()
            if before is not None and form.image.value is None:
                others = (form.tissue.choice.value, form.motion.boundary.confidence.value)
                images = [layer for layer in form.image.offered if layer not in others]
                self._by_hand = self._by_hand and bool(images)
                if images:
                    form.image.value = images[0]
                else:  # the next one begins as the first did
                    self.values = {name: self._beginning[name] for name in ("border", "edge")}

    def choose_first(self) -> None:
        """Choose the image in front, or one that is worked on, and what is painted on it."""
        self.look()
        viewer, offered = self._viewer, self._form.image.offered
        worked_on = self._drawn_on or shared(viewer, ResultLayers).sources
        with self.nobody_chooses():
            self._form.image.value = image = image_in_front(viewer, offered, worked_on)
            for layer in reversed(viewer.layers) if image is None else ():
                self._take_painted(layer)

    def begin(self) -> None:
        """Work has begun with the image that is chosen: no other takes its place by itself."""
        self._by_hand = True

    def take(self, layer: Any) -> None:
        """Choose a layer that came: an image until work has begun on one, and what lies on that."""
        image = self._form.image
        begun = self._by_hand or (image.value is not None and self._edits.next_undo is not None)
        with self.nobody_chooses():
            if layer in image.offered and not begun:
                image.value = layer
            there = self._viewer.layers
            if image.value is None or layer in painted_on(image.value, there, self._form.view()):
                self._take_painted(layer)
        if layer in image.offered and begun and not self.by_itself:
            covers = image.value and image_covering(self._viewer, image.value) is layer
            self.said.emit("" if covers else NOT_CHOSEN.format(layer.name))  # that is said anyway

    def _take_painted(self, layer: Any) -> None:
        """Choose what is painted, where nothing is chosen yet."""
        choice = self.fields.get(role_of(layer) or "")
        if choice is None or choice.value is not None or layer not in choice.offered:
            return
        if role_of(layer) == BOUNDARY and layer.data.any():  # it says all that is held
            self._let_edge_go()
        choice.value = layer

    def _let_edge_go(self) -> None:
        """Have the edge not be held, as a part of choosing a boundary."""
        edge = self._form.motion.edge
        with edge.changed.blocked():
            edge.value = False

    @property
    def _drawn_on(self) -> list[Any]:
        """The images on any slice of which something is drawn."""
        slots = [each for each in self._edits.slots if each.what == DRAWING]
        return [slot.layer for slot in slots if self._edits.get(slot).marks]

    def _on_extent(self, _: str) -> None:
        """Have napari's brush be a ball where a volume is painted."""
        for choice in (self._form.tissue.choice, self._form.motion.boundary.choice):
            if isinstance(choice.value, Labels) and choice.value.ndim > 2:
                choice.value.n_edit_dimensions = 3 if self._form.extent.is_volume else 2

    def _on_boundary(self, layer: Any) -> None:
        """A field says how the edge moves; without a boundary it is held."""
        if holds_field(layer):
            if self._form.motion.edge.value:
                self.said.emit(EDGE_GOES.format(layer.name))
            self._let_edge_go()
        elif layer is None:
            self._form.motion.edge.value = True

    def _on_image(self, image: Any) -> None:
        """Choose what goes with an image: what was chosen for it before, if it was."""
        self._by_hand = self._by_hand or not self.by_itself
        before, self._image = self._image, image
        if before is image:
            return
        # What was chosen for an image that is gone, or before there was one, is for the next.
        stays = before is None or (image is None and self.by_itself)
        self._lost = image is None
        with self.nobody_chooses():
            if not stays:
                self.values = self._beginning
            self._form.extent.look_at(image)
            self._form.tissue.offer(self._edits.get(Slot(CURVE, image)))
            known = self._edits.get(Slot(CHOICE, image))
            if known is not None:
                self.values = known
            elif image is not None:
                self._begin_with(image)

    def _begin_with(self, image: Any) -> None:
        """Choose what is painted on an image, and nothing any more that lies elsewhere."""
        edits, view = self._edits, self._form.view()
        # What goes with other images is not meant for this one.
        others = [each for each in edits.slots if each.what == CHOICE and each.layer is not image]
        theirs = [value for slot in others for value in edits.get(slot).values()]
        for name, layer in self.values.items():
            # A field may lie anywhere.
            if isinstance(layer, Layer) and not (holds_field(layer) or fits(layer, image, view)):
                self.fields[name].value = None
        for layer in reversed(painted_on(image, self._viewer.layers, view)):
            if layer not in theirs:
                self._take_painted(layer)

    # What is a step, and what is undone

    def release(self) -> None:
        """The dock is closed, or its window is gone."""
        self._steps.unbind_keys(self)
        self._heard.release()

    def note(self, by_itself: bool = False) -> None:
        """Keep what is edited now; what comes `by_itself` is no step."""
        choice = Slot(CHOICE, self._form.image.value), self.values
        model = _THE_MODEL, self._form.model.values
        self._keep([*self._tables, choice, model], by_itself)

    def _keep(self, edited: list[tuple[Slot, Any]], by_itself: bool) -> None:
        for slot, now in () if self.by_itself else edited:
            if slot.layer is None or now == (before := self._edits.open(slot, now)):
                continue
            word = "" if by_itself else _step(slot, before, now)
            if word:
                self._edits.do(slot, now, word)
            else:
                self._edits.amend(slot, now)

    @property
    def _tables(self) -> list[tuple[Slot, Any]]:
        return [(Slot(each.role, each.layer), each.contents) for each in self._form.tables]

    @property
    def curve(self) -> StiffnessCurve | None:
        """The curve by which the image's brightness is its tissue, if it is; to be set, too."""
        return self._form.tissue.curve

    @curve.setter
    def curve(self, curve: StiffnessCurve | None) -> None:
        if curve is not None:
            self._take_curve(curve)
            self._edits.end()
        elif self.curve is not None:
            self._form.tissue.choice.value = None

    def _take_curve(self, curve: StiffnessCurve) -> None:
        """Have the image go by a curve: its first, or a step that is not over yet."""
        slot, model = self._curve_slot, self._edits
        if slot.layer is None:
            raise HmrfError(WELCOME)
        known = model.open(slot, curve)
        if self.curve is None:
            self._form.tissue.go_by(known)
        if known != curve:
            if model.in_progress != slot:
                model.begin(slot, f"changed the curve of '{slot.layer.name}'")
            model.update(curve)

    @property
    def _curve_slot(self) -> Slot:
        return Slot(CURVE, self._form.image.value)

    def _on_undone(self, slot: Any, value: Any, _: Any = None) -> None:
        """Put back what is shown of it here, and choose the image it is of."""
        form = self._form
        if slot.what == DRAWING and slot.layer is form.image.value:
            return
        with self.nobody_chooses():
            others = [each for each in form.image.offered if each is not form.image.value]
            if slot.what in (DRAWING, CHOICE) and slot.layer in others:
                form.image.value = slot.layer
                uncover(self._viewer, slot.layer)
            if slot == _THE_MODEL:
                form.model.values = value
            elif slot.what == CHOICE:
                self.values = value
            elif slot == self._curve_slot:
                form.tissue.go_by(value)
            for table in form.tables:
                if slot == Slot(table.role, table.layer):
                    table.contents = value


def _step(slot: Slot, before: Any, now: Any) -> str:
    """What was done, in words; "" if it is no step."""
    if slot.what in (MODEL, CHOICE):
        changed = [name for name in now if before[name] != now[name]]
        return next((word for name, word in _WORDS.items() if name in changed), "")
    return change(before, now, slot.layer.name)

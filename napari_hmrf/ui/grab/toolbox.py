"""The tool in the hand, with its button, its keys, its fields and its name on the canvas."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.landmarks import landmarks_of
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.ui.grab.badge import Badge
from napari_hmrf.ui.grab.form import GrabForm
from napari_hmrf.ui.grab.puller import Puller
from napari_hmrf.ui.grab.tools import BY_NAME, Tool
from napari_hmrf.ui.messages import in_short


class Toolbox:
    """Has buttons, keys and fields choose the tool and how it draws.

    Parameters
    ----------
    form : GrabForm
    puller : Puller
    viewer : napari.Viewer or ViewerModel
    say : callable
        Called with what there is to say.
    start, stop : callable
        Have the mouse pull, and have it move the view again.
    """

    def __init__(
        self,
        form: GrabForm,
        puller: Puller,
        viewer: Any,
        say: Callable[[str], None],
        *,
        start: Callable[[], object],
        stop: Callable[[], None],
    ) -> None:
        self._form, self._puller, self._say = form, puller, say
        self._start, self._stop = start, stop
        self._badge = Badge(viewer)
        #: The landmarks that were taken from points last, and from which, for which drawing.
        self._taken: tuple[Landmark, ...] = ()
        self._taken_of: tuple[Any, ...] = ()
        for name, button in form.tools.items():
            button.native.clicked.connect(partial(self._on_button, name))
        for field in form.fields:
            if field is not form.fields.preset:
                field.changed.connect(self._on_field)
        for choice in (form.where, form.should):
            choice.changed.connect(self.look)
        form.take.changed.connect(self.take_points)
        puller.taken.connect(form.fields.show_how)
        puller.taken_up.connect(self._on_tool)
        puller.asked_for.connect(self.take)
        puller.asked_for_size.connect(self._on_size)

    def take(self, name: str) -> None:
        """Have a tool in the hand.

        Raises
        ------
        ValueError
            If there is none of that name.
        """
        if name not in BY_NAME:
            raise ValueError(f"there is no tool {name!r}, only {', '.join(BY_NAME)}")
        self._puller.take_up(BY_NAME[name])

    def look(self, *_: Any) -> None:
        """Look again at what the tool needs: layers have come or gone."""
        self._form.show_for(self._puller.tool)

    def take_points(self, *_: Any) -> bool:
        """Draw landmarks from the points of the two layers chosen; whether it could."""
        form, puller = self._form, self._puller
        where, should, ground = form.where.value, form.should.value, puller.ground
        if where is None or should is None or ground is None:
            return False
        radius, sure = form.radius.value, form.confidence.value
        try:
            found = landmarks_of(where, should, ground.study.grid.place, ground.shape, radius, sure)
        except LayerError as error:
            self._say(in_short(error))
            return False
        marks = puller.history.drawing.marks
        slot: Any = puller.history.slot
        key = (slot.place, *(weakref.ref(layer) for layer in (slot.layer, where, should)))
        # What was taken from these points before is replaced: they may have moved since.
        before = self._taken if self._taken_of == key else ()
        kept = [mark for mark in marks if mark not in before and mark not in found]
        self._taken, self._taken_of = tuple(found), key
        puller.set_drawing(Drawing((*kept, *found)), f"took {len(found)} landmarks from points")
        again = ", in place of those taken before" if len(kept) < len(marks) else ""
        self._say(f"Took {len(found)} landmarks from '{where.name}' and '{should.name}'{again}.")
        return True

    def show(self) -> None:
        """Show which tool the mouse has, if any."""
        tool, active = self._puller.tool, self._puller.active
        self._form.show_toggle(tool.name if active else "")
        self._badge.say(self._form.fields.words if active else "")

    def release(self) -> None:
        """Say nothing on the canvas any more."""
        self._badge.say("")

    def _on_button(self, name: str, *_: Any) -> None:
        """The button of a tool takes it, and puts it down again."""
        if self._puller.active and self._puller.tool.name == name:
            self._stop()
            return
        self.take(name)
        if self._puller.active:
            self.show()
        else:
            self._start()

    def _on_size(self, factor: float) -> None:
        radius = self._form.radius
        radius.value = min(max(float(f"{radius.value * factor:.3g}"), radius.min), radius.max)

    def _on_tool(self, tool: Tool) -> None:
        self._form.show_for(tool)
        self._puller.display.arrows.show_tool(tool.how)
        self.show()

    def _on_field(self, *_: Any) -> None:
        how = self._form.fields.how
        self._puller.display.arrows.show_radius(how.radius)
        self.show()
        # A tissue is chosen for what is painted next; of the others the last is adjusted, too.
        if self._puller.tool.name == "tissue" and not self._puller.picked:
            return
        try:
            self._puller.hand.change(**asdict(how))
        except HmrfError as error:
            self._say(in_short(error))

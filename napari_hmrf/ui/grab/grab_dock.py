"""The dock widget *Grab and pull*: press on tissue, drag, and it follows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from psygnal import Signal

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.image_choice import image_covering
from napari_hmrf.layers.layer_copies import LayerCopies
from napari_hmrf.layers.paint_layer import tissue_colours
from napari_hmrf.layers.read import Request, read_study
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View, unit_symbol
from napari_hmrf.layers.viewer_layers import is_selection_kept, still_there
from napari_hmrf.layers.viewer_shared import shared
from napari_hmrf.solver.live_solver import TOLERANCE
from napari_hmrf.solver.optimizers import Multigrid
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.study import Study
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.usual_lengths import usual_radius, usual_step
from napari_hmrf.ui.grab.grab_controls import GrabControls
from napari_hmrf.ui.grab.grab_events import GrabWatch
from napari_hmrf.ui.grab.grab_messages import (
    ARROWS_GONE,
    COVERED,
    FLAT,
    IMAGE_GONE,
    OFF,
    START,
    covered,
)
from napari_hmrf.ui.grab.toolbox import Toolbox
from napari_hmrf.ui.messages import WELCOME, in_short
from napari_hmrf.ui.step_buttons import StepKeys
from napari_hmrf.ui.timers import single_shot

#: How long a drawing must rest until its displacement is drawn, in milliseconds.
_REST = 300


class GrabAndPull(GrabControls):
    """Pull tissue with the mouse and see all of it follow.

    Everything the mouse can do a script can do too: choose `image` and `tissue`, `start()`, set
    `drawing`, `undo()` and `redo()`; `seen` is emitted with every new state of the tissue.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    seen : Signal(object)
        Emitted with what is `Seen` from now on.
    """

    seen = Signal(object)

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self._started = self._sized = self._was_active = False
        self._status = self._step = ""
        self._resting = single_shot(self.native, _REST, self._on_rest)
        self._selected = single_shot(self.native, 0, self.active_changed)
        # napari may be in the middle of removing more layers than the one.
        self._leaving = single_shot(self.native, 0, self._puller.display.leave)
        self._toolbox = Toolbox(
            self.form, self._puller, self._viewer, self.say, start=self.start, stop=self.stop
        )
        self._connect()
        self._watch = GrabWatch(self, self.form, self._viewer)
        self._copies = shared(self._viewer, LayerCopies)
        StepKeys(self.native, self._puller.steps)
        self.reset_choices()
        self._watch.choose_first()
        self.say(self._invitation)

    # What there is to see

    @property
    def busy(self) -> bool:
        """Whether tissue is still on its way."""
        read = not self._started or not self._watch.waiting
        return self._puller.follower.busy or self._resting.isActive() or not read

    @property
    def study(self) -> Study | None:
        """What is drawn, and what it is drawn on; None where nothing can be."""
        ground = self._puller.ground
        if ground is None:
            return None
        return replace(ground.study, motion=replace(ground.study.motion, drawing=self.drawing))

    @property
    def status(self) -> str:
        """The sentence below the buttons: what was done last, or can be done next."""
        return self._status

    @property
    def tool(self) -> str:
        """What the mouse does: "pull", "landmark", or what it paints, an action of a `Stroke`."""
        return self._puller.tool.name

    @tool.setter
    def tool(self, name: str) -> None:
        self._toolbox.take(name)

    # What can be done

    def start(self) -> bool:
        """Have the mouse pull tissue; whether it does from now on."""
        before, self._started = self._started, True
        if not self.look():
            self._started = before
        else:
            if not self._sized and self._puller.ground is not None:
                ground = self._puller.ground
                size = (ground.shape, ground.study.grid.spacing)
                self.form.fields.begin_with(usual_radius(*size), usual_step(*size))
                self._sized = True
            self._watch.hide_paint()
            self._puller.take(self.form.radius.value)
        self.show_toggle()
        return self.active

    def stop(self) -> None:
        """Have the mouse move the view again; what is drawn stays."""
        if self.active and self.image in self._viewer.layers:
            self._viewer.layers.selection = {self.image}
        self.active_changed()

    def look(self) -> bool:
        """Read the layers of the slice that is shown, and go on with what is drawn there.

        Returns
        -------
        bool
            Whether there is anything to draw on.
        """
        if not self._started or self.away:
            if self._status == FLAT and self._viewer.dims.ndisplay == 2:
                self.say(self._invitation)
            return False
        try:
            if self.image is None:
                raise HmrfError(IMAGE_GONE if self._viewer.layers else WELCOME)
            if self._viewer.dims.ndisplay != 2:
                raise HmrfError(FLAT)
            view = View.of(self._viewer.dims)
            form = self.form
            request = Request(
                image=self.image,
                tissue=self.tissue,
                boundary=self.boundary,
                view=view,
                hold_edge=form.edge.value,
                preset=form.fields.preset.value,
                drawing=Drawing(),
            )
            study = read_study(request, optimizer=Multigrid(TOLERANCE), copies=self._copies)
            before = self._puller.ground
            same = before is not None and before.study.lies_as(study)
            ground = before if before is not None and same else Ground.of(study)
        except (HmrfError, ValueError) as error:
            self._puller.stand_on(None)
            self.show_toggle()
            self.say(in_short(error))
            return False
        if ground is not before:
            tissues = tissue_colours(ground.palette, self.tissue)
            self._puller.stand_on(ground, self.image, tissues)
            self.form.fields.offer(ground.palette)
            self.show_toggle()
        ways = Directions.of(ground.study.grid.place, self._viewer)
        self.form.fields.show_place(unit_symbol(ground.study.grid.place.unit), ways)
        return True

    def take_points(self, where: Any, should: Any) -> bool:
        """Draw landmarks from the points of two layers, paired by their order; whether it could."""
        self.form.where.value, self.form.should.value = where, should
        return self._toolbox.take_points()

    def reset_choices(self, *_: Any) -> None:
        """Look again at which layers there are."""
        if not self.away:
            for choice in self.form.choices:
                choice.reset_choices()
            self._toolbox.look()

    def say(self, sentence: str) -> None:
        """Say something below the buttons."""
        if not self.away:
            self._status = sentence
            self.form.status.say(sentence)

    def let_go(self) -> None:
        """End a drag where it is."""
        self._puller.answers.release()

    # What happens elsewhere

    def active_changed(self) -> None:
        """Another layer feels the mouse, or ours does again."""
        if is_selection_kept(self._viewer):
            self._selected.start()  # what is selected then counts
            return
        before, self._was_active = self._was_active, self.active
        if self._puller.quiet:
            return
        if not self.active:
            self._puller.answers.release()
            if before and self._rests and self._status != ARROWS_GONE:
                self.say(OFF)
        else:
            if not before:
                self._puller.display.come_forward()
            if self._status == OFF:
                self.say(self._puller.tool.how)
        self.show_toggle()

    def show_toggle(self) -> None:
        """Show which tool the mouse has."""
        self._toolbox.show()

    def layer_gone(self, layer: Any) -> None:
        """A layer was removed: nothing of it is pulled any more."""
        if self._puller.quiet or not self._started:
            return
        if layer is self._puller.display.arrows.former:
            self._puller.answers.release()
            self.say(ARROWS_GONE)
        if self._puller.ground is not None and self.image is None:
            self._started = False
            self._puller.stand_on(None)
            self._leaving.start()
            self.say(IMAGE_GONE)
        self.show_toggle()

    def cover_changed(self) -> None:
        """The image may be hidden beneath another, or no more."""
        how = self._puller.tool.how if self._started else START
        if self._status.startswith(COVERED) or self._status == how:
            self.say(self._covered or (OFF if self._started and not self.active else how))

    def _connect(self) -> None:
        puller = self._puller
        for name in ("undo", "redo", "remove", "clear"):
            getattr(self.form, name).changed.connect(getattr(self, name))
        self.form.image.changed.connect(self._on_image)
        puller.said.connect(self._on_said)
        puller.begun.connect(self._on_begun)
        puller.warned.connect(self._on_warned)
        puller.steps.said.connect(self._on_step)
        puller.steps.edits.moved.connect(self._show_steps)
        puller.changed.connect(self._on_changed)
        puller.seen.connect(self.seen.emit)

    @property
    def _rests(self) -> bool:
        """Whether the tool was taken up, and put down."""
        return self._started and self._puller.ground is not None and not self.active

    @property
    def _covered(self) -> str:
        """That the image is hidden beneath another, if it is."""
        image = still_there(self._viewer, self.image)
        other = None if image is None else image_covering(self._viewer, image)
        return "" if other is None else covered(other.name)

    @property
    def _invitation(self) -> str:
        """What can be done first."""
        return WELCOME if self.image is None else self._covered or START

    def _on_image(self, image: Any) -> None:
        told = self._status in (WELCOME, IMAGE_GONE, START) or self._status.startswith(COVERED)
        if image is not None and told:
            self.say(self._invitation)

    def _on_changed(self) -> None:
        if self.away:
            return
        self._resting.start()
        self._show_steps()

    def _show_steps(self) -> None:
        if not self.away:
            selected = self._puller.hand.selected is not None
            self.form.show_steps(self._puller.steps, len(self.drawing.marks), selected)

    def _on_said(self, sentence: str) -> None:
        if sentence == self._puller.tool.how and self._puller.preparing:
            return  # not yet
        # On another slice, too, it is still to be read what was taken back there.
        if sentence not in (self._puller.tool.how, OFF) or self._status != self._step:
            self.say(self._covered or sentence if sentence == self._puller.tool.how else sentence)

    def _on_begun(self) -> None:
        self._step = ""
        if not self._puller.preparing:
            self.say(self._puller.tool.how)

    def _on_warned(self, warning: str) -> None:
        if not self.away:
            self.form.warn(warning)

    def _on_step(self, sentence: str, _: object) -> None:
        gone = self._puller.display.arrows.layer is None
        next_ = (ARROWS_GONE if gone else OFF) if self._rests else ""
        self._step = f"{sentence} {next_}".strip()
        self.say(self._step)

    def _on_rest(self) -> None:
        if self.away:
            return
        if self._puller.hand.holding or self._puller.follower.busy:
            self._resting.start()
        else:
            self._puller.complete()

    def _on_opened(self) -> None:
        self._puller.steps.bind_keys(self._puller.answers)
        self.reset_choices()
        if not self._started:
            # Of what was said and shown when the dock was closed nothing is so any more.
            self._step = ""
            self._on_warned("")
            self.say(self._invitation)
            self._show_steps()
            self.show_toggle()

    def _on_closed(self) -> None:
        self._started = False
        self._resting.stop()
        self._selected.stop()
        self._toolbox.release()
        self._puller.steps.unbind_keys(self._puller.answers)
        self._puller.leave()

    def _on_end(self) -> None:
        self._watch.release()
        self._puller.steps.unbind_keys(self._puller.answers)
        self._puller.end()

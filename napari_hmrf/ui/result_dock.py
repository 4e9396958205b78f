"""The part of *Deform tissue* that shows results, and says what there is to say."""

from __future__ import annotations

import weakref
from typing import Any

from psygnal import Signal

from napari_hmrf.layers.layer_copies import LayerCopies
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.read import Request, read_study
from napari_hmrf.layers.result_layers import picture_layer
from napari_hmrf.layers.viewer_shared import shared
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.study import Study
from napari_hmrf.ui.chooser import Chooser
from napari_hmrf.ui.footer import Footer
from napari_hmrf.ui.forms import Part
from napari_hmrf.ui.job import Done
from napari_hmrf.ui.messages import CHOOSE, MAKE, NO_FOLDS, READY, WELCOME
from napari_hmrf.ui.messages import details as details_of
from napari_hmrf.ui.remembered_settings import keep
from napari_hmrf.ui.result_state import Latest


class ResultDock(Chooser):
    """What came out last, in layers and in words; what is asked for, and when, comes on top.

    Parameters
    ----------
    napari_viewer : napari.Viewer

    Attributes
    ----------
    footer : Footer
        What always stays in sight.
    dims : napari.components.Dims
        Which slice is shown.
    followed : Signal(object)
        Emitted with `Outputs` when the result has followed an edit, in live mode.
    """

    footer = Part[Footer]("_face.footer")
    dims = Part[Any]("_viewer.dims")
    followed = Signal(object)

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__(napari_viewer)
        self._status = ""
        self._latest = shared(self._viewer, Latest)
        self._copies = shared(self._viewer, LayerCopies)
        self._painting: tuple[str, weakref.ref[Any] | None] = ("", None)
        keep(self._viewer, self._face.solved)
        self._face.folds.changed.connect(self._on_folds)

    # What there is to see

    @property
    def idle(self) -> bool:
        """Whether nothing is being computed for this widget."""
        return self._life.job is None

    @property
    def status(self) -> str:
        """The sentence at the bottom."""
        return self._status

    @property
    def details(self) -> str:
        """What ran to make the latest result, how long and how well."""
        done = self._latest.done
        return "" if done is None else details_of(done)

    @property
    def solution(self) -> Solution | None:
        """Of the latest result."""
        done = self._latest.done
        return None if done is None else done.outputs.solution

    @property
    def shown(self) -> Study | None:
        """What the latest result was made from."""
        done = self._latest.done
        return None if done is None else done.study

    @property
    def backend(self) -> str:
        """What a deformation is computed on."""
        return self.settings.backend

    @property
    def study(self) -> Study:
        """What is chosen, painted and set, as it is now.

        Raises
        ------
        HmrfError
            If a layer is missing, or cannot be read.
        """
        return self.read(self.request())

    def read(self, request: Request) -> Study:
        """Read what is chosen, and how it is to be solved."""
        return read_study(request, self.settings.prior, self.settings.optimizer, self._copies)

    # What is said and shown

    def say(self, status: str) -> None:
        """Say something at the bottom, unless there is something more important going on."""
        if self.idle:
            self._say(status)

    def note(self, found: str) -> None:
        """Say what was found in the paint, until the next result."""
        self._latest.note = found
        self.say(found)

    def say_painting(self, sentence: str, layer: Any) -> None:
        """Say what is painted, as long as its layer is the active one."""
        self._painting = sentence, weakref.ref(layer)
        self.say(sentence)

    def active_changed(self, active: Any) -> None:
        """Another layer feels the mouse: nothing is painted in the one before."""
        sentence, reference = self._painting
        if self._status != sentence or reference is None or active is reference():
            return
        if self._latest.done is None:
            self.say(self.invitation)
        else:
            self.say_result()

    @property
    def can_deform(self) -> bool:
        """Whether there is tissue, and a boundary or landmarks that say how it moves."""
        held = self.boundary is not None or self._face.boundary.landmarks.complete
        return self.tissue is not None and held

    @property
    def invitation(self) -> str:
        """What can be done first."""
        if self.can_deform:
            return self.model.objection or READY
        if self.image is None:
            return CHOOSE if self._viewer.layers else WELCOME
        return MAKE

    def image_gone(self, image: Any) -> None:
        """The image was removed: what was said of its result is over."""
        if self._latest.source() is image:
            self._latest.forget()
            self._face.energy.show_solution(None)
        next_one = "choose or open another image."
        if self.image is not None:
            next_one = f"'{self.image.name}' is chosen now."
        self.say(f"'{image.name}' is gone: {next_one}")

    def show_live(self, done: Done, source: Any, asked: bool = True) -> None:
        """The result has followed an edit, or, unasked, the slice that is shown."""
        if source not in self._viewer.layers:
            return
        self._latest.done = done
        self._latest.compare(self.request, self.read)
        self._put(done, source, asked)
        if self._latest.fresh:
            self.say_result()
        self.followed.emit(done.outputs)

    def show_picture(self, moved: Deformation, source: Any, asked: bool = True) -> bool:
        """Show at once how the image has followed an edit; whether that is seen."""
        if "image" not in self.outputs or moved.image is None or moved.solution is None:
            return False
        frame, parameters = moved.study.grid.place, moved.solution.provenance.parameters
        made = picture_layer(frame, moved.study.pictures, moved.image, parameters)
        show = self._results.show
        return bool(show(source, frame, {"image": made}, "deform", asked=asked, moving=True))

    def outdate(self) -> None:
        """The result is not that of the layers."""
        self._latest.outdate()

    def say_result(self) -> None:
        """Say what came out."""
        if self.idle:
            words, small = self._latest.words
            self._say(f"{words} {self._latest.note}".rstrip(), small)
            self._latest.note = ""

    def _put(self, done: Done, source: Any, asked: bool = True) -> None:
        outputs = done.outputs
        for made in outputs.layers.values():
            made.attributes["metadata"][METADATA]["inputs_changed"] = not self._latest.fresh
        self._hide_preview()
        self._latest.source = weakref.ref(source)
        frame = done.study.grid.place
        self._results.show(source, frame, outputs.layers, "deform", asked=asked)
        self._face.energy.show_solution(outputs.solution)

    def _on_folds(self, ticked: bool) -> None:
        done = self._latest.done
        if ticked and done is not None and self._latest.fresh and not done.outputs.folds:
            self.say(NO_FOLDS)

    def _take_over(self) -> Any:
        """Go on with the result of a dock that was closed, if it is still that of the layers."""
        latest, source = self._latest, self._latest.source()
        if latest.done is None:
            return None
        self._copies.forget()  # a script may have changed what no dock looked at
        latest.compare(self.request, self.read)
        if not latest.fresh or source not in self._viewer.layers:
            latest.forget()
            return None
        self._face.energy.show_solution(latest.done.outputs.solution)
        self.say_result()
        return source

    @property
    def _worked_on(self) -> tuple[Any, ...]:
        return (self._latest.source(),)

    def _say(self, status: str, details: str = "") -> None:
        self._status = status
        self._face.footer.say(status, details)

    def _hide_preview(self) -> None:
        """Make way for a result."""

"""Layers of the selected result at any percentage of its deformation, and their player."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy.typing as npt
from psygnal import Signal

from napari_hmrf.field.deformation import magnitude
from napari_hmrf.field.units import as_seen
from napari_hmrf.layers.field_layer import picture_of, source_of
from napari_hmrf.layers.image_result import Part, Result
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.read import look_of
from napari_hmrf.layers.result_layers import Overlay, PlacedSolution
from napari_hmrf.layers.thick_marks import half_widths, thickened
from napari_hmrf.layers.viewer_layers import layers_of
from napari_hmrf.posterior import Uncertainty
from napari_hmrf.results.animation import FOLD_MARKS, Moment, Motion
from napari_hmrf.results.comparison import Comparison
from napari_hmrf.results.tissue_point import Points
from napari_hmrf.ui.events import repeating
from napari_hmrf.ui.jobs import Jobs
from napari_hmrf.ui.result.result_messages import FULL

#: Duration of playing from 0 to 100 %, in seconds.
SECONDS = 2.0
#: Interval between two pictures while playing, in milliseconds.
_TICK = 40
#: Smallest step while playing, in percentage points.
_STEP = 2


class MovingLayers:
    """Layers of a result, which can be shown at any percentage of the deformation.

    The arrow length scales with the percentage. The user can change the arrow length in napari's
    layer controls.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    arrows : napari.layers.Vectors
        Arrow layer that stores the result.
    answer : PlacedSolution
        The result.
    layers : Result
        Layers of the result in the viewer.

    Attributes
    ----------
    overlay : Overlay, optional
        Overlay on the image.
    motion : Motion
        Image, overlay and arrows at each percentage.
    source : napari.layers.Image, optional
        Image that is deformed.
    image : ndarray, optional
        Copy of the pixels of `source`.
    percent : int
        Percentage of the deformation that is drawn.
    longest : float
        Largest displacement, in the unit of the answer.
    points : Points
        Displacement and strain at each point.
    estimated : Uncertainty, optional
        Uncertainty of the displacement, once it is estimated.
    """

    def __init__(self, viewer: Any, arrows: Any, answer: PlacedSolution, layers: Result) -> None:
        self.arrows, self.answer, self.layers = arrows, answer, layers
        self._viewer = viewer
        self.overlay: Overlay | None = None
        # Extent of the marks in the layer at 100 %, as returned by `half_widths`.
        self._widths: tuple[int, ...] = ()
        self.source = source_of(viewer.layers, answer)
        self.image: npt.NDArray[Any] | None = None
        self.motion = Motion(answer.solution)
        self.percent = FULL
        self.longest = float(magnitude(answer.solution.displacement).max(initial=0.0))
        self.points = Points(answer.solution)
        self.estimated: Uncertainty | None = None
        # Length of the arrows at 100 %, and percentage for which they are drawn.
        self._length, self._arrows_percent = arrows.length, FULL

    @property
    def visible_image(self) -> Any:
        """Layer of the deformed image if it is visible, else of the undeformed image, or None."""
        image = self.layers.layer("image")
        return image if image is not None and image.visible else self.source

    def copy_image(self) -> None:
        """Copy the current pixels of the image to deform.

        Raises
        ------
        HmrfError
            If the image cannot be read; the other layers can still be moved.
        """
        if self.source is not None:
            self.image = picture_of(self.source, self.answer)
            self.motion = Motion(self.answer.solution, self.image)

    def lay_over(self, made: Overlay | None, show: bool = False) -> None:
        """Set or remove the overlay, which moves with the tissue."""
        solution, self.overlay = self.answer.solution, made
        if made is None:
            self.layers.drop("overlay")
            self.motion = Motion(solution, self.image)
        else:
            thick = made.layer._replace(data=self._visible(made.layer.data))
            self._widths = half_widths(self._viewer, self.answer.frame)
            self.layers.put("overlay", thick, self.source, show)
            self.motion = made.motion(solution, self.image)

    def _visible(self, pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the pixels of an overlay; marks are thick enough to be seen."""
        if not self.has_marks:
            return pixels
        return thickened(pixels, half_widths(self._viewer, self.answer.frame))

    @property
    def has_marks(self) -> bool:
        """True if the overlay marks single sites."""
        return self.overlay is not None and self.overlay.name == FOLD_MARKS

    def refresh_marks(self) -> None:
        """Adapt the marks to the zoom at 100 %; at other percentages, the next picture does."""
        made, layer = self.overlay, self.layers.layer("overlay")
        widths = half_widths(self._viewer, self.answer.frame)
        if not self.has_marks or made is None or layer is None or self.percent != FULL:
            return
        if widths != self._widths:
            self._widths = widths
            layers_of(self._viewer).set_data(layer, thickened(made.layer.data, widths))

    def ready(self) -> bool:
        """Add the layer of the moving image, if needed; return whether any layer can move."""
        if self.image is not None:
            if self.layers.layer("image") is None:  # created undeformed
                look, name = look_of(self.source), self.source.name
                made = self.answer.layer("image", self.image, "deformed", look, source=name)
                made.attributes["metadata"][METADATA]["percent"] = 0
                self.layers.put("image", made, self.source)
            self.layers.set_wanted("image", True)
        return any(self.layers.layer(part) is not None for part in ("image", "overlay"))

    def draw(self, percent: int, moment: Moment) -> None:
        """Draw the layers at a percentage, except the arrows."""
        frame, parts = self.answer.frame, dict[Part, Any]()
        if moment.image is not None:
            parts["image"] = frame.put_image(moment.image)
        if moment.overlay is not None:
            parts["overlay"] = self._visible(frame.put_image(moment.overlay))
        if moment.grid is not None:
            parts["overlay"] = frame.put_vectors(moment.grid)
        self.layers.show_part(percent, parts)
        self.percent = percent

    @property
    def has_arrows(self) -> bool:
        """True if the layer of the arrows is visible and contains arrows."""
        arrows = self.layers.layer("arrows")
        return arrows is not None and bool(arrows.visible and arrows.data[:, 1].any())

    @property
    def times_as_long(self) -> float:
        """Ratio of the displayed length of the arrows to the displacement."""
        arrows = self.layers.layer("arrows")
        if arrows is None or not (self._arrows_percent and arrows.data[:, 1].any()):
            return 1.0
        return float(arrows.length) * FULL / self._arrows_percent

    def draw_arrows(self, percent: int) -> None:
        """Scale the displayed length of the arrows without changing their data."""
        before, self._arrows_percent = self._arrows_percent, percent
        if (arrows := self.layers.layer("arrows")) is not None:
            # The user may have changed the length.
            if before and arrows.length != self._length * before / FULL:
                self._length = arrows.length * FULL / before
            arrows.length = self._length * percent / FULL

    def draw_whole(self) -> None:
        """Draw the arrows at 100 %, because the other layers are at 100 % again."""
        self.percent = FULL
        self.draw_arrows(FULL)
        self.refresh_marks()


class Player:
    """Player for a deformation; the pictures are computed on the compute thread.

    Parameters
    ----------
    parent : QWidget
    jobs : Jobs
    shown : callable
        Returns the selected result, or None.

    Attributes
    ----------
    moved : Signal(int)
        Emitted with the next percentage while playing.
    playing_changed : Signal(bool)
        Emitted when playing starts or stops.
    drawn : Signal()
        Emitted when a picture has been drawn.
    """

    moved = Signal(int)
    playing_changed = Signal(bool)
    drawn = Signal()

    def __init__(self, parent: Any, jobs: Jobs, shown: Callable[[], MovingLayers | None]) -> None:
        self._jobs, self._shown = jobs, shown
        self._timer = repeating(parent, _TICK, self._on_tick)
        self._started = 0.0
        # Motion, percentage and pictures that are about to be drawn while playing.
        self._computed: tuple[Motion | None, int, Moment | None] = (None, 0, None)

    @property
    def playing(self) -> bool:
        """True while the deformation is played."""
        return bool(self._timer.isActive())

    def play(self) -> None:
        """Play back and forth from the current percentage until `stop` is called."""
        if (shown := self._shown()) is None or self.playing:
            return
        self._started = time.monotonic() - SECONDS * shown.percent / FULL
        self._timer.start()
        self.playing_changed.emit(True)

    def stop(self) -> None:
        """Stop playing at the current percentage."""
        if self.playing:
            self._timer.stop()
            self.playing_changed.emit(False)

    def show(self, percent: int) -> None:
        """Draw the arrows at a percentage, and the pictures after they have been computed."""
        if (shown := self._shown()) is None:
            return
        # Do not wait for the pictures, which take long in a volume.
        shown.draw_arrows(percent)
        if (moment := self._moment_of(shown, percent)) is not None:
            self._jobs.cancel("moment")
            self._draw(shown, percent, moment)
        else:
            work = partial(shown.motion.at, percent / FULL)
            self._jobs.submit("moment", work, partial(self._draw, shown, percent))

    def _draw(self, shown: MovingLayers, percent: int, moment: Moment) -> None:
        shown.draw(percent, moment)
        self.drawn.emit()

    def _moment_of(self, shown: MovingLayers, percent: int) -> Moment | None:
        """Return the pictures at a percentage if they have been computed, else None."""
        motion, known, moment = self._computed
        if motion is shown.motion and known == percent:
            return moment
        return shown.motion.cached(percent / FULL)

    def _on_computed(self, shown: MovingLayers, percent: int, moment: Moment) -> None:
        """Move the slider to a percentage, together with its pictures and arrows."""
        if self.playing and shown is self._shown():
            self._computed = shown.motion, percent, moment
            self.moved.emit(percent)
            self._computed = None, 0, None

    def _on_tick(self) -> None:
        # The slider moves only when the picture is computed, so that slider and picture agree.
        if (shown := self._shown()) is None or self._jobs.busy("moment"):
            return
        along = (time.monotonic() - self._started) / SECONDS % 2
        part = along if along <= 1 else 2 - along
        # Smallest step for which all pictures fit into the cache.
        step = max(_STEP, math.ceil(FULL * shown.motion.finest))
        percent = min(FULL, round(FULL * part / step) * step)
        if percent == shown.percent:
            return
        if self._moment_of(shown, percent) is not None:
            self.moved.emit(percent)
        else:
            work = partial(shown.motion.at, percent / FULL)
            self._jobs.submit("moment", work, partial(self._on_computed, shown, percent))


def how_far(
    result: PlacedSolution,
    longest: float,
    percent: int,
    compared: Comparison | None = None,
    *,
    is_before: bool = False,
) -> str:
    """Describe the displayed deformation, its slice, and its difference from a reference.

    `is_before` is True while the undeformed image is shown instead of the deformation.
    """
    far = as_seen(longest * percent / FULL, result.solution.spacing)
    where = f" in {result.frame.slice_seen}" if result.frame.slice_seen else ""
    distance = f"up to {far:.3g} {result.unit}{where}"
    moved = f"{percent} %: tissue moved {distance}"
    if is_before:
        moved = f"Shown undeformed; at {percent} %, tissue moves {distance}"
    if compared is None:
        return moved
    return f"{moved}. {compared.in_words(result.solution, result.unit)}"


def arrow_scale(times: float) -> str:
    """Return a clause about arrows that are longer or shorter than the displacement, or ""."""
    ratio = f"{times:.2g}"
    return "" if ratio == "1" else f"Arrows are drawn {ratio} times as long as the motion"

"""A drawing on top of the images of a problem, kept up to date."""

from __future__ import annotations

from napari_hmrf.tissue.drawing.canvas import Box, Canvas, box_of, common, is_empty, paint
from napari_hmrf.tissue.drawing.drawing import Drawing
from napari_hmrf.tissue.drawing.marks import Mark, Stroke


class Rendering:
    """The images with a drawing on top; an edit rewrites only the pixels it may have changed.

    Parameters
    ----------
    base : Canvas
        What is beneath the drawing; not changed, and not to be changed meanwhile.

    Attributes
    ----------
    canvas : Canvas
        The images with the drawing; written to in place.
    drawing : Drawing
        The one shown.
    """

    def __init__(self, base: Canvas) -> None:
        self._base = base
        self.canvas = base.copy()
        self.drawing = Drawing()

    def show(self, drawing: Drawing) -> Box | None:
        """Bring the images up to date.

        Parameters
        ----------
        drawing : Drawing

        Returns
        -------
        Box or None
            The pixels that may have changed: (first row, row after the last, first column, column
            after the last); None if none did.

        Raises
        ------
        ProblemError
            As `Drawing.render`; the images are then those of the drawing before.
        """
        window = self._changed(drawing)
        if window is None:
            self.drawing = drawing
            return None
        try:
            self._redraw(drawing, window)
        except Exception:
            self._redraw(self.drawing, window)
            raise
        self.drawing = drawing
        return window

    def _redraw(self, drawing: Drawing, window: Box) -> None:
        at = (slice(window[0], window[1]), slice(window[2], window[3]))
        base, canvas = self._base, self.canvas
        canvas.observed[at], canvas.confidence[at] = base.observed[at], base.confidence[at]
        if base.labels is not None and canvas.labels is not None:
            canvas.labels[at] = base.labels[at]
        if base.kinds is not None and canvas.kinds is not None:
            canvas.kinds[at] = base.kinds[at]
        for mark in drawing.marks:
            paint(mark, canvas, window)

    def _changed(self, drawing: Drawing) -> Box | None:
        """The box of all marks that are not in both drawings, at the same place in the order."""
        old, new = self.drawing.marks, drawing.marks
        shorter = min(len(old), len(new))
        first = next((i for i in range(shorter) if old[i] != new[i]), shorter)
        rest = shorter - first
        last = next((i for i in range(rest) if old[-1 - i] != new[-1 - i]), rest)
        gone, come = old[first : len(old) - last], new[first : len(new) - last]
        boxes = [box_of(mark, self.canvas) for mark in _differing(gone, come)]
        boxes = [box for box in boxes if not is_empty(box)]
        if not boxes:
            return None
        around = (
            min(box[0] for box in boxes),
            max(box[1] for box in boxes),
            min(box[2] for box in boxes),
            max(box[3] for box in boxes),
        )
        return common(around, self.canvas.whole)


def _differing(gone: tuple[Mark, ...], come: tuple[Mark, ...]) -> tuple[Mark, ...]:
    """The marks that differ; of a stroke that only went on, the part that is new."""
    match gone, come:
        case (Stroke() as before,), (Stroke() as after,) if after.action != "expand":
            added = after.added_to(before)
            if added is not None:
                return (added,)
    return (*gone, *come)

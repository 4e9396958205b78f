"""Overlay of a film: coloured pixels or lines that move with the tissue, with a legend."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.animation import Moment, Motion
from napari_hmrf.solver.backends.thread import compute_thread

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]
#: Smallest width and height of a frame with a legend, in pixels.
_LEAST_SIDE = 240
#: Size of the letters, and space around parts of the legend, in pixels.
_LETTERS, _SPACE = 13, 6
#: Width of the colour bar, and number of values beside it.
_BAR, _TICKS = 16, 5


@dataclass(frozen=True, eq=False)
class FilmOverlay:
    """Overlay on the frames of a film.

    Attributes
    ----------
    motion : Motion
        Overlay at each fraction of the motion, without the image.
    colours : callable
        Returns the colours, (..., 4) from 0 to 1, of values of the overlay.
    title : str
        Title of the legend.
    limits : (float, float), optional
        Ends of the colour scale; None for an overlay without a scale.
    line : tuple of float
        Colour of the lines of a grid, from 0 to 1.
    """

    motion: Motion
    colours: Callable[[Array], Array]
    title: str
    limits: tuple[float, float] | None = None
    line: tuple[float, ...] = (0.0, 1.0, 1.0)

    def blend(
        self, frames: Bytes, steps: Sequence[float], plane: tuple[int, int] | None
    ) -> tuple[Bytes, list[Array | None]]:
        """Return the frames in colour with the overlay, and the lines of each frame.

        Parameters
        ----------
        frames : ndarray of uint8, shape (N, H, W) or (N, H, W, 3)
        steps : sequence of float
            Fraction of the motion in each frame.
        plane : (int, int), optional
            Axis and index of the slice of a volume.
        """
        shown = frames if frames.ndim == 4 else np.repeat(frames[..., None], 3, axis=-1)
        made, lines = [], []
        for frame, step in zip(shown, steps, strict=True):
            moment: Moment = compute_thread.result_of(partial(self.motion.at, step), "drawing")
            values = moment.overlay
            if values is not None:
                if plane is not None:
                    values = values.take(plane[1], plane[0])
                frame = _over(frame, self.colours(values))
            made.append(frame)
            lines.append(moment.grid)
        return np.stack(made), lines

    def finish(self, frames: Bytes, lines: Sequence[Array | None], grid: tuple[int, int]) -> Bytes:
        """Enlarge small frames, and draw the lines and the legend.

        Parameters
        ----------
        frames : ndarray of uint8, shape (N, H, W, 3)
        lines : sequence of ndarray or None
            Segments, (M, 2, 2), as (start, direction) in pixels of the solution.
        grid : (int, int)
            Numbers of rows and columns of the solution.
        """
        times = math.ceil(max(1.0, *(_LEAST_SIDE / side for side in frames.shape[1:3])))
        large = frames.repeat(times, axis=1).repeat(times, axis=2)
        scale = np.array(large.shape[1:3]) / grid
        colour = tuple(round(255 * part) for part in self.line[:3])
        drawn = [
            frame if segments is None else _with_lines(frame, segments, scale, colour)
            for frame, segments in zip(large, lines, strict=True)
        ]
        return np.stack([self._with_legend(frame) for frame in drawn])

    def _with_legend(self, frame: Bytes) -> Bytes:
        """Return a frame with the title above it and the colour bar beside it."""
        from PIL import Image, ImageDraw, ImageFont  # heavy: PIL

        letters = ImageFont.load_default(_LETTERS)
        rows, cols = frame.shape[:2]
        beside = [] if self.limits is None else _ticks(self.limits)
        widest = max((letters.getlength(text) for text, _ in beside), default=0.0)
        width = cols + (round(_BAR + widest) + 4 * _SPACE if beside else 0)
        lines = _wrapped(self.title, lambda text: letters.getlength(text) <= width - 2 * _SPACE)
        above = len(lines) * (_LETTERS + _SPACE) + _SPACE
        page = Image.new("RGB", (width, above + rows))
        page.paste(Image.fromarray(frame), (0, above))
        draw = ImageDraw.Draw(page)
        draw.multiline_text((_SPACE, _SPACE), "\n".join(lines), "white", letters, spacing=_SPACE)
        if self.limits is not None:
            top, height = above + _LETTERS, rows - 2 * _LETTERS
            values = np.linspace(*self.limits[::-1], height)[:, None]
            black = np.zeros((height, 1, 3), np.uint8)
            bar = _over(black, self.colours(values)).repeat(_BAR, axis=1)
            page.paste(Image.fromarray(bar), (cols + _SPACE, top))
            for text, part in beside:
                at = (cols + 2 * _SPACE + _BAR, top + round((1 - part) * (height - 1)))
                draw.text(at, text, "white", letters, anchor="lm")
        return np.asarray(page)


def _over(frame: Bytes, colours: Array) -> Bytes:
    """Blend colours, (H, W, 4) from 0 to 1, over a frame."""
    part = colours[..., 3:]
    blended: Bytes = np.rint(frame * (1 - part) + 255 * colours[..., :3] * part).astype(np.uint8)
    return blended


def _with_lines(frame: Bytes, segments: Array, scale: Array, colour: tuple[int, ...]) -> Bytes:
    """Draw segments, (M, 2, 2) as (start, direction) in pixels, over a frame."""
    from PIL import Image, ImageDraw  # heavy: PIL

    page = Image.fromarray(frame)
    draw = ImageDraw.Draw(page)
    ends = (np.stack([segments[:, 0], segments.sum(axis=1)], axis=1) + 0.5) * scale
    for start, end in ends[..., ::-1].tolist():
        draw.line((*start, *end), colour)
    return np.asarray(page)


def _ticks(limits: tuple[float, float]) -> list[tuple[str, float]]:
    """Return the texts beside a colour bar, and their positions from 0 to 1."""
    low, high = limits
    parts = np.linspace(0, 1, _TICKS).tolist()
    return [(f"{low + part * (high - low):.3g}", part) for part in parts]


def _wrapped(text: str, fits: Callable[[str], bool]) -> list[str]:
    """Break a text between words into lines that fit."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and not fits(longer):
            lines.append(word)
        else:
            lines[-1] = longer
    return lines

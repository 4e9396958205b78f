"""Overlay of a film: coloured pixels or lines that move with the tissue, with a legend."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.results.animation import Moment, Motion

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]
#: Smallest width and height of the picture in a frame, in pixels.
_LEAST_SIDE = 240
#: Size of the letters, their mean width, height of a line, and space around parts, in pixels.
_LETTERS, _LETTER_WIDTH, _LINE, _SPACE = 12, 8, 18, 6
#: Width of the colour bar, and of the bar with its values, in pixels.
_BAR, _LEGEND = 16, 70
#: Pixels per inch: a power of two, so that sizes in inches are exact, and points per pixel.
_DPI = 64
_POINT = 72 / _DPI


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

    def draw(
        self,
        frames: Bytes,
        steps: Sequence[float],
        spacing: Sequence[float],
        plane: tuple[int, int] | None,
    ) -> Bytes:
        """Draw the overlay on each frame, with a legend; small frames are enlarged.

        Parameters
        ----------
        frames : ndarray of uint8, shape (N, H, W) or (N, H, W, 3)
        steps : sequence of float
            Fraction of the motion in each frame.
        spacing : sequence of float, shape (2,)
            Distance between rows, and between columns.
        plane : (int, int), optional
            Index of the slice of a volume, and its axis.

        Returns
        -------
        ndarray of uint8, shape (N, H', W', 3)
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # heavy: matplotlib
        from matplotlib.figure import Figure  # heavy: matplotlib
        from matplotlib.lines import Line2D  # heavy: matplotlib

        rows, cols = frames.shape[1:3]
        sides = np.array([rows, cols]) * spacing / min(spacing)
        rows_shown, cols_shown = np.rint(sides * math.ceil(max(1, _LEAST_SIDE / min(sides))))
        width = cols_shown + (0 if self.limits is None else _LEGEND)
        title = textwrap.fill(self.title, int(width) // _LETTER_WIDTH)
        height = rows_shown + (title.count("\n") + 1) * _LINE + _SPACE
        figure = Figure((width / _DPI, height / _DPI), _DPI, facecolor="black")
        canvas = FigureCanvasAgg(figure)
        figure.text(
            *(_SPACE / width, 1 - _SPACE / height, title),
            color="white",
            size=_LETTERS * _POINT,
            verticalalignment="top",
            parse_math=False,
        )
        axes = figure.add_axes((0, 0, cols_shown / width, rows_shown / height))
        axes.set_axis_off()
        picture = axes.imshow(frames[0], "gray", vmin=0, vmax=255, aspect="auto")
        overlay = axes.imshow(np.zeros((rows, cols, 4)), aspect="auto")
        lines = axes.add_line(Line2D([], [], color=self.line, linewidth=_POINT))
        if self.limits is not None:
            left, below = (cols_shown + _SPACE) / width, _LETTERS / height
            bar = figure.add_axes((left, below, _BAR / width, rows_shown / height - 2 * below))
            scale = self.colours(np.linspace(*self.limits, 256)[:, None])
            bar.imshow(scale, aspect="auto", origin="lower", extent=(0, 1, *self.limits))
            bar.set_facecolor("black")
            bar.set_xticks([])
            bar.yaxis.tick_right()
            bar.tick_params(colors="white", labelsize=_LETTERS * _POINT)
        drawn = []
        for frame, step in zip(frames, steps, strict=True):
            moment: Moment = compute_thread.result_of(partial(self.motion.at, step), "drawing")
            picture.set_data(frame)
            if moment.overlay is not None:
                values = moment.overlay
                overlay.set_data(self.colours(values if plane is None else values.take(*plane)))
            if moment.grid is not None:
                starts, directions = moment.grid.swapaxes(0, 1)
                breaks = np.full_like(starts, np.nan)  # one line is drawn faster than many
                points = np.stack([starts, starts + directions, breaks], axis=1).reshape(-1, 2)
                lines.set_data(points[:, 1], points[:, 0])
            canvas.draw()
            drawn.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        return np.stack(drawn)

"""Where landmarks begin and end: the points of two layers, or the ends of lines that were drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from napari.layers import Shapes

from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import View, unit_factor
from napari_hmrf.study.layer_names import LayerError

FloatArray = npt.NDArray[np.float64]

#: Shapes with two ends.
_LINES = ("line", "path")


@dataclass(frozen=True, eq=False)
class Ends:
    """One end of each landmark, in the order of a layer.

    Attributes
    ----------
    layer : napari.layers.Points or napari.layers.Shapes
    places : ndarray, shape (N, D)
        In the layer's own coordinates.
    what : {"point", "line"}
        What errors call them.
    """

    layer: Any
    places: FloatArray
    what: Literal["point", "line"] = "point"

    def in_pixels(self, frame: Frame) -> FloatArray:
        """Where they lie in the pixels of the layer a frame is of, shape (N, D).

        Raises
        ------
        ProblemError
            Naming the layer, if a place is no number or measured otherwise.
        """
        layer, places = self.layer, self.places
        bad = np.flatnonzero(~np.isfinite(places).all(axis=1))
        if len(bad):
            raise LayerError(layer, f"has NaN or infinity in {self.what} {bad[0]}. Remove it.")
        own = np.array([layer.data_to_world(place) for place in places], dtype=float)
        # Where they lack an axis they lie on the slice.
        matrix = np.array(frame.matrix)
        world = np.tile((matrix @ np.array([*frame.index, 1.0]))[:-1], (len(places), 1))
        shared = min(own.shape[1], frame.ndim)
        units = zip(layer.units[-shared:], frame.units[-shared:], strict=True)
        factors = np.array([unit_factor(str(unit), to) for unit, to in units])
        if not np.isfinite(factors).all():
            raise LayerError(
                layer, "is measured in other units than the image. Give both a unit of length."
            )
        world[:, -shared:] = own[:, -shared:] * factors
        placed: FloatArray = np.linalg.solve(
            matrix, np.concatenate([world, np.ones((len(world), 1))], axis=1).T
        ).T[:, :-1]
        return placed

    def on_slice(
        self, pixels: FloatArray, frame: Frame, view: View | None
    ) -> npt.NDArray[np.bool_]:
        """Which lie on the slice of the image; and on that shown, on axes it has not.

        Parameters
        ----------
        pixels : ndarray
            As `in_pixels`.
        frame : Frame
        view : View, optional
        """
        others = [axis for axis in range(frame.ndim) if axis not in frame.plane]
        here: npt.NDArray[np.bool_]
        here = (np.rint(pixels[:, others]) == np.array(frame.index)[others]).all(axis=1)
        extra = self.layer.ndim - frame.ndim
        if extra > 0 and view is not None:
            shown = np.array(Frame.of(self.layer, view).index)[:extra]
            here = here & (np.rint(self.places[:, :extra]) == shown).all(axis=1)
        return here


def ends_of(where: Any, should: Any) -> tuple[Ends, Ends]:
    """The two ends of every landmark.

    Parameters
    ----------
    where : napari.layers.Points or napari.layers.Shapes
    should : napari.layers.Points or None
        None with Shapes, whose lines lead from where things are to where they should be.

    Raises
    ------
    ProblemError
        Naming the layer: if two layers of points do not hold as many, or there are none, or
        a shape is no line.
    """
    if isinstance(where, Shapes):
        return _of_lines(where)
    if should is None:
        raise LayerError(
            where,
            "says where things are: choose another Points layer as 'should be at', or a Shapes "
            "layer of lines.",
        )
    if where is should:
        raise LayerError(
            where, "cannot be both where things are and where they should be. Choose two layers."
        )
    count, other = len(where.data), len(should.data)
    if count != other:
        points = "1 point" if other == 1 else f"{other} points"
        raise LayerError(
            should,
            f"has {points}, but '{where.name}' has {count}: they are paired by their "
            "order. Add or remove some.",
        )
    if not count:
        raise LayerError(where, "has no points. Add some, and as many to the other layer.")
    first, last = (Ends(each, np.asarray(each.data, dtype=float)) for each in (where, should))
    return first, last


def _of_lines(layer: Any) -> tuple[Ends, Ends]:
    """The first and the last place of every line."""
    for number, kind in enumerate(layer.shape_type):
        if kind not in _LINES:
            article = "an" if kind == "ellipse" else "a"
            raise LayerError(
                layer,
                f"has shape {number}, {article} {kind}, which leads nowhere. Draw lines, from "
                "where things are to where they should be; what a whole region does is painted in "
                "a Labels layer (its key 3 draws an outline).",
            )
    if not len(layer.data):
        raise LayerError(
            layer, "has no lines. Draw some, from where things are to where they should be."
        )
    first, last = (
        Ends(layer, np.array([line[end] for line in layer.data], dtype=float), "line")
        for end in (0, -1)
    )
    return first, last

"""Points of a layer, or its lines, as a value, and what was done to them in words."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from napari.layers import Shapes

#: What of each point is lost where napari is told of more or fewer points.
_EACH = ("features", "size", "symbol", "border_width")
_COLOURS = ("face_color", "border_color")
#: And of each line.
_EACH_LINE = ("features", "edge_width", "z_index")
_LINE_COLOURS = ("edge_color", "face_color")


@dataclass(frozen=True)
class Placed:
    """Where the points of a layer are; how each looked comes along, and makes no difference.

    Attributes
    ----------
    places : bytes
        Of their coordinates, exactly.
    shape : (int, int)
        Number of points, and of axes.
    look : dict
        What belongs to each point beside its place.
    """

    places: bytes
    shape: tuple[int, int]
    look: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def of(cls, layer: Any) -> Placed:
        """The points a layer holds."""
        data = np.asarray(layer.data, dtype=np.float64)
        look = _look(layer, _EACH, _COLOURS)
        return cls(data.tobytes(), (data.shape[0], data.shape[1]), look)

    @property
    def count(self) -> int:
        """How many there are."""
        return self.shape[0]

    def give_to(self, layer: Any) -> None:
        """Have a layer hold these points."""
        other = len(layer.data) != self.shape[0]
        layer.selected_data = set()
        layer.data = np.frombuffer(self.places).reshape(self.shape).copy()
        if other and self.shape[0]:
            for name, value in self.look.items():
                setattr(layer, name, value)

    def change(self, after: Placed, name: str) -> str:
        """What was done to the points of a layer of that name, in the past tense."""
        return _change(self.count, after.count, "point", name)


@dataclass(frozen=True)
class PlacedLines:
    """Where the lines of a Shapes layer lead; as `Placed`.

    Attributes
    ----------
    lines : tuple of (str, bytes)
        The kind of each, and the coordinates of its places, exactly.
    ndim : int
        Number of axes.
    look : dict
        What belongs to each line beside its places.
    """

    lines: tuple[tuple[str, bytes], ...]
    ndim: int
    look: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def of(cls, layer: Any) -> PlacedLines:
        """The lines, or other shapes, a layer holds."""
        lines = tuple(
            (str(kind), np.asarray(places, dtype=np.float64).tobytes())
            for kind, places in zip(layer.shape_type, layer.data, strict=True)
        )
        return cls(lines, layer.ndim, _look(layer, _EACH_LINE, _LINE_COLOURS))

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.lines)

    def give_to(self, layer: Any) -> None:
        """Have a layer hold these lines."""
        other = len(layer.data) != self.count
        layer.selected_data = set()
        layer.data = [
            (np.frombuffer(places).reshape(-1, self.ndim).copy(), kind)
            for kind, places in self.lines
        ]
        if other and self.count:
            for name, value in self.look.items():
                setattr(layer, name, value)

    def change(self, after: PlacedLines, name: str) -> str:
        """What was done to the lines of a layer of that name, in the past tense."""
        return _change(self.count, after.count, "line", name)


def placed_in(layer: Any) -> Placed | PlacedLines:
    """The points of a Points layer, or the lines of a Shapes layer."""
    return PlacedLines.of(layer) if isinstance(layer, Shapes) else Placed.of(layer)


def _look(layer: Any, each: tuple[str, ...], colours: tuple[str, ...]) -> dict[str, Any]:
    """What belongs to each point or line beside its place."""
    # Colours that follow the features come back with them.
    direct = [name for name in colours if str(getattr(layer, f"{name}_mode")) == "direct"]
    return {name: getattr(layer, name).copy() for name in (*each, *direct)}


def _change(before: int, after: int, thing: str, name: str) -> str:
    more = after - before
    if not more:
        return f"moved {thing}s of '{name}'"
    what = f"a {thing}" if abs(more) == 1 else f"{abs(more)} {thing}s"
    return f"added {what} to '{name}'" if more > 0 else f"removed {what} from '{name}'"

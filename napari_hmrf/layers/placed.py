"""The points of a Points layer as a value, and what was done to them in words."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

#: What of each point is lost where napari is told of more or fewer points.
_EACH = ("features", "size", "symbol", "border_width")
_COLOURS = ("face_color", "border_color")


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
        look = {name: getattr(layer, name).copy() for name in _EACH}
        # Colours that follow the features come back with them.
        direct = [name for name in _COLOURS if str(getattr(layer, f"{name}_mode")) == "direct"]
        look |= {name: getattr(layer, name).copy() for name in direct}
        return cls(data.tobytes(), (data.shape[0], data.shape[1]), look)

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
        more = after.shape[0] - self.shape[0]
        if not more:
            return f"moved points of '{name}'"
        what = "a point" if abs(more) == 1 else f"{abs(more)} points"
        return f"added {what} to '{name}'" if more > 0 else f"removed {what} from '{name}'"

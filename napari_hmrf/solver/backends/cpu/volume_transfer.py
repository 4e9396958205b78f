"""Transfer between the levels of a volume, in each layout."""

from __future__ import annotations

from napari_hmrf.solver.backends.cpu import volume
from napari_hmrf.solver.backends.cpu.layout import Layout, Values, flat, whole_starts


def restrict(fine: Values, of_fine: Layout, coarse: Values, of_coarse: Layout) -> None:
    """Apply the transpose of `volume.interpolate`."""
    places = of_coarse.starts, of_coarse.tissue
    volume.restrict(flat(fine), of_fine.starts, of_fine.stored, flat(coarse), *places)


def restrict_planes(fine: Values, coarse: Values) -> None:
    """Apply `restrict` to planes."""
    restrict(fine, Layout.whole(fine.shape[1:]), coarse, Layout.whole(coarse.shape[1:]))


def interpolate_planes(coarse: Values, fine: Values, inverse: Values) -> None:
    """Add the interpolated coarse correction to the components that move; all arrays are planes."""
    layout, starts = Layout.whole(fine.shape[1:]), whole_starts(coarse.shape[1:])
    arrays = flat(coarse), starts, flat(fine), layout.starts, flat(inverse)
    volume.interpolate(*arrays, layout.tissue)

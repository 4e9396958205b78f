"""Functions that activate the *Pull* tool on a slice, and on a whole volume."""

from tests.support.screen import Screen


def pull(widget, settle):
    """Activate the *Pull* tool and wait until it is ready."""
    if not widget.active:
        Screen(widget).press("Pull")
    assert widget.active
    settle(widget)
    return widget


def pull_volume(person, widget, settle, *, depth=None, ndisplay=2):
    """Deform the whole volume, show it in a slice or a 3-D view, and activate *Pull*.

    The model stays elastic, although the small patches of the tests fold tissue.

    Parameters
    ----------
    person : Person or Touch
    widget : SoftTissue
    settle : callable
        Waits until the result of the last edit is drawn.
    depth : float, optional
        World coordinate of the visible slice; by default, the slice does not change.
    ndisplay : int
        2 for a slice, 3 for the 3-D view.
    """
    dims = person.viewer.dims
    if depth is not None:
        dims.set_point(0, depth)
    widget.unfolds = False
    Screen(widget).choose("the whole volume")
    dims.ndisplay = ndisplay
    settle(widget)
    return person, pull(widget, settle)

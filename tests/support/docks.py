"""Functions that open, configure and inspect docks of the package."""

from dataclasses import replace

from napari.layers import Layer
from napari.layers._source import layer_source


def dock_in(viewer):
    """Open the dock beside a viewer, as its menu entry does."""
    return viewer.window.add_plugin_dock_widget("napari-hmrf", "Soft tissue")[1]


def quick(dock):
    """Set a dock to a few sweeps of the paper's model on the CPU, with live mode off."""
    dock.device = "cpu"
    dock.model = "paper"
    forget_choice(dock)
    dock.settings = replace(dock.settings, sweeps=3)
    dock.live = False
    return dock


def forget_choice(dock):
    """Remove the choice of a model from the undo history."""
    session, chosen = dock.session, dock.session.model
    session.drop(lambda part: part.kind == "model")
    session.choose_model(chosen, step=False)


def open_sample(viewer, layers):
    """Add the layers of a sample to a viewer, as its menu entry does."""
    with layer_source(sample=("tests", f"sample above {len(viewer.layers)} layers")):
        return [viewer.add_layer(Layer.create(*each)) for each in layers]


def viewer_of(dock):
    """Return the viewer that a dock belongs to."""
    return dock._viewer
